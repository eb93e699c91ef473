"""``r3dpa fit`` that is stopped, killed, or whose disk is full, and what goes on from there."""

from __future__ import annotations

import shutil
import signal
from functools import partial

import pytest
import torch
from fault_commands import (
    STEPS,
    At,
    assert_whole,
    cut,
    fill,
    fit_words,
    kill_worker,
    last,
    limit_files,
    pause,
)

STEP = "r3dpa.modules.VAEAlignment.training_step"
TERMINATE, INTERRUPT = (
    partial(signal.raise_signal, number) for number in (signal.SIGTERM, signal.SIGINT)
)


def assert_same_training(run_dir, other):
    """Weights, averages, buffers and optimiser, bit by bit."""
    ours, theirs = (torch.load(last(path), weights_only=True) for path in (run_dir, other))
    assert ours["global_step"] == theirs["global_step"] == STEPS
    states = [(run["state_dict"], run["optimizer_states"][0]["state"]) for run in (ours, theirs)]
    torch.testing.assert_close(*states, rtol=0, atol=0)


def step_of(path):
    return torch.load(path, weights_only=True)["global_step"]


@pytest.fixture
def goes_on(ended, scans_folder, undisturbed):
    """``goes_on(run_dir)``: the same command, with ``--ckpt_path last``, ends as if undisturbed."""

    def run(run_dir, *more, scans=scans_folder):
        status, seen = ended(fit_words(scans, run_dir, "--ckpt_path", "last", *more))
        assert status == 0, seen
        assert_same_training(run_dir, undisturbed)
        assert assert_whole(run_dir) >= 2
        assert not list(run_dir.rglob(".*.partial.*"))

    return run


class TestStopped:
    def test_between_two_batches_of_a_step(self, scans_folder, tmp_path, ended, goes_on):
        """In the first of the two batches of step 3: it waits for the second."""
        words = fit_words(scans_folder, tmp_path / "run")
        status, seen = ended(words, At(STEP, TERMINATE, call=5))
        assert status == 143
        says = "stopped by SIGTERM after step 3: the same command goes on with --ckpt_path "
        assert f"{says}{last(tmp_path / 'run')}\n" in seen
        assert "Traceback" not in seen
        assert step_of(last(tmp_path / "run")) == 3
        assert_whole(tmp_path / "run")
        goes_on(tmp_path / "run")

    def test_ctrl_c_saves_too(self, scans_folder, tmp_path, ended):
        words = fit_words(scans_folder, tmp_path / "run")
        status, seen = ended(words, At(STEP, INTERRUPT, call=3))
        assert status == 130, seen
        assert "stopped by SIGINT after step 2: the same command goes on" in seen
        assert "Traceback" not in seen
        assert step_of(last(tmp_path / "run")) == 2

    @pytest.mark.slow
    def test_a_second_ctrl_c_ends_at_once(self, scans_folder, tmp_path, ended):
        words = fit_words(scans_folder, tmp_path / "run")
        twice = (
            At(STEP, INTERRUPT, call=3),
            At(STEP, INTERRUPT, call=3),
        )
        status, seen = ended(words, *twice)
        assert status == 1, seen  # that of Lightning
        assert "stopped by" not in seen

    @pytest.mark.slow
    def test_while_a_checkpoint_is_written(self, scans_folder, tmp_path, ended, goes_on):
        words = fit_words(scans_folder, tmp_path / "run")
        status, seen = ended(words, At("torch.save", TERMINATE))
        assert status == 143, seen
        assert "stopped by SIGTERM after step 2" in seen
        assert step_of(last(tmp_path / "run")) == 2
        goes_on(tmp_path / "run")

    @pytest.mark.slow
    def test_in_a_validation(self, scans_folder, tmp_path, ended, goes_on):
        """It ends after the next batch, not after minutes; the rest is validated on resuming."""
        more = ["--trainer.limit_val_batches=4", "--trainer.val_check_interval=6"]
        more += ["--data.init_args.val_every=2", "--data.init_args.batch_size=1"]
        calm = tmp_path / "calm"
        assert ended(fit_words(scans_folder, calm, *more))[0] == 0
        words = fit_words(scans_folder, tmp_path / "run", *more)
        validation = "r3dpa.modules.VAEAlignment.validation_step"
        status, seen = ended(words, At(validation, TERMINATE, call=2))
        assert status == 143, seen
        assert step_of(last(tmp_path / "run")) == 3
        status, seen = ended([*words, "--ckpt_path", "last"])
        assert status == 0, seen
        assert_same_training(tmp_path / "run", calm)


@pytest.mark.slow
class TestKilled:
    @pytest.mark.parametrize("call", [1, 6])
    def test_between_checkpoints(self, call, scans_folder, tmp_path, ended, goes_on):
        """Before the first one, too: ``last`` then means from the start."""
        words = fit_words(scans_folder, tmp_path / "run")
        status, _ = ended(words, At(STEP, partial(signal.raise_signal, signal.SIGKILL), call=call))
        assert status == -signal.SIGKILL
        assert_whole(tmp_path / "run")
        assert last(tmp_path / "run").exists() == (call > 1)
        goes_on(tmp_path / "run")

    @pytest.mark.parametrize("save", [1, 4])
    def test_with_half_a_checkpoint_written(self, save, scans_folder, tmp_path, ended, goes_on):
        """Each saving writes two files, ``step=...`` and ``last``."""
        words = fit_words(scans_folder, tmp_path / "run")
        status, seen = ended(words, At("torch.save", partial(limit_files, 100_000), call=save))
        assert status == -signal.SIGXFSZ, seen
        (half,) = (tmp_path / "run").rglob(".*.partial.ckpt")
        assert half.stat().st_size == 100_000
        assert_whole(tmp_path / "run")
        if save == 4:
            assert step_of(last(tmp_path / "run")) == 2
        goes_on(tmp_path / "run")

    def test_worker(self, scans_folder, tmp_path, ended, goes_on):
        words = fit_words(scans_folder, tmp_path / "run")
        words += ["--data.init_args.num_workers=1"]
        status, seen = ended(words, At(STEP, kill_worker, call=6))
        assert status == 1
        assert "DataLoader worker" in seen
        assert_whole(tmp_path / "run")
        goes_on(tmp_path / "run")


@pytest.mark.slow
class TestDisk:
    def test_full_while_a_checkpoint_is_written(self, scans_folder, small_disk, ended, goes_on):
        """The disk of the run, which is not that of temporary files."""
        disk = small_disk(64_000_000)
        run_dir = disk / "run"
        full = At("torch.save", partial(fill, disk, 100_000), call=4)
        status, seen = ended(fit_words(scans_folder, run_dir), full)
        assert status == 1
        assert f"No space left on device: '{last(run_dir)}'" in seen
        assert step_of(last(run_dir)) == 2
        assert_whole(run_dir)
        assert not list(run_dir.rglob(".*.partial.*"))
        (disk / "filler").unlink()
        goes_on(run_dir)

    def test_read_only(self, scans_folder, small_disk, make_read_only, ended):
        disk = small_disk(1_000_000)
        make_read_only(disk)
        status, seen = ended(fit_words(scans_folder, disk / "run"))
        assert status == 1
        assert f"Read-only file system: '{disk / 'run'}'" in seen


@pytest.mark.slow
def test_a_second_run_is_refused(scans_folder, tmp_path, start, ended, undisturbed):
    run_dir = tmp_path / "run"
    first = start(fit_words(scans_folder, run_dir), At(STEP, partial(pause, tmp_path), call=2))
    first.wait_for((tmp_path / "reached").exists)
    status, seen = ended(fit_words(scans_folder, run_dir, "--ckpt_path", "last"))
    assert status == 1
    assert f"another process ({first.pid} on " in seen
    assert f"runs r3dpa fit in {run_dir}: wait for it" in seen
    (tmp_path / "go").touch()
    assert first.end()[0] == 0
    assert_same_training(run_dir, undisturbed)


@pytest.mark.slow
@pytest.mark.parametrize(("kept", "says"), [(None, "No such file"), (90, "not a multiple")])
def test_scans_lost_between_index_and_read(kept, says, own_scans, tmp_path, ended, goes_on):
    """All of them are, in the step after a checkpoint; then they are back."""
    saved = tmp_path / "saved"
    shutil.copytree(own_scans, saved)
    words = fit_words(own_scans, tmp_path / "run")
    status, seen = ended(
        words, *(At(STEP, partial(cut, path, kept), call=5) for path in own_scans.iterdir())
    )
    assert status == 1
    assert f"{own_scans}/0" in seen.splitlines()[-1]
    assert says in seen.splitlines()[-1]
    assert_whole(tmp_path / "run")
    shutil.copytree(saved, own_scans, dirs_exist_ok=True)
    goes_on(tmp_path / "run", scans=own_scans)

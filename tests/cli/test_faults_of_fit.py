"""``r3dpa fit`` that is stopped, killed, or whose disk is full, and what goes on from there."""

from __future__ import annotations

import os
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

from r3dpa.cli import main

pytestmark = pytest.mark.faults
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
def faulty(ended, scans_folder, tmp_path):
    """``faulty(*faults)``: a run with faults; its folder, exit status, and what the user saw."""

    def run(*faults, more=()):
        run_dir = tmp_path / "run"
        result = run_dir, *ended(fit_words(scans_folder, run_dir, *more), *faults)
        assert_whole(run_dir)
        return result

    return run


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
    def test_a_stop_signal_ends_the_run_after_its_step(self, faulty, goes_on):
        """Once in the second step, and resumed in the first of the two batches of the third."""
        stops = ((INTERRUPT, 3, 130, "SIGINT", 2), (TERMINATE, 1, 143, "SIGTERM", 3))
        for fault, call, number, name, step in stops:
            more = ["--ckpt_path", "last"] if step == 3 else []
            run_dir, status, seen = faulty(At(STEP, fault, call), more=more)
            assert status == number, seen
            says = f"stopped by {name} after step {step}: the same command goes on with --ckpt_path"
            assert f"{says} {last(run_dir)}\n" in seen
            assert "Traceback" not in seen
            assert step_of(last(run_dir)) == step
        goes_on(run_dir)

    @pytest.mark.slow
    def test_a_stop_signal_lets_a_checkpoint_be_written(self, faulty, goes_on):
        run_dir, status, _ = faulty(At("torch.save", TERMINATE, 1))
        assert (status, step_of(last(run_dir))) == (143, 2)
        goes_on(run_dir)

    @pytest.mark.slow
    def test_a_second_ctrl_c_ends_at_once(self, faulty):
        _, status, seen = faulty(*2 * [At(STEP, INTERRUPT, call=3)])
        assert status == 1, seen  # that of Lightning
        assert "stopped by" not in seen

    @pytest.mark.slow
    def test_a_stop_signal_ends_a_validation_after_its_batch(
        self, scans_folder, tmp_path, ended, faulty
    ):
        """It ends after the next batch, not after minutes; the rest is validated on resuming."""
        more = ["--trainer.limit_val_batches=4", "--trainer.val_check_interval=6"]
        more += ["--data.init_args.val_every=2", "--data.init_args.batch_size=1"]
        calm = tmp_path / "calm"
        assert ended(fit_words(scans_folder, calm, *more))[0] == 0
        validation = "r3dpa.modules.VAEAlignment.validation_step"
        run_dir, status, seen = faulty(At(validation, TERMINATE, call=2), more=more)
        assert status == 143, seen
        assert step_of(last(run_dir)) == 3
        status, seen = ended(fit_words(scans_folder, run_dir, *more, "--ckpt_path", "last"))
        assert status == 0, seen
        assert_same_training(run_dir, calm)


@pytest.mark.slow
class TestKilled:
    @pytest.mark.parametrize("call", [1, 6])
    def test_a_run_killed_between_checkpoints_goes_on(self, call, faulty, goes_on):
        """Before the first one, too: ``last`` then means from the start."""
        run_dir, status, _ = faulty(At(STEP, partial(signal.raise_signal, signal.SIGKILL), call))
        assert status == -signal.SIGKILL
        assert last(run_dir).exists() == (call > 1)
        goes_on(run_dir)

    @pytest.mark.parametrize("save", [1, 4])
    def test_a_run_killed_with_half_a_checkpoint_goes_on(self, save, faulty, goes_on):
        """Each saving writes two files, ``step=...`` and ``last``."""
        run_dir, status, seen = faulty(At("torch.save", partial(limit_files, 100_000), save))
        assert status == -signal.SIGXFSZ, seen
        (half,) = run_dir.rglob(".*.partial.ckpt")
        assert half.stat().st_size == 100_000
        if save == 4:
            assert step_of(last(run_dir)) == 2
        goes_on(run_dir)

    def test_a_run_whose_loader_process_was_killed_goes_on(self, faulty, goes_on):
        more = ["--data.init_args.num_workers=1"]
        run_dir, status, seen = faulty(At(STEP, kill_worker, call=6), more=more)
        assert status == 1
        assert "DataLoader worker" in seen
        goes_on(run_dir)


@pytest.mark.slow
class TestDisk:
    def test_a_full_disk_leaves_the_checkpoint_before(
        self, scans_folder, small_disk, ended, goes_on
    ):
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

    def test_a_read_only_run_dir_is_refused(self, scans_folder, small_disk, make_read_only, ended):
        disk = small_disk(1_000_000)
        make_read_only(disk)
        status, seen = ended(fit_words(scans_folder, disk / "run"))
        assert status == 1
        assert f"Read-only file system: '{disk / 'run'}'" in seen


@pytest.mark.slow
def test_a_second_fit_into_one_folder_is_refused(scans_folder, tmp_path, start, ended, undisturbed):
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
def test_scans_lost_between_index_and_read_end_the_run(
    kept, says, own_scans, tmp_path, ended, goes_on
):
    """All of them are, in the step after a checkpoint; then they are back."""
    saved = tmp_path / "saved"
    shutil.copytree(own_scans, saved)
    words = fit_words(own_scans, tmp_path / "run")
    lost = (At(STEP, partial(cut, path, kept), call=5) for path in own_scans.iterdir())
    status, seen = ended(words, *lost)
    assert status == 1
    assert f"{own_scans}/0" in seen.splitlines()[-1]
    assert says in seen.splitlines()[-1]
    assert_whole(tmp_path / "run")
    shutil.copytree(saved, own_scans, dirs_exist_ok=True)
    goes_on(tmp_path / "run", scans=own_scans)


READERS = {
    **{
        f"fit {key}": lambda ckpt, out, scans, key=key: fit_words(scans, out, key, ckpt)
        for key in ("--ckpt_path", "--model.init_args.init_from")
    },
    "test": lambda ckpt, out, scans: ["test", *fit_words(scans, out, "--ckpt_path", ckpt)[1:]],
    "sample": lambda ckpt, out, scans: ["sample", "--ckpt", ckpt, "--out", out],
    "convert": lambda ckpt, out, scans: ["convert", ckpt, out.with_suffix(".safetensors")],
}


@pytest.mark.parametrize(
    ("reader", "is_empty"), [*((r, False) for r in READERS), ("convert", True)]
)
def test_a_checkpoint_cut_short_is_refused_before_anything_is_written(
    reader, is_empty, scans_folder, tmp_path
):
    ckpt = tmp_path / "last.ckpt"
    torch.save({"state_dict": {"weight": torch.zeros(1000)}}, ckpt)
    words = READERS[reader](ckpt, tmp_path / "out", scans_folder)
    os.truncate(ckpt, 0 if is_empty else ckpt.stat().st_size - 1)
    with pytest.raises(ValueError, match=f"cannot read {ckpt}: .*damaged"):
        main([str(word) for word in words])
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path != ckpt]

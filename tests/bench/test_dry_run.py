"""What `fit --dry_run` prints of a training, and that it writes nothing."""

from types import SimpleNamespace

import pytest
import torch

from r3dpa.bench import dry_run as dry_run_module
from r3dpa.bench.dry_run import DryRun, batch_lines
from r3dpa.bench.training import StageCost, StepSettings
from r3dpa.cli import main, stages
from r3dpa.data import LidarDataModule


def dry_run(words, capsys):
    main([*words, "--dry_run"])
    return dict(line.partition(": ")[::2] for line in capsys.readouterr().out.splitlines())


def test_a_dry_run_measures_a_step_and_writes_nothing(smoke_args, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = smoke_args("vae_alignment", tmp_path / "run", "--trainer.accumulate_grad_batches=2")
    lines = dry_run([*words, "--trainer.max_steps=100000000"], capsys)
    assert lines["global batch"] == "4 = 2 per process x 1 processes x 2 accumulated"
    assert lines["steps"] == "100,000,000"
    assert "s per step of 4 scans in each process" in lines["time"]
    assert " s per step of 1, in " in lines["measured"]
    assert "years on this machine" in lines["warning"] or "days on this" in lines["warning"]
    assert lines["memory"].endswith("of the process with 1 scan per step, more with 4")
    assert lines["disk"].startswith("feature grids of 512 bytes per scan, 6.14 kB")  # 2 x 8 x 16
    assert not list(tmp_path.iterdir())


def test_a_dry_run_of_checkpoints(smoke_args, tmp_path, vae_checkpoint, capsys):
    """Beside the weights of a checkpoint lie both moments of those that are trained."""
    words = smoke_args("vae_alignment", tmp_path / "run", "--trainer.max_steps=-1")
    main([*words, "--dry_run"])  # which measures no step without a limit
    (line,) = (x for x in capsys.readouterr().out.splitlines() if "checkpoints of" in x)
    megabytes = float(line.partition("2 checkpoints of ")[2].split()[0])
    assert megabytes == pytest.approx(vae_checkpoint.stat().st_size / 1e6, rel=0.05)


def test_a_dry_run_counts_checkpoints_that_all_stay(smoke_args, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(DryRun, "_measure", lambda *_: StageCost("joint", step_seconds=[1.0]))
    words = smoke_args("joint", tmp_path / "run", "--trainer.max_steps=9")
    words += ["--checkpoint.save_top_k=-1", "--checkpoint.every_n_train_steps=4"]
    main([*words, "--dry_run"])
    assert "disk: 3 checkpoints of" in capsys.readouterr().out


def test_a_dry_run_knows_the_size_of_images_before_they_exist(
    smoke_args, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(DryRun, "_measure", lambda *_: StageCost("vae", step_seconds=[1.0]))
    words = smoke_args("vae_alignment", tmp_path / "run")
    words += ["--data=r3dpa.data.SimulatedImageDataModule"]
    words += [f"--data.init_args.root={tmp_path / 'images'}", "--data.init_args.extractor=null"]
    words += ["--model.init_args.weights.vae_alignment=0"]
    main([*words, "--dry_run"])
    assert "disk: 12 scans, 24.6 kB\n" in capsys.readouterr().out  # in float16


@pytest.mark.parametrize(
    ("instructions", "precision"), [("AVX2", "32-true"), ("AVX512", "bf16-mixed")]
)
def test_a_processor_without_bfloat16_trains_in_float32(
    instructions, precision, smoke_args, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: instructions)
    assert not stages._runs_without_bfloat16(SimpleNamespace(accelerator="cpu"))  # as chosen
    cost = StageCost("vae_alignment", step_seconds=[1.0])  # the steps are measured in other tests
    monkeypatch.setattr(DryRun, "_measure", lambda *_: cost)
    words = smoke_args("vae_alignment", tmp_path / "run", "--trainer.precision=bf16-mixed")
    lines = dry_run([*words, "--trainer.accelerator=auto"], capsys)
    assert f"thread, {precision}" in lines["measured"].replace("threads", "thread")


def test_a_baseline_keeps_no_snapshots(tmp_path, capsys):
    """Though the callback that keeps them is in the common trainer."""
    words = ["fit", "r2dm", "--preset", "demo", "--run_dir", str(tmp_path / "run")]
    main([*words, "--trainer.max_steps=-1", "--dry_run"])
    printed = capsys.readouterr().out
    assert "checkpoints of" in printed
    assert "snapshots" not in printed


@pytest.mark.parametrize(
    ("processes", "batch_size", "warning"),
    [
        (4, 8, ""),
        (8, 8, ": give --data.init_args.batch_size 4"),
        (1, 8, ": give --data.init_args.batch_size 32"),
        (6, 8, "warning: the paper trains with a global batch of 32"),
    ],
)
def test_another_batch_than_the_papers_is_announced(processes, batch_size, warning):
    module, trainer = SimpleNamespace(stage="joint"), SimpleNamespace(world_size=processes)
    trainer.accumulate_grad_batches = 1
    data = SimpleNamespace(batch_size=batch_size, dataset="KITTI-360")
    first, *others = batch_lines(module, data, trainer)
    assert first.startswith(f"global batch: {processes * batch_size} = 8 per process")
    assert len(others) == bool(warning)
    assert "".join(others).endswith(warning)
    data.dataset = None
    assert batch_lines(module, data, trainer) == [first]


def test_a_dry_run_is_of_a_fit(capsys):
    with pytest.raises(SystemExit):
        main(["validate", "joint", "--dry_run"])
    assert "--dry_run is an option of r3dpa fit" in capsys.readouterr().err


def test_a_dry_run_sees_scans_as_the_sensor_of_the_run(monkeypatch):
    """A checkpoint to start from is compared with them."""
    measured = []
    monkeypatch.setattr(dry_run_module, "measure_steps", lambda *given, **_: measured.append(given))
    data = LidarDataModule("scans", sensor="vlp16", image_columns=64)
    module = SimpleNamespace(sit=SimpleNamespace(feature_dim=16))
    DryRun(module, data, None)._measure(StepSettings())
    ((_, scans, _),) = measured
    assert scans.known_projection == data.known_projection

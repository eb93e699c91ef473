"""Options shared by all tests."""

from __future__ import annotations

import gc
import json
import logging
import os
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import nn

from lidarsim import simulate
from r3dpa.cli import main
from r3dpa.io import only_writer

# Lightning keeps its messages from caplog where it is imported before there is any handler.
logging.getLogger().addHandler(logging.NullHandler())
gc.disable()  # a tenth of the time of collecting is spent on modules that all stay


def pytest_addoption(parser):
    parser.addoption(
        "--parity-dir",
        type=Path,
        default=None,
        help="folder with cases.json and the .npz files of golden numbers "
        "(default: the shared folder where it is present, else the synthetic files)",
    )


def pytest_ignore_collect(collection_path, config):
    """Micro-benchmarks are collected for `-m bench` alone; helpers have no doctests."""
    name = collection_path.name
    is_helper = name.endswith(".py") and not name.startswith(("test_", "bench_"))
    wanted = config.getoption("markexpr") == "bench"
    return True if is_helper or (name.startswith("bench_") and not wanted) else None


def pytest_collection_finish():
    gc.enable()
    gc.freeze()
    gc.set_threshold(10_000)  # parsers make many small objects and few cycles


REPOSITORY = Path(__file__).resolve().parents[1]
CONF = REPOSITORY / "conf"
THIN_DECODER = {
    "latent_channels": 4,
    "channels": 32,
    "channel_multipliers": [1, 1, 1],
    "strides": [[2, 2], [2, 2]],
    "num_res_blocks": 0,
}

CSV_LOGGER = {
    "class_path": "lightning.pytorch.loggers.CSVLogger",
    "init_args": {"save_dir": "", "name": ""},
}


@pytest.fixture(scope="session")
def real_scans_dir(pytestconfig) -> Path:
    """Folder of the real scans, beside the repository or beside the ``--parity-dir``."""
    given = pytestconfig.getoption("--parity-dir")
    shared = [REPOSITORY.parent / "shared"] + ([] if given is None else [given.resolve().parent])
    folders = [folder / "data" / "real_scans" for folder in shared]
    for folder in folders:
        if any(folder.rglob("*.bin")):
            return folder
    pytest.skip(f"no real scan in {' or '.join(map(str, folders))} (KITTI, not redistributed)")


@pytest.fixture(scope="session")
def make_once(tmp_path_factory):
    """``make_once(name, make)``: folder that the first process in need of it fills.

    All processes of one `pytest -n` share it; ``make(folder)`` runs in one of them.
    """
    top = tmp_path_factory.getbasetemp()
    top = top.parent if "PYTEST_XDIST_WORKER" in os.environ else top

    def folder_of(name: str, make: Callable[[Path], object]) -> Path:
        folder, done = top / name, top / f"{name}.done"
        with only_writer(top / f"{name}.lock", f"makes {folder}", wait=True):
            if not done.exists():
                make(folder)
                done.touch()
        return folder

    return folder_of


@pytest.fixture(scope="session")
def smoke_root(make_once) -> Path:
    """Root of the simulated scans of conf/smoke.yaml."""
    return make_once("smoke", lambda root: simulate(root, 12))


@pytest.fixture(scope="session")
def smoke_args(smoke_root):
    """``smoke_args(stage, run_dir, *more)``: command line that trains a stage at smoke size."""

    def arguments(stage: str, run_dir: Path, *more: str) -> list[str]:
        configs = [CONF / "trainer.yaml", CONF / "experiment" / f"{stage}.yaml"]
        words = [word for path in [*configs, CONF / "smoke.yaml"] for word in ("--config", path)]
        words += ["--data.init_args.root", smoke_root, "--run_dir", run_dir]
        if stage == "few_step":
            words += ["--model.init_args.sit.init_args.average_blocks=1"]
            words += [f"--model.init_args.thin_decoder.init_args={json.dumps(THIN_DECODER)}"]
            words += ["--model.init_args.trajectories=6"]
        return ["fit", *map(str, words), *more]

    return arguments


@pytest.fixture(scope="session")
def trained_once(smoke_args, make_once):
    """``trained_once(stage, *more)``: last checkpoint of a stage at smoke size, with log."""

    def checkpoint(stage: str, *more: str) -> Path:
        words = [f"--trainer.logger={json.dumps([CSV_LOGGER])}", *more]
        run_dir = make_once(stage, lambda folder: main(smoke_args(stage, folder, *words)))
        return run_dir / "checkpoints" / "last.ckpt"

    return checkpoint


@pytest.fixture(scope="session")
def vae_checkpoint(trained_once) -> Path:
    """Checkpoint of the VAE-alignment stage at smoke size, trained for three steps."""
    return trained_once("vae_alignment")


@pytest.fixture(scope="session")
def flow_checkpoint(trained_once, vae_checkpoint) -> Path:
    """Checkpoint of the flow-matching stage at smoke size, trained for three steps."""
    return trained_once("flow_matching", "--model.init_args.init_from", str(vae_checkpoint))


@pytest.fixture(scope="session")
def joint_run(smoke_args, vae_checkpoint, make_once):
    """Run of the joint stage, with W&B, whose last and averaged weights have moved apart."""
    more = ["--model.init_args.optimizer.lr=1e-2", "--model.init_args.ema_decay=0.5"]
    more += ["--model.init_args.init_from", str(vae_checkpoint)]

    def make(run_dir: Path) -> None:
        import wandb

        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("WANDB_MODE", "offline")
            main(smoke_args("joint", run_dir, *more))
        wandb.finish()  # or the next logger of this process would join the run

    return make_once("joint", make)


@pytest.fixture
def one_thread():
    """So that processes may be forked, and loader processes and the suite share few cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def unchanged(points):
    return points


class ScaledPoints(nn.Module):
    """Extractor whose features are the points times a gain; counts the scans it is given."""

    name = "scaled"
    dim = 4
    prepare = staticmethod(unchanged)

    def __init__(self, gain=1.0, fail_after=None):
        super().__init__()
        self.settings = {"gain": gain}
        self.fail_after = fail_after
        self.calls = 0

    def point_features(self, prepared):
        features = []
        for points in prepared:
            self.calls += 1
            if self.fail_after is not None and self.calls > self.fail_after:
                raise RuntimeError("interrupted")
            features.append(points * self.settings["gain"])
        return features

    def forward(self, points):
        return self.point_features([self.prepare(points)])[0]


@pytest.fixture
def until_logged(caplog):
    """``until_logged(words)``: waits half a minute at most for a thread to log these words."""

    def wait(words: str) -> None:
        end = time.monotonic() + 30
        while words not in caplog.text:
            assert time.monotonic() < end, f"{words!r} was not logged"
            time.sleep(0.001)

    return wait


@pytest.fixture
def scaled_points():
    """The extractor class."""
    return ScaledPoints


@pytest.fixture
def small_disk(tmp_path):
    """``small_disk(num_bytes)``: folder of a disk of its own, in memory, of that size."""
    folder = tmp_path / "disk"

    def make(num_bytes: int) -> Path:
        folder.mkdir()
        _mount("-t", "tmpfs", "-o", f"size={num_bytes}", "tmpfs", folder)
        return folder

    yield make
    if folder.is_mount():
        subprocess.run(["umount", "--lazy", folder], check=True)


@pytest.fixture
def make_read_only():
    """``make_read_only(disk)``: nothing can be written to a disk of ``small_disk`` any more."""
    return lambda disk: _mount("-o", "remount,ro", disk)


def _mount(*words):
    try:
        subprocess.run(["mount", *map(str, words)], check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"this user may not mount a disk in memory: {getattr(error, 'stderr', error)}")

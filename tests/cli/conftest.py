"""Commands in processes of their own, their scans, and a checkpoint of random weights."""

from dataclasses import replace

import numpy as np
import pytest
from fault_commands import Command, fit_words
from tiny_baselines import fit_words as baseline_words
from tiny_networks import tiny_checkpoint

from r3dpa.callbacks import scene_scoring
from r3dpa.cli import main
from r3dpa.metrics import scene


@pytest.fixture(scope="session")
def joint_checkpoint(joint_run):
    return joint_run / "checkpoints" / "last.ckpt"


@pytest.fixture(scope="session")
def tiny_file(tmp_path_factory):
    """Checkpoint of random weights for images of 16 x 64, without a training."""
    path = tmp_path_factory.mktemp("tiny") / "tiny.safetensors"
    return tiny_checkpoint(path, step=3, feature_source="geometric")


@pytest.fixture(scope="session")
def baseline_once(smoke_root, make_once):
    """``baseline_once(stage)``: last checkpoint of a tiny baseline, trained for three steps."""

    def checkpoint(stage, *more):
        words = ["fit", stage, smoke_root]
        folder = make_once(stage, lambda run_dir: main(baseline_words(*words, run_dir, *more)))
        return folder / "checkpoints" / "last.ckpt"

    return checkpoint


@pytest.fixture(scope="module")
def coarse_protocols():
    """Cells of half a metre: a hundredth of the work."""
    coarse = {p.name: replace(p, voxel_m=0.5) for p in (scene.DEFAULT, scene.PUBLISHED)}
    with pytest.MonkeyPatch.context() as patch:
        for module in (scene, scene_scoring):
            patch.setattr(module, "PROTOCOLS", coarse)
        yield


@pytest.fixture
def start(tmp_path):
    """``start(words, *faults)``: a command on its way."""
    started = []

    def run(words, *faults) -> Command:
        started.append(Command(tmp_path / f".log_{len(started)}", words, *faults))
        return started[-1]

    return run


@pytest.fixture
def ended(start):
    """``ended(words, *faults)``: exit status of a command and what the user saw."""
    return lambda words, *faults: start(words, *faults).end()


def write_scans(folder):
    folder.mkdir()
    generator = np.random.default_rng(0)
    points = generator.uniform((2, 2, 2, 0), (20, 20, 20, 1), (8, 200, 4)).astype(np.float32)
    for index, scan in enumerate(points):
        (folder / f"{index:06d}.bin").write_bytes(scan.tobytes())
    return folder


@pytest.fixture(scope="session")
def scans_folder(tmp_path_factory):
    """Eight small scans in a folder."""
    return write_scans(tmp_path_factory.mktemp("faults") / "scans")


@pytest.fixture
def own_scans(tmp_path):
    """The same scans, to be damaged."""
    return write_scans(tmp_path / "scans")


@pytest.fixture(scope="session")
def undisturbed(scans_folder, tmp_path_factory):
    """Folder of a run without faults."""
    run_dir = tmp_path_factory.mktemp("undisturbed")
    words = fit_words(scans_folder, run_dir / "run")
    assert Command(run_dir / ".log", words).end()[0] == 0
    return run_dir / "run"

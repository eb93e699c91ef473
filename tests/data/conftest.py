"""Small scans for the tests of r3dpa.data."""

import numpy as np
import pytest
import torch
from lightning.pytorch import LightningModule, Trainer

from r3dpa.data import LidarDataModule
from r3dpa.geometry import LidarSensor, SphericalProjection


def random_points(seed, count=300):
    generator = np.random.default_rng(seed)
    direction = generator.normal(size=(count, 3)) * (1, 1, 0.1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = direction * generator.uniform(2, 50, (count, 1))
    return np.concatenate([points, generator.uniform(0, 1, (count, 1))], 1).astype(np.float32)


@pytest.fixture
def sensor():
    return LidarSensor(beams=8, columns=32)


@pytest.fixture
def projection(sensor):
    return SphericalProjection(sensor)


@pytest.fixture
def make_scans():
    """Function that writes `count` different scans into a folder."""

    def make(folder, count, seed=0):
        folder.mkdir(parents=True, exist_ok=True)
        for frame in range(count):
            path = folder / f"{frame:010d}.bin"
            if not path.exists():
                path.write_bytes(random_points(1000 * seed + frame).tobytes())
        return folder

    return make


@pytest.fixture
def files_of():
    """Function that gives the bytes of each file below a folder, but of locks."""

    def files(folder):
        paths = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
        return {str(path.relative_to(folder)): path.read_bytes() for path in paths}

    return files


class Recorder(LightningModule):
    """Keeps the batches that it is trained and validated on; draws from the global state."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.trained, self.validated = [], []

    @property
    def seen(self):
        return [batch["index"].tolist() for batch in self.trained]

    def training_step(self, batch, batch_idx):
        self.trained.append(batch)
        return (self.weight - torch.rand(())) ** 2

    def validation_step(self, batch, batch_idx):
        torch.rand(())
        self.validated.append(batch)

    def predict_step(self, batch, batch_idx):
        return batch

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


@pytest.fixture
def trainer(tmp_path):
    """Function that makes a trainer for some steps."""

    def make(max_steps, *callbacks, **options):
        return Trainer(
            default_root_dir=tmp_path,
            max_steps=max_steps,
            accelerator="cpu",
            logger=False,
            enable_checkpointing=bool(callbacks),
            enable_progress_bar=False,
            enable_model_summary=False,
            callbacks=list(callbacks),
            **options,
        )

    return make


@pytest.fixture
def fit(trainer):
    """Function that trains a recorder on a data module."""

    def run(data, max_steps, *callbacks, ckpt_path=None, **options):
        module = Recorder()
        trainer(max_steps, *callbacks, **options).fit(module, data, ckpt_path=ckpt_path)
        return module

    return run


@pytest.fixture
def recorder():
    """The module class."""
    return Recorder


@pytest.fixture
def data(tmp_path, make_scans, sensor):
    """Function that makes a data module of 11 scans, one of them held out."""
    folder = make_scans(tmp_path / "scans", 11)

    def build(**options):
        defaults = {"batch_size": 2, "val_every": 11, "grid_size": (2, 4)}
        return LidarDataModule(str(folder), sensor=sensor, **defaults | options)

    return build


@pytest.fixture(autouse=True)
def _one_thread(one_thread):
    """For every test here."""

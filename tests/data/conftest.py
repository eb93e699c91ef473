"""Small scans and a small extractor for the tests of r3dpa.data."""

from __future__ import annotations

import numpy as np
import pytest
from torch import nn

from r3dpa.geometry import LidarSensor


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
def scaled_points():
    """The extractor class."""
    return ScaledPoints


@pytest.fixture
def files_of():
    """Function that gives the bytes of each file below a folder, but of locks."""

    def files(folder):
        paths = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
        return {str(path.relative_to(folder)): path.read_bytes() for path in paths}

    return files


@pytest.fixture(autouse=True)
def _one_thread(one_thread):
    """For every test here."""

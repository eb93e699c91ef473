"""Scans and data sets of the micro-benchmarks; one thread, so that runs can be compared."""

import pytest
import torch

from lidarsim import Street, hdl64e, simulate, simulate_scan
from lidarsim.scene import Conditions


@pytest.fixture(scope="session")
def points():
    """A scan ``(P, 4)`` of a dry street."""
    scan = simulate_scan(Street(0, 2, Conditions()).scene(40), hdl64e(), (0, "effects", 2, 40))
    return torch.from_numpy(scan.points)


@pytest.fixture(scope="session")
def data_root(tmp_path_factory):
    """Eight simulated scans."""
    root = tmp_path_factory.mktemp("bench") / "scans"
    simulate(root, scans=8)
    return root


@pytest.fixture
def alone(one_thread):
    """No gradients."""
    with torch.inference_mode():
        yield

"""Scans and data sets of the micro-benchmarks; one thread, so that runs can be compared."""

from __future__ import annotations

import pytest
import torch

from r3dpa.simulation import Street, Weather, hdl64e, simulate, simulate_scan

STREET = (0, 2, 40)  # seed, drive, scan


def pytest_ignore_collect(collection_path, config):
    """Micro-benchmarks are collected for `make bench` alone."""
    wanted = config.getoption("markexpr") == "bench"
    return True if collection_path.name.startswith("bench_") and not wanted else None


@pytest.fixture(scope="session")
def points():
    """A scan ``(P, 4)`` of a dry street."""
    seed, drive, number = STREET
    scene = Street(seed, drive, Weather()).scene(number)
    return torch.from_numpy(simulate_scan(scene, hdl64e(), (seed, "effects", drive, number)).points)


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

"""Updates on CUDA tensors without a device: nothing of the CPU is mixed in, and nothing waits.

Two kinds of update must wait for the device: the checks of values that come from outside, which
are left out here, and the cells of a cloud, whose number is known only when they are there.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode
from torch.fx.experimental.symbolic_shapes import ShapeEnv

from r3dpa.geometry import LidarSensor
from r3dpa.metrics import functional, functional_bev
from r3dpa.metrics.distances import (
    BEVHistogramDistance,
    MinimumMatchingDistance,
    RangeHistogramDistance,
)
from r3dpa.metrics.feature_distances import (
    FrechetDistance,
    FrechetInfinity,
    PolynomialMMD,
    PrecisionRecall,
)
from r3dpa.metrics.scene import DEFAULT

PROTOCOL = replace(DEFAULT, sensor=LidarSensor(beams=8, columns=32), voxel_m=1.0)
KINDS = {
    "frechet": lambda: FrechetDistance(4),
    "inf": lambda: FrechetInfinity(4),
    "kid": lambda: PolynomialMMD(4),
    "shares": lambda: PrecisionRecall(4),
    "mmd": lambda: MinimumMatchingDistance(PROTOCOL, max_real=1, max_generated=1),
    "ranges": lambda: RangeHistogramDistance(56.0, num_groups=3),
}


def getitem(values, index):
    """Indexing by operators: that of Python asks for a CUDA build."""
    dim, tensors = 0, []
    for part in index if isinstance(index, tuple) else (index,):
        if isinstance(part, torch.Tensor):
            tensors.append(part)
        elif part is None:
            values = values.unsqueeze(dim)
            dim += 1
        elif isinstance(part, int):
            values = values.select(dim, part)
        else:
            values = torch.ops.aten.slice(values, dim, part.start, part.stop)
            dim += 1
    return torch.ops.aten.index(values, tensors) if tensors else values


def setitem(values, index, new):
    torch.ops.aten.index_put_(values, list(index), new)


@pytest.fixture
def unchecked(monkeypatch):
    monkeypatch.setattr(torch.Tensor, "__getitem__", getitem)
    monkeypatch.setattr(torch.Tensor, "__setitem__", setitem)
    monkeypatch.setattr(functional, "checked_features", lambda x, *_: x.double())
    monkeypatch.setattr(functional_bev, "_checked_points", lambda x, _: x)


@pytest.mark.parametrize("name", KINDS)
def test_updates_stay_on_the_device(unchecked, name):
    with FakeTensorMode():
        with torch.device("cuda"):
            metric = KINDS[name]()
        shape = (2, 8, 32) if name in ("mmd", "ranges") else (2, 4)
        for real in (True, False):
            for _ in range(40):
                metric.update(torch.zeros(shape, device="cuda"), real=real)
        for state in metric._defaults:
            value = getattr(metric, state)
            for part in value if isinstance(value, list) else [value]:
                assert part.device.type == "cuda", state


def test_cells_stay_on_the_device(monkeypatch, unchecked):
    """The number of occupied cells is a symbol, and so nothing may read it."""
    monkeypatch.setattr(functional_bev.BEVGrid, "kept", lambda self, points, name: points)
    with FakeTensorMode(shape_env=ShapeEnv()):
        with torch.device("cuda"):
            metric = BEVHistogramDistance(PROTOCOL.grid, num_groups=3)
        for real in (True, False):
            metric.update([torch.zeros(5, 3, device="cuda")] * 2, real=real)
        assert metric.real_bins.device.type == "cuda"


def test_a_wait_or_a_tensor_of_the_cpu_would_be_seen():
    with FakeTensorMode():
        values = torch.zeros(2, device="cuda")
        with pytest.raises(DataDependentOutputException):
            values.sum().item()
        with pytest.raises(RuntimeError, match="two devices"):
            values + torch.zeros(2)

"""Metric updates never wait for a GPU and never mix devices, see ``one_device``.

Left out: the checks of values that come from outside, and the histogram of bird's eye view cells,
whose number of occupied cells is known only after a synchronisation.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from one_device import OneDevice

from r3dpa.geometry import LidarSensor
from r3dpa.metrics import functional
from r3dpa.metrics.distances import MinimumMatchingDistance, RangeHistogramDistance
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


@pytest.mark.parametrize("name", KINDS)
def test_updates_stay_on_the_device(monkeypatch, name):
    monkeypatch.setattr(functional, "checked_features", lambda x, *_: x.double())
    with torch.device("meta"):
        metric = KINDS[name]()
    shape = (2, 8, 32) if name in ("mmd", "ranges") else (2, 4)
    with OneDevice():
        for real in (True, False):
            for _ in range(40):
                metric.update(torch.zeros(shape, device="meta"), real=real)
    for state in metric._defaults:
        value = getattr(metric, state)
        for part in value if isinstance(value, list) else [value]:
            assert part.device.type == "meta", state

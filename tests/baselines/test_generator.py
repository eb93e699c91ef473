"""Scenes of baselines: what a network returns that is no number."""

import math
from types import SimpleNamespace

import pytest
import torch

from r3dpa.baselines.generator import BaselineGenerator
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection

GEOMETRY = ScanGeometry(SphericalProjection(LidarSensor(4, 8)), RangeCodec(), (2, 2))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_scene_with_a_pixel_that_is_no_number_is_none(value):
    image = torch.zeros(2, 1, 4, 8)
    image[1, 0, 2, 3] = value
    generator = object.__new__(BaselineGenerator)
    generator.baseline = SimpleNamespace(decode=lambda latents: latents)
    generator.geometry, generator.calls = GEOMETRY, 1
    finite = generator.decode(image).isfinite().flatten(1)
    assert finite.all(dim=1).tolist() == [True, False]
    assert not finite[1].any()

"""Scenes of baselines: solvers that they take, and what a network returns that is no number."""

import math
from types import SimpleNamespace

import pytest
import torch
from velocities import growth

from r3dpa.baselines import baseline_generator
from r3dpa.baselines.diffusion_paths import StepPath
from r3dpa.baselines.generator import BaselineGenerator
from r3dpa.baselines.lidm import LiDM, released_times
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection

GEOMETRY = ScanGeometry(SphericalProjection(LidarSensor(4, 8)), RangeCodec(), (2, 2))


def test_average_velocities_are_refused():
    checkpoint = SimpleNamespace(stage="r2dm", path="a.ckpt", geometry={})
    with pytest.raises(ValueError, match=r"average_velocity needs .* a\.ckpt is of stage r2dm"):
        baseline_generator(checkpoint, SamplerConfig("average_velocity", 4))


def test_lidm_solves_with_the_solver_and_the_shift_that_are_given():
    """The list of the released code is for its own two solvers."""
    path, noise = StepPath(), torch.ones(4, 1)
    for change in ({"solver": "heun"}, {"solver": "ddim", "shift": 2.0}):
        config = LiDM.published.changed(steps=20, **change)
        plain = SamplerConfig(config.solver, 20, shift=config.shift)
        found, expected = (c.solve(growth, noise, iter(()), path) for c in (config, plain))
        assert torch.equal(found, expected)
    with pytest.raises(ValueError, match="cannot take 1500 of 1000 steps"):
        released_times(1500)


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

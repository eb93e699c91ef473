"""Sampling with each solver never waits for a GPU and never mixes devices, see ``one_device``."""

from __future__ import annotations

from typing import get_args

import pytest
import torch
from one_device import OneDevice
from tiny_networks import tiny_networks

from r3dpa.editing.latents import invert, noise_inside_mask, restore_outside_mask, slerp
from r3dpa.flow import FeatureGuidance, FeatureTarget, heun, ode_times
from r3dpa.flow.sampler import Solver
from r3dpa.generation import Autoguidance, SamplerConfig, SceneGenerator
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection

SENSOR = LidarSensor(beams=16, columns=64, range_min_m=2.0, range_max_m=40.0)
GEOMETRY = ScanGeometry(SphericalProjection(SENSOR), RangeCodec("log2"), (2, 8))
# An adaptive solver has to read its error estimate.
SOLVERS = get_args(Solver)


def generator(sampler, path="linear", guided=False):
    vae, sit, norm = tiny_networks()
    guidance = None
    if guided:
        weak = tiny_networks()[1].to("meta")
        shift = torch.zeros(4, device="meta")
        guidance = Autoguidance(weak, 2.0, latent_scale=1.2, latent_shift=shift)
    scenes = SceneGenerator(vae, sit, norm, GEOMETRY, sampler, path, autoguidance=guidance)
    for network in (vae, sit, norm):
        network.to("meta")
    return scenes


@pytest.mark.parametrize(
    ("solver", "path"),
    [
        *((solver, "linear") for solver in SOLVERS if solver != "average_velocity"),
        ("unipc", "cosine"),
        ("euler_maruyama", "cosine"),
    ],
)
def test_sampling(solver, path):
    scenes = generator(SamplerConfig(solver, 4), path)
    with OneDevice():
        result = scenes.generate(2)
    assert {result.latents.device.type, result.range_m.device.type} == {"meta"}
    assert result.range_m.shape == (2, 16, 64)


def test_autoguided_sampling():
    scenes = generator(SamplerConfig("ab2", 4), guided=True)
    with OneDevice():
        assert scenes.generate(2).nfe == 8


def test_feature_guidance_with_gradients():
    sit = tiny_networks()[1].to("meta").requires_grad_(False)
    x = torch.zeros(2, 4, 4, 16, device="meta")
    target = FeatureTarget(torch.randn(2, 16, 8))
    guidance = FeatureGuidance(sit.velocity, sit.aligned_pass, target, scale=0.5, relative=True)
    for name, values in vars(guidance).items():  # its constructor reads which tokens are selected
        if isinstance(values, torch.Tensor):
            setattr(guidance, name, values.to("meta"))
    with OneDevice():
        assert heun(guidance, x, ode_times(3)).device.type == "meta"
    assert len(guidance.history) == 5


@pytest.mark.parametrize("solver", ["midpoint", "unipc"])
def test_inversion_and_inpainting(solver):
    sit = tiny_networks()[1].to("meta")
    x = torch.zeros(2, 4, 4, 16, device="meta")
    mask = torch.zeros(1, 1, 4, 16, dtype=torch.bool, device="meta")
    with OneDevice():
        trajectory = invert(sit.velocity, x, ode_times(3), solver)
        start = noise_inside_mask(trajectory, mask, slerp(x, x, 0.5))
        assert restore_outside_mask(trajectory, mask)(start, 0.0, 3).shape == x.shape


@pytest.mark.parametrize(
    "fault",
    [
        lambda x: x.sum().item(),
        lambda x: bool((x > 0).any()),
        lambda x: x[x > 0],
        lambda x: x.tolist(),
        lambda x: x + torch.zeros(3),
        lambda x: x @ torch.zeros(3, 3),
        lambda x: torch.where(torch.ones(3, dtype=torch.bool), x, 0.0),
    ],
)
def test_each_fault_is_found(fault):
    with OneDevice(), pytest.raises((AssertionError, RuntimeError, NotImplementedError)):
        fault(torch.zeros(3, device="meta"))

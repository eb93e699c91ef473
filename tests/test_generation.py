"""Scenes depend on (seed, index) alone; network evaluations, precision and geometry of the result.

A fresh SiT predicts zero velocity and a fresh decoder a nearly constant image, so all weights are
drawn at random here: scenes then differ from each other, and hold pixels with and without return.
"""

from __future__ import annotations

import pytest
import torch

from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection, points_of
from r3dpa.nn import VAE, LatentNorm, SiT

SENSOR = LidarSensor(beams=16, columns=64, range_min_m=2.0, range_max_m=40.0)
GEOMETRY = ScanGeometry(SphericalProjection(SENSOR), RangeCodec(), (2, 8))
LATENT_SHAPE = (4, 4, 16)
ODE, SDE = SamplerConfig("heun", steps=3), SamplerConfig("euler_maruyama", steps=4)


def networks():
    torch.manual_seed(0)
    vae = VAE(
        latent_channels=4,
        channels=32,
        channel_multipliers=(1, 1, 1),
        strides=((2, 2), (2, 2)),
        num_res_blocks=1,
    )
    sit = SiT(
        input_size=LATENT_SHAPE[1:],
        in_channels=LATENT_SHAPE[0],
        hidden_size=32,
        depth=2,
        num_heads=2,
        alignment_depth=1,
        feature_dim=8,
        projector_dim=8,
    )
    with torch.no_grad():
        for parameter in sit.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
        vae.decoder.conv_out.weight.mul_(3)
    norm = LatentNorm(4)
    norm.update(1.0 + 2.0 * torch.randn(8, *LATENT_SHAPE))
    return vae, sit, norm


def generator(sampler=ODE, precision="fp32", geometry=GEOMETRY, path="linear"):
    return SceneGenerator(*networks(), geometry, sampler, path, precision)


def stand_still(latents, time):
    return torch.zeros_like(latents)


@pytest.mark.parametrize("sampler", [ODE, SDE], ids=["ode", "sde"])
def test_a_scene_does_not_depend_on_its_batch(sampler):
    """Other batch sizes sum in another order: float32 rounding over four steps stays below 1e-5.

    The decoder turns 1e-5 in the latents into less than 1e-3 m.
    """
    scenes = generator(sampler)
    whole = scenes.generate(range(8), seed=3)
    for size in (1, 3):
        parts = [scenes.generate(range(8)[i : i + size], seed=3) for i in range(0, 8, size)]
        latents = torch.cat([part.latents for part in parts])
        range_m = torch.cat([part.range_m for part in parts])
        torch.testing.assert_close(latents, whole.latents, atol=1e-5, rtol=0)
        torch.testing.assert_close(range_m, whole.range_m, atol=1e-3, rtol=0)
    shuffled = scenes.generate([5, 2], seed=3)
    torch.testing.assert_close(shuffled.latents, whole.latents[[5, 2]], atol=1e-5, rtol=0)


@pytest.mark.parametrize("sampler", [ODE, SDE], ids=["ode", "sde"])
def test_other_indices_and_seeds_give_other_scenes(sampler):
    scenes = generator(sampler)
    first, second = scenes.generate([0, 1], seed=0), scenes.generate([0, 1], seed=1)
    every = torch.cat([first.latents, second.latents])
    distance = torch.cdist(every.flatten(1), every.flatten(1)) / every[0].numel() ** 0.5
    assert (distance + 9 * torch.eye(4) > 0.5).all()
    assert torch.equal(first.latents, scenes.generate([0, 1], seed=0).latents)


def test_the_noise_is_standard_normal_and_unrelated_between_scenes():
    """256 numbers: mean within 4 / 16, standard deviation within 4 / sqrt(2 * 256) of 1.

    (seed, index) = (1, 2) and (2, 1) are other scenes.
    """
    scenes = generator(SamplerConfig("euler", steps=1))
    scenes.sit.velocity = stand_still
    keys = [(0, 0), (1, 2), (2, 1), (1_000_000, 0)]
    draws = torch.stack([scenes.generate([i], seed).latents.flatten() for seed, i in keys])
    assert draws.mean(dim=1).abs().max() < 4 / 16
    assert (draws.std(dim=1) - 1).abs().max() < 4 / 512**0.5
    correlation = torch.corrcoef(draws) - torch.eye(len(keys))
    assert correlation.abs().max() < 4 / 16


def test_global_random_state_is_neither_read_nor_moved():
    scenes = generator(SDE)
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = scenes.generate([0])
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    assert torch.equal(scenes.generate([0]).latents, first.latents)


@pytest.mark.parametrize(
    ("solver", "steps", "evaluations"),
    [("euler", 5, 5), ("heun", 5, 9), ("heun", 1, 1), ("euler_maruyama", 5, 5)],
)
def test_network_evaluations(solver, steps, evaluations):
    """Heun evaluates twice per step but in the last; the batch is evaluated at once."""
    scenes = generator(SamplerConfig(solver, steps))
    calls = []
    velocity = scenes.sit.velocity
    scenes.sit.velocity = lambda *inputs: calls.append(1) or velocity(*inputs)
    assert scenes.generate(range(2)).nfe == len(calls) == evaluations


def test_exact_velocity_leads_to_the_data():
    """With the velocity (x - data) / t of a single datum, Euler ends at it after any steps."""
    scenes = generator(SamplerConfig("euler", steps=7))
    data = torch.randn(1, *LATENT_SHAPE, generator=torch.Generator().manual_seed(5))
    scenes.sit.velocity = lambda latents, time: (latents - data) / time[:, None, None, None]
    found = scenes.generate([0, 1])
    torch.testing.assert_close(found.latents, data.expand(2, -1, -1, -1), atol=1e-5, rtol=0)
    with torch.no_grad():
        image = scenes.vae.decode(scenes.latent_norm.denormalise(data))[:, 0]
    expected = GEOMETRY.codec.decode(image, SENSOR)
    torch.testing.assert_close(found.range_m, expected.expand(2, -1, -1), atol=1e-3, rtol=0)


def test_the_sde_follows_the_path_of_the_sampler():
    """Where the velocity is 0 the SDE drift, t times minus the score, is x or (cosine) t x.

    Evaluations are at t = 1, 0.52 and 0.04: the first step is the same, the second differs by
    ``-0.48 (1 - 0.52) x``.
    """
    states = {"linear": [], "cosine": []}
    for path, seen in states.items():
        scenes = generator(SamplerConfig("euler_maruyama", steps=3), path=path)
        scenes.sit.velocity = lambda latents, time, seen=seen: (
            seen.append(latents) or stand_still(latents, time)
        )
        scenes.generate([0])
    linear, cosine = states["linear"], states["cosine"]
    assert torch.equal(linear[0], cosine[0])
    torch.testing.assert_close(linear[1], cosine[1], atol=1e-5, rtol=0)
    torch.testing.assert_close(
        linear[2] - cosine[2], -0.48 * (1 - 0.52) * linear[1], atol=1e-5, rtol=0
    )


def test_unfitted_statistics_are_refused():
    vae, sit, _ = networks()
    with pytest.raises(ValueError, match=r"never fitted.*joint or flow_matching"):
        SceneGenerator(vae, sit, LatentNorm(4), GEOMETRY)


def test_unknown_solver_is_refused():
    with pytest.raises(ValueError, match=r"euler, heun or euler_maruyama, got 'dopri5'"):
        SamplerConfig("dopri5")


def test_bf16_is_close_to_fp32():
    """bf16 keeps 8 bits: 0.4 % per operation. State, latents and ranges stay float32."""
    full, half = (generator(ODE, precision).generate(range(2)) for precision in ("fp32", "bf16"))
    assert half.latents.dtype == half.range_m.dtype == torch.float32
    assert not torch.equal(half.latents, full.latents)
    torch.testing.assert_close(half.latents, full.latents, atol=0.05, rtol=0.02)
    both = (full.range_m > 0) & (half.range_m > 0)
    assert ((full.range_m > 0) == (half.range_m > 0)).float().mean() > 0.95
    assert (full.range_m - half.range_m)[both].abs().mean() < 0.5


@pytest.mark.parametrize("encoding", ["linear", "log2"])
def test_ranges_are_empty_or_within_the_limits(encoding):
    geometry = ScanGeometry(SphericalProjection(SENSOR), RangeCodec(encoding), (2, 8))
    scenes = generator(geometry=geometry).generate(range(3))
    assert scenes.range_m.shape == (3, SENSOR.beams, SENSOR.columns)
    assert scenes.latents.shape == (3, *LATENT_SHAPE)
    assert scenes.range_m.dtype == torch.float32
    empty = scenes.range_m == -1
    inside = (scenes.range_m > SENSOR.range_min_m) & (scenes.range_m < SENSOR.range_max_m)
    assert (empty | inside).all()
    assert empty.any()
    assert inside.any()


def test_points_lie_on_the_rays_of_their_pixels():
    scene = generator().generate([0]).range_m[0]
    points = points_of(scene, GEOMETRY.projection)
    row, column = GEOMETRY.projection.pixel_of(points)
    torch.testing.assert_close(scene[row, column], points.norm(dim=1), atol=1e-4, rtol=0)
    assert len(points) == (scene > 0).sum()
    assert len(torch.unique(row * SENSOR.columns + column)) == len(points)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("sampler", [ODE, SDE], ids=["ode", "sde"])
def test_cuda_draws_the_scenes_of_the_cpu(sampler, monkeypatch):
    """The draws come from the CPU; other kernels round in another order, without TF32."""
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    vae, sit, norm = networks()
    on_cpu = SceneGenerator(vae, sit, norm, GEOMETRY, sampler).generate(range(3), seed=1)
    parts = (part.cuda() for part in (vae, sit, norm))
    on_gpu = SceneGenerator(*parts, GEOMETRY, sampler).generate(range(3), seed=1)
    assert on_gpu.range_m.device.type == "cuda"
    torch.testing.assert_close(on_gpu.latents.cpu(), on_cpu.latents, atol=1e-4, rtol=0)

"""Scenes depend on (seed, index) alone; network evaluations, precision and geometry of the result.

A fresh SiT predicts zero velocity and a fresh decoder a nearly constant image, so all weights are
drawn at random here: scenes then differ from each other, and hold pixels with and without return.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from tiny_networks import SIT_ARGS, VAE_ARGS, tiny_checkpoint, tiny_networks

import r3dpa
from r3dpa.checkpoints import (
    Checkpoint,
    NetworkState,
    convert,
    read_checkpoint,
    save_checkpoint,
)
from r3dpa.flow import (
    Interpolant,
    PerturbedAttention,
    average_times,
    euler_maruyama,
    ode_solver,
    ode_times,
    sde_times,
)
from r3dpa.flow.noise import scene_random
from r3dpa.generation import Autoguidance, SamplerConfig, SceneGenerator
from r3dpa.geometry import (
    LidarSensor,
    RangeCodec,
    ScanGeometry,
    SphericalProjection,
    points_of,
    range_image,
)
from r3dpa.nn import VAE, LatentNorm, ThinDecoder
from r3dpa.nn.perturbed_attention import velocity_and_perturbed

SENSOR = LidarSensor(beams=16, columns=64, range_min_m=2.0, range_max_m=40.0)
GEOMETRY = ScanGeometry(SphericalProjection(SENSOR), RangeCodec(), (2, 8))
WIDE = SphericalProjection(replace(SENSOR, columns=128))
LATENT_SHAPE = (4, 4, 16)
ODE, SDE = SamplerConfig("heun", steps=3), SamplerConfig("euler_maruyama", steps=4)


def generator(sampler=ODE, precision="fp32", geometry=GEOMETRY, path="linear"):
    return SceneGenerator(*tiny_networks(), geometry, sampler, path, precision)


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


def test_single_returns_of_a_scene_are_dropped_by_its_number_and_seed():
    codec = RangeCodec("log2", return_channel=True)
    geometry = ScanGeometry(SphericalProjection(SENSOR), codec, (2, 8))
    _, sit, norm = tiny_networks()
    vae = VAE(**VAE_ARGS | {"in_channels": 2})
    with torch.no_grad():
        vae.decoder.conv_out.weight[1] = 0.0
        vae.decoder.conv_out.bias[:] = torch.tensor([0.0, 2.0])  # returns are kept 88 % of the time
    scenes = SceneGenerator(vae, sit, norm, geometry, ODE)
    found = scenes.generate([0, 1], seed=3)
    whole = scenes.decode(found.latents)
    holes = (whole > 0) & (found.range_m < 0)
    assert holes.float().mean().item() == pytest.approx(0.12, abs=0.03)
    assert torch.equal(found.range_m, torch.where(holes, -1.0, whole))
    assert not torch.equal(holes[0], holes[1])
    assert torch.equal(scenes.generate([1], seed=3).range_m < 0, found.range_m[1:] < 0)
    assert not torch.equal(scenes.generate([1], seed=4).range_m < 0, found.range_m[1:] < 0)
    assert not torch.equal(scenes.decode(found.latents, [0, 1], seed=4) < 0, found.range_m < 0)
    alone = SceneGenerator(vae, sit, norm, geometry, ODE, batch_size=1)
    assert torch.equal(alone.decode(found.latents, [0, 1], seed=3) < 0, found.range_m < 0)


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
    [
        *[("euler", 5, 5), ("heun", 5, 9), ("heun", 1, 1), ("midpoint", 5, 10), ("ab2", 5, 5)],
        *[("ab3", 5, 5), ("dpmpp_2m", 5, 5), ("unipc", 5, 5), ("euler_maruyama", 5, 5)],
    ],
)
def test_network_evaluations(solver, steps, evaluations):
    """As counted by the network, of which the batch is one call."""
    scenes = generator(SamplerConfig(solver, steps))
    calls = []
    velocity_at = scenes.sit.velocity_at
    scenes.sit.velocity_at = lambda *inputs: calls.append(1) or velocity_at(*inputs)
    assert scenes.generate(range(2)).nfe == len(calls) == evaluations


def slow_latents(sampler, num, seed, path):
    """The same scenes from the plain network, with a time per sample; draws as documented."""
    _, sit, _ = tiny_networks()
    keys = [np.random.SeedSequence([seed, i]).generate_state(1, np.uint64)[0] for i in range(num)]
    sources = [torch.Generator().manual_seed(int(key) >> 1) for key in keys]

    def draws():
        while True:
            yield torch.stack([torch.randn(LATENT_SHAPE, generator=g) for g in sources])

    noise = draws()
    start = next(noise)
    path = Interpolant(path)
    if sampler.solver == "euler_maruyama":
        times = sde_times(sampler.steps)
        return euler_maruyama(sit.velocity, start, times, noise, interpolant=path)
    times = ode_times(sampler.steps, shift=sampler.shift)
    return ode_solver(sampler.solver, path)(sit.velocity, start, times)


SAMPLERS = [ODE, SDE, SamplerConfig("ab2", 8, shift=2.0), SamplerConfig("unipc", 6)]


@pytest.mark.parametrize("path", ["linear", "cosine"])
@pytest.mark.parametrize("sampler", SAMPLERS, ids=lambda sampler: sampler.solver)
def test_tables_of_modulations_give_the_scenes_of_the_plain_network(sampler, path):
    """One row for all samples sums in another order: float32 rounding, here below 1e-5.

    The latents are of order 1. bf16 keeps 8 bits, 0.4 % per operation; measured: below 0.04.
    """
    expected = slow_latents(sampler, 4, 2, path)
    found = generator(sampler, path=path).generate(range(4), seed=2)
    torch.testing.assert_close(found.latents, expected, atol=1e-5, rtol=0)
    half = generator(sampler, "bf16", path=path).generate(range(4), seed=2)
    error = (half.latents - expected).abs().max()
    assert 1e-5 < error < 0.08
    assert half.latents.dtype == half.range_m.dtype == torch.float32
    assert ((found.range_m > 0) == (half.range_m > 0)).float().mean() > 0.95


def test_another_sampler_gets_another_table():
    scenes = generator(SamplerConfig("ab2", 4))
    before = scenes.generate([0])
    sampler = SamplerConfig("ab2", 6, shift=2.0)
    other = scenes.with_sampler(sampler)
    fresh = generator(sampler).generate([0])
    assert torch.equal(other.generate([0]).latents, fresh.latents)
    assert torch.equal(scenes.generate([0]).latents, before.latents)
    scenes.sampler = sampler
    assert torch.equal(scenes.generate([0]).latents, fresh.latents)


@pytest.mark.parametrize("sampler", [ODE, SDE], ids=["ode", "sde"])
def test_a_batch_that_is_filled_up_holds_the_same_scenes(sampler):
    """Bitwise: the networks see the same shape, and what fills it does not matter."""
    scenes = SceneGenerator(*tiny_networks(), GEOMETRY, sampler, batch_size=5)
    shapes = set()
    velocity_at, decode = scenes.sit.velocity_at, scenes._decode
    scenes.sit.velocity_at = lambda x, row: shapes.add(("sit", len(x))) or velocity_at(x, row)
    scenes._decode = lambda x: shapes.add(("vae", len(x))) or decode(x)
    whole = scenes.generate(range(5), seed=1)
    part = scenes.generate(range(3), seed=1)
    assert torch.equal(part.latents, whole.latents[:3])
    assert torch.equal(part.range_m, whole.range_m[:3])
    assert shapes == {("sit", 5), ("vae", 5)}
    with pytest.raises(ValueError, match=r"batch_size is 5, but 6 scenes"):
        scenes.generate(range(6))


def test_autoguidance_is_the_written_out_formula():
    weak = tiny_networks()[1]
    with torch.no_grad():
        for parameter in weak.parameters():
            parameter.mul_(0.9)
    sit = tiny_networks()[1]
    sampler = SamplerConfig("ab2", 6)
    guide = Autoguidance(weak, 2.0)
    scenes = SceneGenerator(*tiny_networks(), GEOMETRY, sampler, autoguidance=guide)
    found = scenes.generate([0, 1], seed=4)
    assert found.nfe == 12
    start = torch.stack([torch.randn(LATENT_SHAPE, generator=scene_random(4, i)) for i in (0, 1)])

    def guided(x, time):
        return 2 * sit.velocity(x, time) - weak.velocity(x, time)

    expected = ode_solver("ab2")(guided, start, ode_times(6))
    torch.testing.assert_close(found.latents, expected, atol=1e-5, rtol=0)

    half_way = Autoguidance(weak, 2.0, (0.0, 0.5))
    scenes = SceneGenerator(*tiny_networks(), GEOMETRY, sampler, autoguidance=half_way)
    assert scenes.generate([0]).nfe == 6 + 3  # of the times 1, 5/6, ..., 1/6
    early = Autoguidance(weak, 2.0, (0.5, 1.0))  # both ends count
    scenes = SceneGenerator(*tiny_networks(), GEOMETRY, sampler, autoguidance=early)
    assert scenes.generate([0]).nfe == 6 + 4


GUIDANCE = PerturbedAttention(block=1, scale=1.5)


@pytest.mark.parametrize("block", [1, 2])
def test_scenes_are_guided_away_from_the_network_without_one_attention_map(block):
    sampler, networks = SamplerConfig("ab2", 6), tiny_networks()
    sit = networks[1]
    guidance = PerturbedAttention(block, 1.5)
    found = SceneGenerator(*networks, GEOMETRY, sampler, guidance=guidance).generate([0, 1])
    assert found.nfe == 12
    start = torch.stack([torch.randn(LATENT_SHAPE, generator=scene_random(0, i)) for i in (0, 1)])

    def guided(x, time):
        strong, weak = velocity_and_perturbed(sit, x, sit.modulations(time[:1]), block)
        return 1.5 * strong - 0.5 * weak

    with torch.no_grad():
        expected = ode_solver("ab2")(guided, start, ode_times(6))
    torch.testing.assert_close(found.latents, expected, atol=1e-5, rtol=0)


def test_guidance_of_strength_one_costs_nothing():
    none = PerturbedAttention(1, 1.0)
    scenes = SceneGenerator(*tiny_networks(), GEOMETRY, SamplerConfig("ab2", 6), guidance=none)
    assert (scenes.generate([0]).nfe, scenes.guidance_scale) == (6, 1)


def test_the_recorded_guidance_is_the_default(tmp_path):
    recorded = {"perturbed_attention": {"block": 1, "scale": 1.5}}
    path = tiny_checkpoint(tmp_path / "guided.safetensors", GEOMETRY, sampling=recorded)

    def latents(**options):
        scenes = SceneGenerator.from_checkpoint(path, ODE, device="cpu", **options)
        return scenes.generate([0]).latents

    assert read_checkpoint(path).sampling == recorded
    plain = generator(ODE).generate([0]).latents
    guided = SceneGenerator(*tiny_networks(), GEOMETRY, ODE, guidance=GUIDANCE).generate([0])
    assert torch.equal(latents(), guided.latents)
    assert torch.equal(latents(guidance_scale=1.5), guided.latents)
    assert torch.equal(latents(guidance_scale=1.0), plain)
    assert not torch.allclose(plain, guided.latents, atol=1e-3)
    auto = Autoguidance(tiny_networks()[1], 1.0)  # replaces it
    assert torch.equal(latents(autoguidance=auto), plain)


def test_guidance_that_the_network_cannot_have_is_refused():
    with pytest.raises(ValueError, match=r"block 3 of the guidance is not in 1\.\.2"):
        SceneGenerator(*tiny_networks(), GEOMETRY, guidance=PerturbedAttention(3, 1.5))
    with pytest.raises(ValueError, match="blocks are counted from 1, got block 0"):
        PerturbedAttention(0, 1.5)


def test_average_velocities_are_not_guided(few_step):
    networks = tiny_networks(average_blocks=1)
    sampler = SamplerConfig("average_velocity", 2)
    scenes = SceneGenerator(*networks, GEOMETRY, sampler, guidance=GUIDANCE)
    assert (scenes.generate([0]).nfe, scenes.guidance_scale) == (2, 1)
    scenes = scenes.with_sampler(ODE)
    assert (scenes.generate([0]).nfe, scenes.guidance_scale) == (10, 1.5)
    with pytest.raises(ValueError, match=r"never guided: drop guidance_scale 2"):
        SceneGenerator.from_checkpoint(
            replace(few_step, sampling={"perturbed_attention": {"block": 1, "scale": 1.0}}),
            sampler,
            guidance_scale=2.0,
        )


@pytest.mark.parametrize("scale", [0.5, float("nan"), float("inf")])
def test_a_scale_of_guidance_below_one_is_refused(scale, few_step):
    with pytest.raises(ValueError, match="scale of guidance must be a number of 1 or more"):
        PerturbedAttention(1, scale)
    with pytest.raises(ValueError, match="scale of guidance must be a number of 1 or more"):
        SceneGenerator.from_checkpoint(few_step, ODE, guidance_scale=scale)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 1.5], ids=["plain", "guided"])
def test_compiled_networks_draw_the_same_scenes(scale):
    """Fused kernels round in another order; no shape is met twice, so nothing recompiles."""
    options = {"guidance": PerturbedAttention(1, scale)}
    networks = tiny_networks()
    scenes = SceneGenerator(*networks, GEOMETRY, ODE, batch_size=3, compile=True, **options)
    plain = SceneGenerator(*networks, GEOMETRY, ODE, **options).generate(range(3))
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    for part in (slice(0, 3), slice(0, 2), slice(2, 3)):
        found = scenes.generate(range(3)[part])
        torch.testing.assert_close(found.latents, plain.latents[part], atol=1e-5, rtol=0)
        torch.testing.assert_close(found.range_m, plain.range_m[part], atol=1e-3, rtol=0)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == 2


def test_options_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="give SceneGenerator a batch_size"):
        SceneGenerator(*tiny_networks(), GEOMETRY, ODE, compile=True)
    with pytest.raises(ValueError, match="batch_size must be at least 1, got 0"):
        SceneGenerator(*tiny_networks(), GEOMETRY, ODE, batch_size=0)
    with pytest.raises(ValueError, match="unknown precision 'fp16'; choose from fp32, bf16"):
        generator(precision="fp16")
    with pytest.raises(ValueError, match="unknown quality 'GOOD'; choose from instant, draft"):
        SamplerConfig.of_quality("GOOD")


@pytest.mark.parametrize("none", [0, [], -1])
def test_a_request_for_no_scene_is_refused(none):
    with pytest.raises(ValueError, match="no scene is requested"):
        generator().generate(none)


@pytest.mark.parametrize("wrong", [True, "3", 1.5])
def test_what_is_no_number_of_scenes_is_refused(wrong):
    with pytest.raises(ValueError, match="give a number of scenes or their indices, got"):
        generator().generate(wrong)


def test_a_number_of_scenes_may_be_one_of_numpy():
    assert len(generator(SamplerConfig("euler", steps=1)).generate(np.int64(2))) == 2


def test_every_quality_is_a_sampler_and_better_ones_take_longer():
    samplers = {name: SamplerConfig.of_quality(name) for name in ("draft", "good", "best")}
    for name, sampler in samplers.items():
        line = SamplerConfig.quality_line(name)
        assert f"quality {name}: {sampler.solver}, {sampler.steps} steps, shift" in line
    steps = [sampler.steps for sampler in samplers.values()]
    assert steps == sorted(set(steps))


def test_exact_velocity_leads_to_the_data():
    """With the velocity (x - data) / t of a single datum, Euler ends at it after any steps."""
    scenes = generator(SamplerConfig("euler", steps=7))
    data = torch.randn(1, *LATENT_SHAPE, generator=torch.Generator().manual_seed(5))
    scenes.sit.modulations = lambda time: time[:, None]
    scenes.sit.velocity_at = lambda latents, time: (latents - data) / time[:, :, None, None]
    found = scenes.generate([0, 1])
    torch.testing.assert_close(found.latents, data.expand(2, -1, -1, -1), atol=1e-5, rtol=0)
    with torch.no_grad():
        image = scenes.vae.decode(scenes.latent_norm.denormalise(data))[:, 0]
    expected = GEOMETRY.codec.decode(image, SENSOR)
    torch.testing.assert_close(found.range_m, expected.expand(2, -1, -1), atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"solver": "rk45"}, r"euler, heun, .*, euler_maruyama, ddpm, ddim, .*, got 'rk45'"),
        ({"steps": 0}, r"steps >= 1, .* got 0, 1.0 and 1.0"),
        ({"shift": 0.0}, r"shift > 0 .* got 256, 0.0 and 1.0"),
        ({"eta": -1.0}, r"eta >= 0, got 256, 1.0 and -1.0"),
        (
            {"solver": "heun", "eta": 0.5},
            r"solver heun does not read eta.* for euler_maruyama, ddpm;",
        ),
        ({"solver": "ab2", "sde_last": "mean"}, r"solver ab2 does not read sde_last,"),
        ({"solver": "ab2", "sde_last_time": 0.1}, r"solver ab2 does not read sde_last_time"),
        ({"shift": 2.0}, r"solver euler_maruyama does not read shift, which is for euler, heun"),
    ],
)
def test_samplers_that_cannot_be_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        SamplerConfig(**options)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("sampler", [ODE, SDE], ids=["ode", "sde"])
def test_cuda_draws_the_scenes_of_the_cpu(sampler, monkeypatch):
    """The draws come from the CPU; other kernels round in another order, without TF32."""
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    vae, sit, norm = tiny_networks()
    on_cpu = SceneGenerator(vae, sit, norm, GEOMETRY, sampler).generate(range(3), seed=1)
    parts = (part.cuda() for part in (vae, sit, norm))
    on_gpu = SceneGenerator(*parts, GEOMETRY, sampler).generate(range(3), seed=1)
    assert on_gpu.range_m.device.type == "cuda"
    torch.testing.assert_close(on_gpu.latents.cpu(), on_cpu.latents, atol=1e-4, rtol=0)


def test_a_diverged_network_gives_nan_and_no_empty_scene():
    scenes = generator()
    with torch.no_grad():
        scenes.sit.final_layer.linear.bias[0] = torch.nan
    assert scenes.generate([0]).range_m.isnan().all()


def test_preparing_says_what_the_first_scene_would():
    """And computes what that would wait for."""
    with pytest.raises(ValueError, match=r"must lie in \(0, 1\), got 2"):
        generator(SamplerConfig(sde_last_time=2.0)).prepare()
    scenes, asked = generator(ODE), []
    modulations = scenes.sit.modulations
    scenes.sit.modulations = lambda time: asked.append(time.tolist()) or modulations(time)
    scenes.prepare()
    scenes.generate([0])
    third = 1 / 3
    assert asked == [pytest.approx([1, 2 * third, 2 * third, third, third])]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """File whose last weights and statistics differ from the averaged ones."""
    vae, last, norm = tiny_networks()
    _, average, average_norm = tiny_networks(spread=0.2)
    average_norm.running_mean.add_(0.1)
    networks = {
        "vae": NetworkState.of(vae, VAE_ARGS),
        "sit": NetworkState.of(last, SIT_ARGS),
        "latent_norm": NetworkState.of(norm, {"channels": 4}),
        "ema": NetworkState.of(average, SIT_ARGS),
        "ema_latent_norm": NetworkState.of(average_norm, {"channels": 4}),
    }
    content = Checkpoint(
        "tiny", "joint", networks, geometry=GEOMETRY.to_dict(), interpolant="cosine"
    )
    path = tmp_path_factory.mktemp("checkpoint") / "joint.safetensors"
    return save_checkpoint(content, path)


@pytest.mark.parametrize("weights", ["ema", "last"])
def test_a_checkpoint_is_sampled_with_the_weights_asked_for(checkpoint, weights):
    """Averaged weights with their own statistics by default, on the path of the training."""
    options = {} if weights == "ema" else {"weights": "last"}
    found = r3dpa.SceneGenerator.from_checkpoint(checkpoint, ODE, **options).generate(2, seed=1)
    _, sit, norm = tiny_networks(spread=0.2 if weights == "ema" else 0.1)
    if weights == "ema":
        norm.running_mean.add_(0.1)
    expected = SceneGenerator(tiny_networks()[0], sit, norm, GEOMETRY, ODE, "cosine")
    expected = expected.generate(range(2), seed=1)
    assert torch.equal(found.latents, expected.latents)
    assert torch.equal(found.range_m, expected.range_m)
    assert torch.equal(found.points(1), points_of(expected.range_m[1], GEOMETRY.projection))
    assert len(found) == 2
    default = SceneGenerator.from_checkpoint(str(checkpoint))
    assert default.sampler == SamplerConfig.of_quality("good")
    assert default.interpolant.path == "cosine"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stage": "vae_alignment"}, "trains no velocity; sample from .* joint or flow_matching"),
        ({"geometry": None}, "does not record which sensor"),
        ({"networks": {}}, "has no vae"),
        (
            {"geometry": replace(GEOMETRY, projection=WIDE).to_dict()},
            "make images of 16 x 64 pixels, but their geometry has 16 beams and 128 columns",
        ),
    ],
)
def test_checkpoints_that_cannot_be_sampled_are_refused(checkpoint, change, message):
    with pytest.raises(ValueError, match=message):
        SceneGenerator.from_checkpoint(replace(read_checkpoint(checkpoint), **change))


@pytest.mark.numerics("statistics before any update")
def test_latent_statistics_without_an_update_are_refused():
    """A batch norm without a batch hands latents on as they are."""
    vae, sit, _ = tiny_networks()
    with pytest.raises(ValueError, match=r"never fitted.*joint or flow_matching"):
        SceneGenerator(vae, sit, LatentNorm(4), GEOMETRY)


def test_vae_of_a_checkpoint_encodes_and_decodes_a_scan(checkpoint):
    """From points to the posterior mean, and back to points on the rays of the pixels."""
    vae = r3dpa.SceneVAE.from_checkpoint(checkpoint)
    points = 10 * torch.nn.functional.normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1, 1, 0.1])
    )
    latents = vae.encode(torch.cat([points, torch.ones(500, 1)], dim=1).numpy())
    image = GEOMETRY.codec.encode(range_image(points, GEOMETRY.projection)[0])
    assert torch.equal(latents, vae.vae.encode(image[None, None]).mean)
    scene = vae.decode(latents)
    assert scene.range_m.shape == (1, 16, 64)
    assert len(scene.points(0)) == (scene.range_m > 0).sum()


def test_importing_the_package_imports_no_torch():
    code = "import sys, r3dpa; assert 'torch' not in sys.modules; r3dpa.__version__"
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="has no attribute 'SceneMaker'"):
        r3dpa.SceneMaker  # noqa: B018


@pytest.fixture(scope="module")
def few_step(tmp_path_factory):
    path = tmp_path_factory.mktemp("few_step") / "few.safetensors"
    return read_checkpoint(tiny_checkpoint(path, GEOMETRY, stage="few_step"))


class TestFewSteps:
    def test_scenes_are_those_of_the_average_velocity(self, few_step):
        """Written out step by step, and the decoder by hand."""
        made = SceneGenerator.from_checkpoint(few_step, "instant", device="cpu")
        scenes = made.generate([3], seed=1)
        sit, steps = made.sit, made.sampler.steps
        x = torch.randn(LATENT_SHAPE, generator=scene_random(1, 3))[None]
        times = average_times(steps).tolist()
        with torch.no_grad():
            for now, then in pairwise(times):
                time, target = torch.tensor([now]), torch.tensor([then])
                x = x + (then - now) * sit.average_velocity(x, time, target)
            image = (
                few_step.network("thin_decoder")
                .build()
                .eval()
                .decode(made.latent_norm.denormalise(x))
            )
        assert scenes.nfe == steps
        torch.testing.assert_close(scenes.latents, x, atol=1e-5, rtol=1e-5)
        ranges = GEOMETRY.codec.ranges_of(image, SENSOR)
        torch.testing.assert_close(scenes.range_m, ranges, atol=1e-3, rtol=0)
        assert few_step.network("ema").arguments["average_blocks"] == 1

    def test_the_thin_decoder_is_the_default_of_the_quality_instant_alone(self, few_step):
        def decoder(sampler, **options):
            made = SceneGenerator.from_checkpoint(few_step, sampler, device="cpu", **options)
            return type(made.vae)

        assert decoder("instant") is decoder("draft", decoder="thin") is ThinDecoder
        assert decoder("draft") is decoder("instant", decoder="full") is VAE

    def test_no_guidance_may_be_asked_for(self, few_step):
        plain, one = (
            SceneGenerator.from_checkpoint(few_step, "instant", device="cpu", guidance_scale=scale)
            for scale in (None, 1.0)
        )
        assert torch.equal(plain.generate([0]).latents, one.generate([0]).latents)

    def test_other_qualities_do_not_see_the_copied_blocks(self, few_step):
        made = SceneGenerator.from_checkpoint(few_step, ODE, device="cpu")
        first = made.generate([0]).latents
        for parameter in made.sit.average.parameters():
            torch.nn.init.normal_(parameter)
        assert torch.equal(made.with_sampler(ODE).generate([0]).latents, first)
        few = made.with_sampler(SamplerConfig("average_velocity", 4))
        assert not torch.allclose(few.generate([0]).latents, first)
        assert few.generate([0]).nfe == 4

    def test_what_makes_no_sense_is_refused_by_name(self, few_step):
        sampler = SamplerConfig("average_velocity", 2)
        with pytest.raises(ValueError, match="a checkpoint of stage few_step"):
            generator(sampler)
        with pytest.raises(ValueError, match="a checkpoint of stage few_step"):
            generator().with_sampler(sampler)
        weak = Autoguidance(few_step.network("ema").build(), 2.0)
        with pytest.raises(ValueError, match="drop autoguidance"):
            SceneGenerator.from_checkpoint(few_step, sampler, device="cpu", autoguidance=weak)
        with pytest.raises(ValueError, match=r"takes 1, 2, 4, 8 steps.*got 3"):
            SamplerConfig("average_velocity", 3)
        with pytest.raises(ValueError, match="average_velocity does not read shift"):
            SamplerConfig("average_velocity", 4, shift=2.0)
        with pytest.raises(ValueError, match=r"the ODE solvers are.*got 'average_velocity'"):
            ode_solver("average_velocity")  # of edits too

    def test_the_official_layout_has_no_place_for_it(self, few_step, tmp_path):
        with pytest.raises(ValueError, match=r"stage few_step.*no official counterpart"):
            convert(few_step.path, tmp_path / "few.pt", to="official")
        convert(few_step.path, tmp_path / "half.safetensors", half=True)
        half = SceneGenerator.from_checkpoint(
            tmp_path / "half.safetensors", "instant", device="cpu"
        )
        assert half.generate([0]).range_m.isfinite().all()


def test_a_generator_and_a_vae_say_what_they_are_in_one_line(checkpoint):
    scenes = generator(SamplerConfig("ab3", 5))
    assert repr(scenes) == (
        "SceneGenerator(16 x 64 pixels, ab3 with 5 steps, guidance_scale 1, fp32, cpu)"
    )
    vae = r3dpa.SceneVAE.from_checkpoint(checkpoint, device="cpu")
    assert repr(vae) == "SceneVAE(16 x 64 pixels, latents 4 x 4 x 16, cpu)"


def test_networks_move_and_their_tables_follow(checkpoint):
    weak = Autoguidance(tiny_networks()[1], 2.0, latent_scale=1.2, latent_shift=torch.zeros(4))
    scenes = SceneGenerator(*tiny_networks(), GEOMETRY, ODE, autoguidance=weak)
    scenes.generate([0])
    assert scenes.to("meta") is scenes
    assert scenes.generate([0]).range_m.device.type == "meta"
    vae = r3dpa.SceneVAE.from_checkpoint(checkpoint, device="cpu")
    assert vae.to("meta").device.type == "meta"
    compiled = SceneGenerator(*tiny_networks(), GEOMETRY, ODE, batch_size=1, compile=True)
    with pytest.raises(ValueError, match="compiled networks cannot move"):
        compiled.to("cpu")


def test_progress_is_shown_on_request(capsys):
    scenes = generator(ODE)
    quiet = scenes.generate([0])
    assert capsys.readouterr().err == ""
    loud = scenes.generate([0], progress=True)
    assert "5/5" in capsys.readouterr().err  # evaluations of three Heun steps
    assert torch.equal(quiet.latents, loud.latents)

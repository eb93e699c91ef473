"""Network evaluations of a sampling, their tables of modulations, and guidance."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from tiny_networks import tiny_checkpoint, tiny_networks
from tiny_scenes import GEOMETRY, LATENT_SHAPE, ODE, SDE, SENSOR, generator

from r3dpa.checkpoints import (
    convert,
    read_checkpoint,
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
from r3dpa.nn import VAE, ThinDecoder
from r3dpa.nn.perturbed_attention import velocity_and_perturbed


@pytest.mark.parametrize(
    ("solver", "steps", "evaluations"),
    [
        *[("euler", 5, 5), ("heun", 5, 9), ("heun", 1, 1), ("midpoint", 5, 10), ("ab2", 5, 5)],
        *[("ab3", 5, 5), ("dpmpp_2m", 5, 5), ("unipc", 5, 5), ("euler_maruyama", 5, 5)],
    ],
)
def test_evaluations_of_each_solver_are_counted(solver, steps, evaluations):
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
    expected = slow_latents(sampler, 2, 2, path)
    found = generator(sampler, path=path).generate(range(2), seed=2)
    torch.testing.assert_close(found.latents, expected, atol=1e-5, rtol=0)
    half = generator(sampler, "bf16", path=path).generate(range(2), seed=2)
    error = (half.latents - expected).abs().max()
    assert 1e-5 < error < 0.08
    assert half.latents.dtype == half.range_m.dtype == torch.float32
    assert ((found.range_m > 0) == (half.range_m > 0)).float().mean() > 0.95


def test_a_new_sampler_gets_a_new_table_of_modulations():
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

    def test_average_velocities_are_refused_where_they_make_no_sense(self, few_step):
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

    def test_the_official_layout_has_no_place_for_average_velocities(self, few_step, tmp_path):
        with pytest.raises(ValueError, match=r"stage few_step.*no official counterpart"):
            convert(few_step.path, tmp_path / "few.pt", to="official")
        convert(few_step.path, tmp_path / "half.safetensors", half=True)
        half = SceneGenerator.from_checkpoint(
            tmp_path / "half.safetensors", "instant", device="cpu"
        )
        assert half.generate([0]).range_m.isfinite().all()


def test_networks_move_and_their_tables_follow():
    weak = Autoguidance(tiny_networks()[1], 2.0, latent_scale=1.2, latent_shift=torch.zeros(4))
    scenes = SceneGenerator(*tiny_networks(), GEOMETRY, ODE, autoguidance=weak)
    scenes.generate([0])
    assert scenes.to("meta") is scenes
    assert scenes.generate([0]).range_m.device.type == "meta"
    compiled = SceneGenerator(*tiny_networks(), GEOMETRY, ODE, batch_size=1, compile=True)
    with pytest.raises(ValueError, match="compiled networks cannot move"):
        compiled.to("cpu")

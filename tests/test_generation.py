"""Scenes depend on (seed, index) alone; precision and geometry of the result; what is refused."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_labelled import labelled_checkpoint
from tiny_networks import SIT_ARGS, VAE_ARGS, tiny_networks
from tiny_scenes import GEOMETRY, LATENT_SHAPE, ODE, SDE, SENSOR, generator

import r3dpa
from r3dpa.checkpoints import (
    Checkpoint,
    NetworkState,
    read_checkpoint,
    save_checkpoint,
)
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import (
    SEMANTIC_CLASSES,
    RangeCodec,
    ScanGeometry,
    SphericalProjection,
    points_of,
)
from r3dpa.nn import VAE, LatentNorm

WIDE = SphericalProjection(replace(SENSOR, columns=128))
NEAR = SphericalProjection(replace(SENSOR, range_max_m=7.0))


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
        # Returns are kept 88 % of the time.
        vae.decoder.conv_out.bias[:] = torch.tensor([0.0, 2.0 / 1.3])
    scenes = SceneGenerator(vae, sit, norm, geometry, ODE)
    found = scenes.generate([0, 1], seed=3)
    whole = scenes.decode(found.latents)
    with pytest.raises(ValueError, match="no latents to decode"):
        scenes.decode(found.latents[:0])
    holes = (whole > 0) & (found.range_m < 0)
    assert holes.float().mean().item() == pytest.approx(0.12, abs=0.03)
    assert torch.equal(found.range_m, torch.where(holes, -1.0, whole))
    assert not torch.equal(holes[0], holes[1])
    assert torch.equal(scenes.generate([1], seed=3).range_m < 0, found.range_m[1:] < 0)
    assert not torch.equal(scenes.generate([1], seed=4).range_m < 0, found.range_m[1:] < 0)
    assert not torch.equal(scenes.decode(found.latents, [0, 1], seed=4) < 0, found.range_m < 0)
    alone = SceneGenerator(vae, sit, norm, geometry, ODE, batch_size=1)
    assert torch.equal(alone.decode(found.latents, [0, 1], seed=3) < 0, found.range_m < 0)


def test_ranges_of_a_scene_have_noise_by_its_number_and_seed():
    """For a decoder that smooths ranges along rings: a standard deviation of 1 cm."""
    codec = RangeCodec("log2", return_channel=True)
    geometry = ScanGeometry(SphericalProjection(SENSOR), codec, (2, 8))
    _, sit, norm = tiny_networks()
    vae = VAE(**VAE_ARGS | {"in_channels": 2, "modes": 2})
    with torch.no_grad():
        vae.decoder.conv_out.weight[5] = 0.0
        vae.decoder.conv_out.bias[5] = 20.0  # all are returns
    scenes = SceneGenerator(vae, sit, norm, geometry, ODE)
    found = scenes.generate([0, 1], seed=3)
    smooth = scenes.decode(found.latents)
    returns = smooth > 0
    assert torch.equal(returns, found.range_m > 0)
    noise_m = (found.range_m - smooth)[returns]
    assert noise_m.std().item() == pytest.approx(0.01, rel=0.1)
    assert abs(noise_m.mean().item()) < 0.001
    assert torch.equal(found.range_m[~returns], smooth[~returns])
    again, other = (scenes.decode(found.latents, [0, 1], seed=seed) for seed in (3, 4))
    assert torch.equal(again, found.range_m)
    assert (other - again).std().item() == pytest.approx(0.01 * 2**0.5, rel=0.1)
    alone = scenes.decode(found.latents[1:], [1], seed=3)
    torch.testing.assert_close(alone, found.range_m[1:], atol=1e-3, rtol=0)  # rounding of a batch
    near = SceneGenerator(vae, sit, norm, replace(geometry, projection=NEAR), ODE)
    limited = near.decode(found.latents, [0, 1], seed=3)
    assert limited.max() < NEAR.sensor.range_max_m
    assert torch.equal(limited > 0, near.decode(found.latents) > 0)


def test_global_random_state_is_neither_read_nor_moved():
    scenes = generator(SDE)
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = scenes.generate([0])
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    assert torch.equal(scenes.generate([0]).latents, first.latents)


def test_options_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="give SceneGenerator a batch_size"):
        SceneGenerator(*tiny_networks(), GEOMETRY, ODE, compile=True)
    with pytest.raises(ValueError, match="batch_size must be at least 1, got 0"):
        SceneGenerator(*tiny_networks(), GEOMETRY, ODE, batch_size=0)
    with pytest.raises(ValueError, match="unknown precision 'fp16'; choose from fp32, bf16"):
        generator(precision="fp16")
    for name, value in (("weights", "EMA"), ("decoder", "small")):
        with pytest.raises(ValueError, match=f"unknown {name} {value!r}; choose from"):
            SceneGenerator.from_checkpoint("r3dpa-s", **{name: value})
    with pytest.raises(ValueError, match="unknown quality 'GOOD'; choose from instant, draft"):
        SamplerConfig.of_quality("GOOD")


@pytest.mark.parametrize("none", [0, [], -1])
def test_a_request_for_no_scene_is_refused(none):
    with pytest.raises(ValueError, match="no scene is requested"):
        generator().generate(none)


@pytest.mark.parametrize("wrong", [True, "3", 1.5, None, {0, 1}, torch.tensor(1.5)])
def test_numbers_of_scenes_that_are_none_are_refused(wrong):
    with pytest.raises(ValueError, match="give a number of scenes or their indices, got"):
        generator().generate(wrong)


@pytest.mark.parametrize("wrong", [[0, -1], [0.5], ["a"], torch.tensor([-3])])
def test_indices_of_scenes_that_cannot_be_are_named(wrong):
    with pytest.raises(ValueError, match=r"indices of scenes must be .*, got (-|0\.5|'a')"):
        generator().generate(wrong)


@pytest.mark.parametrize("wrong", [-1, 0.5, None, "0"])
def test_seeds_that_cannot_be_are_named(wrong):
    with pytest.raises(ValueError, match=rf"seed must be a whole number, .* got {wrong!r}"):
        generator().generate(1, wrong)


def test_a_number_of_scenes_may_be_of_numpy_or_torch():
    scenes = generator(SamplerConfig("euler", steps=1))
    assert len(scenes.generate(np.int64(2))) == len(scenes.generate(torch.tensor(2))) == 2
    second = scenes.generate([1]).latents
    for indices in (np.array([1]), torch.tensor([1])):
        assert scenes.generate(indices).latents.equal(second)


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
        ({"eta": float("nan")}, r"eta >= 0, got 256, 1.0 and nan"),
        ({"solver": "heun", "shift": float("inf")}, r"finite shift > 0 .* got 256, inf and"),
        ({"solver": "heun", "steps": 2.5}, r"whole number of steps >= 1, .* got 2.5, 1.0 and"),
        ({"steps": None}, r"whole number of steps >= 1, .* got None, 1.0 and"),
        (
            {"solver": "heun", "eta": 0.5},
            r"solver heun does not read eta.* for euler_maruyama, ddpm;",
        ),
        ({"solver": "ab2", "sde_last": "mean"}, r"solver ab2 does not read sde_last,"),
        ({"solver": "ab2", "sde_last_time": 0.1}, r"solver ab2 does not read sde_last_time"),
        ({"sde_last": "noise"}, r"sde_last must be one of denoise, mean, got 'noise'"),
        ({"sde_last_time": 2.0}, r"sde_last_time must lie in \(0, 1\), got 2"),
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


def test_latents_of_float64_are_decoded_and_of_another_shape_refused():
    scenes = generator()
    latents = scenes.noise([0, 1])
    assert scenes.decode(latents.double()).equal(scenes.decode(latents))
    for wrong in (latents[0], torch.zeros(2, 3), latents[:, :3]):
        with pytest.raises(ValueError, match=r"latents must have shape \(B, 4, 4, 16\), got"):
            scenes.decode(wrong)
    with pytest.raises(ValueError, match="2 scenes need as many indices, got 1"):
        scenes.decode(latents, [0])


def test_a_diverged_network_gives_nan_and_no_empty_scene():
    scenes = generator()
    with torch.no_grad():
        scenes.sit.final_layer.linear.bias[0] = torch.nan
    assert scenes.generate([0]).range_m.isnan().all()


def test_preparing_says_what_the_first_scene_would():
    """And computes what that would wait for."""
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


def test_importing_the_package_imports_no_torch():
    code = "import sys, r3dpa; assert 'torch' not in sys.modules; r3dpa.__version__"
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="has no attribute 'SceneMaker'"):
        r3dpa.SceneMaker  # noqa: B018


def test_a_generator_says_what_it_is_in_one_line():
    scenes = generator(SamplerConfig("ab3", 5))
    assert repr(scenes) == (
        "SceneGenerator(16 x 64 pixels, ab3 with 5 steps, guidance_scale 1, fp32, cpu)"
    )


def test_tensors_of_scenes_can_be_changed_and_are_inputs_of_autograd():
    scenes = generator(ODE).generate([0])
    scenes.range_m[0, 0, 0] = 5.0
    assert (scenes.latents * torch.ones((), requires_grad=True)).sum().requires_grad


def test_progress_is_shown_on_request(capsys):
    scenes = generator(ODE)
    quiet = scenes.generate([0])
    assert capsys.readouterr().err == ""
    loud = scenes.generate([0], progress=True)
    assert "5/5" in capsys.readouterr().err  # evaluations of three Heun steps
    assert torch.equal(quiet.latents, loud.latents)


def test_a_sampler_by_its_name_is_refused():
    with pytest.raises(ValueError, match="sampler must be a SamplerConfig, got 'euler'"):
        generator().with_sampler("euler")


def test_scenes_have_intensity_and_labels_at_their_returns(tmp_path):
    path = labelled_checkpoint(tmp_path)
    scenes = SceneGenerator.from_checkpoint(path, ODE, device="cpu").generate(2)
    returns = scenes.range_m > 0
    assert 0 < returns.sum() < returns.numel()
    assert scenes.labels.shape == scenes.intensity.shape == scenes.range_m.shape
    assert torch.equal(scenes.labels > 0, returns)
    assert set(scenes.labels.unique().tolist()) <= {
        0,
        *(semantic.label for semantic in SEMANTIC_CLASSES),
    }
    assert len(scenes.labels[returns].unique()) > 2
    assert scenes.intensity.min() == 0
    assert scenes.intensity.max() <= 1
    assert len(scenes.intensity[returns].unique()) > 100
    for index in range(2):
        kept = returns[index]
        assert torch.equal(scenes.point_labels(index), scenes.labels[index][kept])
        assert torch.equal(scenes.point_intensity(index), scenes.intensity[index][kept])
        assert len(scenes.points(index)) == kept.sum()


def test_scenes_without_intensity_and_labels_say_so():
    scenes = generator(ODE).generate(1)
    assert scenes.labels is None
    assert scenes.intensity is None
    with pytest.raises(ValueError, match="these scenes have no labels"):
        scenes.point_labels(0)

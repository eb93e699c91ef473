from collections import Counter
from itertools import combinations, pairwise
from types import SimpleNamespace

import pytest
import torch
from tiny_networks import SIT_ARGS, tiny_checkpoint
from tiny_stages import ARGUMENTS, QUIET, Observed, TinyData, stage_module, tiny_sit, train

from r3dpa.checkpoints import load_into, read_checkpoint
from r3dpa.flow import PerturbedAttention, ab3, average_times, ode_times
from r3dpa.flow.average_velocity import TIME_SHIFT
from r3dpa.modules import FewStep, few_step
from r3dpa.modules.stage import PathDraws
from r3dpa.nn import VAE, AverageVelocitySiT, SiT, ThinDecoder
from r3dpa.nn.perturbed_attention import velocity_and_perturbed

pytestmark = QUIET


@pytest.mark.parametrize("time", [0.0, 0.5, 0.99])
def test_the_velocity_of_straight_paths_is_their_average(time):
    """Points t * noise move by noise between any two times: predicting it costs nothing."""
    module, logged = stage_module("few_step"), {}
    module.on_fit_start()
    noise = torch.randn(2, 4, 4, 8)
    points = noise[:, None] * average_times(8).to(noise)[:, None, None, None]
    draws = PathDraws(torch.zeros_like(noise), torch.full((2,), time), points)
    module.draw_path, module.log_dict = lambda *_: draws, logged.update
    module.sit.average_velocity = lambda x, start, end: noise
    module.training_step(TinyData().batches[0], 0)
    assert logged["train/denoising"] < 1e-9
    module.sit.average_velocity = lambda x, start, end: 0 * noise
    module.training_step(TinyData().batches[0], 0)
    torch.testing.assert_close(logged["train/denoising"], noise.square().mean())


def test_the_vae_decodes_as_it_does_for_users():
    module = stage_module("few_step").train()
    assert module.sit.training
    assert not any(part.training for part in module.vae.modules())


def test_steps_of_1_2_4_and_8_are_learned_equally_often():
    """Of 32 equal times: each step that a sampler takes, the single one 8 times."""
    module, asked = stage_module("few_step"), Counter()
    module.on_fit_start()
    points = torch.randn(32, 9, 4, 4, 8)
    draws = PathDraws(torch.zeros(32, 4, 4, 8), torch.arange(32) / 32, points)
    module.draw_path, module.log_dict = lambda *_: draws, lambda *_, **__: None

    def average(x, time, target):
        if torch.is_grad_enabled():  # not on the way to where steps start
            asked.update(zip(time.tolist(), target.tolist(), strict=True))
        return x

    module.sit.average_velocity = average
    batch = TinyData().batches[0]
    module.draw_latents = lambda _: (torch.zeros(32, 4, 4, 8), draws)
    module.training_step(batch, 0)
    expected = Counter()
    for steps in (1, 2, 4, 8):
        times = average_times(steps).float().tolist()
        expected.update(dict.fromkeys(pairwise(times), 8 // steps))
    assert asked == expected


@pytest.mark.parametrize("steps", [1, 2, 4, 8])
def test_all_but_the_shortest_steps_start_where_a_step_before_them_leads(steps):
    module = stage_module("few_step")
    points, times = torch.randn(steps, 9, 4, 4, 8), average_times(steps).float()
    first = torch.arange(0, 8, 8 // steps)
    starts = module._starts(points, torch.stack([first, first + 8 // steps], dim=1))
    torch.testing.assert_close(starts[0], points[0, 0])
    for number in range(1, steps):
        if steps == 8:
            expected = points[number, number]
        else:
            x = points[number, first[number - 1]][None]
            time, target = times[number - 1 : number], times[number : number + 1]
            slope = module.sit.average_velocity(x, time, target)
            expected = (x - (time - target) * slope)[0]
        torch.testing.assert_close(starts[number], expected)


def test_weights_that_led_to_a_start_still_learn_in_bfloat16():
    """Autocast of older releases of torch keeps them as they were cast, without gradients."""
    module = stage_module("few_step")
    module.on_fit_start()
    draws = PathDraws(
        torch.zeros(2, 4, 4, 8), torch.tensor([0.45, 0.3]), torch.randn(2, 9, 4, 4, 8)
    )
    module.draw_latents = lambda _: (torch.zeros(2, 4, 4, 8), draws)
    module.log_dict = lambda *_, **__: None
    with torch.autocast("cpu", torch.bfloat16):
        module.training_step(TinyData().batches[0], 0).backward()
    for name, weight in module.sit.average.named_parameters():
        assert weight.grad is not None, name


def test_points_of_a_trajectory_lie_at_the_times_of_eight_average_steps():
    """At a constant velocity c a point at time t is ``noise - (1 - t) c``."""
    module = stage_module("few_step")
    slope = torch.randn(4, 4, 8)
    module.sit.velocity = lambda x, time: slope.expand_as(x)
    points = module.solve([3])
    time = average_times(8).to(points)[:, None, None, None]
    torch.testing.assert_close(points[0], points[0, 0] - (1 - time) * slope)


@torch.no_grad()
def test_guided_trajectories_follow_the_velocity_pushed_away_from_no_attention():
    module = stage_module("few_step", guidance=PerturbedAttention(block=2, scale=3.0))
    velocity = module.flow_velocity(module.sit)
    points, time = module.solve([0, 1]), torch.full((2,), 0.5)
    modulations = module.sit.modulations(time)
    usual, perturbed = velocity_and_perturbed(module.sit, points[:, 4], modulations, block=2)
    assert (usual - perturbed).abs().max() > 0.01
    pushed = perturbed + 3 * (usual - perturbed)
    torch.testing.assert_close(velocity(points[:, 4], time), pushed)
    end = ab3(velocity, points[:, 0], ode_times(16, shift=TIME_SHIFT))
    torch.testing.assert_close(points[:, -1], end)


@torch.no_grad()
def test_the_end_that_held_out_errors_compare_with_is_guided(monkeypatch):
    module = stage_module("few_step", guidance=PerturbedAttention(block=2, scale=3.0))
    module.thin_decoder = None
    noise = module.solve([0])[:, 0]
    monkeypatch.setattr(few_step, "average_velocity_steps", lambda _, x, grid: 0 * x)
    errors = module.held_out_errors(noise, noise, PathDraws(noise, torch.zeros(1), noise))
    end = module.solve([0])[:, -1]
    torch.testing.assert_close(errors["endpoint_1"], end.square().mean(dim=(1, 2, 3)))


def test_guidance_of_a_block_that_the_flow_does_not_have_is_refused():
    with pytest.raises(ValueError, match=r"block 9 of the guidance is not in 1\.\.2"):
        stage_module("few_step", guidance=PerturbedAttention(block=9, scale=1.5))


def test_the_noise_of_a_trajectory_depends_on_its_number_and_the_seed():
    first, other = (stage_module("few_step", seed=seed) for seed in (0, 1))
    noise = [module.solve([index])[0, 0] for module in (first, other) for index in (0, 1)]
    for one, two in combinations(noise, 2):
        assert not torch.allclose(one, two)
    assert torch.equal(first.solve([0, 1])[1, 0], noise[1])


def test_pairs_of_points_are_drawn_evenly_whatever_the_flow_was_trained_with():
    assert stage_module("few_step", time_sampling="lognormal").time_sampling == "uniform"


@pytest.mark.parametrize("stage", ["few_step", "flow_matching"])
def test_a_flow_of_another_path_is_refused(tmp_path, stage):
    before = read_checkpoint(
        tiny_checkpoint(tmp_path / "few.safetensors", TinyData.geometry, stage="few_step")
    )
    networks = ["vae", "latent_norm", "sit"]
    module = stage_module(stage, path="cosine", init_networks=networks)
    with pytest.raises(ValueError, match=r"was trained on the linear path.*model.init_args.path"):
        module.previous_networks(before)


def test_no_trajectories_are_refused():
    with pytest.raises(ValueError, match="trajectories must be at least 1, got 0"):
        stage_module("few_step", trajectories=0)


@torch.no_grad()
def test_held_out_errors_by_hand(monkeypatch):
    """Ends of AB3 and of one step, 3 apart; a thin decoder that loses a quarter of the returns."""
    module, times = stage_module("few_step"), []
    module.geometry = TinyData.geometry
    monkeypatch.setattr(few_step, "ab3", lambda _, x, grid: times.append(grid) or 0 * x)
    monkeypatch.setattr(few_step, "average_velocity_steps", lambda _, x, grid: 0 * x + 3)
    codec = TinyData.geometry.codec
    range_m = torch.full((2, 8, 16), 10.0)
    reconstruction = codec.encode(range_m)[:, None]
    range_m[:, :2] = -1
    module.thin_decoder.decode = lambda _: codec.encode(range_m)[:, None]
    latents = torch.randn(2, 4, 4, 8)
    errors = module.held_out_errors(reconstruction, latents, PathDraws(latents, None, latents))
    assert errors["endpoint_1"].tolist() == errors["endpoint_4"].tolist() == [9, 9]
    assert torch.equal(times[0], ode_times(16, shift=TIME_SHIFT))
    count, either = errors["thin_return_iou"]
    assert (count.tolist(), either.tolist()) == ([96, 96], [128, 128])
    assert errors["thin_range_error_m"][0].tolist() == [0, 0]


@pytest.mark.parametrize(
    ("name", "own", "theirs"), [("latent_channels", 8, 4), ("least_scale", 0.5, 0.25)]
)
def test_a_thin_decoder_that_does_not_fit_the_vae_is_refused(name, own, theirs):
    vae = VAE(**ARGUMENTS["vae"] | {"least_scale": 0.25})
    thin = ThinDecoder(**ARGUMENTS["thin_decoder"] | {"least_scale": 0.25, name: own})
    with pytest.raises(ValueError, match=f"{name} is {own}, but {theirs} of the VAE"):
        FewStep(vae, tiny_sit(average_blocks=1), thin)


@pytest.mark.parametrize(("name", "own"), [("intensity", True), ("num_classes", 3)])
def test_a_thin_decoder_of_other_channels_than_the_vae_has_is_refused(name, own):
    vae = VAE(**ARGUMENTS["vae"] | {"in_channels": 2})
    thin = ThinDecoder(**ARGUMENTS["thin_decoder"] | {"in_channels": 2, name: own})
    with pytest.raises(ValueError, match=f"{name} is {own}, but .* of the VAE"):
        FewStep(vae, tiny_sit(average_blocks=1), thin)


@pytest.mark.parametrize(("size", "world"), [(1, 1), (3, 1), (8, 1), (5, 2), (1, 3)])
def test_losses_of_the_thin_decoder_are_means_at_any_batch_size(size, world, monkeypatch):
    """Of equal latents, the mean over processes is the loss of one of them."""
    module = stage_module("few_step")
    one = torch.randn(1, 4, 4, 8, generator=torch.Generator().manual_seed(0))
    expected = module.reconstruction_losses(
        module.vae.decode(one), module.thin_decoder.predict(one)
    )
    monkeypatch.setattr(few_step, "num_processes", lambda: world)
    total = Counter()
    for rank in range(world):
        monkeypatch.setattr(FewStep, "global_rank", rank)
        losses = module._decoder_losses(one.expand(size, -1, -1, -1))
        total.update({name: loss.item() for name, loss in losses.items()})
    for name, loss in expected.items():
        assert total[name] / world == pytest.approx(loss.item(), rel=1e-5)


def test_trajectories_have_the_precision_of_the_steps(tmp_path):
    module, data = stage_module("few_step", trajectories=2), TinyData()
    module.on_fit_start = lambda: (Observed.on_fit_start(module), FewStep.on_fit_start(module))
    data.batch_size = 2
    train(module, data, precision="bf16-mixed", default_root_dir=tmp_path)
    cached = module._cached
    found = torch.stack([cached.read(item) for item in cached.items])
    with torch.autocast("cpu", torch.bfloat16):
        rounded = module.solve([0, 1])
    torch.testing.assert_close(found, rounded, rtol=1e-3, atol=1e-3)  # stored in float16
    assert (found - module.solve([0, 1])).abs().max() > 0.01


@pytest.mark.parametrize(
    ("stage", "blocks"), [("flow_matching", 1), ("few_step", 1), ("few_step", 2)]
)
def test_stages_start_from_the_flow_of_few_steps(stage, blocks, tmp_path):
    """Its copied blocks are left out, trained on, or, if they are more or fewer, made again."""
    settings = {"spread": 0.3, "sit_args": {"average_blocks": blocks}, "stage": "few_step"}
    before = read_checkpoint(
        tiny_checkpoint(tmp_path / "few.safetensors", TinyData.geometry, **settings)
    )
    module = stage_module(stage)
    sit = AverageVelocitySiT(1, **SIT_ARGS) if stage == "few_step" else SiT(**SIT_ARGS)
    module.sit = sit
    load_into({"sit": sit}, module.previous_networks(before), stage)
    flow = before.network("ema").build()
    x, time = torch.randn(2, 4, 4, 16), torch.tensor([0.3, 0.9])
    velocity = flow.velocity(x, time)
    assert torch.equal(sit.velocity(x, time), velocity)
    average = flow.average_velocity(x, time, 0 * time)
    assert not torch.allclose(average, velocity)
    if stage == "few_step":
        expected = average if blocks == 1 else velocity
        assert torch.equal(sit.average_velocity(x, time, 0 * time), expected)


def test_processes_take_all_trajectories_in_turn():
    """Two processes with two samples each: four batches take each of 16 trajectories once."""
    module, taken = stage_module("few_step", trajectories=16), Counter()
    module.solve = lambda indices: taken.update(indices) or torch.zeros(len(indices), 9, 4, 4, 8)
    for rank in (0, 1):
        module._trainer = SimpleNamespace(world_size=2, global_rank=rank)
        for number in range(4):
            module.draw_path(2, number)
    assert taken == Counter(range(16))


def test_cached_trajectories_are_those_of_flow_seed_precision_and_guidance(monkeypatch, tmp_path):
    def settings_of(seed=0, precision="32-true", change=None, guidance=None):
        module, seen = stage_module("few_step", seed=seed, guidance=guidance), []
        if change is not None:
            with torch.no_grad():
                module.get_parameter(change).add_(1.0)
        monkeypatch.setattr(
            few_step,
            "tensor_cache",
            lambda root, kind, settings, *_: seen.append(settings) or SimpleNamespace(folder=root),
        )
        monkeypatch.setattr(few_step, "fill_cache", lambda *_: None)
        module._trainer = SimpleNamespace(
            precision=precision,
            fast_dev_run=False,
            default_root_dir=tmp_path,
            datamodule=SimpleNamespace(batch_size=2),
        )
        FewStep.on_fit_start(module)
        return seen[0]

    usual = settings_of()
    assert settings_of() == usual
    assert settings_of(seed=1) != usual
    assert settings_of(precision="bf16-mixed") != usual
    assert settings_of(guidance=PerturbedAttention(block=2, scale=3.0)) != usual
    assert settings_of(change="sit.final_layer.linear.bias") != usual
    # The copied blocks are trained on the trajectories, and do not change them.
    assert settings_of(change="sit.average.final_layer.linear.bias") == usual


@pytest.mark.numerics("targets that grow with the network")
def test_trajectories_do_not_depend_on_the_average_velocity_that_is_trained():
    """Other than the targets of MeanFlow, which follow a network that has become steep."""
    module = stage_module("few_step")
    before = module.solve([0, 1])
    with torch.no_grad():
        for parameter in module.sit.average.parameters():
            parameter.mul_(4)
    assert torch.equal(module.solve([0, 1]), before)

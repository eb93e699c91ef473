"""SiT and UNet: what holds for every velocity network, and what is their own."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import nn

from r3dpa.nn import SiT, UNet

COMMON = {"in_channels": 3, "feature_dim": 5, "projector_dim": 12}
SIT = {"input_size": (4, 8), "hidden_size": 16, "depth": 3, "num_heads": 2, "alignment_depth": 2}
UNET = {"input_size": (4, 16), "channels": 32, "channel_multipliers": (1, 2), "head_channels": 16}
SIZES = {SiT: SIT | {"qk_norm": True}, UNet: UNET | {"num_res_blocks": 1}}
CLOSE = {"atol": 1e-5, "rtol": 1e-5}


def fresh(kind, **options):
    return kind(**COMMON | SIZES[kind] | options)


def build(kind, seed=0, **options):
    """Small network without zero layers, which would hide most of it."""
    torch.manual_seed(seed)
    network = fresh(kind, **options)
    for parameter in network.parameters():
        if not parameter.any():
            nn.init.normal_(parameter, std=0.2)
    return network


def inputs(network, batch=2, seed=1):
    generator = torch.Generator().manual_seed(seed)
    latents = torch.randn(batch, 3, *network.input_size, generator=generator)
    return latents, torch.rand(batch, generator=generator)


@pytest.fixture(params=[SiT, UNet])
def network(request):
    return build(request.param)


def test_all_ways_of_evaluation_agree(network):
    latents, time = inputs(network, batch=3)
    velocity, features = network(latents, time)
    rows, columns = network.grid_size
    assert (velocity.shape, features.shape) == (latents.shape, (3, rows * columns, 5))
    assert torch.equal(velocity, network.velocity(latents, time))
    assert torch.equal(features, network.project_features(latents, time))
    labels = torch.zeros(3, dtype=torch.long)
    assert torch.equal(velocity, network.velocity(latents, time, labels))
    table = network.modulations(time)
    assert torch.equal(network.velocity_at(latents, table), velocity)


def test_a_sample_does_not_depend_on_its_batch(network):
    """Nor does it with one row of modulations for all samples, whose float32 rounding differs."""
    latents, time = inputs(network, batch=3)
    velocity, features = network(latents, time)
    table = network.modulations(time)
    for index in range(3):
        one = slice(index, index + 1)
        alone = network(latents[one], time[one])
        torch.testing.assert_close(alone.velocity[0], velocity[index], **CLOSE)
        torch.testing.assert_close(alone.features[0], features[index], **CLOSE)
        shared = network.velocity_at(latents, table[one])[index]
        torch.testing.assert_close(shared, velocity[index], **CLOSE)


def test_aligned_pass_differentiates_the_features_alone(network):
    latents, time = inputs(network)
    velocity, features = network(latents, time)
    latents.requires_grad_()
    found, finish = network.aligned_pass(latents, time)
    assert torch.equal(found, features)
    finished = finish()
    assert torch.equal(finished, velocity)
    assert not finished.requires_grad
    (gradient,) = torch.autograd.grad(found.sum(), latents)
    (expected,) = torch.autograd.grad(network.project_features(latents, time).sum(), latents)
    torch.testing.assert_close(gradient, expected)


@pytest.mark.parametrize("kind", [SiT, UNet])
def test_time_and_class_matter(kind):
    network = build(kind, num_classes=3)
    latents, time = inputs(network)
    for evaluate in (network, lambda _, time: network.modulations(time)):
        with pytest.raises(ValueError, match="3 classes needs labels"):
            evaluate(latents, time)
    labels = torch.tensor([0, 2])
    velocity = network.velocity(latents, time, labels)
    assert torch.equal(network.velocity_at(latents, network.modulations(time, labels)), velocity)
    for other in ((time.flip(0), labels), (time, labels.flip(0))):
        assert not torch.allclose(velocity, network.velocity(latents, *other), atol=1e-4)


def test_inputs_of_another_shape_are_named(network):
    latents, time = inputs(network)
    rows, columns = network.input_size
    takes = rf"{type(network).__name__} takes latents \(2, 3, {rows}, {columns}\) for 2 times, got "
    for given, message in (
        ((latents[..., :6], time), rf"{takes}\(2, 3, {rows}, 6\)"),
        ((latents[:, :2], time), rf"{takes}\(2, 2, {rows}, {columns}\)"),
        ((latents, time[:1]), r"for 1 times, got \(2, .* and times \(1,\)"),
        ((latents[:1], time[0]), r"for 1 times, got \(1, .* and times \(\)"),
    ):
        with pytest.raises(ValueError, match=message):
            network(*given)


def test_float64_network_stays_float64(network):
    latents, time = inputs(network)
    narrow = network.velocity(latents, time)
    wide = network.double().velocity(latents.double(), time.double())
    assert wide.dtype == torch.float64
    torch.testing.assert_close(narrow.double(), wide, atol=1e-4, rtol=1e-4)


@pytest.mark.numerics
def test_halved_weights_and_autocast_stay_close(network):
    """Bfloat16 has 8 bits: a percent or two after about ten layers."""
    latents, time = inputs(network)
    velocity, features = network(latents, time)
    half = copy.deepcopy(network).to_bfloat16_()
    assert torch.equal(half.modulations(time), network.modulations(time))
    assert {p.dtype for p in half.parameters()} == {torch.float32, torch.bfloat16}
    assert {p.dtype for p in half.input_layer.parameters()} == {torch.float32}
    found = half.velocity(latents, time)
    assert found.dtype == torch.float32
    assert 0 < (found - velocity).norm() < 0.03 * velocity.norm()
    with torch.autocast("cpu", torch.bfloat16):
        mixed = network(latents, time)
        alone = network(latents[:1], time[:1])  # one modulation takes another way through the norm
    assert 0 < (mixed.velocity - velocity).norm() < 0.05 * velocity.norm()
    assert 0 < (mixed.features - features).norm() < 0.05 * features.norm()
    assert (alone.velocity[0] - mixed.velocity[0]).norm() < 0.05 * velocity[0].norm()


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (SiT, {"input_size": (4, 7)}, r"4 x 7 do not divide into patches of 2"),
        (SiT, {"num_heads": 3}, r"16 is not a multiple of num_heads 3"),
        (SiT, {"alignment_depth": 4}, r"1\.\.3, got 4"),
        (SiT, {"alignment_depth": 0}, r"1\.\.3, got 0"),
        (SiT, {"hidden_size": 6}, r"divisible by 4, got 6"),
        (UNet, {"input_size": (5, 16)}, "5 x 16 cannot be halved 1 times"),
        (UNet, {"channels": 40}, "40 is not a multiple of head_channels 16"),
        (UNet, {"channels": 48}, "multiple of 32"),
        (UNet, {"attention_resolutions": [4]}, r"among \[1, 2\], got \[4\]"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(kind, options, message):
    with pytest.raises(ValueError, match=message):
        fresh(kind, **options)


@pytest.mark.numerics
@pytest.mark.parametrize("half_weights", [False, True])
def test_1000_times_have_1000_embeddings_in_half_precision(half_weights):
    embedder = build(SiT).t_embedder
    if half_weights:
        embedder = embedder.bfloat16()
    times = torch.linspace(0, 1, 1000)
    with torch.autocast("cpu", torch.bfloat16):
        embeddings = embedder(times)
    assert embeddings.dtype == torch.float32
    assert len(embeddings.unique(dim=0)) == 1000
    wide = embedder.double()
    differences = torch.diff(embeddings.double(), dim=0) * 999
    middles = (times[1:] + times[:-1]).double() / 2
    derivative = torch.func.jvp(wide, (middles,), (torch.ones_like(middles),))[1]
    error = (differences - derivative).norm(dim=1) / derivative.norm(dim=1)
    assert error.max() < 0.01
    assert len(times.bfloat16().unique()) < 600  # the times themselves would coincide
    if not half_weights:
        with torch.autocast("cpu", torch.bfloat16):
            rows = build(UNet).modulations(times)
        assert rows.dtype == torch.float32
        assert len(rows.unique(dim=0)) == 1000


def test_fresh_networks_have_velocity_zero_and_blocks_of_sit_do_nothing():
    for network in (fresh(UNet), sit := fresh(SiT)):
        assert not network.velocity(*inputs(network)).any()
    latents, time = inputs(sit)
    tokens = sit.x_embedder(latents) + sit.pos_embed
    assert torch.equal(sit.project_features(latents, time), sit.projector(tokens))
    bound = math.sqrt(6 / (16 + 3 * 16))  # Xavier for the 16 -> 48 layer
    weight = sit.blocks[0].attn.qkv.weight
    assert 0.9 * bound < weight.abs().max() <= bound
    assert sit.blocks[0].attn.qkv.bias.abs().max() == 0
    assert 0.015 < sit.t_embedder.mlp[0].weight.std() < 0.025


@pytest.mark.numerics
def test_token_norm_of_constant_tokens_is_finite():
    sit = build(SiT)
    nn.init.zeros_(sit.x_embedder.proj.weight)
    nn.init.zeros_(sit.x_embedder.proj.bias)
    sit.pos_embed.zero_()
    latents, time = inputs(sit)
    latents.requires_grad_()
    output = sit(latents, time)
    output.velocity.sum().backward()
    assert output.velocity.isfinite().all()
    assert latents.grad.isfinite().all()
    tokens = torch.zeros(8, 16)
    assert (tokens / tokens.std(dim=1, keepdim=True)).isnan().all()  # without eps


def test_half_weights_leave_the_token_stream_in_float32():
    """Closer to float32 than half of everything, which rounds the tokens in every block."""
    sit, half, all_half = (build(SiT, depth=8) for _ in range(3))
    latents, time = inputs(sit, batch=16)
    expected = sit.velocity(latents, time)
    error = (half.to_bfloat16_().velocity(latents, time) - expected).norm()
    naive = all_half.bfloat16().velocity(latents.bfloat16(), time).float()
    assert 0 < error < 0.7 * (naive - expected).norm()


def test_columns_wrap_around_but_for_the_position_bias():
    """Rotated by one cell of the middle block, everything turns along; a bias breaks that."""
    unet = build(UNet)
    latents, time = inputs(unet)
    rotated = latents.roll(2, dims=-1)

    def turned():
        velocity, features = unet(rotated, time)
        grid = features.unflatten(1, unet.grid_size)
        return velocity.roll(-2, dims=-1), grid.roll(-1, dims=2).flatten(1, 2)

    expected = unet(latents, time)
    assert (turned()[0] - expected.velocity).abs().max() > 0.01
    nn.init.zeros_(unet.ape.bias)
    expected = unet(latents, time)
    for found, value in zip(turned(), expected, strict=True):
        torch.testing.assert_close(found, value, atol=1e-5, rtol=1e-5)


def test_attention_blocks_stand_at_the_chosen_resolutions():
    """LiDM's names: the residual block is layer 0, attention layer 1, a step up the last one."""
    unet = build(UNet, channel_multipliers=(1, 2, 1), attention_resolutions=[2])
    letters = {"in_layers": "r", "norm": "a", "op": "-", "up": "+"}  # by the first part of a layer
    kinds = [
        "".join(letters[next(iter(layer._modules))] for layer in block)
        for block in (*unet.input_blocks[1:], unet.middle_block, *unet.output_blocks)
    ]
    assert " ".join(kinds) == "r - ra - r rar r r+ ra ra+ r r"
    assert unet.velocity(*inputs(unet)).isfinite().all()
    every = fresh(UNet, attention_resolutions=[2, 1])
    assert every.state_dict().keys() == fresh(UNet).state_dict().keys()

"""What holds for every velocity network, SiT and UNet."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from r3dpa.nn import SiT, UNet

COMMON = {"in_channels": 3, "feature_dim": 5, "projector_dim": 12}
SIZES = {
    SiT: {
        "input_size": (4, 8),
        "hidden_size": 16,
        "depth": 3,
        "num_heads": 2,
        "alignment_depth": 2,
        "qk_norm": True,
    },
    UNet: {
        "input_size": (4, 16),
        "channels": 32,
        "channel_multipliers": (1, 2),
        "num_res_blocks": 1,
        "head_channels": 16,
    },
}
CLOSE = {"atol": 1e-5, "rtol": 1e-5}


def build(kind, seed=0, **options):
    """Small network without zero layers, which would hide most of it."""
    torch.manual_seed(seed)
    network = kind(**{**COMMON, **SIZES[kind], **options})
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
    assert table.shape == (3, network.modulation_width)
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
    found = network.aligned_pass(latents, time)
    assert torch.equal(found.features, features)
    finished = found.velocity()
    assert torch.equal(finished, velocity)
    assert not finished.requires_grad
    (gradient,) = torch.autograd.grad(found.features.sum(), latents)
    (expected,) = torch.autograd.grad(network.project_features(latents, time).sum(), latents)
    torch.testing.assert_close(gradient, expected)


def trained(network):
    """Names of the parts, and of the blocks of SiT, that have gradients."""
    names = [name.split(".") for name, p in network.named_parameters() if p.grad is not None]
    network.zero_grad()
    return {".".join(name[: 2 if name[0] == "blocks" else 1]) for name in names}


@pytest.mark.parametrize(
    ("kind", "first", "last"),
    [
        (
            SiT,
            {"x_embedder", "t_embedder", "y_embedder", "blocks.0", "blocks.1"},
            {"blocks.2", "final_layer"},
        ),
        (
            UNet,
            {"time_embed", "label_emb", "input_blocks", "ape", "middle_block"},
            {"output_blocks", "out"},
        ),
    ],
)
def test_features_and_velocity_train_their_layers(kind, first, last):
    network = build(kind)
    latents, time = inputs(network)
    network.project_features(latents, time).sum().backward()
    assert trained(network) == first | {"projector"}
    network.velocity(latents, time).sum().backward()
    assert trained(network) == first | last


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
    built = rf"{type(network).__name__} was built for .*\(B, 3, {rows}, {columns}\), got \(2, "
    width = network.modulation_width
    for given, message in (
        ((latents[..., :6], time), rf"{built}3, {rows}, 6\)"),
        ((latents[:, :2], time), rf"{built}2, {rows}, {columns}\)"),
        ((latents, time[:1]), r"one value per sample, shape \(2,\), got \(1,\)"),
        ((latents, time, torch.zeros(3, dtype=torch.long)), r"shape \(2,\), got \(3,\)"),
    ):
        with pytest.raises(ValueError, match=message):
            network(*given)
    with pytest.raises(ValueError, match=rf"rows of {width} numbers.*\.modulations"):
        network.velocity_at(latents, torch.zeros(1, width - 1))
    with pytest.raises(ValueError, match=r"1 row or one for each of 2 samples, got 3"):
        network.velocity_at(latents, torch.zeros(3, width))


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
    half = copy.deepcopy(network).halve_()
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


@pytest.mark.numerics
def test_1000_times_have_1000_rows_under_autocast():
    """Of the UNet; the embedding of SiT has a test of its own."""
    with torch.autocast("cpu", torch.bfloat16):
        rows = build(UNet).modulations(torch.linspace(0, 1, 1000))
    assert rows.dtype == torch.float32
    assert len(rows.unique(dim=0)) == 1000

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import torch
import yaml
from torch import nn

from r3dpa.nn import UNet

CONF = Path(__file__).resolve().parents[2] / "conf" / "net"
SMALL = {
    "input_size": (4, 16),
    "in_channels": 3,
    "channels": 32,
    "channel_multipliers": (1, 2),
    "num_res_blocks": 1,
    "head_channels": 16,
    "feature_dim": 5,
    "projector_dim": 12,
}


def build(seed=0, **options):
    """Small UNet without zero layers, which would hide most of it."""
    torch.manual_seed(seed)
    unet = UNet(**{**SMALL, **options})
    for parameter in unet.parameters():
        if not parameter.any():
            nn.init.normal_(parameter, std=0.1)
    return unet


def inputs(batch=2, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, 3, 4, 16, generator=generator), torch.rand(batch, generator=generator)


def test_all_ways_of_evaluation_agree():
    unet, (latents, time) = build(), inputs()
    velocity, features = unet(latents, time)
    assert velocity.shape == latents.shape
    assert unet.grid_size == (2, 8)
    assert features.shape == (2, 16, 5)
    assert torch.equal(velocity, unet.velocity(latents, time))
    assert torch.equal(features, unet.project_features(latents, time))
    assert torch.equal(velocity, unet.velocity(latents, time, torch.zeros(2, dtype=torch.long)))
    table = unet.modulations(time)
    assert torch.equal(unet.velocity_at(latents, table), velocity)
    for index in range(2):
        shared = unet.velocity_at(latents, table[index : index + 1])[index]
        torch.testing.assert_close(shared, velocity[index], atol=1e-5, rtol=1e-5)


def test_aligned_pass_differentiates_the_features_alone():
    unet, (latents, time) = build(), inputs()
    velocity, features = unet(latents, time)
    latents.requires_grad_()
    found = unet.aligned_pass(latents, time)
    assert torch.equal(found.features, features)
    finished = found.velocity()
    assert torch.equal(finished, velocity)
    assert not finished.requires_grad
    (gradient,) = torch.autograd.grad(found.features.sum(), latents)
    (expected,) = torch.autograd.grad(unet.project_features(latents, time).sum(), latents)
    torch.testing.assert_close(gradient, expected)


def test_a_single_sample_equals_that_of_a_batch():
    """The official forward pass fails for one sample."""
    unet, (latents, time) = build(), inputs(batch=3)
    velocity, features = unet(latents, time)
    for index in range(3):
        alone = unet(latents[index : index + 1], time[index : index + 1])
        torch.testing.assert_close(alone.velocity[0], velocity[index], atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(alone.features[0], features[index], atol=1e-5, rtol=1e-5)


def test_columns_wrap_around_but_for_the_position_bias():
    """Rotated by one cell of the middle block, everything turns along; a bias breaks that."""
    unet, (latents, time) = build(), inputs()
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


def test_rows_do_not_wrap_around():
    unet, (latents, time) = build(), inputs()
    nn.init.zeros_(unet.ape.bias)
    turned = unet.velocity(latents.roll(2, dims=-2), time).roll(-2, dims=-2)
    assert (turned - unet.velocity(latents, time)).abs().max() > 0.01


def trained_parts(unet):
    return {name.split(".")[0] for name, p in unet.named_parameters() if p.grad is not None}


def test_features_train_the_way_down_and_the_velocity_all_but_the_projector():
    unet, (latents, time) = build(), inputs()
    unet.project_features(latents, time).sum().backward()
    below = {"time_embed", "label_emb", "input_blocks", "ape", "middle_block"}
    assert trained_parts(unet) == below | {"projector"}
    unet.zero_grad()
    unet.velocity(latents, time).sum().backward()
    assert trained_parts(unet) == below | {"output_blocks", "out"}


def test_a_fresh_network_has_velocity_zero():
    latents, time = inputs()
    assert not UNet(**SMALL).velocity(latents, time).any()


def test_attention_at_chosen_resolutions():
    """LiDM's names: the residual block is layer 0, attention layer 1, a step up the last one."""
    unet = build(channel_multipliers=(1, 2, 1), attention_resolutions=[2])
    kinds = [
        [type(layer).__name__.strip("_") for layer in block]
        for block in (*unet.input_blocks[1:], unet.middle_block, *unet.output_blocks)
    ]
    res, attention = "TimedResBlock", "HeadsAttention"
    down = [[res], ["HalfSize"], [res, attention], ["HalfSize"], [res]]
    up = [
        [res],
        [res, "DoubleSize"],
        [res, attention],
        [res, attention, "DoubleSize"],
        [res],
        [res],
    ]
    assert kinds == [*down, [res, attention, res], *up]
    latents, time = inputs()
    assert unet.velocity(latents, time).isfinite().all()
    every = build(attention_resolutions=[2, 1])
    assert every.state_dict().keys() == build().state_dict().keys()
    with pytest.raises(ValueError, match=r"among \[1, 2\], got \[4\]"):
        build(attention_resolutions=[4])


def test_time_and_class_matter():
    unet, (latents, time) = build(num_classes=3), inputs()
    with pytest.raises(ValueError, match="3 classes needs labels"):
        unet(latents, time)
    labels = torch.tensor([0, 2])
    velocity = unet.velocity(latents, time, labels)
    other = unet.velocity(latents, time.flip(0), labels)
    assert not torch.allclose(velocity, other, atol=1e-4)
    assert not torch.allclose(velocity, unet.velocity(latents, time, labels.flip(0)), atol=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"input_size": (5, 16)}, "5 x 16 cannot be halved 1 times"),
        ({"channels": 40}, "40 is not a multiple of head_channels 16"),
        ({"channels": 48}, "multiple of 32"),
    ],
)
def test_sizes_that_do_not_divide_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        build(**options)


def test_wrong_shapes_are_named():
    unet, (latents, time) = build(), inputs()
    with pytest.raises(ValueError, match=r"UNet was built for .*\(B, 3, 4, 16\), got \(2, 3, 4, 8"):
        unet(latents[..., :8], time)
    with pytest.raises(ValueError, match=r"one value per sample, shape \(2,\), got \(1,\)"):
        unet.velocity(latents, time[:1])
    with pytest.raises(ValueError, match=r"rows of 128 numbers.*UNet\.modulations"):
        unet.velocity_at(latents, torch.zeros(1, 64))
    with pytest.raises(ValueError, match=r"1 row or one for each of 2 samples, got 3"):
        unet.velocity_at(latents, torch.zeros(3, 128))


@pytest.mark.numerics
def test_halved_weights_and_autocast_stay_close():
    """Bfloat16 has 8 bits: a percent or two after about ten layers."""
    unet, (latents, time) = build(), inputs()
    velocity, features = unet(latents, time)
    half = copy.deepcopy(unet).halve_()
    assert half.middle_block[0].in_layers[2].weight.dtype == torch.bfloat16
    assert half.input_layer[0].weight.dtype == torch.float32
    assert torch.equal(half.modulations(time), unet.modulations(time))
    found = half.velocity(latents, time)
    assert found.dtype == torch.float32
    assert 0 < (found - velocity).norm() < 0.03 * velocity.norm()
    with torch.autocast("cpu", torch.bfloat16):
        mixed = unet(latents, time)
    assert 0 < (mixed.velocity - velocity).norm() < 0.03 * velocity.norm()
    assert 0 < (mixed.features - features).norm() < 0.03 * features.norm()


@pytest.mark.numerics
def test_1000_times_have_1000_embeddings_under_autocast():
    unet = build()
    with torch.autocast("cpu", torch.bfloat16):
        rows = unet.modulations(torch.linspace(0, 1, 1000))
    assert rows.dtype == torch.float32
    assert len(rows.unique(dim=0)) == 1000


@pytest.mark.parametrize(
    ("name", "total", "head", "grid_size"),
    [
        ("unet_lidm", 266_146_056, 7_869_184, (4, 32)),
        ("unet_small", 108_141_000, 7_082_752, (4, 32)),
        ("unet_demo", 3_164_488, 296_192, (4, 16)),
    ],
)
def test_shipped_sizes(name, total, head, grid_size):
    config = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    assert config["class_path"] == "r3dpa.nn.UNet"
    with torch.device("meta"):
        unet = UNet(**config["init_args"])
    assert sum(p.numel() for p in unet.parameters()) == total
    assert sum(p.numel() for p in unet.projector.parameters()) == head
    assert unet.grid_size == grid_size

from __future__ import annotations

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

"""Position networks of HDiT, and how a released checkpoint names them."""

import math

import pytest
import torch
import torch.nn.functional as F

from r3dpa.baselines.hdit import HDiT
from r3dpa.baselines.readers import from_r2flow, hdit_weights, reverse_time

SIZES = {
    "resolution": (16, 128),
    "base_channels": 16,
    "time_channels": 16,
    "depths": (1, 1, 1, 1),
    "num_heads": (1, 1, 2, 4),
}
ENCODED = {"fourier_features": 18, "spherical_harmonics": 25, "polar_coordinates": 2}


def hdit_with(encoding):
    torch.manual_seed(0)
    network = HDiT(**SIZES, positional_embedding=encoding)
    for weight in network.parameters():
        torch.nn.init.normal_(weight, std=0.2)
    return network


@pytest.mark.parametrize("encoding", ENCODED)
def test_state_dict_of_a_position_network(encoding):
    """Names and shapes of R2Flow, whose two feed-forward layers are three times as wide."""
    shapes = {
        key: tuple(value.shape)
        for key, value in hdit_with(encoding).state_dict().items()
        if key.startswith("spatial_pe")
    }
    layers = {}
    for layer in (1, 2):
        layers[f"spatial_pe.1.{layer}.norm.scale"] = (16,)
        layers[f"spatial_pe.1.{layer}.gegelu.weight"] = (96, 16)
        layers[f"spatial_pe.1.{layer}.linear.weight"] = (16, 48)
    assert shapes == layers | {
        "spatial_pe.0.linear.weight": (16, ENCODED[encoding]),
        "spatial_pe.1.0.scale": (16,),
        "spatial_pe.1.3.scale": (16,),
    }


@torch.no_grad()
def test_position_network_of_fourier_features():
    """Sines and cosines of the mean angles of a token, at powers of two below its grid's sides."""
    network = hdit_with("fourier_features")
    inclination = (3 - 28 * torch.arange(16) / 16).deg2rad()
    azimuth = math.pi - 2 * math.pi * (torch.arange(32) * 4 + 1.5) / 128  # four columns a token
    phases = [factor * inclination[:, None].expand(16, 32) for factor in (1, 2, 4, 8)]
    phases += [factor * azimuth.expand(16, 32) for factor in (1, 2, 4, 8, 16)]
    phases = torch.stack(phases, dim=-1)
    weights = network.state_dict()

    def norm(x, name):
        scale = weights[f"spatial_pe.1.{name}.scale"]
        return x / (x.square().mean(-1, keepdim=True) + 1e-6).sqrt() * scale

    hidden = torch.cat([phases.sin(), phases.cos()], -1) @ weights["spatial_pe.0.linear.weight"].T
    hidden = norm(hidden, "0")
    for layer in (1, 2):
        inner = norm(hidden, f"{layer}.norm") @ weights[f"spatial_pe.1.{layer}.gegelu.weight"].T
        value, gate = inner.chunk(2, -1)
        hidden = hidden + (value * F.gelu(gate)) @ weights[f"spatial_pe.1.{layer}.linear.weight"].T
    found = network.spatial_pe(F.avg_pool2d(network.coords, (1, 4)))
    torch.testing.assert_close(found, norm(hidden, "3")[None], atol=1e-5, rtol=1e-5)
    image = torch.randn(1, 2, 16, 128)
    velocity = network(image, torch.tensor([0.3]))
    weights["spatial_pe.1.3.scale"].zero_()
    assert (network(image, torch.tensor([0.3])) - velocity).abs().max() > 0.01


@pytest.mark.parametrize("encoding", ENCODED)
def test_a_released_position_network_is_read(encoding, tmp_path):
    """Frequencies and phases, which are constants, are left out."""
    network = hdit_with(encoding)
    official = reverse_time(network.state_dict())
    if encoding == "fourier_features":
        official["spatial_pe.0.embedding.freqs"] = torch.ones(9, 2, 1, 1)
        official["spatial_pe.0.embedding.phase"] = torch.zeros(9)
    assert set(hdit_weights(official)) == set(network.state_dict())
    model = {
        "architecture": "nat_hdit",
        "base_channels": 16,
        "temb_channels": 16,
        "num_residual_blocks": SIZES["depths"],
        "attn_num_heads": SIZES["num_heads"],
        "coords_encoding": encoding,
    }
    data = {
        "data_format": "logscale",
        "train_reflectance": True,
        "resolution": SIZES["resolution"],
        "min_depth": 1.45,
        "max_depth": 80.0,
    }
    options = {"model": model, "data": data, "training": {"batch_size": 8}}
    options["finetuning"] = {"k_distil": None}
    content = {"cfg": options, "weights": official, "num_images": 80}
    read = from_r2flow(content, tmp_path / "r2flow.pth").network("ema_network").build()
    image, time = torch.randn(1, 2, 16, 128), torch.tensor([0.3])
    with torch.no_grad():
        torch.testing.assert_close(read(image, time), network(image, time), atol=1e-4, rtol=1e-4)

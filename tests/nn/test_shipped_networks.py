"""Sizes of the networks in conf/net."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest
import torch
import yaml

from r3dpa.nn import VAE

CONF = Path(__file__).resolve().parents[2] / "conf"
LATENTS = {
    "vae_h2p4d8": (8, 16, 128),
    "vae_h1p4d4": (4, 16, 256),
    "vae_h16d4": (4, 64, 64),
    "vae_h16p2d16": (16, 32, 32),
}


def build(name):
    """Network of conf/net without memory for its weights."""
    config = yaml.safe_load((CONF / "net" / f"{name}.yaml").read_text())
    module, _, kind = config["class_path"].rpartition(".")
    with torch.device("meta"):
        return getattr(import_module(module), kind)(**config.get("init_args", {}))


def count(network):
    return sum(parameter.numel() for parameter in network.parameters())


def test_parameters_of_the_paper_configuration():
    sit, vae = build("sit_b2"), build("vae_h2p4d8")
    with_position = count(sit) + sit.pos_embed.numel()
    assert with_position == 137_298_208
    assert with_position - count(sit.projector) == 129_953_312
    with torch.device("meta"):
        assert count(vae) == count(VAE()) == 59_660_649
    assert (sit.in_channels, *sit.input_size) == LATENTS["vae_h2p4d8"]


def test_unet_configs():
    for name, total, head, grid_size in (
        ("unet_lidm", 266_146_056, 7_869_184, (4, 32)),
        ("unet_small", 108_141_000, 7_082_752, (4, 32)),
    ):
        unet = build(name)
        assert (count(unet), count(unet.projector), unet.grid_size) == (total, head, grid_size)


@pytest.mark.parametrize("name", LATENTS)
def test_vae_config(name):
    vae = build(name)
    image = torch.empty(1, 1, 64, 1024, device="meta")
    latents = vae.encode(image).mean
    assert latents.shape == (1, *LATENTS[name])
    assert (vae.latent_channels, *vae.latent_size((64, 1024))) == LATENTS[name]
    assert vae.decode(latents).shape == image.shape

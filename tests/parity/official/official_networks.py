"""Networks with the same weights on both sides, and how far their results are apart."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch
from official_code import OfficialCode
from official_scripts import official_sit, official_vae
from torch import Tensor

from r3dpa.checkpoints import Checkpoint, NetworkState, to_official
from r3dpa.flow.noise import scene_random
from r3dpa.geometry import LidarSensor, RangeCodec
from r3dpa.nn import VAE, LatentNorm, PatchDiscriminator, SiT


class Pair(NamedTuple):
    """One network, official and ours, with the same weights, not for training."""

    theirs: Any
    ours: Any


def random_networks(sit: dict[str, Any], vae: dict[str, Any]) -> Checkpoint:
    """Networks for official range images whose layers are all random, none of them zero."""
    vae = {**vae, "legacy_upsample": True}
    norm: dict[str, Any] = {"channels": 8, "legacy_inverse": True}
    network, statistics = SiT(**sit), LatentNorm(**norm)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if parameter.dim() == 2 and not parameter.any():
                parameter.normal_(std=0.5 * parameter.shape[1] ** -0.5)
            elif name == "final_layer.linear.bias":
                parameter.normal_()
        statistics.num_batches_tracked.fill_(1)  # as if they were fitted
    states = {
        "vae": NetworkState.of(VAE(**vae), vae),
        "discriminator": NetworkState.of(PatchDiscriminator(), {}),
    }
    for sit_name, norm_name in (("sit", "latent_norm"), ("ema", "ema_latent_norm")):
        states[sit_name] = NetworkState.of(network, sit)
        states[norm_name] = NetworkState.of(statistics, norm)
    rows, columns = network.input_size
    sensor = LidarSensor(beams=4 * rows, columns=8 * columns)  # the strides of h2p4d8
    geometry = {
        "projection": {"kind": "spherical", "sensor": asdict(sensor)},
        "codec": asdict(RangeCodec()),
        "grid_size": list(network.grid_size),
    }
    return Checkpoint(Path("random"), "joint", states, geometry=geometry)


def sits(code: OfficialCode, networks: Checkpoint) -> Pair:
    """The averaged SiT on both sides."""
    theirs = official_sit(code, networks)
    theirs.load_state_dict(to_official(networks)["ema"])
    return Pair(theirs.eval(), networks.network("ema").build().eval())


def vaes(code: OfficialCode, networks: Checkpoint) -> Pair:
    """The VAE on both sides."""
    theirs = official_vae(code, networks)
    theirs.load_state_dict(to_official(networks)["vae"])
    return Pair(theirs.eval(), networks.network("vae").build().eval())


def noise_of(networks: Checkpoint, num: int, seed: int) -> Tensor:
    """``(num, C, h, w)``: what the SiT of a :class:`SceneGenerator` meets first for a seed."""
    sit = networks.network("ema").arguments
    shape = (sit["in_channels"], *sit["input_size"])
    return torch.stack([torch.randn(shape, generator=scene_random(seed, i)) for i in range(num)])


def relative(values: Tensor, reference: Tensor) -> float:
    """Root mean square of the difference over that of the reference."""
    difference = values.double() - reference.double()
    return (difference.square().mean() / reference.double().square().mean()).sqrt().item()

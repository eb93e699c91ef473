"""Tiny networks of every kind for checkpoints."""

import torch

from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.nn.discriminator import PatchDiscriminator
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.sit import SiT
from r3dpa.nn.vae import VAE

EXACT = {"atol": 0, "rtol": 0}
SIT_ARGS = {"input_size": (4, 8), "in_channels": 4, "hidden_size": 8, "depth": 3, "num_heads": 2}
SIT_ARGS |= {"alignment_depth": 2, "feature_dim": 6, "projector_dim": 10}
VAE_ARGS = {"latent_channels": 4, "channels": 32, "channel_multipliers": (1, 2, 2)}
VAE_ARGS |= {"strides": ((1, 2), (2, 2)), "num_res_blocks": 1, "attention_levels": (1,)}
VAE_ARGS |= {"legacy_upsample": True}
GEOMETRY = ScanGeometry(SphericalProjection(LidarSensor(8, 32)), RangeCodec("log2"), (2, 4))
NETWORKS = {
    "vae": (VAE, VAE_ARGS),
    "discriminator": (PatchDiscriminator, {"channels": 4}),
    "sit": (SiT, SIT_ARGS),
    "latent_norm": (LatentNorm, {"channels": 4}),
    "ema": (SiT, SIT_ARGS),
    "ema_latent_norm": (LatentNorm, {"channels": 4}),
}


def randomised(network):
    for value in network.state_dict().values():
        value.copy_(torch.rand_like(value) if value.is_floating_point() else torch.tensor(7))
    return network


def assert_same_networks(actual, expected):
    assert set(actual.networks) == set(expected.networks)
    for name, state in expected.networks.items():
        own = actual.network(name)
        assert own.class_path == state.class_path
        assert own.arguments == state.arguments
        torch.testing.assert_close(own.state_dict, state.state_dict, **EXACT)


OFFICIAL_SIT_ARGS = {"num_heads": 2, "input_size": (4, 8)}

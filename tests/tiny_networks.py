"""Networks with random weights for images of 16 x 64 pixels, and a checkpoint of them."""

from __future__ import annotations

from pathlib import Path

import torch

from r3dpa.checkpoints import Checkpoint, NetworkState, save_checkpoint
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.nn import VAE, AverageVelocitySiT, LatentNorm, SiT, ThinDecoder

GEOMETRY = ScanGeometry(SphericalProjection(LidarSensor(16, 64)), RangeCodec(), (2, 8))
VAE_ARGS = {"latent_channels": 4, "channels": 32, "num_res_blocks": 1}
VAE_ARGS |= {"channel_multipliers": [1, 1, 1], "strides": [[2, 2], [2, 2]]}
SIT_ARGS = {"input_size": [4, 16], "in_channels": 4, "hidden_size": 32, "depth": 2, "num_heads": 2}
SIT_ARGS |= {"alignment_depth": 1, "feature_dim": 8, "projector_dim": 8}


def tiny_networks(spread=0.1, vae_args=VAE_ARGS, **sit_args):
    """``vae, sit, norm``: weights spread at random, so that scenes differ and have holes."""
    torch.manual_seed(0)
    kind = AverageVelocitySiT if "average_blocks" in sit_args else SiT
    vae, sit, norm = VAE(**vae_args), kind(**SIT_ARGS | sit_args), LatentNorm(4)
    with torch.no_grad():
        for parameter in sit.parameters():
            parameter.add_(spread * torch.randn_like(parameter))
        vae.decoder.conv_out.weight.mul_(3)
    norm.update(1.0 + 2.0 * torch.randn(8, 4, 4, 16))
    return vae, sit, norm


def tiny_checkpoint(
    path, geometry=GEOMETRY, spread=0.1, sit_args=None, stage="joint", vae_args=VAE_ARGS, **fields
):
    """Checkpoint of a stage for inference, of :func:`tiny_networks`."""
    if stage == "few_step":
        sit_args = {"average_blocks": 1, **(sit_args or {})}
    vae, sit, norm = tiny_networks(spread, vae_args, **sit_args or {})
    networks = {
        "vae": NetworkState.of(vae, vae_args),
        "ema": NetworkState.of(sit, SIT_ARGS | (sit_args or {})),
        "ema_latent_norm": NetworkState.of(norm, {"channels": 4}),
    }
    if stage == "few_step":
        arguments = VAE_ARGS | {"num_res_blocks": 0}
        thin = ThinDecoder(**arguments)
        with torch.no_grad():
            thin.decoder.conv_out.weight.mul_(3)
        networks["thin_decoder"] = NetworkState.of(thin, arguments)
    content = Checkpoint(Path("tiny"), stage, networks, geometry=geometry.to_dict(), **fields)
    return save_checkpoint(content, path)


def aligned_velocity(velocity, project_features):
    """An aligned velocity of two functions that share no work."""

    def evaluate(x, time):
        def finish():
            with torch.no_grad():
                return velocity(x.detach(), time)

        return project_features(x, time), finish

    return evaluate

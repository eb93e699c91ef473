"""Checkpoints: our files, Lightning's and the official ones, with strict loading."""

from r3dpa.checkpoints.files import convert, read_checkpoint, save_checkpoint
from r3dpa.checkpoints.networks import Checkpoint, NetworkState, load_into
from r3dpa.checkpoints.official import from_official, to_official
from r3dpa.checkpoints.transfer import (
    read_snapshot,
    transfer_rgb,
    vae_fingerprint,
    with_further_channels,
    with_projector_of,
    without_further_channels,
)
from r3dpa.io import weights_sha256

__all__ = [
    "Checkpoint",
    "NetworkState",
    "convert",
    "from_official",
    "load_into",
    "read_checkpoint",
    "read_snapshot",
    "save_checkpoint",
    "to_official",
    "transfer_rgb",
    "vae_fingerprint",
    "weights_sha256",
    "with_further_channels",
    "with_projector_of",
    "without_further_channels",
]

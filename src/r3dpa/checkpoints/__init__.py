"""Checkpoints: our files, Lightning's and the official ones, with strict loading."""

from r3dpa.checkpoints.convert import (
    ConversionReport,
    TransferReport,
    TransferRow,
    convert,
    transfer_rgb,
)
from r3dpa.checkpoints.files import read_checkpoint, save_checkpoint
from r3dpa.checkpoints.networks import Checkpoint, NetworkState, load_into, weights_sha256
from r3dpa.checkpoints.official import from_official, to_official

__all__ = [
    "Checkpoint",
    "ConversionReport",
    "NetworkState",
    "TransferReport",
    "TransferRow",
    "convert",
    "from_official",
    "load_into",
    "read_checkpoint",
    "save_checkpoint",
    "to_official",
    "transfer_rgb",
    "weights_sha256",
]

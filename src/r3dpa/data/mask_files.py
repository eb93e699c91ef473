"""Masks that users draw: pictures of the size of a range image."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from r3dpa.geometry import LidarSensor

__all__ = ["read_mask"]

_MODES = ("1", "L", "LA", "P", "RGB", "RGBA")
_BRIGHT = 128


def read_mask(path: str | Path, sensor: LidarSensor) -> Tensor:
    """Mask from a picture: True where it is bright in any colour, and opaque.

    Args:
        path: Picture of H x W pixels, one for each of the range image; PNG keeps them exact.
        sensor: Size of the range image.

    Returns:
        ``(H, W)`` bool.

    Raises:
        ValueError: If the file is no picture of 8 bits a colour, or of another size; it is named.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # refused by size below
            with Image.open(path) as picture:
                if picture.size != (sensor.columns, sensor.beams):
                    width, height = picture.size
                    raise ValueError(
                        f"{path}: has {height} x {width} pixels (rows x columns), but the range "
                        f"image {sensor.beams} x {sensor.columns}: draw one pixel for each"
                    )
                if picture.mode not in _MODES:
                    raise ValueError(
                        f"{path}: has pixels of type {picture.mode}; save it with 8 bits a colour"
                    )
                pixels = np.asarray(picture.convert("RGBA"))
    except (OSError, SyntaxError, Image.DecompressionBombError, UnidentifiedImageError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"{path}: cannot be read as a picture ({reason})") from error
    bright = pixels[..., :3].max(axis=2) >= _BRIGHT
    return torch.from_numpy(bright & (pixels[..., 3] >= _BRIGHT))

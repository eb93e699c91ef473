"""Arrays to pixels and to files: what all pictures share."""

from __future__ import annotations

import io
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.colors import Colormap, ListedColormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from r3dpa.io import atomic_path

Array = Tensor | NDArray[np.generic]
Pixels = NDArray[np.uint8]

BACKGROUND = (10, 10, 14)  # RGB of "no return"; darker than every colour of the maps


def save(picture: Figure | Pixels, path: str | Path) -> Path:
    """Writes a figure or a picture atomically, in the format of the suffix.

    Args:
        picture: Figure, or uint8 pixels ``(rows, columns)`` or ``(rows, columns, 3)``.
        path: Its folder is made if missing.

    Raises:
        ValueError: If the suffix is not a known format or the pixels are not uint8.
    """
    with atomic_path(path := Path(path)) as temporary:
        if isinstance(picture, Figure):
            picture.savefig(temporary)
        elif picture.dtype == np.uint8:
            Image.fromarray(picture).save(temporary)
        else:
            raise ValueError(f"pixels are {picture.dtype}; give uint8 from 0 to 255")
    return path


def palette_image(picture: Figure | Pixels, colours: int = 64) -> Image.Image:
    """The picture with few colours, a third of the size as PNG: for notebooks."""
    if isinstance(picture, Figure):
        picture.savefig(file := io.BytesIO(), format="png")
        return Image.open(file).convert("RGB").quantize(colours)
    return Image.fromarray(picture).quantize(colours)


def as_numpy(array: Array, axes: tuple[str, ...]) -> NDArray[np.float64]:
    """The array in float64 on the CPU, checked to have the named axes."""
    if array.ndim != len(axes):
        raise ValueError(f"expected shape ({', '.join(axes)}), got {tuple(array.shape)}")
    if isinstance(array, Tensor):
        return array.detach().double().cpu().numpy()
    return array.astype(np.float64)


def bright_part(name: str, start: float) -> Colormap:
    """The part of a named colour map from ``start`` in [0, 1] on, to stand out from the dark."""
    return ListedColormap(matplotlib.colormaps[name](np.linspace(start, 1.0, 256)))


def paint(values: NDArray[np.float64], colour_map: Colormap, scale: Normalize) -> Pixels:
    """RGB bytes of values; values outside the scale take the end colours."""
    return colour_map(scale(values), bytes=True)[..., :3]


def as_bytes(colours: NDArray[np.float64]) -> Pixels:
    """RGB in [0, 1] as uint8."""
    return np.rint(np.clip(colours, 0, 1) * 255).astype(np.uint8)


def enlarge(picture: Pixels, scale: int) -> Pixels:
    """Every pixel as a square of ``scale`` x ``scale``."""
    if scale < 1:
        raise ValueError(f"scale is {scale}; give a whole number of at least 1")
    return picture.repeat(scale, axis=0).repeat(scale, axis=1)

"""The dead-leaves model: procedural images with the statistics of natural ones.

Letters: S side of a square image.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r3dpa.data.images import ImageEntry, ImageSource

_VERSION = 1  # to be raised when other pixels come out of the same settings
_OVERSAMPLING = 2  # samples per pixel and axis, averaged: edges are no staircases
_COVERED = 0.99  # share of an image at which the rest is left to the background
_MOST_SHAPES = 600
_PALETTE = 6  # colours that the shapes of an image vary


@dataclass(frozen=True)
class DeadLeaves(ImageSource):
    """The dead-leaves model of natural images, drawn when an image is read.

    Discs and polygons occlude each other, their radii with density ``r^-3`` between ``smallest``
    and ``largest`` times the side of the image, so that the power spectrum falls as ``1 / f^2``.
    Each has a colour near one of a palette, a gradient of light, and its part of a texture with
    spectrum ``1 / f``. An image is a function of ``seed`` and its number alone.

    Source: Lee, Mumford and Huang, "Occlusion models for natural images" (IJCV 2001); as training
    data: Baradad et al., "Learning to see by looking at noise" (NeurIPS 2021).

    Args:
        num_images: Number of images.
        seed: Seed of all of them.
        smallest: Smallest radius in sides of the image.
        largest: Largest radius in sides of the image.
    """

    num_images: int = 100_000
    seed: int = 0
    smallest: float = 0.06
    largest: float = 0.5

    def entries(self) -> list[ImageEntry]:
        """Entries named by their number."""
        place = Path("dead_leaves")
        return [ImageEntry(f"{index:09d}", place, 0) for index in range(self.num_images)]

    def read(self, entry: ImageEntry, size: int) -> NDArray[np.uint8]:
        """Draw an image ``(S, S, 3)``."""
        generator = np.random.default_rng((self.seed, int(entry.name.partition(".")[0])))
        return dead_leaves(generator, size, self.smallest, self.largest)

    def settings(self) -> dict[str, Any]:
        """All but the number of images, which changes none of them."""
        values = {**asdict(self), "version": _VERSION}
        del values["num_images"]
        return values


def dead_leaves(
    generator: np.random.Generator, size: int, smallest: float = 0.06, largest: float = 0.5
) -> NDArray[np.uint8]:
    """One image ``(S, S, 3)`` uint8 of the model that :class:`DeadLeaves` describes.

    Shapes are drawn from the front to the back, each where nothing is drawn yet.
    """
    side = size * _OVERSAMPLING
    # Lightness varies more than hue, as in nature.
    lightness = generator.uniform(0.1, 0.9, (_PALETTE, 1))
    palette = (lightness + generator.normal(0, 0.1, (_PALETTE, 3))).astype(np.float32)
    texture = _texture(generator, side)
    image = np.empty((side, side, 3), np.float32)
    image[:] = palette[0] + 0.1 * texture[..., None]
    free = np.ones((side, side), bool)
    num_free, enough = side * side, (1 - _COVERED) * side * side
    for _ in range(_MOST_SHAPES):
        # Inverse of the distribution of r^-3 between the two radii.
        low, high = (smallest * side) ** -2, (largest * side) ** -2
        radius = (low + generator.random() * (high - low)) ** -0.5
        centre = generator.uniform(-radius, side + radius, 2)
        first = np.clip(np.floor(centre - radius).astype(int), 0, side)
        last = np.clip(np.ceil(centre + radius).astype(int) + 1, 0, side)
        box = slice(first[0], last[0]), slice(first[1], last[1])
        if not free[box].any():
            continue
        rows = np.arange(first[0], last[0], dtype=np.float32)[:, None] - np.float32(centre[0])
        columns = np.arange(first[1], last[1], dtype=np.float32)[None] - np.float32(centre[1])
        drawn = _inside(generator, rows, columns, radius) & free[box]
        count = int(drawn.sum())
        colour = palette[generator.integers(_PALETTE)] + generator.normal(0, 0.05, 3)
        slope = generator.normal(0, 0.06, 2).astype(np.float32)
        roughness = float(generator.exponential(0.06))
        shade = slope[0] * rows / radius + slope[1] * columns / radius + roughness * texture[box]
        image[box][drawn] = colour.astype(np.float32) + shade[drawn][:, None]
        free[box][drawn] = False
        num_free -= count
        if num_free <= enough:
            break
    pixels = image.reshape(size, _OVERSAMPLING, size, _OVERSAMPLING, 3).mean(axis=(1, 3))
    return np.clip(255.0 * pixels + 0.5, 0, 255).astype(np.uint8)


def _inside(
    generator: np.random.Generator,
    rows: NDArray[np.float32],
    columns: NDArray[np.float32],
    radius: float,
) -> NDArray[np.bool_]:
    """Whether points relative to the centre lie in a random disc or convex polygon."""
    corners = int(generator.integers(2, 8))
    if corners == 2:  # a disc
        return rows**2 + columns**2 <= radius**2
    turns = np.arange(corners) + generator.random() + generator.uniform(-0.3, 0.3, corners)
    angles = 2 * math.pi / corners * turns
    inner = radius * math.cos(math.pi / corners)
    inside = np.ones((len(rows), columns.shape[1]), bool)
    for row, column in zip(np.sin(angles), np.cos(angles), strict=True):
        inside &= np.float32(row) * rows + np.float32(column) * columns <= inner
    return inside & (rows**2 + columns**2 <= radius**2)


def _texture(generator: np.random.Generator, side: int) -> NDArray[np.float32]:
    """Gaussian field ``(side, side)`` of mean 0 and variance 1 with amplitude ``1 / f``."""
    noise = np.fft.rfft2(generator.standard_normal((side, side)))
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None])
    frequency[0, 0] = np.inf  # no mean
    field = np.fft.irfft2(noise / frequency, (side, side))
    return (field / field.std()).astype(np.float32)

"""Random numbers by key: equal keys give equal draws."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

#: Rays that an effect touches: indices ``(M,)``, or ``slice(None)`` for all.
RayIndex = NDArray[np.int64] | slice


def generator_for(*key: int | str) -> np.random.Generator:
    """Random generator of a key of numbers (0 or greater) and words.

    Raises:
        ValueError: If a number is negative or has a fraction.
    """
    words = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key]
    try:
        sequence = np.random.SeedSequence(words)
    except (TypeError, ValueError) as error:
        numbers = ", ".join(str(part) for part in key if not isinstance(part, str))
        raise ValueError(f"seed must be a whole number, 0 or greater, got {numbers}") from error
    return np.random.Generator(np.random.Philox(sequence))


def smooth_field(
    shape: tuple[int, int], width: tuple[float, float], generator: np.random.Generator
) -> NDArray[np.float64]:
    """Normal field of unit variance over beams and shots, alike within ``width`` of both."""
    field = gaussian_filter(generator.standard_normal(shape), width, mode="wrap")
    return field / field.std()


class Draws:
    """Random numbers of one effect in one scan, one per ray.

    Each key has its own counter-based generator (Philox). A call draws for all rays of the turn and
    returns the requested ones, so that the number of a ray depends neither on the selection of
    rays nor on any other effect.
    """

    def __init__(self, num_rays: int, *key: int | str) -> None:
        self._generator = generator_for(*key)
        self._num_rays = num_rays

    def uniform(self, rays: RayIndex) -> NDArray[np.float32]:
        """Uniform in [0, 1)."""
        return self._generator.random(self._num_rays, dtype=np.float32)[rays]

    def normal(self, rays: RayIndex) -> NDArray[np.float32]:
        """Standard normal."""
        return self._generator.standard_normal(self._num_rays, dtype=np.float32)[rays]

    def exponential(self, rays: RayIndex) -> NDArray[np.float32]:
        """Exponential of mean 1."""
        return self._generator.standard_exponential(self._num_rays, dtype=np.float32)[rays]

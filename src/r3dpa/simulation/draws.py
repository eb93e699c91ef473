"""Random numbers by key: equal keys, equal draws, whatever else is drawn."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

#: Rays that an effect touches: indices ``(M,)``, or ``slice(None)`` for all.
RayIndex = NDArray[np.int64] | slice


def generator_for(*key: int | str) -> np.random.Generator:
    """Random generator of a key of numbers (0 or greater) and words."""
    words = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(words)))


class Draws:
    """Random numbers of one effect in one scan, one per ray.

    A counter-based generator (Philox) of its own per key; each call draws for all rays of the turn
    and returns those asked for, so that a ray's number depends neither on which other rays are
    touched nor on any other effect.
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

"""Random generators by key: equal keys, equal draws, whatever else is drawn."""

from __future__ import annotations

import zlib

import numpy as np


def generator_for(*key: int | str) -> np.random.Generator:
    """Random generator of a key of numbers (0 or greater) and words."""
    words = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(words)))

"""Noise of scenes, a function of the seed and the number of a scene alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor


def scene_noise(shape: tuple[int, int, int], indices: Sequence[int], seed: int) -> Iterator[Tensor]:
    """Noise after noise ``(B, C, h, w)`` for samples ``(C, h, w)`` of scenes, on the CPU."""
    generators = [scene_random(seed, index) for index in indices]
    while True:
        yield torch.stack([torch.randn(shape, generator=g) for g in generators])


def scene_uniform(shape: Sequence[int], indices: Sequence[int], seed: int) -> Tensor:
    """Uniform draws ``(B, H, W)`` per scene on the CPU, independent of the noise stream."""
    return torch.stack([torch.rand(shape, generator=scene_random(seed, i, 1)) for i in indices])


def scene_random(seed: int, index: int, *stream: int) -> torch.Generator:
    """Random numbers of a scene, on the CPU; without a stream, the ones of its noise."""
    key = np.random.SeedSequence([seed, index, *stream]).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(key[0]) >> 1)

"""Noise of scenes, a function of the seed and the number of a scene alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

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


def scene_normal(shape: Sequence[int], indices: Sequence[int], seed: int) -> Tensor:
    """Normal draws ``(B, H, W)`` per scene on the CPU, in a stream of their own."""
    return torch.stack([torch.randn(shape, generator=scene_random(seed, i, 2)) for i in indices])


def scene_random(seed: int, index: int, *stream: int) -> torch.Generator:
    """Random numbers of a scene, on the CPU; without a stream, the ones of its noise.

    Raises:
        ValueError: If the seed is no whole number of 0 or greater.
    """
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed must be a whole number, 0 or greater, got {seed!r}")
    return random_generator([seed, index, *stream])


def random_generator(
    key: Sequence[int], device: torch.device | str = "cpu", bits: Literal[32, 63] = 63
) -> torch.Generator:
    """Random numbers of a key of whole numbers, 0 or greater: equal keys give equal draws.

    Args:
        key: Such as seed, stream and number of a batch.
        device: Where the numbers are drawn.
        bits: Bits of the seed that the key becomes. Training draws with 32, so that runs of earlier
            versions can be repeated.
    """
    sequence = np.random.SeedSequence(key)
    if bits == 32:
        seed = int(sequence.generate_state(1)[0])
    else:
        seed = int(sequence.generate_state(1, np.uint64)[0]) >> 1
    return torch.Generator(device).manual_seed(seed)

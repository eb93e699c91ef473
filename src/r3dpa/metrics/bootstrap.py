"""Bootstrap intervals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Ends = tuple[float, float]

_LEVEL = 0.95


@dataclass(frozen=True)
class Resampling:
    """Seed and cost of the 95 % bootstrap intervals of an evaluation.

    Args:
        seed: Of each metric on its own.
        num_resamples: Of each interval; fewer than 40 cannot tell its ends, 0 gives none.
    """

    seed: int = 0
    num_resamples: int = 100

    def generator(self) -> torch.Generator:
        """A new generator with the seed."""
        return torch.Generator().manual_seed(self.seed)

    def interval(self, statistic: Callable[[Tensor], float], size: int) -> Ends | None:
        """Interval of a function of ``(size,)`` indices; None without resamples or two samples.

        The ends are the value minus the quantiles of (resampled - mean of all resampled). The mean
        removes the growth of distances when samples repeat: the interval shows the spread at this
        number of samples, not the bias of few samples. An end may lie below zero.

        Source: basic bootstrap (Davison and Hinkley 1997, eq. 5.6) about the mean of the resamples.
        """
        if size < 2 or not self.num_resamples:
            return None
        generator, value = self.generator(), float(statistic(torch.arange(size)))
        resampled = torch.tensor(
            [
                float(statistic(torch.randint(size, (size,), generator=generator)))
                for _ in range(self.num_resamples)
            ],
            dtype=torch.float64,
        )
        quantiles = torch.tensor([(1 + _LEVEL) / 2, (1 - _LEVEL) / 2], dtype=torch.float64)
        low, high = (value + resampled.mean() - resampled.quantile(quantiles)).tolist()
        return low, high

    def of_mean(self, values: Tensor) -> Ends | None:
        """Interval of the mean of ``(n,)`` values, one for each sample."""
        return self.interval(lambda drawn: values[drawn].mean().item(), len(values))

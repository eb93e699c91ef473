"""Intervals of numbers that come from a set of samples."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from scipy.stats import binomtest
from scipy.stats import t as student
from torch import Tensor

Ends = tuple[float, float]

_LEVEL = 0.95


@dataclass(frozen=True)
class Resampling:
    """Seed and cost of the 95 % intervals of an evaluation.

    Args:
        seed: Seed of each metric that draws subsets.
        num_resamples: Number of groups of samples; each resample leaves out one. 0 for no
            intervals.

    Example:
        >>> low, high = Resampling().of_share(torch.tensor([1, 1, 1, 0]))
        >>> f"{low:.3f} to {high:.3f}"
        '0.301 to 0.954'
    """

    seed: int = 0
    num_resamples: int = 16

    def generator(self) -> torch.Generator:
        """Return a new generator with the seed."""
        return torch.Generator().manual_seed(self.seed)

    def interval(self, statistic: Callable[[Tensor], float], size: int) -> Ends | None:
        """Return the interval of a function of indices below ``size``; None below three groups.

        Each of the G resamples leaves out a group of m samples; the remainder, where G does not
        divide their number, is never left out. With Student's t of G - 1 degrees of freedom::

            variance = (size - m)^2 / (size * m) * variance of the resamples
            ends     = value -+ t * sqrt(variance)

        The bias of few samples is about the same in all resamples, so the interval shows the
        spread at this number of samples, not the bias. Near zero, where a distance is mostly such
        a bias, it is up to 1.6 times too wide (Efron and Stein 1981). An end may lie below zero.

        Source: delete-a-group jackknife (Shao and Tu 1995, section 2.3; Kott 2001).
        """
        num_groups = min(self.num_resamples, size)
        if num_groups < 3:
            return None
        left_out = size // num_groups
        indices = torch.arange(size)
        groups = indices % num_groups
        groups[num_groups * left_out :] = num_groups
        resampled = [float(statistic(indices[groups != group])) for group in range(num_groups)]
        factor = (size - left_out) ** 2 / (size * left_out)
        spread = torch.tensor(resampled, dtype=torch.float64).std().item()
        half = quantile_of_t(num_groups - 1) * math.sqrt(factor) * spread
        value = float(statistic(indices))
        return value - half, value + half

    def of_mean(self, values: Tensor) -> Ends | None:
        """Return Student's interval of the mean of ``(n,)`` values, one for each sample."""
        if len(values) < 2 or not self.num_resamples:
            return None
        mean = values.mean().item()
        half = quantile_of_t(len(values) - 1) * values.std().item() / math.sqrt(len(values))
        return mean - half, mean + half

    def of_share(self, hits: Tensor) -> Ends | None:
        """Return Wilson's interval of the share of ones among ``(n,)`` zeros and ones."""
        if len(hits) < 2 or not self.num_resamples:
            return None
        test = binomtest(int(hits.sum()), len(hits))
        low, high = test.proportion_ci(_LEVEL, method="wilson")
        return float(low), float(high)


def quantile_of_t(degrees: int) -> float:
    """Return the deviations of Student's distribution that hold 95 % of it, to each side."""
    return float(student.ppf((1 + _LEVEL) / 2, degrees))

"""Bootstrap intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

Ends = tuple[float, float]


@dataclass(frozen=True)
class Interval:
    """A value with the ends of its confidence interval."""

    value: float
    low: float
    high: float


def bootstrap_interval(
    statistic: Callable[..., float],
    sizes: Sequence[int],
    generator: torch.Generator,
    *,
    paired: bool = False,
    num_resamples: int = 1000,
    level: float = 0.95,
) -> Interval:
    """Basic bootstrap interval of a number that depends on one or more sets of samples.

    ``statistic`` gets one vector of indices for each set, so that it can pick features, clouds or
    files::

        bootstrap_interval(lambda a, b: frechet_distance_of(x[a], y[b]), (len(x), len(y)), gen)

    The ends are the value minus the quantiles of (resampled - mean of all resampled). The mean
    removes the growth of distances when samples repeat: the interval shows the spread at this
    number of samples, not the bias of few samples. An end may lie below zero.

    Source: basic bootstrap (Davison and Hinkley 1997, eq. 5.6) about the mean of the resamples.

    Args:
        statistic: Of index vectors ``(n_i,)`` int64, one for each set.
        sizes: Samples n_i of each set.
        generator: Source of the indices, on the CPU.
        paired: Draw the same indices for all sets, for the difference of two generators with the
            same references or seeds.
        num_resamples: Evaluations of the statistic.
        level: Share of intervals that hold the true value.

    Raises:
        ValueError: If a set has fewer than two samples, or paired sets have several sizes.
    """
    if not sizes or min(sizes) < 2:
        raise ValueError(f"sets of {list(sizes)} samples; resampling needs at least 2 in each")
    if paired and len(set(sizes)) != 1:
        raise ValueError(f"paired sets of {list(sizes)} samples; give the same number in each")
    if not 0 < level < 1 or num_resamples < 2 / (1 - level):
        raise ValueError(
            f"{num_resamples} resamples cannot tell the ends of a {level:.0%} interval; give a "
            "level below 1 and at least 2 / (1 - level) resamples"
        )

    def draw(size: int) -> Tensor:
        return torch.randint(size, (size,), generator=generator)

    value = float(statistic(*(torch.arange(size) for size in sizes)))
    resampled = torch.tensor(
        [
            float(statistic(*([draw(sizes[0])] * len(sizes) if paired else map(draw, sizes))))
            for _ in range(num_resamples)
        ],
        dtype=torch.float64,
    )
    ends = torch.tensor([(1 + level) / 2, (1 - level) / 2], dtype=torch.float64)
    low, high = (value + resampled.mean() - resampled.quantile(ends)).tolist()
    return Interval(value, low, high)


@dataclass(frozen=True)
class Resampling:
    """Seed and cost of the intervals of an evaluation.

    Args:
        seed: Of each metric on its own.
        num_resamples: Of each 95 % bootstrap interval, at least 40; 0 for none.
    """

    seed: int = 0
    num_resamples: int = 100

    def generator(self) -> torch.Generator:
        """A new generator with the seed."""
        return torch.Generator().manual_seed(self.seed)

    def interval(self, statistic: Callable[[Tensor], float], size: int) -> Ends | None:
        """Bootstrap interval over one set of samples; None if it has fewer than two."""
        if size < 2 or not self.num_resamples:
            return None
        result = bootstrap_interval(
            statistic, (size,), self.generator(), num_resamples=self.num_resamples
        )
        return result.low, result.high

    def of_mean(self, values: Tensor) -> Ends | None:
        """Interval of the mean of ``(n,)`` values, one for each sample."""
        return self.interval(lambda drawn: values[drawn].mean().item(), len(values))

"""Times that can be compared: all cases in turn, round by round, and the first of them twice."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

_RESAMPLES = 2000
_AGAIN = "first case again"


@dataclass(frozen=True)
class Times:
    """Median, smallest and largest time of some rounds, milliseconds."""

    rounds: int
    median: float
    min: float
    max: float


@dataclass(frozen=True)
class Ratio:
    """Quotient of two medians, and its 95 % bootstrap interval over the rounds."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, numerator: Sequence[float], denominator: Sequence[float]) -> Ratio:
        """Ratio of two series of the same rounds, which are drawn together."""
        pairs = np.array([numerator, denominator])
        rng = np.random.default_rng(0)
        drawn = pairs[:, rng.integers(0, pairs.shape[1], (_RESAMPLES, pairs.shape[1]))]
        over, under = np.median(drawn, axis=2)
        low, high = np.quantile(over / under, [0.025, 0.975]).tolist()
        return cls(median(numerator) / median(denominator), low, high)


@dataclass(frozen=True)
class Comparison:
    """Cases measured together.

    Args:
        ms: Times of each case.
        over_first: Time of each other case over that of the first.
        repeat: The first case over itself: how far two equal things are apart.
    """

    ms: dict[str, Times]
    over_first: dict[str, Ratio]
    repeat: Ratio

    @property
    def sound(self) -> bool:
        """Whether the two series of the first case do not differ at the level of 95 %."""
        return self.repeat.low <= 1 <= self.repeat.high


def compare(cases: Mapping[str, Callable[[], float]], rounds: int) -> Comparison:
    """Run each case once a round, after one round that does not count.

    Every second round goes backwards, so that drifts of the machine meet all cases alike.

    Args:
        cases: Functions that return the seconds they took, see :func:`seconds`.
        rounds: At least 1.
    """
    first = next(iter(cases))
    every = {**cases, _AGAIN: cases[first]}
    taken: dict[str, list[float]] = {name: [] for name in every}
    for number in range(rounds + 1):
        for name in list(every)[:: -1 if number % 2 else 1]:
            ms = 1000 * every[name]()
            if number:
                taken[name].append(ms)
    return Comparison(
        {
            name: Times(rounds, median(taken[name]), min(taken[name]), max(taken[name]))
            for name in cases
        },
        {name: Ratio.of(taken[name], taken[first]) for name in cases if name != first},
        Ratio.of(taken[_AGAIN], taken[first]),
    )


def seconds(function: Callable[[], object]) -> Callable[[], float]:
    """The function as a case: what it returns is dropped, the time it takes is the result."""

    def run() -> float:
        start = time.perf_counter()
        function()
        return time.perf_counter() - start

    return run

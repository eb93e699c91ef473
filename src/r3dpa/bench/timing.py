"""Times that can be compared: all cases in turn, round by round, and the first of them twice.

On a machine that others use, a control of fixed work runs before each measurement: where it took
another time than usual, the machine was not its usual self, and the measurement is left out.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import NamedTuple

import numpy as np

_RESAMPLES = 2000
_CONTROL_OFF = 0.05  # of the median of the control
_WALL_OVER_CORE = 1.1  # more than this: the processor worked for somebody else
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
    for counts, name in _in_turn(list(every), rounds):
        ms = 1000 * every[name]()
        if counts:
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


class Spent(NamedTuple):
    """What one run of a case took, in seconds.

    Attributes:
        device: Until its result was there.
        end_to_end: Until everything was done with it.
        core: Processor time of all threads within ``device``; None where another device computed.
    """

    device: float
    end_to_end: float
    core: float | None

    def judged(self, threads: int) -> float:
        """Processor time of a single thread, to which other work adds little; else ``device``."""
        return self.core if threads == 1 and self.core else self.device


@dataclass(frozen=True)
class Series:
    """The measurements of one case, in the order of the rounds.

    Args:
        device: Seconds of each round, see :meth:`Spent.judged`.
        end_to_end: Seconds of each round with everything.
        kept: Which of them count.
        enough: Whether at least half of them were undisturbed. If not, all count.
    """

    device: tuple[float, ...]
    end_to_end: tuple[float, ...]
    kept: tuple[bool, ...]
    enough: bool

    def of_kept(self, values: Sequence[float]) -> list[float]:
        """Those of one value per round whose measurement counts."""
        return [value for value, keep in zip(values, self.kept, strict=True) if keep]


@dataclass(frozen=True)
class Controlled:
    """Cases measured together, with a control before each measurement.

    Args:
        series: Of each case.
        dropped: Share of all measurements that the rule leaves out.
        repeat: The first case over itself, see :class:`Comparison`.
    """

    series: dict[str, Series]
    dropped: float
    repeat: Ratio

    @property
    def sound(self) -> bool:
        """Whether the two series of the first case do not differ at the level of 95 %."""
        return self.repeat.low <= 1 <= self.repeat.high

    @property
    def tolerance(self) -> float:
        """By which share two equal times may differ here, as the first case did from itself."""
        return max(self.repeat.high, 1 / self.repeat.low, 1.0) - 1


def measure(
    cases: Mapping[str, Callable[[], Spent]],
    rounds: int,
    control: Callable[[], Spent],
    threads: int = 1,
) -> Controlled:
    """Run each case once a round as :func:`compare` does, and the control before each of them.

    A measurement does not count if its control took a time more than 5 % off the median of all
    controls, or if its wall time was more than 1.1 times its processor time, where that is known
    and one thread computes. If less than half of the measurements of a case were left, all of
    them count, and its ``enough`` says so.

    Args:
        cases: Functions that tell what they took.
        rounds: At least 1; one more, which does not count, comes before.
        control: Fixed work of some milliseconds that waits for its result, as a case.
        threads: Of the processor; with several, waiting for each other is no disturbance.
    """
    first = next(iter(cases))
    every = {**cases, _AGAIN: cases[first]}
    taken: dict[str, list[tuple[float, Spent]]] = {name: [] for name in every}
    for counts, name in _in_turn(list(every), rounds):
        run = (control().judged(threads), every[name]())
        if counts:
            taken[name].append(run)
    usual = median(control_s for runs in taken.values() for control_s, _ in runs)
    quiet = {
        name: [_undisturbed(control_s, usual, spent, threads) for control_s, spent in runs]
        for name, runs in taken.items()
    }
    series = {
        name: _series([run for _, run in taken[name]], quiet[name], threads) for name in every
    }
    pairs = [
        (again, once)
        for again, once, *both in zip(
            series[_AGAIN].device,
            series[first].device,
            series[_AGAIN].kept,
            series[first].kept,
            strict=True,
        )
        if all(both)
    ]
    if not pairs:  # never both undisturbed in one round
        pairs = list(zip(series[_AGAIN].device, series[first].device, strict=True))
    repeat = Ratio.of(*(list(values) for values in zip(*pairs, strict=True)))
    every_quiet = [keep for kept in quiet.values() for keep in kept]
    dropped = 1 - sum(every_quiet) / len(every_quiet)
    return Controlled({name: series[name] for name in cases}, dropped, repeat)


def _undisturbed(control: float, usual: float, spent: Spent, threads: int) -> bool:
    if abs(control / usual - 1) > _CONTROL_OFF:
        return False
    # The clock of a processor may be coarse: what is too short for it is not judged.
    if not spent.core or threads > 1:
        return True
    return spent.device <= _WALL_OVER_CORE * spent.core


def _series(runs: Sequence[Spent], quiet: Sequence[bool], threads: int) -> Series:
    enough = 2 * sum(quiet) >= len(quiet)
    return Series(
        tuple(run.judged(threads) for run in runs),
        tuple(run.end_to_end for run in runs),
        tuple(quiet) if enough else (True,) * len(runs),
        enough,
    )


def _in_turn(names: Sequence[str], rounds: int) -> Iterator[tuple[bool, str]]:
    """Whether it counts, and the name, of each run: every second round goes backwards."""
    for number in range(rounds + 1):
        for name in names[:: -1 if number % 2 else 1]:
            yield number > 0, name

"""Times, work and memory: interleaved timing with an A/A check, FLOP, peak rate, peak memory."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

#: FLOP per second of dense matrix products, by part of the device's name; the SXM variants.
#: Source: data sheets of NVIDIA A100, H100 and H200 (figures "with sparsity" halved).
PEAKS = {
    "H200": {"bf16": 989e12, "tf32": 495e12, "fp32": 67e12},
    "H100": {"bf16": 989e12, "tf32": 495e12, "fp32": 67e12},
    "A100": {"bf16": 312e12, "tf32": 156e12, "fp32": 19.5e12},
}
_RESAMPLES = 2000
_CONTROL_OFF = 0.05  # of the median of the control
_WALL_OVER_CORE = 1.1  # above it, other processes took the core
_CPU = torch.device("cpu")


class Spent(NamedTuple):
    """Seconds of one run of a case: until its result was there, and until all was done with it.

    ``core`` is the processor time of all threads within ``device``; None on a GPU.
    """

    device: float
    end_to_end: float
    core: float | None = None

    def over(self, number: int) -> Spent:
        """Seconds of one of several samples."""
        core = None if self.core is None else self.core / number
        return Spent(self.device / number, self.end_to_end / number, core)

    def judged(self, threads: int) -> float:
        """Processor time of a single thread, which other work hardly changes; else ``device``."""
        return self.core if threads == 1 and self.core else self.device


@dataclass(frozen=True)
class Ratio:
    """Quotient of two medians with its 95 % bootstrap interval over the rounds."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, numerator: Sequence[float], denominator: Sequence[float]) -> Ratio:
        """Ratio of two series of the same rounds, which are resampled together."""
        pairs = np.array([numerator, denominator])
        rng = np.random.default_rng(0)
        drawn = pairs[:, rng.integers(0, pairs.shape[1], (_RESAMPLES, pairs.shape[1]))]
        over, under = np.median(drawn, axis=2)
        low, high = np.quantile(over / under, [0.025, 0.975]).tolist()
        return cls(median(numerator) / median(denominator), low, high)

    def __str__(self) -> str:
        return f"{self.value:.3f} ({self.low:.3f}..{self.high:.3f})"


@dataclass(frozen=True)
class Series:
    """Measurements of one case, in the order of the rounds.

    Args:
        device: Seconds of each round, see :meth:`Spent.judged`.
        end_to_end: Seconds of each round with everything.
        kept: Which of them count.
        enough: Whether at least half of them were undisturbed; if not, all count.
    """

    device: tuple[float, ...]
    end_to_end: tuple[float, ...]
    kept: tuple[bool, ...]
    enough: bool

    @classmethod
    def of(cls, runs: Sequence[Spent], quiet: Sequence[bool], threads: int) -> Series:
        """Series of runs, of which some were undisturbed."""
        enough = 2 * sum(quiet) >= len(quiet)
        device = tuple(run.judged(threads) for run in runs)
        kept = tuple(quiet) if enough else (True,) * len(runs)
        return cls(device, tuple(run.end_to_end for run in runs), kept, enough)

    def of_kept(self, values: Sequence[float]) -> list[float]:
        """The values of the rounds that count."""
        return [value for value, keep in zip(values, self.kept, strict=True) if keep]

    @property
    def seconds(self) -> float:
        """Median of ``device`` over the rounds that count."""
        return median(self.of_kept(self.device))

    def over(self, other: Series) -> Ratio:
        """Time over that of another case, in the rounds that count for both, or else in all."""
        pairs = list(zip(self.device, other.device, strict=True))
        kept = [pair for pair, *k in zip(pairs, self.kept, other.kept, strict=True) if all(k)]
        return Ratio.of(*(list(values) for values in zip(*(kept or pairs), strict=True)))


@dataclass(frozen=True)
class Comparison:
    """Cases measured together.

    Args:
        series: Measurements of each case.
        dropped: Share of all measurements that the control rule drops.
        repeat: The first case over itself: the resolution of the measurement.
    """

    series: dict[str, Series]
    dropped: float
    repeat: Ratio

    @property
    def sound(self) -> bool:
        """Whether the interval of the A/A ratio contains 1; if not, ratios are no evidence."""
        return self.repeat.low <= 1 <= self.repeat.high

    @property
    def tolerance(self) -> float:
        """Share by which equal times may differ here: the far end of the A/A interval."""
        return max(self.repeat.high, 1 / self.repeat.low, 1.0) - 1

    def over_first(self, name: str) -> Ratio:
        """Time of a case over that of the first."""
        return self.series[name].over(next(iter(self.series.values())))

    def summary(self) -> dict[str, Any]:
        """Milliseconds, ratio to the first case and A/A ratio as plain values."""
        return {
            "ms": {name: 1000 * each.seconds for name, each in self.series.items()},
            "over_first": {name: asdict(self.over_first(name)) for name in self.series},
            "repeat": asdict(self.repeat) | {"sound": self.sound, "dropped": self.dropped},
        }


Round = list[tuple[float, Spent]]  # control and measurement of each case, of the first one twice


def compare(
    cases: Mapping[str, Callable[[], Spent]],
    rounds: int,
    control: Callable[[], Spent] | None = None,
    threads: int = 1,
    keep: Callable[[int, Callable[[], Round]], Round] = lambda number, run: run(),
) -> Comparison:
    """Runs each case once a round, after a warm-up round that does not count.

    Every second round runs backwards, so that drifts of the machine affect all cases alike. A
    measurement is dropped if the control before it took 5 % more or less than the median of all
    controls, or if its wall time was more than 1.1 times its processor time (one thread of a CPU).
    If less than half of the measurements of a case are left, all of them count.

    Args:
        cases: Functions that return what they took, see :func:`timed`.
        rounds: At least 1.
        control: Fixed work of some milliseconds, see :func:`control_kernel`; none, no dropping.
        threads: Of the processor; several wait for each other, which is no disturbance.
        keep: Returns the measurements of a round by number, from ``run`` or from an earlier run.
    """
    every = [*cases, next(iter(cases))]

    def run(number: int) -> Round:
        order = range(len(every))
        found: dict[int, tuple[float, Spent]] = {}
        for place in reversed(order) if number % 2 else order:
            controlled = control().judged(threads) if control else 1.0
            found[place] = controlled, cases[every[place]]()
        return [found[place] for place in order]

    run(0)
    taken = [keep(number, partial(run, number)) for number in range(1, rounds + 1)]
    usual = median(controlled for each in taken for controlled, _ in each)

    def quiet(controlled: float, spent: Spent) -> bool:
        if control is None:
            return True
        # A processor clock may be too coarse for a short case, which is then not judged by it.
        alone = threads == 1 and spent.core
        slow = alone and spent.device > _WALL_OVER_CORE * (spent.core or 0)
        return abs(controlled / usual - 1) <= _CONTROL_OFF and not slow

    runs = [[each[place] for each in taken] for place in range(len(every))]
    calm = [[quiet(*measured) for measured in one] for one in runs]
    series = [
        Series.of([spent for _, spent in one], kept, threads)
        for one, kept in zip(runs, calm, strict=True)
    ]
    dropped = 1 - sum(map(sum, calm)) / (rounds * len(every))
    return Comparison(dict(zip(cases, series, strict=False)), dropped, series[-1].over(series[0]))


def timed(function: Callable[[], object], device: torch.device = _CPU) -> Callable[[], Spent]:
    """The function as a case of :func:`compare`; on a GPU until the device has finished."""

    def run() -> Spent:
        synchronise(device)
        start, core = time.perf_counter(), time.process_time()
        function()
        synchronise(device)
        wall, core = time.perf_counter() - start, time.process_time() - core
        return Spent(wall, wall, core if device.type == "cpu" else None)

    return run


def control_kernel(device: torch.device) -> Callable[[], Spent]:
    """Fixed work of some milliseconds: matrix products on a GPU, Fourier transforms on a CPU."""
    generator = torch.Generator().manual_seed(0)
    if device.type == "cuda":
        factor = torch.randn(2048, 2048, generator=generator).to(device, torch.bfloat16)
        return timed(lambda: [torch.mm(factor, factor) for _ in range(50)], device)
    signal = torch.randn(4, 2**17, generator=generator)
    return timed(lambda: torch.fft.rfft(signal))


@dataclass(frozen=True)
class Peak:
    """Highest rate of a device in FLOP per second, 2 for each multiply-add, and its source."""

    flop_s: float
    source: Literal["data sheet", "measured"]


def peak_of(device: torch.device, number_format: str) -> Peak:
    """Peak for factors in bf16, tf32 or fp32: of the data sheet, else of a matrix product."""
    if device.type == "cuda":
        name = torch.cuda.get_device_name(device)
        for part, rates in PEAKS.items():
            if part in name:
                return Peak(rates[number_format], "data sheet")
    dtype = torch.bfloat16 if number_format == "bf16" else torch.float32
    size = 8192 if device.type == "cuda" else 1024
    factor = torch.randn(size, size, device=device).to(dtype)
    product, threads = timed(lambda: factor @ factor, device), torch.get_num_threads()
    return Peak(2 * size**3 / min(product().judged(threads) for _ in range(7)), "measured")


def flop_of(function: Callable[[], object]) -> int:
    """FLOP of the matrix products, convolutions and attention of one call, not compiled.

    Attention runs as matrix products meanwhile, since the counter does not know the fused kernels
    of every device.
    """
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        function()
    return counter.get_total_flops()


def peak_bytes(device: torch.device) -> int:
    """Peak memory so far: of tensors on a GPU, of this whole process on a CPU."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    status = Path("/proc/self/status")
    if status.exists():  # ru_maxrss of Linux is at least the memory of the parent process
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def synchronise(device: torch.device) -> None:
    """Waits until a GPU has finished all work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)

"""Times, work and memory: interleaved timing with an A/A check, FLOP, peak memory."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode
from tqdm import tqdm

_RESAMPLES = 2000
_CPU = torch.device("cpu")


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


@dataclass(frozen=True)
class PairedTimings:
    """Seconds of cases measured together, by round, and the first of them over itself (A/A)."""

    seconds: dict[str, list[float]]
    repeat: Ratio

    @property
    def sound(self) -> bool:
        """Whether the interval of the A/A ratio contains 1; if not, ratios are no evidence."""
        return self.repeat.low <= 1 <= self.repeat.high


def compare(
    cases: Mapping[str, Callable[[], float]],
    rounds: int,
    keep: Callable[[int, Callable[[], list[float]]], list[float]] = lambda number, run: run(),
) -> PairedTimings:
    """Run each case once per round, the first one twice, after a warm-up round.

    Every second round runs backwards, so that drifts of the machine affect all cases alike.

    Args:
        cases: Functions that return the seconds that they took, see :func:`timed`.
        rounds: At least 1.
        keep: Returns the seconds of a round by its number, from ``run`` or from an earlier run.
    """
    names = [*cases, next(iter(cases))]

    def run(number: int) -> list[float]:
        order = range(len(names))
        seconds = {i: cases[names[i]]() for i in (reversed(order) if number % 2 else order)}
        return [seconds[i] for i in order]

    run(0)
    numbers = tqdm(range(1, rounds + 1), "timing", unit="round", disable=None)
    taken = [keep(number, partial(run, number)) for number in numbers]
    *seconds, again = (list(column) for column in zip(*taken, strict=True))
    return PairedTimings(dict(zip(cases, seconds, strict=True)), Ratio.of(again, seconds[0]))


def timed(function: Callable[[], object], device: torch.device = _CPU) -> Callable[[], float]:
    """Make the function a case of :func:`compare`; on a GPU it ends when the device has finished.

    With a single CPU thread the processor time counts, which other processes hardly change.
    """

    def run() -> float:
        one_core = device.type == "cpu" and torch.get_num_threads() == 1
        clock = time.process_time if one_core else time.perf_counter
        synchronise(device)
        start = clock()
        function()
        synchronise(device)
        return clock() - start

    return run


def flop_of(function: Callable[[], object]) -> int:
    """Count the FLOP of products, convolutions and attention of one call, not compiled."""
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        function()
    return counter.get_total_flops()


def peak_bytes(device: torch.device) -> int:
    """Return the peak memory so far: of tensors on a GPU, of this whole process on a CPU."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    status = Path("/proc/self/status")
    if status.exists():  # ru_maxrss of Linux is at least the memory of the parent process
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # macOS counts bytes


def synchronise(device: torch.device) -> None:
    """Wait until a GPU has finished all work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)

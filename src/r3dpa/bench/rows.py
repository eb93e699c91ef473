"""Rows of the sampling benchmark: errors, costs, Pareto front, advice and quality levels.

Letters: R rows, N scenes, K resamples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from r3dpa.bench.problems import Setting

Floats = NDArray[np.float64]

_LEVEL = 0.975  # one-sided: 95 % for both sides
_RESAMPLES = 1000
_MARGIN = 10  # the reference must be this many times more exact than what it judges
_SMALL_ERROR = 0.01  # negligible error of latents (of unit variance) where no bf16 row tells one
_LEVELS = {"draft": 10.0, "good": 4.0, "best": 1.0}  # largest error over the negligible one
_AS_CHEAP = 1.1


class Errors(NamedTuple):
    """Errors of a setting against the converged solution of the same noise.

    ``squared`` is the mean squared error of the latents of each scene; ``discretisation`` the RMSE
    of the same solver in fp32, not compiled, and ``precision`` that from it. ``range_rmse_m`` is of
    pixels with a return in both, ``mask_iou`` of returns; both None without a decoder.
    """

    squared: list[float]
    discretisation: float
    precision: float
    range_rmse_m: float | None
    mask_iou: float | None


@dataclass(frozen=True)
class Row:
    """One way to sample: its label, errors, seconds per scene of each round, and FLOP per scene.

    ``self_error`` is that of the converged solution, ``memory_bytes`` the peak of a GPU.
    """

    label: str
    way: Setting
    errors: Errors
    device_s: list[float]
    end_to_end_s: list[float]
    flop: float
    peak_flop_s: float
    self_error: float
    memory_bytes: int | None = None

    @property
    def error(self) -> float:
        """RMSE of the latents."""
        return float(np.sqrt(np.mean(self.errors.squared)))

    @property
    def interval(self) -> tuple[float, float]:
        """95 % bootstrap interval of the error over the scenes."""
        spread = resampled_errors(np.array([self.errors.squared]))[0]
        low, high = np.quantile(spread, [0.025, 0.975]).tolist()
        return low, high

    @property
    def precision_error(self) -> float | None:
        """RMSE from the same solver in fp32, not compiled; None for that itself."""
        return self.errors.precision if self.way != self.way.plain else None

    @property
    def converged(self) -> bool:
        """Whether the converged solution is exact enough to judge the error."""
        return self.self_error < self.error / _MARGIN

    @property
    def seconds(self) -> float:
        """Per scene until the range image is there, median of the rounds."""
        return float(np.median(self.device_s))

    def record(self) -> dict[str, Any]:
        """Plain values for tables and files."""
        way, errors = self.way, self.errors
        return {
            "label": self.label,
            "name": way.name,
            "solver": way.sampler.solver,
            "steps": way.sampler.steps,
            "shift": way.sampler.shift,
            "nfe": way.nfe,
            "precision": way.precision,
            "compiled": way.compiled,
            "batch": way.batch,
            "error": self.error,
            "error_interval": self.interval,
            "discretisation": errors.discretisation,
            "precision_error": self.precision_error,
            "range_rmse_m": errors.range_rmse_m,
            "mask_iou": errors.mask_iou,
            "converged": self.converged,
            "seconds": self.seconds,
            "seconds_interval": np.quantile(self.device_s, [0.25, 0.75]).tolist(),
            "end_to_end": float(np.median(self.end_to_end_s)),
            "flop": self.flop,
            "flop_s": self.flop / self.seconds,
            "peak_share": self.flop / self.seconds / self.peak_flop_s,
            "memory_bytes": self.memory_bytes,
            "rounds": self.device_s,
        }


def front_of(rows: Sequence[Row], tolerance: float) -> list[Row]:
    """Rows of the Pareto front, from the fastest on, each better than the one before at 95 %.

    Times are equal up to the share ``tolerance``, see :attr:`Comparison.tolerance`.
    """
    errors = resampled_errors(np.array([row.errors.squared for row in rows]))
    rng, seconds = np.random.default_rng(0), []
    for row in rows:
        taken = np.array(row.device_s)
        drawn = rng.integers(0, len(taken), (_RESAMPLES, len(taken)))
        seconds.append(np.median(taken[drawn], axis=1))
    front, better = pareto_front(np.array(seconds), errors, tolerance), _smaller(errors)
    chosen: list[int] = []
    for index in np.argsort(np.median(seconds, axis=1), kind="stable").tolist():
        if front[index] and (not chosen or better[index, chosen[-1]]):
            chosen.append(index)
    return [rows[index] for index in chosen]


def resampled_errors(squared: Floats) -> Floats:
    """RMSE ``(R, K)`` over resampled scenes, the same for all rows, of squared errors (R, N)."""
    count = squared.shape[1]
    weights = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), _RESAMPLES)
    return np.sqrt(squared @ (weights / count).T)


def pareto_front(seconds: Floats, errors: Floats, tolerance: float = 0.0) -> NDArray[np.bool_]:
    """Rows of ``(R, K)`` resampled times and errors that no other row dominates at 95 %.

    A row dominates another if it is better in one of them and not worse in the other.
    """
    faster, better = _smaller(seconds, tolerance), _smaller(errors)
    dominates = (faster & ~better.T) | (better & ~faster.T)
    return np.logical_not(dominates.any(axis=0))


def _smaller(values: Floats, tolerance: float = 0.0) -> NDArray[np.bool_]:
    """``(R, R)``: whether the first is smaller than the second at the level of 95 %."""
    scaled = values * (1 + tolerance)
    return np.array([(row < values).mean(axis=1) >= _LEVEL for row in scaled])


def sentences(front: Sequence[Row]) -> list[str]:
    """One sentence for each step along the Pareto front: its cost and its gain."""
    return [
        f"From {duration(cheap.seconds)} ({cheap.label}) to {duration(dear.seconds)} "
        f"({dear.label}): the error of the latents falls from {cheap.error:.3g} to "
        f"{dear.error:.3g}, {cheap.error / max(dear.error, 1e-300):.3g} times less, for "
        f"{duration(dear.seconds - cheap.seconds)} more a scene."
        for cheap, dear in pairwise(front)
    ]


def duration(seconds: float) -> str:
    """Three digits in seconds, milliseconds or microseconds."""
    for scale, unit in ((1.0, "s"), (1e-3, "ms")):
        if abs(seconds) >= scale:
            return f"{seconds / scale:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} µs"


def quality_levels(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Solver, steps, shift, error and relative time of ``r3dpa sample --quality``, by level.

    Only rows at the batch size and precision that most of them have count. With ``small`` the
    larger of the error of bf16 (0.01 if no row has it) and the smallest error, ``best`` has an
    error of at most ``small``, ``good`` of 4 and ``draft`` of 10 times that. It is the cheapest
    such row, or the one with the smallest error among those that take at most a tenth longer.
    """
    kinds = [(row.way.precision, row.way.compiled, row.way.batch) for row in rows]
    usual = max(kinds, key=kinds.count)
    usable = [row for row, kind in zip(rows, kinds, strict=True) if kind == usual]
    bf16 = [r.precision_error for r in rows if r.way.precision == "bf16" and r.precision_error]
    small = max(min(bf16) if bf16 else _SMALL_ERROR, min(row.error for row in usable))

    def chosen(limit: float) -> Row:
        enough = [row for row in usable if row.error <= limit]
        longest = _AS_CHEAP * min(row.seconds for row in enough)
        return min((r for r in enough if r.seconds <= longest), key=lambda row: row.error)

    levels = {level: chosen(factor * small) for level, factor in _LEVELS.items()}
    return {
        level: {
            "solver": row.way.sampler.solver,
            "steps": row.way.sampler.steps,
            "shift": row.way.sampler.shift,
            "error": row.error,
            "seconds_share": row.seconds / levels["best"].seconds,
        }
        for level, row in levels.items()
    }

"""Which rows of a benchmark are worth their time, and what each further second buys.

Letters: R rows, N scenes, K resamples.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r3dpa.flow.solvers import ODE_SOLVERS
from r3dpa.io import atomic_path

__all__ = [
    "Row",
    "pareto_front",
    "quality_levels",
    "resampled_errors",
    "resampled_seconds",
    "save_quality_levels",
    "sentences",
    "steps_along",
]

Floats = NDArray[np.float64]

_LEVEL = 0.975  # of one side: 95 % for both
_RESAMPLES = 1000
#: Error of the latents, which have unit variance, that counts as nothing where bf16 tells none.
_SMALL_ERROR = 0.01
#: Largest error of a level, in units of the smallest that matters.
_LEVELS = {"draft": 10.0, "good": 4.0, "best": 1.0}
_AS_CHEAP = 1.1


@dataclass(frozen=True)
class Row:
    """One way to sample, what it costs and how far it is from the exact solution.

    Args:
        label: ``name`` and NFE, and what differs from the other rows.
        name: Solver with its settings, the same for all its steps.
        solver: Of ``SamplerConfig``.
        steps: Solver steps.
        shift: Of the time grid.
        nfe: Network evaluations per scene, as counted.
        precision: ``fp32`` or ``bf16``.
        compiled: Whether the networks are compiled.
        batch: Scenes computed together.
        error: RMSE of the latents from the converged ones of the same noise; None for an SDE,
            whose scenes are others.
        error_interval: 95 % bootstrap interval over the scenes.
        discretisation: The part of ``error`` that the solver makes: the same in fp32, not compiled.
        precision_error: RMSE from the same solver in fp32, not compiled.
        range_rmse_m: RMSE of the ranges over the pixels with a return in both, metres.
        mask_iou: Pixels with a return in both over pixels with a return in either.
        converged: Whether the reference is good enough to tell ``error``.
        seconds: Per scene until the range image is there, median of the rounds.
        seconds_interval: Lower and upper quartile of the rounds.
        end_to_end: Seconds per scene with points and file, median.
        quiet: Whether at least half of the rounds were undisturbed.
        flop: Per scene, decoder included.
        flop_s: Achieved per second.
        peak_share: ``flop_s`` over the peak of the device in this precision.
        suspect: Why ``peak_share`` cannot be right, or what bounds it; empty as a rule.
        memory_bytes: Peak of the GPU; None on a CPU.
        metrics: Distances between distributions by name.
    """

    label: str
    name: str
    solver: str
    steps: int
    shift: float
    nfe: int
    precision: str
    compiled: bool
    batch: int
    error: float | None
    error_interval: tuple[float, float] | None
    discretisation: float | None
    precision_error: float | None
    range_rmse_m: float | None
    mask_iou: float | None
    converged: bool | None
    seconds: float
    seconds_interval: tuple[float, float]
    end_to_end: float
    quiet: bool
    flop: float
    flop_s: float
    peak_share: float
    suspect: str = ""
    memory_bytes: int | None = None
    metrics: dict[str, float] = field(default_factory=dict)


def resampled_errors(squared: Floats, seed: int = 0) -> Floats:
    """RMSE ``(R, K)`` of each row over resampled scenes, which are the same for all rows.

    Args:
        squared: ``(R, N)`` mean squared error of each scene.
        seed: Of the choice.
    """
    count = squared.shape[1]
    rng = np.random.default_rng(seed)
    weights = rng.multinomial(count, np.full(count, 1 / count), _RESAMPLES) / count
    return np.sqrt(squared @ weights.T)


def resampled_seconds(seconds: Sequence[Sequence[float]], seed: int = 0) -> Floats:
    """Median ``(R, K)`` of each row over its resampled rounds.

    Args:
        seconds: Of each row, its rounds that count, at least one.
        seed: Of the choice.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for taken in seconds:
        values = np.asarray(taken)
        drawn = rng.integers(0, len(values), (_RESAMPLES, len(values)))
        rows.append(np.median(values[drawn], axis=1))
    return np.array(rows)


def pareto_front(seconds: Floats, errors: Floats, tolerance: float = 0.0) -> NDArray[np.bool_]:
    """Which rows are not dominated at the level of 95 %.

    A row dominates another one if it is better in time or error and not worse in the other, each
    of them at that level.

    Args:
        seconds: ``(R, K)`` resampled times.
        errors: ``(R, K)`` resampled errors.
        tolerance: Times are equal up to this share, as the A/A test found.
    """
    faster, better = _smaller(seconds, tolerance), _smaller(errors)
    dominates = (faster & ~better.T) | (better & ~faster.T)
    return ~np.any(dominates, axis=0, keepdims=True)[0]


def _smaller(values: Floats, tolerance: float = 0.0) -> NDArray[np.bool_]:
    """``(R, R)``: whether the first is smaller than the second at the level of 95 %."""
    scaled = values * (1 + tolerance)
    return np.array([(row < values).mean(axis=1) >= _LEVEL for row in scaled])


def steps_along(seconds: Floats, errors: Floats, front: NDArray[np.bool_]) -> list[int]:
    """Rows of the front from the fastest on, each better than the one before at 95 %.

    Args:
        seconds: ``(R, K)``.
        errors: ``(R, K)``.
        front: ``(R,)`` of :func:`pareto_front`.
    """
    better = _smaller(errors)
    chosen: list[int] = []
    for index in np.argsort(np.median(seconds, axis=1), kind="stable").tolist():
        if front[index] and (not chosen or better[index, chosen[-1]]):
            chosen.append(index)
    return chosen


def sentences(
    rows: Sequence[Row], values: Sequence[float], what: str, unit: str = "", floor: float = 0.0
) -> list[str]:
    """What each further second buys: one sentence for each step from row to row.

    Args:
        rows: From the fastest on.
        values: Their errors, or another measure of which less is better.
        what: Name of the measure.
        unit: Its unit, if any.
        floor: Differences below it are no gain.
    """
    unit = unit and f" {unit}"
    told = []
    for (cheap, before), (dear, after) in zip(
        list(zip(rows, values, strict=True))[:-1],
        list(zip(rows, values, strict=True))[1:],
        strict=True,
    ):
        head = f"From {duration(cheap.seconds)} ({cheap.label}) to {duration(dear.seconds)} "
        head += f"({dear.label}): {what} "
        more = f"for {duration(dear.seconds - cheap.seconds)} more a scene."
        if before - after < floor:
            told.append(f"{head}ties ({before:.3g} and {after:.3g}{unit}), {more}")
            continue
        times = f"{before / after:.3g} times less" if after > 0 else "all of it"
        told.append(f"{head}falls from {before:.3g} to {after:.3g}{unit}, {times}, {more}")
    return told


def duration(seconds: float) -> str:
    """Three digits in the unit that suits."""
    for scale, unit in ((1.0, "s"), (1e-3, "ms")):
        if abs(seconds) >= scale:
            return f"{seconds / scale:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} µs"


def quality_levels(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """The solver and steps that ``r3dpa sample --quality`` stands for.

    Only deterministic rows of the usual solvers count, at the batch size and precision that most
    of them have. With ``small`` the larger of what bf16 alone changes in the latents (0.01 where
    no row tells) and the smallest error, ``best`` has an error of at most ``small``, ``good`` of 4
    and ``draft`` of 10 times that. It is the cheapest such row, or the one with the smallest error
    among those that take at most a tenth longer.

    Returns:
        By level: ``solver``, ``steps``, ``shift``, ``error``, and ``seconds_share``, its time over
        that of ``best``.

    Raises:
        ValueError: If no row has an error.
    """
    known = [row for row in rows if row.solver in ODE_SOLVERS and row.error is not None]
    known = [row for row in known if row.name in plain_names(known)]
    kinds = [(row.precision, row.compiled, row.batch) for row in known]
    if not known:
        raise ValueError("no deterministic row has an error: there is nothing to choose from")
    usual = max(kinds, key=kinds.count)
    candidates = [row for row, kind in zip(known, kinds, strict=True) if kind == usual]
    bf16 = [row.precision_error for row in rows if row.precision == "bf16" and row.precision_error]
    small = max(min(bf16) if bf16 else _SMALL_ERROR, min(map(_error, candidates)))

    def chosen(limit: float) -> Row:
        enough = [row for row in candidates if _error(row) <= limit]
        longest = _AS_CHEAP * min(row.seconds for row in enough)
        return min((row for row in enough if row.seconds <= longest), key=_error)

    levels = {level: chosen(factor * small) for level, factor in _LEVELS.items()}
    return {
        level: {
            "solver": row.solver,
            "steps": row.steps,
            "shift": row.shift,
            "error": row.error,
            "seconds_share": row.seconds / levels["best"].seconds,
        }
        for level, row in levels.items()
    }


def plain_names(rows: Sequence[Row]) -> set[str]:
    """Names of the rows that solver, steps and shift tell all about."""
    return {row.name for row in rows if row.name == plain_name(row.solver, row.shift)}


def plain_name(solver: str, shift: float) -> str:
    """Name of a solver on a shifted grid."""
    return solver if math.isclose(shift, 1) else f"{solver} shift {shift:g}"


def _error(row: Row) -> float:
    assert row.error is not None
    return row.error


def save_quality_levels(
    levels: Mapping[str, Mapping[str, Any]], measured_on: str, path: Path
) -> None:
    """Writes levels as ``r3dpa sample --quality`` reads them, with where they were measured."""
    content = {"levels": levels, "measured_on": measured_on}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")

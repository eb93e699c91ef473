"""Errors, Pareto front, advice, table and files of ``r3dpa bench sampling``.

Letters: R rows, N scenes, K resamples.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from r3dpa import viz
from r3dpa.bench.measure import Comparison
from r3dpa.bench.problems import Setting
from r3dpa.io import one_line, text_table, write_text

Floats = NDArray[np.float64]

_LEVEL = 0.975  # one-sided: 95 % for both sides
_RESAMPLES = 1000
_MARGIN = 10  # the reference must be this many times more exact than what it judges
_SMALL_ERROR = 0.01  # negligible error of latents (of unit variance) without a measured bf16 row
_LEVELS = {"draft": 10.0, "good": 4.0, "best": 1.0}  # largest error over the negligible one
_AS_CHEAP = 1.1

_TITLES = {"mixture": "exact velocity of 128 Gaussians in 64 dimensions", "model": "trained model"}


class Errors(NamedTuple):
    """Errors of a setting against the converged solution of the same noise.

    ``squared`` is the mean squared error of the latents of each scene, ``precision`` the RMSE from
    the same solver in fp32. ``range_rmse_m`` is of pixels with a return in both, ``mask_iou`` of
    returns; both None without a decoder.
    """

    squared: list[float]
    precision: float
    range_rmse_m: float | None
    mask_iou: float | None


@dataclass(frozen=True)
class Row:
    """One way to sample: its label, errors, seconds per scene of each round, FLOP per scene.

    ``self_error`` is that of the converged solution.
    """

    label: str
    way: Setting
    errors: Errors
    rounds: list[float]
    flop: float
    self_error: float

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
        """RMSE from the same solver in fp32; None for that itself."""
        return None if self.way.precision == "fp32" else self.errors.precision

    @property
    def converged(self) -> bool:
        """Whether the converged solution is exact enough to judge the error."""
        return self.self_error < self.error / _MARGIN

    @property
    def seconds(self) -> float:
        """Per scene until the range image is there, median of the rounds."""
        return float(np.median(self.rounds))

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
            "batch": way.batch,
            "decoder": way.decoder,
            "error": self.error,
            "error_interval": self.interval,
            "precision_error": self.precision_error,
            "range_rmse_m": errors.range_rmse_m,
            "mask_iou": errors.mask_iou,
            "converged": self.converged,
            "seconds": self.seconds,
            "flop": self.flop,
            "flop_s": self.flop / self.seconds,
            "rounds": self.rounds,
        }


def front_of(rows: Sequence[Row], tolerance: float) -> list[Row]:
    """Rows of the Pareto front, from the fastest on, each better than the one before at 95 %.

    Times are equal up to the share ``tolerance``, see :attr:`Comparison.tolerance`.
    """
    errors = resampled_errors(np.array([row.errors.squared for row in rows]))
    rng, seconds = np.random.default_rng(0), []
    for row in rows:
        taken = np.array(row.rounds)
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
    return np.array([(row < values).mean(axis=1) >= _LEVEL for row in values * (1 + tolerance)])


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
    such row, or the one with the smallest error among those that take at most a tenth longer. With
    average velocities ``instant`` is the smallest error of their rows, by the thin decoder if there
    is one, in at most a fifth of the time of ``good``, or the fastest of them.
    """
    kinds = [(row.way.precision, row.way.batch) for row in rows]
    usual = max(kinds, key=kinds.count)
    usable = [row for row, kind in zip(rows, kinds, strict=True) if kind == usual]
    few = [row for row in usable if row.way.sampler.solver == "average_velocity"]
    few = [row for row in few if row.way.decoder == "thin"] or few
    usable = [row for row in usable if row.way.sampler.solver != "average_velocity"]
    bf16 = [r.precision_error for r in rows if r.way.precision == "bf16" and r.precision_error]
    small = max(min(bf16) if bf16 else _SMALL_ERROR, min(row.error for row in usable))

    def chosen(limit: float) -> Row:
        enough = [row for row in usable if row.error <= limit]
        longest = _AS_CHEAP * min(row.seconds for row in enough)
        return min((r for r in enough if r.seconds <= longest), key=lambda row: row.error)

    levels = {level: chosen(factor * small) for level, factor in _LEVELS.items()}
    if few:
        longest = max(levels["good"].seconds / 5, min(row.seconds for row in few))
        quick = [row for row in few if row.seconds <= longest]
        levels = {"instant": min(quick, key=lambda row: row.error), **levels}
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


class Finding(NamedTuple):
    """All figures of one problem.

    ``steps`` are the Heun steps of the converged solution and ``self_error`` its RMSE from that of
    half the steps; ``flop`` is that of one evaluation, and of everything else of a scene.
    """

    rows: Sequence[Row]
    steps: int
    samples: int
    self_error: float
    timing: Comparison
    flop: tuple[float, float]


def write_report(out: Path, found: Mapping[str, Finding], facts: dict[str, Any]) -> str:
    """Writes all files; returns the text of the summary."""
    records = {name: _record(part) for name, part in found.items()}
    content = facts | {"problems": records}
    write_text(out / "sampling.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    name = "model" if "model" in found else "mixture"
    viz.save(_picture(name, found[name]), out / "pareto.png")
    tail = ["no checkpoint was given: all figures are of the mixture, none of a model"]
    if "model" in found:
        levels = quality_levels(found[name].rows)
        where = f"{facts['machine']['gpu'] or facts['machine']['cpu']}, {one_line(facts['model'])}"
        table = {"levels": levels, "measured_on": where}
        write_text(out / "quality.json", json.dumps(table, indent=2, allow_nan=False) + "\n")
        tail = [
            f"quality {level}: {choice['solver']}, {choice['steps']} steps, shift "
            f"{choice['shift']:g} (error {choice['error']:.3g}, {choice['seconds_share']:.0%} of "
            "the time of best)"
            for level, choice in levels.items()
        ]
    tail += [f"{key}: {one_line(values)}" for key, values in facts.items()]
    lines = ["# What accuracy costs in time", "", "![Pareto front](pareto.png)", ""]
    for key, part in found.items():
        lines += [f"## {_TITLES[key]}", "", "What each further second buys:", ""]
        lines += [f"- {sentence}" for sentence in records[key]["sentences"]]
        lines += ["", "```", _table(records[key]["rows"]), *_notes(part), "```", ""]
    write_text(out / "summary.md", "\n".join([*lines, *(f"- {line}" for line in tail), ""]))
    files = sorted(path.name for path in out.iterdir() if path.is_file())
    return "\n".join([*lines[4:], *tail, f"files: {', '.join(files)}"])


def _record(found: Finding) -> dict[str, Any]:
    front = front_of(found.rows, found.timing.tolerance)
    unsure = [row.label for row in found.rows if not row.converged]
    return {
        "rows": [row.record() for row in found.rows],
        "reference": {
            "solver": "heun",
            "steps": found.steps,
            "samples": found.samples,
            "self_error": found.self_error,
            "certified": not unsure,
            "not_converged": unsure,
        },
        "front": [row.label for row in front],
        "sentences": sentences(front),
        "timing": {"a_a": asdict(found.timing.repeat), "sound": found.timing.sound},
        "flop": {"evaluation": found.flop[0], "rest": found.flop[1]},
    }


def _picture(name: str, found: Finding) -> Figure:
    def points(rows: Sequence[Row]) -> list[viz.ParetoPoint]:
        return [
            viz.ParetoPoint(
                *(row.label, row.way.name, row.seconds, row.error, row.interval),
                filled=row.way.precision == "bf16",
            )
            for row in rows
            if row.error > 0
        ]

    front = front_of(found.rows, found.timing.tolerance)
    bf16 = [row for row in found.rows if row.way.precision == "bf16" and row.precision_error]
    return viz.pareto_figure(
        f"What accuracy costs in time: {_TITLES[name]}",
        "RMSE of the latents from the converged solution",
        points(found.rows),
        points(front),
        {"bf16 against fp32": bf16[0].precision_error or 0.0} if bf16 else {},
    )


#: Column of the table, key of the row, factor and format.
_COLUMNS = (
    ("NFE", "nfe", 1, "d"),
    ("error", "error", 1, ".3g"),
    ("precision", "precision_error", 1, ".3g"),
    ("range m", "range_rmse_m", 1, ".3g"),
    ("IoU", "mask_iou", 1, ".3g"),
    ("ms a scene", "seconds", 1e3, ".4g"),
    ("GFLOP", "flop", 1e-9, ".3g"),
    ("TFLOP/s", "flop_s", 1e-12, ".3g"),
)


def _table(rows: Sequence[dict[str, Any]]) -> str:
    lines = []
    for row in rows:
        line = [row["label"] + ("" if row["converged"] else " ?")]
        for _, key, factor, style in _COLUMNS:
            line.append("-" if row[key] is None else format(row[key] * factor, style))
        lines.append(line)
    return text_table(lines, ["row", *(column[0] for column in _COLUMNS)])


def _notes(found: Finding) -> list[str]:
    return [
        f"error: RMSE from Heun-{found.steps} of {found.samples} samples, itself "
        f"{found.self_error:.3g} from half its steps; ?: error too small for that reference",
        f"timing: first row over itself {found.timing.repeat}"
        + ("" if found.timing.sound else ": the machine was too busy, claim nothing"),
        f"{found.flop[0] / 1e9:.3g} GFLOP an evaluation, {found.flop[1] / 1e9:.3g} the rest",
    ]

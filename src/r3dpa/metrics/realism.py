"""How realistic scans are: each measure beside the distance between real drives.

The floor is the distance from one drive of the reference to another one. What is held against it
must be made the same way: one drive of the scans against one drive of the reference, since pooled
sets are closer to each other than single drives are. Both are medians over all pairs, because a
single pair of drives may be unusually near or far. A ratio of 1 then says: no farther from a
real drive than another real drive is. Drives of fewer scans than those of the reference have
noisier histograms and come out farther away, never nearer. The distance between the pooled sets
is shown as well; it has no floor.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from itertools import combinations, product
from typing import Any

import numpy as np

from r3dpa.io import text_table
from r3dpa.metrics.features import curves
from r3dpa.metrics.measures import MEASURES, Measure, known
from r3dpa.metrics.scan_statistics import ScanStatistics

_MAX_RATIO = 3.0
_COLUMNS = ("measure", "unit", "A", "B", "distance", "floor", "(max)", "ratio", "<= 3", "pooled")


@dataclass(frozen=True)
class RealismRow:
    """One measure; a number that cannot be told is None.

    Args:
        name: Of the measure.
        unit: Of all numbers but the ratio.
        value_a: The scans in one number, None where the measure has none.
        value_b: The same of the reference.
        distance: Median distance from a drive of the scans to a drive of the reference.
        floor: Median distance between two drives of the reference.
        floor_max: Largest distance between two drives of the reference.
        pooled: Distance between all scans and the whole reference.
        ratio: Distance / floor; infinite where only the floor is 0.
        reason: Why there is no ratio; empty where there is one.
    """

    name: str
    unit: str
    value_a: float | None
    value_b: float | None
    distance: float | None
    floor: float | None
    floor_max: float | None
    pooled: float | None
    ratio: float | None
    reason: str

    @property
    def within(self) -> bool | None:
        """Whether the distance is at most 3 times the floor."""
        return None if self.ratio is None else self.ratio <= _MAX_RATIO


@dataclass(frozen=True)
class RealismTable:
    """The realism of scans against a reference; ``str`` gives the table.

    Args:
        rows: One per measure, all of them.
        notes: What a reader must know of the data, line by line.
        statistics_a: All scans, pooled.
        statistics_b: The whole reference, pooled.
    """

    rows: tuple[RealismRow, ...]
    notes: tuple[str, ...]
    statistics_a: ScanStatistics
    statistics_b: ScanStatistics

    @property
    def misses(self) -> tuple[RealismRow, ...]:
        """Measures farther off than 3 times the floor, the worst first."""
        missed = [row for row in self.rows if row.within is False]
        return tuple(sorted(missed, key=lambda row: -(row.ratio or 0.0)))

    def __str__(self) -> str:
        """Aligned table, the measures that miss, and the notes."""
        table = text_table(map(_cells, self.rows), _COLUMNS, align="ll" + "r" * 8)
        missed = ", ".join(f"{row.name} ({row.ratio:.1f}x)" for row in self.misses)
        num_judged = sum(row.ratio is not None for row in self.rows)
        verdict = f"{num_judged - len(self.misses)} of {num_judged} measures within 3 x the floor"
        unknown = [f"n/a: {row.name}: {row.reason}" for row in self.rows if row.reason]
        missing = [f"beyond 3 x the floor: {missed}"] if missed else []
        return "\n".join([table, "", verdict, *missing, *unknown, *self.notes])

    def to_dict(self) -> dict[str, Any]:
        """Rows, notes and the curves behind them, as JSON can hold them (None where unknown)."""
        return {
            "rows": [_finite(asdict(row) | {"within_3x": row.within}) for row in self.rows],
            "notes": list(self.notes),
            "a": _described(self.statistics_a),
            "b": _described(self.statistics_b),
        }


def realism_table(
    scans: Mapping[str, ScanStatistics],
    reference: Mapping[str, ScanStatistics],
    notes: Iterable[str] = (),
) -> RealismTable:
    """Compare scans with a reference, measure by measure; see the text of the module.

    Args:
        scans: Statistics by drive (A).
        reference: Statistics by drive (B), of two or more drives for a floor.
        notes: Further lines to print below the table.

    Raises:
        ValueError: If one of them has no drive.
    """
    if not scans or not reference:
        raise ValueError("realism needs at least one drive of scans and one of the reference")
    pooled_a = sum(scans.values(), ScanStatistics())
    pooled_b = sum(reference.values(), ScanStatistics())
    pairs = list(product(scans.values(), reference.values()))
    real_pairs = list(combinations(reference.values(), 2))
    rows = tuple(_row(measure, pooled_a, pooled_b, pairs, real_pairs) for measure in MEASURES)
    described = (_counted("A", scans, pooled_a), _counted("B", reference, pooled_b))
    return RealismTable(rows, (*described, *notes), pooled_a, pooled_b)


_Pairs = list[tuple[ScanStatistics, ScanStatistics]]


def _row(
    measure: Measure, a: ScanStatistics, b: ScanStatistics, pairs: _Pairs, real_pairs: _Pairs
) -> RealismRow:
    distances, floors = (
        [far for pair in some if not math.isnan(far := measure.between(*pair))]
        for some in (pairs, real_pairs)
    )
    distance = float(np.median(distances)) if distances else None
    floor = float(np.median(floors)) if floors else None
    absent = [
        f"{name}: {why}" for name, s in (("A", a), ("B", b)) if (why := measure.missing_in(s))
    ]
    ratio, reason = None, ""
    if absent:
        reason = "; ".join(absent)
    elif distance is None:
        reason = "no bin holds enough returns in a drive of A and in one of B"
    elif floor is None:
        reason = "no two drives of B can be compared, so there is no floor"
    elif floor == 0:
        ratio = 0.0 if distance == 0 else math.inf
    else:
        ratio = distance / floor
    return RealismRow(
        measure.name,
        measure.unit,
        known(measure.value_in(a)),
        known(measure.value_in(b)),
        distance,
        floor,
        max(floors, default=None),
        known(measure.between(a, b)),
        ratio,
        reason,
    )


def _cells(row: RealismRow) -> tuple[str, ...]:
    given = (row.value_a, row.value_b)
    values = ["-" if value is None and not row.reason else _number(value) for value in given]
    distances = [_number(value) for value in (row.distance, row.floor, row.floor_max)]
    ratio = "n/a" if row.ratio is None else f"{row.ratio:.1f}"
    within = {None: "n/a", True: "yes", False: "NO"}[row.within]
    return (row.name, row.unit, *values, *distances, ratio, within, _number(row.pooled))


def _number(value: float | None) -> str:
    if value is None:
        return "n/a"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _counted(name: str, drives: Mapping[str, ScanStatistics], pooled: ScanStatistics) -> str:
    counts = [statistics.num_scans for statistics in drives.values()]
    total = f"{name}: {pooled.num_scans} scans of {len(drives)} drive{'s' * (len(drives) > 1)}, "
    total += f"{min(counts)} to {max(counts)} each"
    parts = {
        "not in ring order": pooled.num_scans - pooled.num_ring_scans,
        "with another number of rings": pooled.num_ring_scans - pooled.num_beam_scans,
        "without a ground plane": pooled.num_scans - pooled.num_ground_scans,
        "without intensity": pooled.num_scans - pooled.num_intensity_scans,
    }
    left_out = [f"{count} {what}" for what, count in parts.items() if count]
    return f"{total}; left out where needed: {', '.join(left_out)}" if left_out else total


def _described(statistics: ScanStatistics) -> dict[str, Any]:
    per_scan = {
        "scans": statistics.num_scans,
        "scans_in_ring_order": statistics.num_ring_scans,
        "scans_with_all_rings": statistics.num_beam_scans,
        "shots_per_turn": (
            statistics.shots / statistics.num_beam_scans if statistics.num_beam_scans else None
        ),
    }
    return _finite(per_scan | {"curves": curves(statistics)})


def _finite(value: Any) -> Any:
    """The same with arrays as lists, and None for what JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _finite(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | list):
        return [_finite(part) for part in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value

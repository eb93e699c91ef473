"""How realistic scans are: each measure beside the distance between real drives.

The floor is the distance from one drive of the reference to another one. What is held against it
must be made the same way: one drive of the scans against one drive of the reference, since pooled
sets are closer to each other than single drives are. Both are medians over all pairs, because a
single pair of drives may be unusually near or far. A ratio of 1 then says: no farther from a
real drive than another real drive is. Drives of fewer scans than those of the reference have
noisier histograms and come out farther away, never nearer. The distance between the pooled sets
is shown as well; it has no floor.

Source: JSD and W1 of histograms as in LiDARGen (ECCV 2022) and LiDM (CVPR 2024), but the divergence
itself in nats, not its root.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r3dpa.io import text_table
from r3dpa.metrics import features
from r3dpa.metrics.features import (
    curves,
    histogram_mean,
    keep_rate,
    known_median,
    median_intensity,
    overall_keep_rate,
)
from r3dpa.metrics.functional import curve_rmse, jensen_shannon, wasserstein_1
from r3dpa.metrics.scan_statistics import (
    GROUND_REACH_BIN_M,
    GROUND_RESIDUAL_BIN_M,
    HEIGHT_BIN_M,
    HEIGHT_LIMITS_M,
    NUM_BEAMS,
    POINTS_BIN,
    RANGE_BIN_M,
    VALID_SHARE_BIN,
    ScanStatistics,
)

Floats = NDArray[np.float64]

_MAX_RATIO = 3.0
_COLUMNS = ("measure", "unit", "A", "B", "distance", "floor", "(max)", "ratio", "<= 3", "pooled")


def known(number: float) -> float | None:
    """The number, or None where it is NaN: where it cannot be told."""
    return None if np.isnan(number) else float(number)


def difference(value_a: float, value_b: float) -> float:
    """Absolute difference of two numbers."""
    return abs(value_a - value_b)


@dataclass(frozen=True)
class Measure:
    """One row of the realism table.

    Args:
        name: As it is printed.
        unit: Of the distance, and of the value where there is one.
        needs: What a scan must show to take part; several words, separated by spaces.
        feature: What is compared: a number, a curve or a histogram.
        distance: Between two features; NaN where they cannot be compared.
        value: One number that sums up a data set, or None where the feature has none.
    """

    name: str
    unit: str
    needs: str
    feature: Callable[[ScanStatistics], Floats | float]
    distance: Callable[..., float]
    value: Callable[[ScanStatistics], float] | None = None

    def between(self, a: ScanStatistics, b: ScanStatistics) -> float:
        """Distance of two sets of scans; NaN where one of them cannot give it."""
        if self.missing_in(a) or self.missing_in(b):
            return float("nan")
        return self.distance(self.feature(a), self.feature(b))

    def value_in(self, statistics: ScanStatistics) -> float:
        """The one number of a set of scans; NaN where there is none."""
        if self.value is None or self.missing_in(statistics):
            return float("nan")
        return float(self.value(statistics))

    def missing_in(self, statistics: ScanStatistics) -> str:
        """Why a set of scans cannot give this measure; empty where it can."""
        have = {
            "rings": (statistics.num_ring_scans, "no scan is stored ring after ring"),
            "beams": (statistics.num_beam_scans, f"no scan shows {NUM_BEAMS} rings in order"),
            "ground": (statistics.num_ground_scans, "no scan shows a ground plane"),
            "intensity": (statistics.num_intensity_scans, "the intensity is zero everywhere"),
            "points": (statistics.num_scans, "no scan"),
        }
        return next((have[need][1] for need in self.needs.split() if not have[need][0]), "")


def _range_counts(statistics: ScanStatistics, blocks: slice) -> Floats:
    return statistics.range_counts[blocks].sum(axis=0)


def _mean_range_m(statistics: ScanStatistics, blocks: slice) -> float:
    return histogram_mean(_range_counts(statistics, blocks), RANGE_BIN_M)


def _range_measures(where: str, blocks: slice) -> tuple[Measure, Measure]:
    """W1 and JSD of the range histogram of some blocks of lasers."""
    counts, mean = partial(_range_counts, blocks=blocks), partial(_mean_range_m, blocks=blocks)
    by_w1 = partial(wasserstein_1, bin_width=RANGE_BIN_M)
    return (
        Measure(f"range W1{where}", "m", "points", counts, by_w1, mean),
        Measure(f"range JSD{where}", "nats", "points", counts, jensen_shannon),
    )


def _keep_measure(name: str, needs: str, counts: Callable[[ScanStatistics], Floats]) -> Measure:
    """Curve of the shots that came back, among those between two returns of one surface."""
    return Measure(
        f"keep rate by {name}",
        "1",
        needs,
        lambda s: keep_rate(counts(s)),
        curve_rmse,
        lambda s: overall_keep_rate(counts(s)),
    )


# fmt: off
MEASURES: tuple[Measure, ...] = (
    Measure("returns per scan", "points", "points",
        lambda s: s.points_per_scan, partial(wasserstein_1, bin_width=POINTS_BIN),
        lambda s: s.num_returns / s.num_scans),
    Measure("valid share of the image", "1", "points",
        lambda s: s.valid_share, partial(wasserstein_1, bin_width=VALID_SHARE_BIN),
        lambda s: float(features.row_shares(s).mean())),
    Measure("valid share by image row", "1", "points", features.row_shares, curve_rmse),
    Measure("image rows > 2 % valid", "rows", "points",
        features.num_hit_rows, difference, features.num_hit_rows),
    *_range_measures("", slice(None)),
    *_range_measures(", upper block", slice(0, 1)),
    *_range_measures(", lower block", slice(1, 2)),
    Measure("dropout by beam", "1", "beams",
        features.dropout, curve_rmse, lambda s: float(features.dropout(s).mean())),
    Measure("dropout run length", "shots", "rings",
        lambda s: s.drop_runs, partial(wasserstein_1, bin_width=1.0),
        lambda s: histogram_mean(s.drop_runs, 1.0, -0.5)),
    _keep_measure("range, any surface", "rings", lambda s: s.keep_by_range[0]),
    _keep_measure("range, ground", "rings ground", lambda s: s.keep_by_range[1]),
    _keep_measure("range, upright", "rings", lambda s: s.keep_by_range[2]),
    _keep_measure("incidence, ground", "rings ground", lambda s: s.keep_by_incidence[0]),
    _keep_measure("incidence, upright", "rings", lambda s: s.keep_by_incidence[1]),
    Measure("range residual sd by beam", "mm", "beams",
        features.residual_sd_mm, curve_rmse, lambda s: known_median(features.residual_sd_mm(s))),
    Measure("range bias by beam", "mm", "beams", features.bias_mm, curve_rmse),
    Measure("spread of the beams' bias", "mm", "beams",
        features.bias_spread_mm, difference, features.bias_spread_mm),
    Measure("intensity JSD", "nats", "intensity", features.intensity_levels, jensen_shannon),
    Measure("median intensity by range", "1", "intensity",
        lambda s: median_intensity(s.intensity_by_range), curve_rmse,
        lambda s: float(median_intensity(features.intensity_levels(s)))),
    Measure("median intensity by incidence, ground", "1", "intensity ground",
        lambda s: median_intensity(s.intensity_by_incidence[0]), curve_rmse,
        lambda s: float(median_intensity(s.intensity_by_incidence[0].sum(axis=0)))),
    Measure("median intensity by incidence, upright", "1", "intensity rings",
        lambda s: median_intensity(s.intensity_by_incidence[1]), curve_rmse,
        lambda s: float(median_intensity(s.intensity_by_incidence[1].sum(axis=0)))),
    Measure("saturated share", "1", "intensity",
        features.saturated_share, difference, features.saturated_share),
    Measure("share below z = -1.4 m", "1", "points",
        features.low_share, difference, features.low_share),
    Measure("ground plane residual", "mm", "ground",
        lambda s: s.ground_residual_counts,
        partial(wasserstein_1, bin_width=GROUND_RESIDUAL_BIN_M * 1000),
        features.ground_residual_sd_mm),
    Measure("last ground ring", "m", "ground",
        features.last_ring_m, difference, features.last_ring_m),
    Measure("ground reach by sector", "m", "ground",
        lambda s: s.ground_reach_counts, partial(wasserstein_1, bin_width=GROUND_REACH_BIN_M),
        lambda s: histogram_mean(s.ground_reach_counts, GROUND_REACH_BIN_M)),
    Measure("ground ring spacing", "m", "beams ground",
        features.ring_spacing_m, curve_rmse, lambda s: known_median(features.ring_spacing_m(s))),
    Measure("mixed pixels", "1", "rings", features.mixed_share, difference, features.mixed_share),
    Measure("jumps > 0.5 m to the next", "1", "rings",
        features.jump_share, difference, features.jump_share),
    Measure("BEV JSD, 0.5 m cells", "nats", "points", lambda s: s.bev_counts, jensen_shannon),
    Measure("BEV JSD, 1 m cells", "nats", "points", features.coarse_bev, jensen_shannon),
    Measure("height map W1", "m", "points",
        lambda s: s.height_counts, partial(wasserstein_1, bin_width=HEIGHT_BIN_M),
        lambda s: histogram_mean(s.height_counts, HEIGHT_BIN_M, HEIGHT_LIMITS_M[0])),
    Measure("occupied cells by sector", "1", "points",
        features.sector_shares, curve_rmse, lambda s: float(features.sector_shares(s).mean())),
)
# fmt: on


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
    """The realism of scans against a reference; ``str`` gives the table."""

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

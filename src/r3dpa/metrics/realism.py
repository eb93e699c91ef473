"""Realism of scans: 36 distances to real scans, each beside the distance between real drives.

The floor is the median distance between two drives of the reference. The distance of the scans is
the median over pairs of one drive of the scans and one of the reference: pooled sets are closer to
each other than single drives are, and a single pair may be unusually near or far. A ratio of 1
means that the scans are no farther from a real drive than another real drive is. Drives of fewer
scans than those of the reference have noisier histograms and come out farther away, never nearer.
The distance between the pooled sets is shown as well; it has no floor.

Source: JSD and W1 of histograms as in LiDARGen (ECCV 2022) and LiDM (CVPR 2024), but the divergence
itself in nats, not its root.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations, product
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from r3dpa.io import text_table
from r3dpa.metrics.functional import curve_rmse, jensen_shannon, wasserstein_1
from r3dpa.metrics.scan_statistics import (
    BEAMS,
    BEV_EXTENT_M,
    GROUND_REACH,
    GROUND_RESIDUAL,
    HEIGHT,
    INTENSITY_LEVELS,
    RANGE,
    RESIDUAL,
    RETURNS,
    RUN,
    SENSOR,
    STEP,
    VALID_SHARE,
    Bins,
    ScanStatistics,
)

Floats = NDArray[np.float64]
_Feature = Callable[[ScanStatistics], Any]

_MAX_RATIO = 3.0
_COLUMNS = ("measure", "unit", "A", "B", "distance", "floor", "(max)", "ratio", "<= 3", "pooled")
_MIN_COUNT = 200  # a bin of a curve with fewer returns is left out
_LAST_RING_SHARE = 0.1  # of the azimuth
_NEAR_RINGS_M = 25.0  # farther rings are apart by metres and follow the slope of the road
_HIT_ROW_SHARE = 0.02
_NORMAL_MEDIAN = 0.6745  # median of |x| of a normal variable of deviation 1
_NEEDS = {
    "points": ("num_scans", "no scan"),
    "rings": ("num_ring_scans", "no scan is stored ring after ring"),
    "beams": ("num_beam_scans", f"no scan shows {BEAMS} rings in order"),
    "ground": ("num_ground_scans", "no scan shows a ground plane"),
    "intensity": ("num_intensity_scans", "the intensity is zero everywhere"),
}


class Measure(NamedTuple):
    """One row of the realism table.

    Args:
        name: Printed name.
        unit: Unit of the distance and of the value.
        needs: What scans must have: names of ``_NEEDS``, separated by spaces.
        feature: Number, curve or histogram that is compared.
        distance: Of two features; NaN where they cannot be compared.
        value: One number that summarises a data set; NaN where there is none.
    """

    name: str
    unit: str
    needs: str
    feature: _Feature
    distance: Callable[[Any, Any], float]
    value: _Feature = lambda _: math.nan

    def between(self, a: ScanStatistics, b: ScanStatistics) -> float:
        """Distance of two sets of scans; NaN where one of them cannot give it."""
        return float(self.distance(self.feature(a), self.feature(b)))

    def missing_in(self, statistics: ScanStatistics) -> str:
        """Why a set of scans cannot give this measure; empty where it can."""
        needs = [_NEEDS[need] for need in self.needs.split()]
        return next((why for count, why in needs if not getattr(statistics, count)), "")


def _ratio(numerator: Any, denominator: Any, at_least: float = 0.0) -> Any:
    """Quotient, NaN where the denominator is 0 or below ``at_least``."""
    known = (denominator > 0) & (denominator >= at_least)
    return np.where(known, numerator / np.where(known, denominator, 1.0), np.nan)


def _quantile(counts: Floats, quantile: float, at_least: float = _MIN_COUNT) -> Floats:
    """Quantile along the last axis in bins from 0, linear within a bin; NaN for too few counts."""
    cdf = counts.cumsum(axis=-1)
    total = cdf[..., -1:]
    wanted = quantile * total
    index = (cdf < wanted).sum(axis=-1, keepdims=True).clip(max=counts.shape[-1] - 1)
    inside = np.take_along_axis(counts, index, axis=-1)
    below = np.take_along_axis(cdf, index, axis=-1) - inside
    return np.where(total >= at_least, index + _ratio(wanted - below, inside), np.nan)[..., 0]


def _known(statistic: Callable[[Floats], Any], curve: Floats) -> float:
    """Statistic of the finite values of a curve."""
    finite = curve[np.isfinite(curve)]
    return float(statistic(finite)) if len(finite) else math.nan


def _row_shares(s: ScanStatistics) -> Floats:
    return _ratio(s.row_returns, s.num_scans * SENSOR.columns)


def _dropout(s: ScanStatistics) -> Floats:
    """Probability by beam that a shot gives no return between 1 and 80 m."""
    return (1 - _ratio(s.beam_returns, s.shots)).clip(0)


def _residual_sd_mm(s: ScanStatistics) -> Floats:
    """Standard deviation by beam of a range around its neighbours in the ring.

    From the median of the absolute residuals, as for a normal variable, so that the few returns of
    grass and foliage that pass for smooth do not count more than others.
    """
    return _quantile(s.residual_counts, 0.5) * RESIDUAL.width * 1000 / _NORMAL_MEDIAN


def _bias_mm(s: ScanStatistics) -> Floats:
    """Median range of a beam minus that of both neighbouring beams."""
    return (_quantile(s.step_counts, 0.5) - STEP.number / 2) * STEP.width * 1000


def _median_intensity(counts: Floats) -> Floats:
    """Median along the last axis; each step of 0.01 is an interval."""
    return (_quantile(counts, 0.5) - 0.5) / (INTENSITY_LEVELS - 1)


def _intensities(s: ScanStatistics) -> Floats:
    return s.intensity_by_range.sum(axis=0)


def _ground_residual_sd_mm(s: ScanStatistics) -> float:
    centres_mm = (np.arange(GROUND_RESIDUAL.number) + 0.5) * GROUND_RESIDUAL.width * 1000
    shares = _ratio(s.ground_residual_counts, s.ground_residual_counts.sum())
    return np.sqrt((shares * (centres_mm - (shares * centres_mm).sum()) ** 2).sum())


def _last_ring_m(s: ScanStatistics) -> Floats:
    """Horizontal distance at or beyond which 10 % of the azimuth still sees ground."""
    return _quantile(s.ground_reach_counts, 1 - _LAST_RING_SHARE, 1) * GROUND_REACH.width


def _ring_spacing_m(s: ScanStatistics) -> Floats:
    """Distance ``(H - 1,)`` between the ground rings of neighbouring beams within 25 m."""
    distance = _ratio(s.ground_distance_m, s.ground_returns, _MIN_COUNT)
    return np.where(distance[:-1] < _NEAR_RINGS_M, -np.diff(distance), np.nan)


def _coarse_bev(s: ScanStatistics) -> Floats:
    cells = len(s.bev_counts) // 2
    return s.bev_counts.reshape(cells, 2, cells, 2).sum(axis=(1, 3))


def _sector_shares(s: ScanStatistics) -> Floats:
    """Share of the 1-m cells within 50 m that hold a return, by azimuth sector."""
    cells = np.pi * BEV_EXTENT_M**2 / len(s.sector_cells)
    return _ratio(s.sector_cells, s.num_scans * cells)


def _number(name: str, unit: str, needs: str, number: _Feature) -> Measure:
    return Measure(name, unit, needs, number, lambda a, b: abs(a - b), number)


def _share(name: str, needs: str, part: _Feature, whole: _Feature) -> Measure:
    return _number(name, "1", needs, lambda s: _ratio(part(s), whole(s)))


def _jsd(name: str, needs: str, counts: _Feature) -> Measure:
    return Measure(name, "nats", needs, counts, jensen_shannon)


def _w1(name: str, unit: str, needs: str, counts: _Feature, bins: Bins) -> Measure:
    def mean(s: ScanStatistics) -> float:
        centres = bins.start + (np.arange(bins.number) + 0.5) * bins.width
        return _ratio(counts(s) @ centres, counts(s).sum())

    return Measure(name, unit, needs, counts, lambda a, b: wasserstein_1(a, b, bins.width), mean)


def _range(where: str, counts: _Feature) -> tuple[Measure, Measure]:
    """W1 and JSD of the range histogram of some blocks of lasers."""
    return (
        _w1(f"range W1{where}", "m", "points", counts, RANGE),
        _jsd(f"range JSD{where}", "points", counts),
    )


def _keep_rate(by: str, needs: str, counts: _Feature) -> Measure:
    """Share of the shots that came back, among those between two returns of one surface."""
    return Measure(
        f"keep rate by {by}",
        "1",
        needs,
        lambda s: _ratio(counts(s)[:, 1], counts(s).sum(axis=-1), _MIN_COUNT),
        curve_rmse,
        lambda s: _ratio(counts(s)[:, 1].sum(), counts(s).sum()),
    )


def _intensity(by: str, needs: str, counts: _Feature) -> Measure:
    return Measure(
        f"median intensity by {by}",
        "1",
        needs,
        lambda s: _median_intensity(counts(s)),
        curve_rmse,
        lambda s: _median_intensity(counts(s).sum(axis=0)),
    )


# fmt: off
MEASURES: tuple[Measure, ...] = (
    _w1("returns per scan", "points", "points", attrgetter("points_per_scan"), RETURNS)
        ._replace(value=lambda s: _ratio(s.num_returns, s.num_scans)),
    _w1("valid share of the image", "1", "points", attrgetter("valid_share"), VALID_SHARE)
        ._replace(value=lambda s: _row_shares(s).mean()),
    Measure("valid share by image row", "1", "points", _row_shares, curve_rmse),
    _number("image rows > 2 % valid", "rows", "points",
        lambda s: (_row_shares(s) > _HIT_ROW_SHARE).sum()),
    *_range("", lambda s: s.range_counts.sum(axis=0)),
    *_range(", upper block", lambda s: s.range_counts[0]),
    *_range(", lower block", lambda s: s.range_counts[1]),
    Measure("dropout by beam", "1", "beams", _dropout, curve_rmse, lambda s: _dropout(s).mean()),
    _w1("dropout run length", "shots", "rings", attrgetter("drop_runs"), RUN),
    _keep_rate("range, any surface", "rings", lambda s: s.keep_by_range[0]),
    _keep_rate("range, ground", "rings ground", lambda s: s.keep_by_range[1]),
    _keep_rate("range, upright", "rings", lambda s: s.keep_by_range[2]),
    _keep_rate("incidence, ground", "rings ground", lambda s: s.keep_by_incidence[0]),
    _keep_rate("incidence, upright", "rings", lambda s: s.keep_by_incidence[1]),
    Measure("range residual sd by beam", "mm", "beams", _residual_sd_mm, curve_rmse,
        lambda s: _known(np.median, _residual_sd_mm(s))),
    Measure("range bias by beam", "mm", "beams", _bias_mm, curve_rmse),
    _number("spread of the beams' bias", "mm", "beams", lambda s: _known(np.std, _bias_mm(s))),
    _jsd("intensity JSD", "intensity", _intensities),
    _intensity("range", "intensity", lambda s: s.intensity_by_range),
    _intensity("incidence, ground", "intensity ground", lambda s: s.intensity_by_incidence[0]),
    _intensity("incidence, upright", "intensity rings", lambda s: s.intensity_by_incidence[1]),
    # 0.99 is the largest intensity in KITTI files.
    _share("saturated share", "intensity",
        lambda s: _intensities(s)[-2:].sum(), lambda s: _intensities(s).sum()),
    _share("share below z = -1.4 m", "points", attrgetter("low_points"), attrgetter("num_returns")),
    _w1("ground plane residual", "mm", "ground", attrgetter("ground_residual_counts"),
        Bins(GROUND_RESIDUAL.width * 1000, GROUND_RESIDUAL.number))
        ._replace(value=_ground_residual_sd_mm),
    _number("last ground ring", "m", "ground", _last_ring_m),
    _w1("ground reach by sector", "m", "ground", attrgetter("ground_reach_counts"), GROUND_REACH),
    Measure("ground ring spacing", "m", "beams ground", _ring_spacing_m, curve_rmse,
        lambda s: _known(np.median, _ring_spacing_m(s))),
    _share("mixed pixels", "rings", lambda s: s.neighbours[1], lambda s: s.neighbours[0]),
    _share("jumps > 0.5 m to the next", "rings",
        lambda s: s.neighbours[2], lambda s: s.neighbours[0]),
    _jsd("BEV JSD, 0.5 m cells", "points", attrgetter("bev_counts")),
    _jsd("BEV JSD, 1 m cells", "points", _coarse_bev),
    _w1("height map W1", "m", "points", attrgetter("height_counts"), HEIGHT),
    Measure("occupied cells by sector", "1", "points", _sector_shares, curve_rmse,
        lambda s: _sector_shares(s).mean()),
)
# fmt: on


class RealismRow(NamedTuple):
    """One measure; NaN where a number is unknown."""

    name: str
    unit: str  # of all numbers but the ratio
    value_a: float  # summary of the scans, where the measure has one
    value_b: float  # the same of the reference
    distance: float  # median from a drive of the scans to a drive of the reference
    floor: float  # median between two drives of the reference
    floor_max: float  # largest of these
    pooled: float  # between all scans and the whole reference
    ratio: float  # distance / floor; infinite where only the floor is 0
    reason: str  # why there is no ratio; empty where there is one

    @property
    def within(self) -> bool | None:
        """Whether the distance is at most 3 times the floor; None without a ratio."""
        return None if math.isnan(self.ratio) else self.ratio <= _MAX_RATIO


@dataclass(frozen=True)
class RealismTable:
    """Realism of scans (A) against a reference (B); ``str`` gives the table."""

    rows: tuple[RealismRow, ...]
    notes: tuple[str, ...]
    statistics_a: ScanStatistics
    statistics_b: ScanStatistics

    @property
    def misses(self) -> tuple[RealismRow, ...]:
        """Measures farther off than 3 times the floor, the worst first."""
        missed = [row for row in self.rows if row.within is False]
        return tuple(sorted(missed, key=lambda row: -row.ratio))

    def __str__(self) -> str:
        table = text_table(map(_cells, self.rows), _COLUMNS, align="ll" + "r" * 8)
        missed = ", ".join(f"{row.name} ({row.ratio:.1f}x)" for row in self.misses)
        num_judged = sum(row.within is not None for row in self.rows)
        verdict = f"{num_judged - len(self.misses)} of {num_judged} measures within 3 x the floor"
        unknown = [f"n/a: {row.name}: {row.reason}" for row in self.rows if row.reason]
        missing = [f"beyond 3 x the floor: {missed}"] if missed else []
        return "\n".join([table, "", verdict, *missing, *unknown, *self.notes])

    def to_dict(self) -> dict[str, Any]:
        """Rows, notes and the curves and histograms behind them, for JSON (null where unknown)."""
        return {
            "rows": [
                {key: _json(value) for key, value in row._asdict().items()}
                | {"within_3x": row.within}
                for row in self.rows
            ],
            "notes": list(self.notes),
            "a": _described(self.statistics_a),
            "b": _described(self.statistics_b),
        }


def realism_table(
    scans: Mapping[str, ScanStatistics],
    reference: Mapping[str, ScanStatistics],
    notes: Iterable[str] = (),
) -> RealismTable:
    """Compare drives of scans with drives of a reference; see the text of the module.

    Raises:
        ValueError: If one of them has no drive.
    """
    if not scans or not reference:
        raise ValueError("realism needs at least one drive of scans and one of the reference")
    a = sum(scans.values(), ScanStatistics())
    b = sum(reference.values(), ScanStatistics())
    pairs = list(product(scans.values(), reference.values()))
    real_pairs = list(combinations(reference.values(), 2))
    rows = tuple(_row(measure, a, b, pairs, real_pairs) for measure in MEASURES)
    described = (_counted("A", scans, a), _counted("B", reference, b))
    return RealismTable(rows, (*described, *notes), a, b)


_Pairs = list[tuple[ScanStatistics, ScanStatistics]]


def _row(
    measure: Measure, a: ScanStatistics, b: ScanStatistics, pairs: _Pairs, real_pairs: _Pairs
) -> RealismRow:
    distances = np.array([measure.between(*pair) for pair in pairs])
    floors = np.array([measure.between(*pair) for pair in real_pairs])
    distance, floor = _known(np.median, distances), _known(np.median, floors)
    absent = {"A": measure.missing_in(a), "B": measure.missing_in(b)}
    ratio, reason = math.nan, ""
    if any(absent.values()):
        reason = "; ".join(f"{name}: {why}" for name, why in absent.items() if why)
    elif math.isnan(distance):
        reason = "no bin holds enough returns in a drive of A and in one of B"
    elif math.isnan(floor):
        reason = "no two drives of B can be compared, so there is no floor"
    elif floor == 0:
        ratio = 0.0 if distance == 0 else math.inf
    else:
        ratio = distance / floor
    values = float(measure.value(a)), float(measure.value(b))
    largest, pooled = _known(np.max, floors), measure.between(a, b)
    return RealismRow(
        measure.name, measure.unit, *values, distance, floor, largest, pooled, ratio, reason
    )


def _cells(row: RealismRow) -> tuple[str, ...]:
    given = (row.value_a, row.value_b)
    values = ["-" if math.isnan(value) and not row.reason else _text(value) for value in given]
    distances = [_text(value) for value in (row.distance, row.floor, row.floor_max)]
    ratio = "n/a" if math.isnan(row.ratio) else f"{row.ratio:.1f}"
    within = {None: "n/a", True: "yes", False: "NO"}[row.within]
    return (row.name, row.unit, *values, *distances, ratio, within, _text(row.pooled))


def _text(value: float) -> str:
    if math.isnan(value):
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
    features = {measure.name: np.asarray(measure.feature(statistics)) for measure in MEASURES}
    return {
        "scans": statistics.num_scans,
        "scans_in_ring_order": statistics.num_ring_scans,
        "scans_with_all_rings": statistics.num_beam_scans,
        "shots_per_turn": _json(_ratio(statistics.shots, statistics.num_beam_scans)),
        "curves": {name: _json(values) for name, values in features.items() if values.ndim == 1},
    }


def _json(value: Any) -> Any:
    """Numbers and arrays for JSON, None for those that are not finite; texts as they are."""
    if isinstance(value, str):
        return value
    return np.asarray(np.where(np.isfinite(value), value, None)).tolist()

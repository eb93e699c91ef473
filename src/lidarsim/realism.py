"""Realism of scans: 36 distances to real scans, each beside the distance between real drives.

The floor is the median distance between two drives of the reference, and the distance of the scans
the median over pairs of one drive of the scans and one of the reference, as pooled sets are closer
to each other. A ratio of 1 means that the scans are no farther from a real drive than another real
drive is. Drives of few scans have noisier histograms and come out farther away, never nearer.

Source: JSD and W1 of histograms as in LiDARGen (ECCV 2022) and LiDM (CVPR 2024), but the divergence
itself in nats, not its root.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import chain, combinations, product
from typing import Any, NamedTuple

import numpy as np

from lidarsim.divergences import curve_rmse, jensen_shannon, wasserstein_1
from lidarsim.io import number_of, text_table
from lidarsim.scan_statistics import (
    BEAMS,
    BEV_EXTENT_M,
    BINS,
    INTENSITY_LEVELS,
    SENSOR,
    ScanStatistics,
)
from lidarsim.scan_structure import Floats

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
    """One quantity of a set of scans."""

    name: str
    unit: str  # of the distance and of the summary
    lacks: str  # why the set cannot give the measure; empty where it can
    distance: Callable[[Any, Any], float]  # of the values of two sets; NaN where unknown
    values: Any  # number, curve or histogram that is compared
    summary: float = math.nan  # one number for the set; NaN where there is none


def measures(s: ScanStatistics) -> dict[str, Measure]:
    """The 36 measures of a set of scans by name."""
    missing = {need: why for need, (count, why) in _NEEDS.items() if not getattr(s, count)}
    groups = (_returns, _losses, _beams, _intensities, _ground, _neighbours_and_places)
    by_name = {}
    # Their ``lacks`` are still names of ``_NEEDS``.
    for measure in chain.from_iterable(group(s) for group in groups):
        lacks = next((missing[need] for need in measure.lacks.split() if need in missing), "")
        by_name[measure.name] = measure._replace(lacks=lacks)
    return by_name


def _returns(s: ScanStatistics) -> Iterator[Measure]:
    """Number of returns, share of the image, and ranges."""
    row_shares = _ratio(s.row_returns, s.num_scans * SENSOR.columns)
    mean_returns = _ratio(s.num_returns, s.num_scans)
    hit_rows = (row_shares > _HIT_ROW_SHARE).sum()
    yield _w1("returns per scan", "points", "points", s, "points_per_scan", mean_returns)
    yield _w1("valid share of the image", "1", "points", s, "valid_share", row_shares.mean())
    yield Measure("valid share by image row", "1", "points", curve_rmse, row_shares)
    yield _number("image rows > 2 % valid", "rows", "points", hit_rows)

    upper, lower = s.range_counts
    for block, ranges in (("", upper + lower), (", upper block", upper), (", lower block", lower)):
        yield _w1(f"range W1{block}", "m", "points", s, "range_counts", histogram=ranges)
        yield _jsd(f"range JSD{block}", "points", ranges)


def _losses(s: ScanStatistics) -> Iterator[Measure]:
    """Shots without a return."""
    dropout = (1 - _ratio(s.beam_returns, s.shots)).clip(0)  # no return between 1 and 80 m
    yield Measure("dropout by beam", "1", "beams", curve_rmse, dropout, dropout.mean())
    yield _w1("dropout run length", "shots", "rings", s, "drop_runs")
    yield _keep_rate("range, any surface", "rings", s.keep_by_range)
    yield _keep_rate("range, ground", "rings ground", s.surface_keep_by_range[0])
    yield _keep_rate("range, upright", "rings", s.surface_keep_by_range[1])
    yield _keep_rate("incidence, ground", "rings ground", s.keep_by_incidence[0])
    yield _keep_rate("incidence, upright", "rings", s.keep_by_incidence[1])


def _beams(s: ScanStatistics) -> Iterator[Measure]:
    """Noise and bias of each beam."""
    # Around the neighbours in the ring. From the median of the absolute residuals, as for a normal
    # variable, so that the few returns of grass and foliage that pass for smooth do not count more.
    noise_mm = _quantile(s.residual_counts, 0.5) * BINS["residual_counts"].width * 1000
    noise_mm /= _NORMAL_MEDIAN
    median_mm = _over_finite(np.median, noise_mm)
    yield Measure("range residual sd by beam", "mm", "beams", curve_rmse, noise_mm, median_mm)
    # Median range of a beam minus the median range of both neighbouring beams.
    middle = BINS["step_counts"].number / 2
    bias_mm = (_quantile(s.step_counts, 0.5) - middle) * BINS["step_counts"].width * 1000
    yield Measure("range bias by beam", "mm", "beams", curve_rmse, bias_mm)
    yield _number("spread of the beams' bias", "mm", "beams", _over_finite(np.std, bias_mm))


def _intensities(s: ScanStatistics) -> Iterator[Measure]:
    intensities = s.intensity_by_range.sum(axis=0)
    saturated = intensities[-2:].sum()  # 0.99 is the largest intensity in KITTI files
    yield _jsd("intensity JSD", "intensity", intensities)
    yield _intensity("range", "intensity", s.intensity_by_range)
    yield _intensity("incidence, ground", "intensity ground", s.intensity_by_incidence[0])
    yield _intensity("incidence, upright", "intensity rings", s.intensity_by_incidence[1])
    yield _number("saturated share", "1", "intensity", _ratio(saturated, intensities.sum()))


def _ground(s: ScanStatistics) -> Iterator[Measure]:
    yield _number("share below z = -1.4 m", "1", "points", _ratio(s.low_points, s.num_returns))
    heights = BINS["ground_residual_counts"]
    shares = _ratio(s.ground_residual_counts, s.ground_residual_counts.sum())
    centres_mm = (np.arange(heights.number) + 0.5) * heights.width * 1000
    spread_mm = np.sqrt((shares * (centres_mm - (shares * centres_mm).sum()) ** 2).sum())
    yield _w1(
        "ground plane residual", "mm", "ground", s, "ground_residual_counts", spread_mm, scale=1000
    )
    # Horizontal distance at or beyond which 10 % of the azimuth still sees ground.
    last = _quantile(s.ground_reach_counts, 1 - _LAST_RING_SHARE, 1)
    yield _number("last ground ring", "m", "ground", last * BINS["ground_reach_counts"].width)
    yield _w1("ground reach by sector", "m", "ground", s, "ground_reach_counts")
    ring_m = _ratio(s.ground_distance_m, s.ground_returns, _MIN_COUNT)
    spacing_m = np.where(ring_m[:-1] < _NEAR_RINGS_M, -np.diff(ring_m), np.nan)
    median_m = _over_finite(np.median, spacing_m)
    yield Measure("ground ring spacing", "m", "beams ground", curve_rmse, spacing_m, median_m)


def _neighbours_and_places(s: ScanStatistics) -> Iterator[Measure]:
    """Edges along the rings, and where returns lie seen from above."""
    pairs, mixed, jumps = s.neighbours
    cells = len(s.bev_counts) // 2
    coarse = s.bev_counts.reshape(cells, 2, cells, 2).sum(axis=(1, 3))
    # Of the 1-m cells within 50 m, those that hold a return.
    in_sector = np.pi * BEV_EXTENT_M**2 / len(s.sector_cells)
    occupied = _ratio(s.sector_cells, s.num_scans * in_sector)
    yield _number("mixed pixels", "1", "rings", _ratio(mixed, pairs))
    yield _number("jumps > 0.5 m to the next", "1", "rings", _ratio(jumps, pairs))
    yield _jsd("BEV JSD, 0.5 m cells", "points", s.bev_counts)
    yield _jsd("BEV JSD, 1 m cells", "points", coarse)
    yield _w1("height map W1", "m", "points", s, "height_counts")
    yield Measure("occupied cells by sector", "1", "points", curve_rmse, occupied, occupied.mean())


def _number(name: str, unit: str, needs: str, value: Any) -> Measure:
    return Measure(name, unit, needs, lambda a, b: abs(a - b), value, value)


def _jsd(name: str, needs: str, histogram: Floats) -> Measure:
    return Measure(name, "nats", needs, jensen_shannon, histogram)


def _w1(
    name: str,
    unit: str,
    needs: str,
    s: ScanStatistics,
    table: str,
    summary: float | None = None,
    *,
    histogram: Floats | None = None,
    scale: float = 1.0,
) -> Measure:
    """Earth mover's distance of a histogram; its mean unless there is another summary."""
    bins = BINS[table]
    values = getattr(s, table) if histogram is None else histogram
    if summary is None:
        centres = bins.start + (np.arange(bins.number) + 0.5) * bins.width
        summary = _ratio(values @ centres, values.sum())
    distance = partial(wasserstein_1, bin_width=bins.width * scale)
    return Measure(name, unit, needs, distance, values, summary)


def _keep_rate(by: str, needs: str, outcomes: Floats) -> Measure:
    """Share of the shots that came back, among those between two returns of one surface."""
    curve = _ratio(outcomes[:, 1], outcomes.sum(axis=-1), _MIN_COUNT)
    mean = _ratio(outcomes[:, 1].sum(), outcomes.sum())
    return Measure(f"keep rate by {by}", "1", needs, curve_rmse, curve, mean)


def _intensity(by: str, needs: str, histograms: Floats) -> Measure:
    """Median intensity; each step of 0.01 is an interval."""

    def median(levels: Floats) -> Any:
        return (_quantile(levels, 0.5) - 0.5) / (INTENSITY_LEVELS - 1)

    curve, summary = median(histograms), median(histograms.sum(axis=0))
    return Measure(f"median intensity by {by}", "1", needs, curve_rmse, curve, summary)


def _ratio(numerator: Any, denominator: Any, at_least: float = 0.0) -> Any:
    """Quotient, NaN where the denominator is 0 or below ``at_least``."""
    known = (denominator > 0) & (denominator >= at_least)
    return np.where(known, numerator / np.where(known, denominator, 1.0), np.nan)


def _quantile(histograms: Floats, quantile: float, at_least: float = _MIN_COUNT) -> Floats:
    """Quantile along the last axis in bins from 0, linear within a bin; NaN for too few counts."""
    cdf = histograms.cumsum(axis=-1)
    total = cdf[..., -1:]
    wanted = quantile * total
    index = (cdf < wanted).sum(axis=-1, keepdims=True).clip(max=histograms.shape[-1] - 1)
    inside = np.take_along_axis(histograms, index, axis=-1)
    below = np.take_along_axis(cdf, index, axis=-1) - inside
    return np.where(total >= at_least, index + _ratio(wanted - below, inside), np.nan)[..., 0]


def _over_finite(statistic: Callable[[Floats], Any], curve: Floats) -> float:
    finite = curve[np.isfinite(curve)]
    return float(statistic(finite)) if len(finite) else math.nan


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

    @property
    def misses(self) -> tuple[RealismRow, ...]:
        """Measures farther off than 3 times the floor, the worst first."""
        missed = [row for row in self.rows if row.within is False]
        return tuple(sorted(missed, key=lambda row: -row.ratio))

    def __str__(self) -> str:
        table = text_table(map(_cells, self.rows), _COLUMNS, align="ll" + "r" * 8)
        lines = [table, ""]
        num_judged = sum(row.within is not None for row in self.rows)
        if num_judged:
            num_within = num_judged - len(self.misses)
            lines.append(f"{num_within} of {num_judged} measures within 3 x the floor")
        if self.misses:
            misses = [f"{row.name} ({row.ratio:.1f}x)" for row in self.misses]
            lines.append(f"beyond 3 x the floor: {', '.join(misses)}")
        names_by_reason: dict[str, list[str]] = {}
        for row in self.rows:
            if row.reason:
                names_by_reason.setdefault(row.reason, []).append(row.name)
        for reason, names in names_by_reason.items():
            is_of_all = len(names) == len(self.rows)
            lines.append(f"n/a: {'all measures' if is_of_all else ', '.join(names)}: {reason}")
        return "\n".join([*lines, *self.notes])

    def to_dict(self) -> dict[str, Any]:
        """Rows and notes for JSON, null where a number is unknown."""
        rows = [row._asdict() | {"within_3x": row.within} for row in self.rows]
        for row in rows:
            unknown = [k for k, v in row.items() if isinstance(v, float) and not math.isfinite(v)]
            row |= dict.fromkeys(unknown)
        return {"rows": rows, "notes": list(self.notes)}


def realism_table(
    scans: Mapping[str, ScanStatistics],
    reference: Mapping[str, ScanStatistics],
    notes: Iterable[str] = (),
) -> RealismTable:
    """Compare drives of scans with drives of a reference, at least one of each."""
    if not scans or not reference:
        raise ValueError("realism needs at least one drive of scans and one of the reference")
    a = sum(scans.values(), ScanStatistics())
    b = sum(reference.values(), ScanStatistics())
    of_scans = [measures(drive) for drive in scans.values()]
    of_reference = [measures(drive) for drive in reference.values()]
    pairs = list(product(of_scans, of_reference))
    real_pairs = list(combinations(of_reference, 2))
    whole_b = measures(b)
    rows = []
    for name, measure in measures(a).items():
        distances = _distances_of_pairs(measure, pairs)
        floors = _distances_of_pairs(measure, real_pairs)
        distance = _over_finite(np.median, distances)
        floor = _over_finite(np.median, floors)
        if measure.unit == "rows":  # whole ones, of which scans may have equally many by chance
            floor = max(floor, 1.0)
        real = whole_b[name]
        ratio = math.nan
        lacks = {"A": measure.lacks, "B": real.lacks}
        reason = "; ".join(f"{side}: {why}" for side, why in lacks.items() if why)
        if math.isnan(distance):
            reason = reason or "no bin holds enough returns in a drive of A and in one of B"
        elif math.isnan(floor):
            if len(reference) == 1:
                no_floor = "B is a single drive, so there is no floor; give two drives or more"
            else:
                no_floor = "no two drives of B can be compared, so there is no floor"
            reason = reason or no_floor
        if not reason and floor:
            ratio = distance / floor
        elif not reason:
            ratio = math.inf if distance else 0.0
        values = float(measure.summary), float(real.summary)
        pooled = float(measure.distance(measure.values, real.values))
        largest = _over_finite(np.max, floors)
        rows.append(
            RealismRow(name, measure.unit, *values, distance, floor, largest, pooled, ratio, reason)
        )
    described = (_describe_drives("A", scans, a), _describe_drives("B", reference, b))
    return RealismTable(tuple(rows), (*described, *notes))


def _distances_of_pairs(
    measure: Measure, pairs: Iterable[tuple[Mapping[str, Measure], Mapping[str, Measure]]]
) -> Floats:
    """Distances of one measure between the two drives of each pair."""
    name = measure.name
    return np.array([float(measure.distance(x[name].values, y[name].values)) for x, y in pairs])


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


def _describe_drives(
    name: str, drives: Mapping[str, ScanStatistics], pooled: ScanStatistics
) -> str:
    sizes = [statistics.num_scans for statistics in drives.values()]
    total = f"{name}: {number_of(pooled.num_scans, 'scan')} of {number_of(len(drives), 'drive')}"
    if len(sizes) > 1:
        low, high = min(sizes), max(sizes)
        total += f", {low} each" if low == high else f", {low} to {high} each"
    parts = {
        "not in ring order": pooled.num_scans - pooled.num_ring_scans,
        "with another number of rings": pooled.num_ring_scans - pooled.num_beam_scans,
        "without a ground plane": pooled.num_scans - pooled.num_ground_scans,
        "without intensity": pooled.num_scans - pooled.num_intensity_scans,
    }
    left_out = [f"{count} {what}" for what, count in parts.items() if count]
    return f"{total}; left out where needed: {', '.join(left_out)}" if left_out else total

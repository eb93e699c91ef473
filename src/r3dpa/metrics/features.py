"""Curves and single numbers that follow from the counts of a set of scans.

Every function takes statistics (or counts of them) and gives NaN where too few returns tell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from r3dpa.metrics.scan_statistics import (
    BEV_EXTENT_M,
    GROUND_REACH_BIN_M,
    GROUND_RESIDUAL_BIN_M,
    INTENSITY_LEVELS,
    POINTS_BIN,
    RESIDUAL_BIN_M,
    SENSOR,
    VALID_SHARE_BIN,
    ScanStatistics,
)

Floats = NDArray[np.float64]

_MIN_COUNT = 200  # a bin of a curve with fewer returns is left out
_LAST_RING_SHARE = 0.1  # of the azimuth
_NEAR_RINGS_M = 25.0  # farther rings are apart by metres and follow the slope of the road
_HIT_ROW_SHARE = 0.02
_NORMAL_MEDIAN = 0.6745  # median of |x| of a normal variable of deviation 1
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def curves(statistics: ScanStatistics) -> dict[str, Floats]:
    """Everything behind the table, for plots: arrays by name, NaN where unknown.

    Bins by range start at 0 m, those by incidence at 0 degrees; the name tells their width.
    """
    keep_range = keep_rate(statistics.keep_by_range)
    keep_angle = keep_rate(statistics.keep_by_incidence)
    intensity_angle = median_intensity(statistics.intensity_by_incidence)
    points, valid = statistics.points_per_scan, statistics.valid_share
    return {
        "returns_per_scan_quantiles_5_25_50_75_95": POINTS_BIN * _quantiles(points),
        "valid_share_quantiles_5_25_50_75_95": VALID_SHARE_BIN * _quantiles(valid),
        "valid_share_by_image_row": row_shares(statistics),
        "range_share_by_1_m": _shares(statistics.range_counts.sum(axis=0)),
        "range_share_by_1_m_upper_block": _shares(statistics.range_counts[0]),
        "range_share_by_1_m_lower_block": _shares(statistics.range_counts[1]),
        "dropout_by_beam": dropout(statistics),
        "dropout_runs_share_by_shots": _shares(statistics.drop_runs),
        "keep_rate_by_4_m": keep_range[0],
        "keep_rate_by_4_m_ground": keep_range[1],
        "keep_rate_by_4_m_upright": keep_range[2],
        "keep_rate_by_5_deg_ground": keep_angle[0],
        "keep_rate_by_5_deg_upright": keep_angle[1],
        "range_residual_sd_mm_by_beam": residual_sd_mm(statistics),
        "range_bias_mm_by_beam": bias_mm(statistics),
        "intensity_share_by_0.01": _shares(statistics.intensity_by_range.sum(axis=0)),
        "intensity_median_by_4_m": median_intensity(statistics.intensity_by_range),
        "intensity_median_by_5_deg_ground": intensity_angle[0],
        "intensity_median_by_5_deg_upright": intensity_angle[1],
        "ground_distance_m_by_beam": ground_distance_m(statistics),
        "ground_reach_share_by_0.5_m": _shares(statistics.ground_reach_counts),
        "height_share_by_5_cm_from_-3_m": _shares(statistics.height_counts),
        "occupied_share_by_sector": sector_shares(statistics),
    }


def histogram_mean(counts: Floats, bin_width: float, start: float = 0.0) -> float:
    """Mean of a histogram by the centres of its bins, of which the first begins at ``start``."""
    centres = start + (np.arange(len(counts)) + 0.5) * bin_width
    return float(_ratio(counts @ centres, counts.sum()))


def known_median(curve: Floats) -> float:
    """Median of the known values of a curve."""
    known = curve[np.isfinite(curve)]
    return float(np.median(known)) if len(known) else float("nan")


def row_shares(statistics: ScanStatistics) -> Floats:
    """Share of valid pixels ``(H,)`` by image row."""
    return statistics.row_returns / (statistics.num_scans * SENSOR.columns)


def num_hit_rows(statistics: ScanStatistics) -> float:
    """Image rows of which more than 2 % are valid."""
    return float((row_shares(statistics) > _HIT_ROW_SHARE).sum())


def low_share(statistics: ScanStatistics) -> float:
    """Share of returns below z = -1.4 m."""
    return _quotient(statistics.low_points, statistics.num_returns)


def dropout(statistics: ScanStatistics) -> Floats:
    """Probability ``(H,)`` by beam that a shot gives no return between 1 and 80 m."""
    return (1 - _ratio(statistics.beam_returns, np.full(SENSOR.beams, statistics.shots))).clip(0)


def keep_rate(counts: Floats) -> Floats:
    """Share of kept shots along the last axis of (lost, kept)."""
    return _ratio(counts[..., 1], counts.sum(axis=-1), _MIN_COUNT)


def overall_keep_rate(counts: Floats) -> float:
    """Share of kept shots over all bins of ``(N, 2)`` counts."""
    return _quotient(counts[:, 1].sum(), counts.sum())


def residual_sd_mm(statistics: ScanStatistics) -> Floats:
    """Standard deviation ``(H,)`` of a range around its neighbours in the ring, millimetres.

    From the median of the absolute residuals, as for a normal variable: the few returns of grass
    and foliage that pass for smooth do not count more than others.
    """
    median = _quantile(statistics.residual_counts, 0.5, _MIN_COUNT)
    return median * RESIDUAL_BIN_M * 1000 / _NORMAL_MEDIAN


def bias_mm(statistics: ScanStatistics) -> Floats:
    """Median range ``(H,)`` of a beam minus that of both neighbouring beams, millimetres."""
    median = _quantile(statistics.step_counts, 0.5, _MIN_COUNT)
    return (median - statistics.step_counts.shape[1] / 2) * RESIDUAL_BIN_M * 1000


def bias_spread_mm(statistics: ScanStatistics) -> float:
    """Standard deviation over the beams of their bias, millimetres."""
    bias = bias_mm(statistics)
    known = bias[np.isfinite(bias)]
    return float(known.std()) if len(known) else float("nan")


def median_intensity(counts: Floats) -> Floats:
    """Median intensity along the last axis, taking each step of 0.01 for an interval."""
    return (_quantile(counts, 0.5, _MIN_COUNT) - 0.5) / (INTENSITY_LEVELS - 1)


def intensity_levels(statistics: ScanStatistics) -> Floats:
    """Returns ``(101,)`` by intensity."""
    return statistics.intensity_by_range.sum(axis=0)


def saturated_share(statistics: ScanStatistics) -> float:
    """Share of returns with an intensity of 0.99 or more, the largest in KITTI files."""
    levels = intensity_levels(statistics)
    return _quotient(levels[-2:].sum(), levels.sum())


def ground_residual_sd_mm(statistics: ScanStatistics) -> float:
    """Standard deviation of the ground returns around the plane, within 0.2 m, millimetres."""
    counts = statistics.ground_residual_counts
    centres_mm = (np.arange(len(counts)) + 0.5) * GROUND_RESIDUAL_BIN_M * 1000
    shares = _shares(counts)
    mean_mm = (shares * centres_mm).sum()
    return float(np.sqrt((shares * (centres_mm - mean_mm) ** 2).sum()))


def last_ring_m(statistics: ScanStatistics) -> float:
    """Horizontal distance at or beyond which 10 % of the azimuth still sees ground, metres.

    Counted in sectors of 5 degrees with at least three ground returns there.
    """
    reach = _quantile(statistics.ground_reach_counts, 1 - _LAST_RING_SHARE, 1)
    return float(reach) * GROUND_REACH_BIN_M


def ground_distance_m(statistics: ScanStatistics) -> Floats:
    """Mean horizontal distance ``(H,)`` of the ground returns of each beam, metres."""
    return _ratio(statistics.ground_distance_m, statistics.ground_returns, _MIN_COUNT)


def ring_spacing_m(statistics: ScanStatistics) -> Floats:
    """Distance ``(H - 1,)`` between the ground rings of neighbouring beams within 25 m, metres."""
    distance = ground_distance_m(statistics)
    return np.where(distance[:-1] < _NEAR_RINGS_M, -np.diff(distance), np.nan)


def mixed_share(statistics: ScanStatistics) -> float:
    """Returns 0.3 m or more off both neighbours, which are more than 1 m apart in range."""
    return _quotient(statistics.neighbours[1], statistics.neighbours[0])


def jump_share(statistics: ScanStatistics) -> float:
    """Returns whose range differs by more than 0.5 m from that of the next one."""
    return _quotient(statistics.neighbours[2], statistics.neighbours[0])


def coarse_bev(statistics: ScanStatistics) -> Floats:
    """Returns ``(100, 100)`` by x and y in cells of 1 m."""
    cells = len(statistics.bev_counts) // 2
    return statistics.bev_counts.reshape(cells, 2, cells, 2).sum(axis=(1, 3))


def sector_shares(statistics: ScanStatistics) -> Floats:
    """Share of the 1-m cells within 50 m that hold a return, ``(16,)`` by azimuth sector."""
    cells = np.pi * BEV_EXTENT_M**2 / len(statistics.sector_cells)
    return statistics.sector_cells / (statistics.num_scans * cells)


def _ratio(numerator: Floats, denominator: Floats, at_least: float = 0.0) -> Floats:
    """Quotient, NaN where the denominator is 0 or below ``at_least``."""
    known = (denominator > 0) & (denominator >= at_least)
    return np.where(known, numerator / np.where(known, denominator, 1.0), np.nan)


def _quotient(numerator: float, denominator: float) -> float:
    return float(numerator / denominator) if denominator else float("nan")


def _shares(counts: Floats) -> Floats:
    return _ratio(counts, np.full(counts.shape, counts.sum()))


def _quantiles(counts: Floats) -> Floats:
    return np.array([_quantile(counts, quantile, 1) for quantile in _QUANTILES])


def _quantile(counts: Floats, quantile: float, at_least: float) -> Floats:
    """Quantile along the last axis in bins from 0, linear within a bin; NaN for too few."""
    cdf = counts.cumsum(axis=-1)
    total = cdf[..., -1:]
    wanted = quantile * total
    index = (cdf < wanted).sum(axis=-1, keepdims=True).clip(max=counts.shape[-1] - 1)
    inside = np.take_along_axis(counts, index, axis=-1)
    below = np.take_along_axis(cdf, index, axis=-1) - inside
    place = index + _ratio(wanted - below, inside)
    return np.where(total >= at_least, place, np.nan)[..., 0]

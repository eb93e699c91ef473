"""The realism measures: what is compared, in which unit, and by which distance.

Source: JSD and W1 of histograms as in LiDARGen (ECCV 2022) and LiDM (CVPR 2024), but the divergence
itself in nats, not its root.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from r3dpa.metrics import features
from r3dpa.metrics.features import (
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


MEASURES: tuple[Measure, ...] = (
    Measure(
        "returns per scan",
        "points",
        "points",
        lambda s: s.points_per_scan,
        partial(wasserstein_1, bin_width=POINTS_BIN),
        lambda s: s.num_returns / s.num_scans,
    ),
    Measure(
        "valid share of the image",
        "1",
        "points",
        lambda s: s.valid_share,
        partial(wasserstein_1, bin_width=VALID_SHARE_BIN),
        lambda s: float(features.row_shares(s).mean()),
    ),
    Measure("valid share by image row", "1", "points", features.row_shares, curve_rmse),
    Measure(
        "image rows > 2 % valid",
        "rows",
        "points",
        features.num_hit_rows,
        difference,
        features.num_hit_rows,
    ),
    *_range_measures("", slice(None)),
    *_range_measures(", upper block", slice(0, 1)),
    *_range_measures(", lower block", slice(1, 2)),
    Measure(
        "dropout by beam",
        "1",
        "beams",
        features.dropout,
        curve_rmse,
        lambda s: float(features.dropout(s).mean()),
    ),
    Measure(
        "dropout run length",
        "shots",
        "rings",
        lambda s: s.drop_runs,
        partial(wasserstein_1, bin_width=1.0),
        lambda s: histogram_mean(s.drop_runs, 1.0, -0.5),
    ),
    _keep_measure("range, any surface", "rings", lambda s: s.keep_by_range[0]),
    _keep_measure("range, ground", "rings ground", lambda s: s.keep_by_range[1]),
    _keep_measure("range, upright", "rings", lambda s: s.keep_by_range[2]),
    _keep_measure("incidence, ground", "rings ground", lambda s: s.keep_by_incidence[0]),
    _keep_measure("incidence, upright", "rings", lambda s: s.keep_by_incidence[1]),
    Measure(
        "range residual sd by beam",
        "mm",
        "beams",
        features.residual_sd_mm,
        curve_rmse,
        lambda s: known_median(features.residual_sd_mm(s)),
    ),
    Measure("range bias by beam", "mm", "beams", features.bias_mm, curve_rmse),
    Measure(
        "spread of the beams' bias",
        "mm",
        "beams",
        features.bias_spread_mm,
        difference,
        features.bias_spread_mm,
    ),
    Measure(
        "intensity JSD",
        "nats",
        "intensity",
        features.intensity_levels,
        jensen_shannon,
    ),
    Measure(
        "median intensity by range",
        "1",
        "intensity",
        lambda s: median_intensity(s.intensity_by_range),
        curve_rmse,
        lambda s: float(median_intensity(features.intensity_levels(s))),
    ),
    Measure(
        "median intensity by incidence, ground",
        "1",
        "intensity ground",
        lambda s: median_intensity(s.intensity_by_incidence[0]),
        curve_rmse,
        lambda s: float(median_intensity(s.intensity_by_incidence[0].sum(axis=0))),
    ),
    Measure(
        "median intensity by incidence, upright",
        "1",
        "intensity rings",
        lambda s: median_intensity(s.intensity_by_incidence[1]),
        curve_rmse,
        lambda s: float(median_intensity(s.intensity_by_incidence[1].sum(axis=0))),
    ),
    Measure(
        "saturated share",
        "1",
        "intensity",
        features.saturated_share,
        difference,
        features.saturated_share,
    ),
    Measure(
        "share below z = -1.4 m", "1", "points", features.low_share, difference, features.low_share
    ),
    Measure(
        "ground plane residual",
        "mm",
        "ground",
        lambda s: s.ground_residual_counts,
        partial(wasserstein_1, bin_width=GROUND_RESIDUAL_BIN_M * 1000),
        features.ground_residual_sd_mm,
    ),
    Measure(
        "last ground ring", "m", "ground", features.last_ring_m, difference, features.last_ring_m
    ),
    Measure(
        "ground reach by sector",
        "m",
        "ground",
        lambda s: s.ground_reach_counts,
        partial(wasserstein_1, bin_width=GROUND_REACH_BIN_M),
        lambda s: histogram_mean(s.ground_reach_counts, GROUND_REACH_BIN_M),
    ),
    Measure(
        "ground ring spacing",
        "m",
        "beams ground",
        features.ring_spacing_m,
        curve_rmse,
        lambda s: known_median(features.ring_spacing_m(s)),
    ),
    Measure("mixed pixels", "1", "rings", features.mixed_share, difference, features.mixed_share),
    Measure(
        "jumps > 0.5 m to the next",
        "1",
        "rings",
        features.jump_share,
        difference,
        features.jump_share,
    ),
    Measure("BEV JSD, 0.5 m cells", "nats", "points", lambda s: s.bev_counts, jensen_shannon),
    Measure("BEV JSD, 1 m cells", "nats", "points", features.coarse_bev, jensen_shannon),
    Measure(
        "height map W1",
        "m",
        "points",
        lambda s: s.height_counts,
        partial(wasserstein_1, bin_width=HEIGHT_BIN_M),
        lambda s: histogram_mean(s.height_counts, HEIGHT_BIN_M, HEIGHT_LIMITS_M[0]),
    ),
    Measure(
        "occupied cells by sector",
        "1",
        "points",
        features.sector_shares,
        curve_rmse,
        lambda s: float(features.sector_shares(s).mean()),
    ),
)

"""Distances between two sets of scenes that need no network, as rows of a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from r3dpa.metrics.bootstrap import bootstrap_interval
from r3dpa.metrics.functional_bev import (
    Matching,
    chamfer_squared,
    histogram_distance,
    minimum_matching,
)
from r3dpa.metrics.measures import wasserstein_1
from r3dpa.metrics.results import MetricResult
from r3dpa.metrics.scene_set import RANGE_BIN_M, SceneSet

Interval = tuple[float, float]

#: Powers of ten that the published table prints its columns in.
_SCALES = {"FLD": -1, "JSD": -2, "MMD": -5}
_CHAMFER_PAIRS = 200


@dataclass(frozen=True)
class Resampling:
    """Where randomness comes from, and how much work the intervals may cost.

    Args:
        seed: Of every metric alone, so that one more metric changes no other.
        num_resamples: Of each 95 % bootstrap interval, at least 40; 0 for none.
    """

    seed: int = 0
    num_resamples: int = 100

    def generator(self) -> torch.Generator:
        """Fresh source of randomness."""
        return torch.Generator().manual_seed(self.seed)

    def interval(self, statistic: Callable[[Tensor], float], size: int) -> Interval | None:
        """Bootstrap interval over one set of samples; None where it has fewer than two."""
        if size < 2 or not self.num_resamples:
            return None
        found = bootstrap_interval(
            statistic, (size,), self.generator(), num_resamples=self.num_resamples
        )
        return found.low, found.high


def histogram_rows(
    real: SceneSet, generated: SceneSet, resampling: Resampling
) -> list[MetricResult]:
    """JSD and TV of occupied cells seen from above, and W1 of ranges.

    The bootstrap resamples the groups that the histograms of the generated scenes are counted in.
    """
    counts = (generated.count, real.count)
    groups = min(generated.count, len(generated.cells))
    real_cells = real.cells.sum(dim=0)
    occupied = (real_cells > 0) | (generated.cells > 0).any(dim=0)
    real_cells, cells = real_cells[occupied].double(), generated.cells[:, occupied].float()
    real_ranges, ranges = real.ranges.sum(dim=0).double(), generated.ranges.double()

    def jsd(counted: Tensor) -> float:
        return histogram_distance(real_cells, counted).jsd_distance

    def total_variation(counted: Tensor) -> float:
        return histogram_distance(real_cells, counted).total_variation

    def range_distance(counted: Tensor) -> float:
        return wasserstein_1(real_ranges.numpy(), counted.numpy(), RANGE_BIN_M)

    def row(
        name: str,
        distance: Callable[[Tensor], float],
        table: Tensor,
        unit: str = "",
        note: str = "",
    ) -> MetricResult:
        def resampled(drawn: Tensor) -> float:
            weights = torch.bincount(drawn, minlength=len(table)).to(table)
            return distance(weights @ table)

        ends = resampling.interval(resampled, groups)
        value = distance(table.sum(dim=0))
        return distance_row(name, name, value, counts, interval=ends, unit=unit, note=note)

    return [
        row("JSD", jsd, cells),
        row("TV", total_variation, cells, note="half of what the official code calls TV"),
        row("W1 range", range_distance, ranges, "m"),
    ]


def matching_rows(
    real: SceneSet, generated: SceneSet, resampling: Resampling
) -> tuple[list[MetricResult], Matching]:
    """MMD of occupied cells, and the 3D Chamfer distance of the scenes it matches.

    The 3D distance is the mean over up to 200 real scans, each with the generated scene that is
    nearest to it by its cells. Intervals are over the real scans.
    """
    grid = real.protocol.grid
    references, samples = (
        [grid.cells(cloud) for cloud in scenes.clouds(range(len(scenes.images)))]
        for scenes in (real, generated)
    )
    matching = minimum_matching(references, samples, grid)
    nearest = matching.nearest[:_CHAMFER_PAIRS].tolist()
    pairs = zip(real.clouds(range(len(nearest))), generated.clouds(nearest), strict=True)
    chamfer = torch.tensor([chamfer_squared(*pair) for pair in pairs], dtype=torch.float64)

    def row(name: str, values: Tensor, unit: str = "") -> MetricResult:
        ends = resampling.interval(lambda drawn: values[drawn].mean().item(), len(values))
        counts = (len(samples), len(values))
        return distance_row(name, name, values.mean().item(), counts, interval=ends, unit=unit)

    return [row("MMD", matching.squared_normalised), row("CD 3D", chamfer, "m2")], matching


def distance_row(
    name: str,
    scaled_as: str,
    value: float | None,
    counts: Sequence[int],
    *,
    interval: Interval | None = None,
    unit: str = "",
    note: str = "",
) -> MetricResult:
    """A distance, where lower is better."""
    return MetricResult(
        name,
        value,
        interval=interval,
        unit=unit,
        scale=_SCALES.get(scaled_as, 0),
        num_samples=counts[0],
        num_references=counts[1],
        note=note,
    )

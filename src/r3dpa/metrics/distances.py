"""Distances between two sets of scenes that need no network, as rows of a table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from r3dpa.metrics.bootstrap import bootstrap_interval
from r3dpa.metrics.functional_bev import (
    BEVGrid,
    Matching,
    chamfer_squared,
    histogram_distance,
    minimum_matching,
)
from r3dpa.metrics.measures import wasserstein_1
from r3dpa.metrics.results import MetricResult
from r3dpa.metrics.scene_set import RANGE_BIN_M, SceneSet

Ends = tuple[float, float]
#: Generated scenes and real scans; None where their number is not known.
Counts = tuple[int, int | None]

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

    def interval(self, statistic: Callable[[Tensor], float], size: int) -> Ends | None:
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
    real_ranges, ranges = real.ranges.sum(dim=0).double(), generated.ranges.double()

    def range_distance(counted: Tensor) -> float:
        return wasserstein_1(real_ranges.numpy(), counted.numpy(), RANGE_BIN_M)

    return [
        *cell_rows(real.cells.sum(dim=0), generated, counts, resampling),
        _histogram_row("W1 range", range_distance, ranges, counts, resampling, "m"),
    ]


def cell_rows(
    real_cells: Tensor, generated: SceneSet, counts: Counts, resampling: Resampling
) -> list[MetricResult]:
    """JSD and TV of occupied cells alone, as :func:`histogram_rows` has them.

    Args:
        real_cells: ``(cells,)``, real scans that occupy each cell.
        generated: Generated scenes.
        counts: Generated scenes and, where it is known, real scans.
        resampling: Of the intervals.
    """
    occupied = (real_cells > 0) | (generated.cells > 0).any(dim=0)
    real_cells, cells = real_cells[occupied].double(), generated.cells[:, occupied].float()

    def jsd(counted: Tensor) -> float:
        return histogram_distance(real_cells, counted).jsd_distance

    def total_variation(counted: Tensor) -> float:
        return histogram_distance(real_cells, counted).total_variation

    half = "half of what the official code calls TV"
    return [
        _histogram_row("JSD", jsd, cells, counts, resampling),
        _histogram_row("TV", total_variation, cells, counts, resampling, note=half),
    ]


def _histogram_row(
    name: str,
    distance: Callable[[Tensor], float],
    table: Tensor,
    counts: Counts,
    resampling: Resampling,
    unit: str = "",
    note: str = "",
) -> MetricResult:
    """Distance of the sum of the groups ``(G, bins)`` of generated scenes."""

    def resampled(drawn: Tensor) -> float:
        weights = torch.bincount(drawn, minlength=len(table)).to(table)
        return distance(weights @ table)

    ends = resampling.interval(resampled, min(counts[0], len(table)))
    value = distance(table.sum(dim=0))
    return distance_row(name, name, value, counts, interval=ends, unit=unit, note=note)


def matching_rows(
    real: SceneSet, generated: SceneSet, resampling: Resampling
) -> tuple[list[MetricResult], Matching]:
    """MMD of occupied cells, and the 3D Chamfer distance of the scenes it matches.

    The 3D distance is the mean over up to 200 real scans, each with the generated scene that is
    nearest to it by its cells. Intervals are over the real scans. Points beyond the grid do not
    count in MMD, by its definition; its note tells their share.
    """
    grid = real.protocol.grid
    (references, real_beyond), (samples, beyond) = (
        _cells_and_share_beyond(scenes, grid) for scenes in (real, generated)
    )
    note = f"{beyond:.2%} of the points, {real_beyond:.2%} of the real ones, lie beyond the grid"
    matching = minimum_matching(references, samples, grid)
    nearest = matching.nearest[:_CHAMFER_PAIRS].tolist()
    pairs = zip(real.clouds(range(len(nearest))), generated.clouds(nearest), strict=True)
    chamfer = torch.tensor([chamfer_squared(*pair) for pair in pairs], dtype=torch.float64)

    def row(name: str, values: Tensor, unit: str = "", note: str = "") -> MetricResult:
        ends = resampling.interval(lambda drawn: values[drawn].mean().item(), len(values))
        counts = (len(samples), len(values))
        value = values.mean().item()
        return distance_row(name, name, value, counts, interval=ends, unit=unit, note=note)

    mmd = row("MMD", matching.squared_normalised, note=note if beyond or real_beyond else "")
    return [mmd, row("CD 3D", chamfer, "m2")], matching


def _cells_and_share_beyond(scenes: SceneSet, grid: BEVGrid) -> tuple[list[Tensor], float]:
    """Occupied cells of the kept scenes, and the share of their points that are not on the grid."""
    cells, points, beyond = [], 0, 0
    for cloud in scenes.clouds(range(len(scenes.images))):
        cells.append(grid.cells(cloud))
        points += len(cloud)
        beyond += int((~grid.inside(cloud)).sum())
    return cells, beyond / max(points, 1)


def distance_row(
    name: str,
    scaled_as: str,
    value: float | None,
    counts: Counts,
    *,
    interval: Ends | None = None,
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

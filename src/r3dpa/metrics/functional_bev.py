"""Distances between sets of point clouds as occupied cells of a bird's-eye view.

Letters: P points, R references, S samples.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from lidarsim.divergences import jensen_shannon

Cells = NDArray[np.int64]

_BLOCK = 5  # cells along a side of the blocks of lower bounds
_TABLES = 32  # of lower bounds held at once


@dataclass(frozen=True)
class BEVGrid:
    """Square grid around the sensor seen from above; default: the grid of published JSD and MMD.

    Args:
        half_m: Limit of x and y to both sides in metres; points on or beyond it are outside.
        cell_m: Edge of a cell in metres.
    """

    half_m: float = 50.0
    cell_m: float = 0.05

    @property
    def side(self) -> int:
        """Cells along x, and along y."""
        return math.ceil(2 * self.half_m / self.cell_m)

    def points_inside(self, points: Tensor, name: str = "cloud") -> Tensor:
        """Return the points ``(P, 3 or more)`` that lie on the grid.

        Raises:
            ValueError: If there are none, or a coordinate is not finite; names the cloud.
        """
        inside = _checked_points(points, name)
        inside = inside[(inside[:, :2].abs() < self.half_m).all(dim=1)]
        if len(inside) == 0:
            raise ValueError(
                f"{name}: none of {len(points)} points has x and y within {self.half_m:g} m; "
                "check the unit and the frame, or leave the cloud out and report it"
            )
        return inside

    def cells(self, points: Tensor, name: str = "cloud") -> Tensor:
        """Return cells ``(n,)`` int64 that hold a point, ``x index * side + y index``, ascending.

        Index 0 is at the lower limit. The division has the precision of the points, as in the
        official code, which decides on points between two cells. Raises as :meth:`points_inside`.
        """
        inside = self.points_inside(points, name)[:, :2]
        # A tensor, not a number: division by a number may become a product with its inverse.
        indices = torch.floor(inside / inside.new_full((), self.cell_m)).long()
        indices = (indices - math.ceil(-self.half_m / self.cell_m)).clamp(0, self.side - 1)
        return (indices[:, 0] * self.side + indices[:, 1]).unique()

    def histogram(self, clouds: Iterable[Tensor]) -> Tensor:
        """Count the clouds that occupy each cell: ``(side, side)`` int64."""
        cells = [self.cells(points, f"cloud {index}") for index, points in enumerate(clouds)]
        return torch.cat(cells).bincount(minlength=self.side**2).view(self.side, self.side)


def _checked_points(points: Tensor, name: str) -> Tensor:
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"{name}: expected points (P, 3 or more), got {tuple(points.shape)}")
    if len(points) == 0:
        raise ValueError(
            f"{name} has no point; leave it out and report it, or repair the generator"
        )
    broken = ~torch.isfinite(points[:, :3]).all(dim=1)
    if broken.any():
        raise ValueError(
            f"{name}: {int(broken.sum())} of {len(points)} points have NaN or infinite "
            f"coordinates, the first is point {int(broken.nonzero()[0])}; remove them at the source"
        )
    return points


class HistogramDistance(NamedTuple):
    """Distances of two normalised histograms, under the published names and the true ones."""

    jsd_distance: float  # root of the divergence, 0 to sqrt(ln 2) = 0.8326: the published "JSD"
    jsd_divergence: float  # Jensen-Shannon divergence in nats, 0 to ln 2 = 0.6931
    l1: float  # sum of absolute differences, 0 to 2: the official code's "TV"
    total_variation: float  # half of it, 0 to 1


def histogram_distance(counts_a: Tensor, counts_b: Tensor) -> HistogramDistance:
    """Compute all distances of two histograms of counts of one shape.

    Raises:
        ValueError: If one is empty.
    """
    for name, counts in (("first", counts_a), ("second", counts_b)):
        if not counts.any():
            raise ValueError(f"{name} histogram is empty; count at least one cloud")
    occupied = (counts_a > 0) | (counts_b > 0)
    a, b = (counts[occupied].double().cpu().numpy() for counts in (counts_a, counts_b))
    divergence = max(jensen_shannon(a, b), 0.0)
    l1 = float(np.abs(a / a.sum() - b / b.sum()).sum())
    return HistogramDistance(math.sqrt(divergence), divergence, l1, l1 / 2)


def point_histogram(
    points: Tensor,
    half_m: float = 80.0,
    num_bins: int = 100,
    nearest_m: float = 3.0,
    farthest_m: float = 70.0,
) -> Tensor:
    """Count points ``(P, 3 or more)`` by cell seen from above: ``(num_bins, num_bins)`` float32.

    Only points strictly between the two distances from the sensor count. The grid reaches to
    ``half_m`` on both sides, upper border included. Unlike :class:`BEVGrid`, which counts clouds.

    Source: LiDARGen (Zyrianov et al. 2022), as R2DM and R2Flow use it.
    """
    xyz = _checked_points(points, "cloud")[:, :3].float().cpu()
    distance = xyz.norm(dim=1)
    counted = xyz[(distance > nearest_m) & (distance < farthest_m), :2]
    return torch.histogramdd(counted, num_bins, range=[-half_m, half_m] * 2).hist


def gaussian_kernel(a: Tensor, b: Tensor, sigma: float = 0.5) -> Tensor:
    """``exp(-|x - y|^2 / (2 sigma^2))`` of all rows of ``(N, F)`` and ``(M, F)``: ``(N, M)``."""
    exact = "donot_use_mm_for_euclid_dist"  # expanded squares cancel between similar histograms
    return torch.exp(-torch.cdist(a, b, compute_mode=exact).square() / (2 * sigma**2))


def kernel_mmd(a: Tensor, b: Tensor, sigma: float = 0.5) -> float:
    """Squared maximum mean discrepancy of normalised histograms ``(N, F)`` and ``(M, F)``.

    With pairs of a histogram with itself, so that it is biased upwards by about 1 / N. R2DM and
    R2Flow call it MMD; LiDM and R3DPA use that name for :func:`minimum_matching`.
    """
    within = gaussian_kernel(a, a, sigma).mean() + gaussian_kernel(b, b, sigma).mean()
    return (within - 2 * gaussian_kernel(a, b, sigma).mean()).item()


def chamfer_squared(points_a: Tensor, points_b: Tensor) -> float:
    """Chamfer distance of two clouds ``(P, 3 or more)``, square metres: the published "CD".

    Mean squared distance to the nearest point of the other cloud, averaged over both directions.

    Raises:
        ValueError: If a cloud is empty or holds NaN.
    """
    a = _checked_points(points_a, "points_a")[:, :3].double().cpu().numpy()
    b = _checked_points(points_b, "points_b")[:, :3].double().cpu().numpy()
    there, back = cKDTree(b).query(a)[0], cKDTree(a).query(b)[0]
    return float((there**2).mean() + (back**2).mean()) / 2


class Matching(NamedTuple):
    """The nearest sample of each reference; the published MMD is the mean of the distances."""

    squared_normalised: Tensor  # (R,) float64, squared Chamfer distance over squared grid width
    nearest: Tensor  # (R,) int64, index of the sample


def minimum_matching(
    references: Sequence[Tensor], samples: Sequence[Tensor], grid: BEVGrid
) -> Matching:
    """Find the smallest Chamfer distance from each reference to any sample, on occupied cells.

    Clouds are vectors of :meth:`BEVGrid.cells` on one grid. The distance of two is
    ``(mean_x min_y |x - y|^2 + mean_y min_x |x - y|^2) / 2`` over the indices of their cells
    divided by the cells along a side: squared, without a unit.

    Exact: kd-trees measure only the pairs whose lower bound, by :func:`_lower_bounds`, is below the
    best distance so far. The work is shared by as many threads as PyTorch uses.

    Source: Achlioptas et al., ICML 2018; in this form LiDM, CVPR 2024.
    """
    side = grid.side
    reference_cells = [cells.cpu().numpy() for cells in references]
    sample_cells = [cells.cpu().numpy() for cells in samples]
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        there = _lower_bounds(reference_cells, sample_cells, side, pool)
        back = _lower_bounds(sample_cells, reference_cells, side, pool).T
        bounds = there + back

        def match(number: int) -> tuple[float, int]:
            places = _places(reference_cells[number], side)
            tree, best, nearest = _tree(places), math.inf, -1
            for index in np.argsort(bounds[number], kind="stable"):
                if bounds[number, index] >= best:
                    break
                sample = _places(sample_cells[index], side)
                distance = _mean_squared(tree, sample)  # back; the way there is still a bound
                if distance + there[number, index] < best:
                    distance += _mean_squared(_tree(sample), places)
                    if distance < best:
                        best, nearest = distance, int(index)
            return best, nearest

        best, nearest = zip(*pool.map(match, range(len(references))), strict=True)
    return Matching(torch.tensor(best, dtype=torch.float64) / (2 * side**2), torch.tensor(nearest))


def _lower_bounds(
    clouds: Sequence[Cells], targets: Sequence[Cells], side: int, pool: ThreadPoolExecutor
) -> NDArray[np.float64]:
    """Bound the mean squared distance of cells to a target's cells from below, by pair.

    Cells of blocks whose centres are d cells apart are at least ``d - sqrt(2) (block - 1)`` apart.
    """
    blocks = _num_blocks(side)
    rows = []
    for cells in clouds:
        occupied, counts = np.unique(_blocks(cells, side), return_counts=True)
        rows.append((occupied, counts / len(cells)))
    ends = np.cumsum([0, *(len(occupied) for occupied, _ in rows)])
    columns, values = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    shares = csr_array((values, columns, ends), shape=(len(clouds), blocks**2))

    def table(cells: Cells) -> NDArray[np.float64]:
        free = np.ones((blocks, blocks), dtype=bool)
        free.ravel()[_blocks(cells, side)] = False
        apart = _BLOCK * distance_transform_edt(free) - math.sqrt(2) * (_BLOCK - 1)
        return np.square(apart.clip(0)).ravel()

    bounds = [
        shares @ np.stack(list(pool.map(table, targets[first : first + _TABLES])), axis=1)
        for first in range(0, len(targets), _TABLES)
    ]
    return np.hstack(bounds) * (1 - 1e-9)  # less what rounding may add


def _num_blocks(side: int) -> int:
    """Blocks along a side of so many cells, the last one perhaps cut off."""
    return math.ceil(side / _BLOCK)


def _blocks(cells: Cells, side: int) -> Cells:
    """Block of each cell; blocks are numbered row by row, as cells are."""
    row, column = np.divmod(cells, side)
    return row // _BLOCK * _num_blocks(side) + column // _BLOCK


def _places(cells: Cells, side: int) -> NDArray[np.float64]:
    return np.stack(np.divmod(cells, side), axis=1).astype(np.float64)


def _tree(places: NDArray[np.float64]) -> cKDTree:
    return cKDTree(places, balanced_tree=False, compact_nodes=False)


def _mean_squared(tree: cKDTree, places: NDArray[np.float64]) -> float:
    """Mean of the squared distances to the tree, which are integers."""
    return float(np.rint(tree.query(places)[0] ** 2).sum()) / len(places)

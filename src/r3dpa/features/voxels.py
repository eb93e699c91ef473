"""Preparation of a scan for WaffleIron, and scans with hidden parts for its training.

Letters: P points of a scan, M of them kept, N kept points of all B scans of a batch, K neighbours,
T descriptors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Self

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree
from torch import Tensor

from r3dpa.features.geometric import GeometricFeatures

#: Axes of the planes, x y z = 0 1 2: the first is the row of a cell, the second its column.
PLANES = ((0, 1), (0, 2), (1, 2))
NUM_FEATURES = 5
# Points this close to the border of the field of view are dropped, as in the official code.
_BORDER_M = 1e-4
# Surroundings of a point on the xy plane: squares of 1, 3 and 9 cells.
_WINDOWS = (1, 3, 9)
# Descriptors averaged over the surroundings: linearity, planarity, sphericity, normal upwards,
# intensity.
_AVERAGED = (0, 1, 2, 5, 8)
_LOCAL = (0, 1, 2, 3, 4, 5, 6, 8)  # all but the range, which is known from the cells
NUM_TARGETS = len(_LOCAL) + len(_WINDOWS) * (3 + len(_AVERAGED))
# Angles of a block of hidden points: a cell of the 8 x 64 grid of an HDL-64E.
_BLOCK_RAD = (math.radians(28 / 8), 2 * math.pi / 64)


@dataclass(frozen=True)
class ScanGrid:
    """Settings that thin, crop and grid a scan; the defaults are ScaLR's.

    Args:
        minimum_m: Lowest x, y, z of the field of view, metres in the sensor frame.
        maximum_m: Highest x, y, z.
        cell_m: Edge of the cells along all axes, or along x, y, z; divides the field of view.
        voxel_m: Edge of the voxels, each of which keeps one point.
        num_neighbors: Neighbours K of a point, itself not counted.
        intensity_mean: Mean of the intensity (0..1), for standardisation.
        intensity_std: Its standard deviation.
    """

    minimum_m: tuple[float, float, float] = (-64.0, -64.0, -8.0)
    maximum_m: tuple[float, float, float] = (64.0, 64.0, 8.0)
    cell_m: float | tuple[float, float, float] = 0.5
    voxel_m: float = 0.1
    num_neighbors: int = 16
    intensity_mean: float = 0.294584
    intensity_std: float = 0.147190

    def __post_init__(self) -> None:
        for name in ("cell_m", "voxel_m", "num_neighbors", "intensity_std"):
            if not np.all(np.greater(getattr(self, name), 0)):
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        extent = np.subtract(self.maximum_m, self.minimum_m)
        if (extent <= 0).any() or not np.allclose(extent, np.multiply(self.cells, self.cell_m)):
            raise ValueError(
                f"the field of view {self.minimum_m} to {self.maximum_m} m must be a whole number "
                f"of cells of {self.cell_m} m along each axis"
            )

    @property
    def cells(self) -> tuple[int, int, int]:
        """Number of cells along x, y, z."""
        extent = np.subtract(self.maximum_m, self.minimum_m) / np.asarray(self.cell_m)
        x, y, z = np.rint(extent).astype(int).tolist()
        return x, y, z


class PreparedScan(NamedTuple):
    """Input of WaffleIron for one scan, computed from its points alone.

    Neighbours are the nearest first, without the point itself; with fewer than K others the
    farthest is repeated, and a single point is its own neighbour.
    """

    features: Tensor  #: ``(M, 5)`` float32: intensity (standardised), x, y, z, range of kept points
    neighbors: Tensor  #: ``(M, K)`` int64 kept points
    cells: Tensor  #: ``(3, M)`` int64 cell of each point on the planes xy, xz, yz, row-major
    kept: Tensor  #: ``(M,)`` int64 row of each kept point in the original scan
    upsample: (
        Tensor  #: ``(P,)`` int64 nearest kept point of each original one; M where none is kept
    )


class PointCloudBatch(NamedTuple):
    """Concatenated kept points of B scans of any length, without padding."""

    features: Tensor  #: ``(N, 5)`` as in :class:`PreparedScan`
    neighbors: Tensor  #: ``(N, K)`` int64, rows of this batch
    cells: Tensor  #: ``(3, N)`` int64, counted anew in each scan
    num_points: Tensor  #: ``(B,)`` int64 points of each scan; their sum is N

    def to(self, device: torch.device | str) -> Self:
        """Return the batch on another device."""
        return type(self)(*(values.to(device, non_blocking=True) for values in self))


def prepare_scan(points: np.ndarray | Tensor, grid: ScanGrid | None = None) -> PreparedScan:
    """Thin, crop and index a scan.

    Each voxel keeps its point of lowest index; voxels are counted from the lowest x, y, z of the
    scan and sorted by (x, y, z). Of these points, those within the field of view are kept. The
    arithmetic is float32: coordinates are often multiples of a millimetre on the border of a
    voxel, and double precision would keep other points.

    Source: Puy et al., "Using a Waffle Iron for Automotive Point Cloud Semantic Segmentation"
    (ICCV 2023); settings of ScaLR (Puy et al., CVPR 2024).

    Points are ``(P, 4)`` x, y, z in metres, intensity 0..1, finite.
    """
    grid = grid or ScanGrid()
    if isinstance(points, Tensor):
        points = points.detach().cpu().numpy()
    points = np.asarray(points, dtype=np.float32)
    if points.ndim != 2 or points.shape[1] != 4:
        raise ValueError(f"points must be (P, 4) x, y, z, intensity, got {points.shape}")
    if not np.isfinite(points).all():
        raise ValueError(
            f"{(~np.isfinite(points).all(axis=1)).sum()} of {len(points)} points are NaN or "
            "infinite: drop them first"
        )
    minimum, maximum = np.array([grid.minimum_m, grid.maximum_m], dtype=np.float32)
    kept = _one_per_voxel(points[:, :3], grid.voxel_m)
    xyz = points[kept, :3]
    border = np.float32(_BORDER_M)
    inside = ((xyz > minimum + border) & (xyz < maximum - border)).all(axis=1)
    kept, xyz = kept[inside], xyz[inside]

    intensity = (points[kept, 3] - np.float32(grid.intensity_mean)) / np.float32(grid.intensity_std)
    radius = np.linalg.norm(xyz, axis=1)
    place = np.floor((xyz - minimum) / np.asarray(grid.cell_m, dtype=np.float32)).astype(np.int64)
    cells = np.stack([place[:, row] * grid.cells[col] + place[:, col] for row, col in PLANES])

    tree = cKDTree(xyz)
    nearest = np.arange(1, min(grid.num_neighbors + 1, max(len(xyz), 1)) + 1)
    _, neighbors = tree.query(xyz, k=nearest)
    neighbors = np.pad(neighbors, ((0, 0), (0, grid.num_neighbors + 1 - len(nearest))), mode="edge")
    _, upsample = tree.query(points[:, :3])
    return PreparedScan(
        features=torch.from_numpy(np.column_stack([intensity, xyz, radius])),
        neighbors=torch.from_numpy(neighbors[:, 1:].astype(np.int64)),
        cells=torch.from_numpy(cells),
        kept=torch.from_numpy(kept),
        upsample=torch.from_numpy(upsample.astype(np.int64)),
    )


def collate_scans(scans: Sequence[PreparedScan]) -> PointCloudBatch:
    """Batch of at least one scan; ``torch.split`` by ``num_points`` takes it apart."""
    num_points = torch.tensor([len(scan.features) for scan in scans])
    starts = (num_points.cumsum(0) - num_points).tolist()
    return PointCloudBatch(
        features=torch.cat([scan.features for scan in scans]),
        neighbors=torch.cat(
            [scan.neighbors + start for scan, start in zip(scans, starts, strict=True)]
        ),
        cells=torch.cat([scan.cells for scan in scans], dim=1),
        num_points=num_points,
    )


def _one_per_voxel(xyz: np.ndarray, voxel_m: float) -> np.ndarray:
    """Rows ``(M,)`` of the points of lowest index in each voxel, by voxel."""
    if not len(xyz):
        return np.empty(0, dtype=np.int64)
    voxels = np.floor((xyz - xyz.min(axis=0)) / np.float32(voxel_m)).astype(np.int64)
    order = np.lexsort(voxels.T[::-1])  # stable: points of a voxel stay in their order
    changes = (np.diff(voxels[order], axis=0) != 0).any(axis=1)
    return order[np.concatenate([[True], changes])]


class MaskedScan(NamedTuple):
    """A whole scan, prepared for masked prediction."""

    scan: PreparedScan
    hidden: Tensor  #: ``(M,)`` bool: kept points that the network must not see
    #: ``(M, T)`` float32 descriptors of the kept points within the whole scan; T is 0
    #: where ``Masking`` leaves them out
    targets: Tensor
    classes: Tensor | None = None  #: ``(M,)`` int64 semantic classes, -1 where unknown


@dataclass(frozen=True)
class Masking:
    """Random rotation about z, mirroring and hidden blocks of rays, with descriptors as targets.

    Args:
        grid: Preparation of scans.
        max_hidden: Upper limit, below 1, of the share of hidden blocks. The share is uniform from
            0 for each scan, so that training includes whole scans.
        geometry: Whether targets are computed, two thirds of the time of a scan: 0.1 s of a core.
    """

    grid: ScanGrid = field(default_factory=ScanGrid)
    max_hidden: float = 0.7
    geometry: bool = True

    def __post_init__(self) -> None:
        if not 0 <= self.max_hidden < 1:
            raise ValueError(f"max_hidden must be at least 0 and below 1, got {self.max_hidden}")

    def __call__(self, points: Tensor, rng: np.random.Generator) -> MaskedScan:
        """Random view of the points ``(P, 4)``: x, y, z in metres, intensity 0..1."""
        angle = rng.uniform(-math.pi, math.pi)
        side = rng.choice([-1.0, 1.0])
        x, y = points[:, 0], points[:, 1] * side
        points = points.clone()
        points[:, 0] = x * math.cos(angle) - y * math.sin(angle)
        points[:, 1] = x * math.sin(angle) + y * math.cos(angle)
        scan = prepare_scan(points, self.grid)
        blocks = _block(points[scan.kept])
        share = rng.uniform(0, self.max_hidden)
        num_blocks = int(blocks.max()) + 1 if len(blocks) else 0
        hidden = torch.from_numpy(rng.random(num_blocks) < share)[blocks]
        targets = torch.empty(len(hidden), 0)
        if self.geometry:
            targets = self.describe(points, scan)
        return MaskedScan(scan, hidden, targets)

    def describe(self, points: Tensor, scan: PreparedScan) -> Tensor:
        """Descriptors ``(M, T)`` float32 of each kept point and its surroundings in the whole scan.

        The values of ``GeometricFeatures.descriptors`` but the range, and for each of three squares
        on the xy plane (1, 3 and 9 cells wide): height over its lowest point, depth below its
        highest, logarithm of the number of points, and means of linearity, planarity, sphericity,
        the normal's upward part and the intensity.
        """
        local = GeometricFeatures.descriptors(points)[scan.kept]
        z, cells = scan.features[:, 3], scan.cells[0]
        rows, columns, _ = self.grid.cells
        shape = (1, rows, columns)
        ones = torch.ones_like(z)
        values = torch.cat([ones[:, None], local[:, _AVERAGED]], dim=1)
        sums = torch.zeros(rows * columns, values.shape[1]).index_add_(0, cells, values)
        sums = sums.T.reshape(-1, rows, columns)
        lowest = torch.full((rows * columns,), torch.inf).scatter_reduce(0, cells, z, "amin")
        highest = torch.full((rows * columns,), -torch.inf).scatter_reduce(0, cells, z, "amax")
        around = [local[:, _LOCAL]]
        for window in _WINDOWS:
            half = window // 2
            low = -F.max_pool2d(-lowest.reshape(shape), window, 1, half).flatten()[cells]
            high = F.max_pool2d(highest.reshape(shape), window, 1, half).flatten()[cells]
            total = F.avg_pool2d(sums, window, 1, half).flatten(1)[:, cells] * window**2
            around += [
                torch.stack([z - low, high - z, total[0].log()], 1),
                (total[1:] / total[0]).T,
            ]
        return torch.cat(around, dim=1)


def _block(points: Tensor) -> Tensor:
    x, y, z = points[:, :3].unbind(dim=1)
    row = ((torch.atan2(z, torch.hypot(x, y)) + math.pi / 2) / _BLOCK_RAD[0]).long()
    column = ((torch.atan2(y, x) + math.pi) / _BLOCK_RAD[1]).long()
    return row * 65 + column  # the column of +pi may be a 65th

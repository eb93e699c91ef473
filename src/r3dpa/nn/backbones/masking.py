"""Scans with hidden parts, and the descriptors of all points that a network shall predict.

Letters: M kept points, T descriptors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from r3dpa.nn.backbones.geometric import GeometricFeatures
from r3dpa.nn.backbones.voxels import PreparedScan, ScanGrid, prepare_scan

# Surroundings of a point on the xy plane: squares of 1, 3 and 9 cells.
_WINDOWS = (1, 3, 9)
# Descriptors averaged over the surroundings: linearity, planarity, sphericity, normal upwards,
# intensity.
_AVERAGED = (0, 1, 2, 5, 8)
_LOCAL = (0, 1, 2, 3, 4, 5, 6, 8)  # all but the range, which is known from the cells
NUM_TARGETS = len(_LOCAL) + len(_WINDOWS) * (3 + len(_AVERAGED))
# Angles of a block of hidden points: a cell of the 8 x 64 grid of an HDL-64E.
_BLOCK_RAD = (math.radians(28 / 8), 2 * math.pi / 64)


class MaskedScan(NamedTuple):
    """A scan for masked prediction.

    Attributes:
        scan: The whole scan, prepared.
        hidden: ``(M,)`` bool: kept points that the network must not see.
        targets: ``(M, T)`` float32 descriptors of the kept points within the whole scan.
    """

    scan: PreparedScan
    hidden: Tensor
    targets: Tensor


@dataclass(frozen=True)
class Masking:
    """Rotates scans about z and mirrors them at random, hides blocks of rays, describes all points.

    Args:
        grid: Preparation of scans.
        max_hidden: Upper limit, below 1, of the share of hidden blocks, which is drawn for each
            scan from 0 on, so that training includes whole scans.
    """

    grid: ScanGrid = field(default_factory=ScanGrid)
    max_hidden: float = 0.7

    def __post_init__(self) -> None:
        if not 0 <= self.max_hidden < 1:
            raise ValueError(f"max_hidden must be at least 0 and below 1, got {self.max_hidden}.")

    def __call__(self, points: Tensor, rng: np.random.Generator) -> MaskedScan:
        """Random view of the points ``(P, 4)``: x, y, z in metres, intensity 0..1."""
        angle = rng.uniform(-math.pi, math.pi)
        side = rng.choice([-1.0, 1.0])
        x, y = points[:, 0], points[:, 1] * side
        points = points.clone()
        points[:, 0] = x * math.cos(angle) - y * math.sin(angle)
        points[:, 1] = x * math.sin(angle) + y * math.cos(angle)
        scan = prepare_scan(points.numpy(), self.grid)
        kept = points[scan.kept]
        blocks = _block(kept)
        share = rng.uniform(0, self.max_hidden)
        hidden = torch.from_numpy(rng.random(int(blocks.max()) + 1) < share)[blocks]
        return MaskedScan(scan, hidden, self.describe(points, scan))

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
    """Index of the block of rays of each point."""
    x, y, z = points[:, :3].unbind(dim=1)
    row = ((torch.atan2(z, torch.hypot(x, y)) + math.pi / 2) / _BLOCK_RAD[0]).long()
    column = ((torch.atan2(y, x) + math.pi) / _BLOCK_RAD[1]).long()
    return row * 65 + column  # the column of +pi may be a 65th

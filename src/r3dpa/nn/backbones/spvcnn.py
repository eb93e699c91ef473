"""SPVCNN: the U-Net of MinkowskiNet with a branch of single points beside it.

Source: Tang et al., "Searching Efficient 3D Architectures with Sparse Point-Voxel Convolution"
(ECCV 2020); same numbers as the network of FPVD in valeoai/R3DPA (``tests/parity``). Dropout, which
the official network has in training, is left out.
Letters: P points, N voxels of one stride, C input channels, F channels of the features.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from r3dpa.nn.backbones.minkowski import MinkowskiNet, scaled_widths
from r3dpa.nn.backbones.sparse import Voxels, kernel_offsets, voxel_keys
from r3dpa.nn.layers import at_least_float32

# Added to the sum of the weights of the corners, as in the official code.
_WEIGHT_EPS = 1e-8


class Points(NamedTuple):
    """Points between the voxels of B clouds.

    Attributes:
        xyz: ``(P, 3)`` float32 in units of the finest voxels.
        batch: ``(P,)`` int64 cloud of each point.
    """

    xyz: Tensor
    batch: Tensor

    def voxel_of(self, stride: int) -> Tensor:
        """``(P, 4)`` int64 lowest corner of the voxel of this stride around each point."""
        corner = (self.xyz / stride).floor() * stride
        return torch.cat([corner.long(), self.batch[:, None]], dim=1)


def to_voxels(features: Tensor, points: Points, voxels: Voxels) -> Tensor:
    """Mean ``(N, C)`` of the point features ``(P, C)`` in each voxel, zeros without a point."""
    rows, occupied = voxels.find(voxel_keys(points.voxel_of(voxels.stride)))
    rows = torch.where(occupied, rows, len(voxels))  # one row more, which is cut off
    wide = at_least_float32(features)
    sums = wide.new_zeros(len(voxels) + 1, wide.shape[1]).index_add_(0, rows, wide)[:-1]
    counts = torch.bincount(rows, minlength=len(voxels) + 1)[:-1, None]
    return (sums / counts.clamp(min=1)).to(features.dtype)


def to_points(features: Tensor, points: Points, voxels: Voxels) -> Tensor:
    """Voxel features ``(N, C)`` interpolated trilinearly at the points, ``(P, C)``.

    A voxel is located at its lowest corner; weights of empty voxels are distributed to the others
    in proportion. A point without an occupied voxel around it gives zeros.
    """
    rows, weights = corners(points, voxels)
    # The last row stands for empty voxels, whose weight is 0.
    table = torch.cat([features, features.new_zeros(1, features.shape[1])])
    return functional.embedding_bag(
        rows, table, mode="sum", per_sample_weights=weights.to(features.dtype)
    )


def corners(points: Points, voxels: Voxels) -> tuple[Tensor, Tensor]:
    """Rows ``(P, 8)`` int64 of the voxels around each point, N if empty, and weights ``(P, 8)``.

    Weights of empty voxels are 0, the others sum to 1. Corners are in the order of
    ``kernel_offsets(2)``.
    """
    lowest = points.voxel_of(voxels.stride)
    rows, occupied = voxels.corners(voxel_keys(lowest))
    part = (points.xyz - lowest[:, :3]) / voxels.stride  # (P, 3) in [0, 1)
    upper = lowest.new_tensor(kernel_offsets(2)).bool()
    weights = torch.where(upper, part[:, None], 1 - part[:, None]).prod(dim=2) * occupied
    weights = weights / (weights.sum(dim=1, keepdim=True) + _WEIGHT_EPS)
    return torch.where(occupied, rows, len(voxels)), weights


class PointTransform(nn.Module):
    """Linear layer, batch norm and ReLU on single points."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.linear = nn.Linear(in_channels, out_channels)
        self.norm = nn.BatchNorm1d(out_channels)

    def forward(self, features: Tensor) -> Tensor:
        """``(P, in_channels)`` to ``(P, out_channels)``."""
        return functional.relu(self.norm(self.linear(features)), inplace=True)


class SPVCNN(MinkowskiNet):
    """Features of points: the U-Net with a point branch between its parts.

    As in the official code, coordinates are multiplied and divided by the voxel size in float32,
    which moves them by up to 2e-4 of a voxel below 4000 voxels.

    Args:
        widths: As for :class:`MinkowskiNet`; the default is the network of FPVD.
        in_channels: Input channels C.
        num_classes: Outputs of the linear layer ``head``, which the forward pass does not use.
        voxel_m: Edge of the finest voxels in metres.
    """

    def __init__(
        self,
        widths: Sequence[int] = scaled_widths(0.5),
        in_channels: int = 4,
        num_classes: int = 20,
        voxel_m: float = 0.05,
    ) -> None:
        super().__init__(widths, in_channels, num_classes)
        self.voxel_m = voxel_m
        stops = [self.widths[index] for index in (0, 4, 6, 8)]
        self.points = nn.ModuleList(map(PointTransform, stops[:-1], stops[1:]))

    def forward(self, coordinates: Tensor, features: Tensor) -> Tensor:
        """Features ``(P, F)`` before the head, in the order of the input.

        Args:
            coordinates: ``(P, 4)`` integers x, y, z, batch; rows of one voxel are averaged.
            features: ``(P, C)``.
        """
        self._check(coordinates, features)
        points = self._points(coordinates)
        voxels, _ = Voxels.from_coordinates(points.voxel_of(1))
        stem = self._stem(to_voxels(features, points, voxels), voxels)
        at_points = to_points(stem, points, voxels)
        levels = self._encode(to_voxels(at_points, points, voxels), voxels)
        levels[0] = (voxels, stem)  # the last decoder stage joins the stem without the points
        inner, index = levels[-1][1], 0
        at_points = self.points[0](at_points) + to_points(inner, points, levels[-1][0])
        for transform in self.points[1:]:
            inner = to_voxels(at_points, points, levels[-1 - index][0])
            for _ in range(2):
                inner = self._up(index, inner, levels)
                index += 1
            at_points = transform(at_points) + to_points(inner, points, levels[-1 - index][0])
        return at_points

    def _points(self, coordinates: Tensor) -> Points:
        # The size is a tensor of the same device: division by a number may multiply by its inverse.
        size = torch.tensor(self.voxel_m, device=coordinates.device)
        xyz = coordinates[:, :3].float()
        # Rounding must not move a negative coordinate into the voxel below; the official code has
        # non-negative ones only, which never move down.
        return Points(torch.maximum(xyz * size / size, xyz), coordinates[:, 3].long())

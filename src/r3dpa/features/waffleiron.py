"""WaffleIron: a network on points that mixes tokens on the planes xy, xz and yz by dense 2D layers.

Source: Puy, Boulch and Marlet, "Using a Waffle Iron for Automotive Point Cloud Semantic
Segmentation" (ICCV 2023); same numbers as valeoai/WaffleIron v0.3.1 (``tests/parity``).
Letters: N points of all B scans of a batch, K neighbours, F width of the tokens.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor, nn

from r3dpa.features.voxels import NUM_FEATURES, PLANES, PointCloudBatch
from r3dpa.nn.layers import at_least_float32, no_autocast

# Added to the number of points of a cell, as in the official code.
_COUNT_EPS = 1e-6
# Starting value of the layer scales: Touvron et al., "Going deeper with Image Transformers" (2021).
_SCALE = 0.1
_BLOCK = 1024  # points


class WaffleIron(nn.Module):
    """Network that computes a token for each point from its features, neighbours and cells.

    ``depth`` layers, each a spatial mixing on one plane (xy, xz, yz, xy, ...) and a channel mixing
    of each token. The default sizes are WI-48-768, the backbone of ScaLR.

    Under ``torch.autocast`` coordinates, statistics, means over cells and the residual stream of
    the tokens stay float32. A training batch needs two points for the batch norms.

    Args:
        width: Width F of the tokens.
        depth: Number of layers.
        cells: Number of cells along x, y, z, see :attr:`ScanGrid.cells`.
        head_dim: Outputs of the linear layer ``head``, which the forward pass does not use.
            Default: ``head`` is the identity.
    """

    def __init__(
        self,
        width: int = 768,
        depth: int = 48,
        cells: tuple[int, int, int] = (256, 256, 32),
        head_dim: int | None = None,
    ) -> None:
        super().__init__()
        self.width, self.depth, self.cells = width, depth, cells
        self.plane_sizes = [(cells[row], cells[column]) for row, column in PLANES]
        self.embedding = Embedding(width)
        self.spatial = nn.ModuleList(SpatialMixing(width) for _ in range(depth))
        self.channel = nn.ModuleList(ChannelMixing(width) for _ in range(depth))
        self.head = nn.Identity() if head_dim is None else nn.Linear(width, head_dim)

    def forward(self, batch: PointCloudBatch) -> Tensor:
        """Tokens ``(N, F)`` of the last layer, which ScaLR takes as features."""
        return self.mix(self.embedding(batch.features, batch.neighbors), batch)

    def mix(self, tokens: Tensor, batch: PointCloudBatch, visible: Tensor | None = None) -> Tensor:
        """Tokens ``(N, F)`` of the last layer, from the tokens of the first.

        Points that are not ``visible`` ``(N,)`` read the planes but write nothing there, so that no
        point depends on them.
        """
        planes = self._planes(batch, visible)
        for layer, (spatial, channel) in enumerate(zip(self.spatial, self.channel, strict=True)):
            tokens = channel(spatial(tokens, planes[layer % len(planes)]))
        return tokens

    def _planes(self, batch: PointCloudBatch, visible: Tensor | None = None) -> list[Plane]:
        num_scans, num_points = len(batch.num_points), len(batch.features)
        scan = torch.repeat_interleave(batch.num_points, output_size=num_points)
        weight = None if visible is None else visible.to(batch.features.dtype)[:, None]
        planes = []
        for cells, (rows, columns) in zip(batch.cells, self.plane_sizes, strict=True):
            index = cells + scan * (rows * columns)
            count = batch.features.new_zeros(num_scans * rows * columns)
            ones = count.new_ones(num_points)
            count.index_add_(0, index, ones if weight is None else weight[:, 0])
            share = (count + _COUNT_EPS).reciprocal()[:, None]
            planes.append(Plane(index, share, (num_scans, rows, columns), weight))
        return planes


class Plane(NamedTuple):
    """Cells of the points of a batch on one plane."""

    cells: Tensor  #: ``(N,)`` int64, ``(scan * rows + row) * columns + column``
    share: Tensor  #: ``(B * rows * columns, 1)`` float32 one over the number of visible points
    size: tuple[int, int, int]  #: B, rows, columns
    weight: Tensor | None  #: ``(N, 1)`` float32, 1 for visible points, else 0; None: all visible


class Embedding(nn.Module):
    """Token of each point from its features and from their differences to its neighbours."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(NUM_FEATURES)
        self.point = nn.Linear(NUM_FEATURES, width)
        self.offset = nn.Sequential(
            nn.BatchNorm1d(NUM_FEATURES),
            _ManyRowsLinear(NUM_FEATURES, width, bias=False),
            nn.BatchNorm1d(width),
            nn.ReLU(inplace=True),
        )
        self.neighbor = nn.Linear(width, width, bias=False)
        self.merge = nn.Linear(2 * width, width)

    def forward(self, features: Tensor, neighbors: Tensor) -> Tensor:
        """Tokens ``(N, F)`` of features ``(N, 5)`` and rows ``(N, K)`` of their neighbours."""
        # Coordinates in bfloat16 would move a point at 60 m by up to 12 cm.
        with no_autocast(features.device):
            features = self.norm(features)
        if self.training:  # the batch norms need all neighbours at once
            others = features.index_select(0, neighbors.flatten())
            offsets = others - features.repeat_interleave(neighbors.shape[1], dim=0)
            around = self._around(offsets).unflatten(0, neighbors.shape).amax(dim=1)
        else:  # one neighbour at a time, in blocks that fit the caches: 1 / K of the memory
            around = torch.cat(
                [
                    reduce(torch.maximum, (self._around(features[i] - values) for i in others.T))
                    for values, others in zip(
                        features.split(_BLOCK), neighbors.split(_BLOCK), strict=True
                    )
                ]
            )
        with no_autocast(features.device):
            point_features = self.point(features)
            return self.merge(torch.cat([point_features, around.to(point_features.dtype)], dim=1))

    def _around(self, offsets: Tensor) -> Tensor:
        with no_autocast(offsets.device):
            hidden = self.offset(offsets)
        return self.neighbor(hidden)  # most of the computation, under autocast


class _ManyRowsLinear(nn.Linear):
    """Linear layer for many rows of few features.

    From a contiguous transpose of the weights, their gradient takes a tenth of the time on a CPU:
    a fifth of a training step of ``waffleiron-s``.
    """

    def forward(self, inputs: Tensor) -> Tensor:
        """``(N, in_features)`` to ``(N, out_features)``."""
        return inputs @ self.weight.T.contiguous() if self.training else super().forward(inputs)


class SpatialMixing(nn.Module):
    """Mixing of the tokens on a plane: mean over each cell, 2D convolutions, and back."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.convs = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1, groups=width),
            nn.ReLU(inplace=True),
            nn.Conv2d(width, width, 3, padding=1, groups=width),
        )
        self.scale = nn.Parameter(torch.full((width,), _SCALE))

    def forward(self, tokens: Tensor, plane: Plane) -> Tensor:
        """``(N, F)`` to the same shape."""
        normed = at_least_float32(self.norm(tokens))
        if plane.weight is not None:
            normed = normed * plane.weight
        sums = normed.new_zeros(len(plane.share), normed.shape[1])
        means = sums.index_add_(0, plane.cells, normed).mul_(plane.share)
        # Channels stay last in memory, so that neither permutation copies the image.
        image = means.unflatten(0, plane.size).permute(0, 3, 1, 2)
        mixed = self.convs(image).permute(0, 2, 3, 1).flatten(0, 2)
        # Not mixed[plane.cells], whose gradient is summed in a random order.
        return torch.addcmul(tokens, self.scale, mixed.index_select(0, plane.cells))


class ChannelMixing(nn.Module):
    """Two linear layers on each token."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.mlp = nn.Sequential(
            nn.Linear(width, width), nn.ReLU(inplace=True), nn.Linear(width, width)
        )
        self.scale = nn.Parameter(torch.full((width,), _SCALE))

    def forward(self, tokens: Tensor) -> Tensor:
        """``(N, F)`` to the same shape."""
        return torch.addcmul(tokens, self.scale, self.mlp(self.norm(tokens)))

"""MinkowskiNet and SPVCNN: U-Nets of sparse convolutions, and their official checkpoints.

Source: Choy, Gwak and Savarese, "4D Spatio-Temporal ConvNets" (CVPR 2019), in the form of Tang et
al., "Searching Efficient 3D Architectures with Sparse Point-Voxel Convolution" (ECCV 2020); same
numbers as the networks of FSVD and FPVD in valeoai/R3DPA (``tests/parity``).
Letters: P voxels or points given, N voxels of one stride, C input channels, F channels of the
features.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from r3dpa.features.official import load_strictly, naming, read_released
from r3dpa.metrics.networks.sparse import KernelMap, SparseConv, Voxels, kernel_offsets, voxel_keys
from r3dpa.nn.layers import at_least_float32, named_layers

#: Widths of the stem, the four encoder stages and the four decoder stages at channel rate 1.
WIDTHS = (32, 32, 64, 128, 256, 256, 128, 96, 96)
_DEPTH = 4
# Convolutions of a residual block: official list of layers, and place of the convolution there.
_BRANCHES = {"first": ("net", 0), "second": ("net", 3), "skip": ("downsample", 0)}
_STEM = "stem.0.kernel"  # official name of the first weight
_RELEASED = "model.ckpt of the released MinkowskiNet or SPVCNN"
# Added to the sum of the weights of the corners, as in the official code.
_WEIGHT_EPS = 1e-8


def scaled_widths(rate: float, widths: Sequence[int] = WIDTHS) -> tuple[int, ...]:
    """Widths at a channel rate, cut off to integers as the official networks do."""
    return tuple(int(rate * width) for width in widths)


class ConvNorm(nn.Module):
    """Sparse convolution and batch norm."""

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int) -> None:
        super().__init__()
        self.conv = SparseConv(in_channels, out_channels, kernel_size)
        self.norm = nn.BatchNorm1d(out_channels)

    def forward(self, features: Tensor, kernel_map: KernelMap | None = None) -> Tensor:
        """``(N, in_channels)`` to ``(N', out_channels)``, not rectified."""
        return self.norm(self.conv(features, kernel_map))


class SparseResidual(nn.Module):
    """Two convolutions of size 3 beside a shortcut, which has weights if the width changes."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.first = ConvNorm(in_channels, out_channels, 3)
        self.second = ConvNorm(out_channels, out_channels, 3)
        same = in_channels == out_channels
        self.skip = nn.Identity() if same else ConvNorm(in_channels, out_channels, 1)

    def forward(self, features: Tensor, kernel_map: KernelMap) -> Tensor:
        """``(N, in_channels)`` to ``(N, out_channels)``."""
        inner = functional.relu(self.first(features, kernel_map), inplace=True)
        return functional.relu(self.second(inner, kernel_map) + self.skip(features), inplace=True)


class ResolutionStage(nn.Module):
    """Change of the stride to ``resampled`` channels, then two residual blocks.

    The blocks also read ``joined`` channels of the encoder.
    """

    def __init__(self, in_channels: int, resampled: int, joined: int, out_channels: int) -> None:
        super().__init__()
        self.resample = ConvNorm(in_channels, resampled, 2)
        self.blocks = nn.ModuleList(
            [
                SparseResidual(resampled + joined, out_channels),
                SparseResidual(out_channels, out_channels),
            ]
        )

    def forward(
        self, features: Tensor, change: KernelMap, voxels: Voxels, joined: Tensor | None = None
    ) -> Tensor:
        """Features ``(N', out_channels)`` at ``voxels``, the output of the map ``change``."""
        features = functional.relu(self.resample(features, change), inplace=True)
        if joined is not None:
            features = torch.cat([features, joined], dim=1)
        for block in self.blocks:
            features = block(features, voxels.neighbors)
        return features


class MinkowskiNet(nn.Module):
    """Features of voxels: a U-Net over strides 1, 2, 4, 8 and 16.

    Args:
        widths: Channels of the stem, four encoder and four decoder stages; the default is the
            network of FSVD, whose pooled feature has 768 = 16 rings x 48 numbers.
        in_channels: Input channels C.
        num_classes: Outputs of the linear layer ``head``, which the forward pass does not use.
    """

    def __init__(
        self,
        widths: Sequence[int] = scaled_widths(0.5),
        in_channels: int = 4,
        num_classes: int = 20,
    ) -> None:
        super().__init__()
        self.widths, self.in_channels = tuple(widths), in_channels
        stem = self.widths[0]
        self.stem = nn.ModuleList([ConvNorm(in_channels, stem, 3), ConvNorm(stem, stem, 3)])
        self.encoder, self.decoder = nn.ModuleList(), nn.ModuleList()
        for index in range(_DEPTH):
            before, width = self.widths[index : index + 2]
            self.encoder.append(ResolutionStage(before, before, 0, width))
        for index in range(_DEPTH):
            before, width = self.widths[_DEPTH + index : _DEPTH + index + 2]
            self.decoder.append(
                ResolutionStage(before, width, self.widths[_DEPTH - 1 - index], width)
            )
        self.head = nn.Linear(self.widths[-1], num_classes)

    @classmethod
    def from_checkpoint(cls, path: str | Path) -> Self:
        """Network with the weights of an official ``model.ckpt``, which determine its widths.

        If the network is one module of several, the weights of the others are ignored.
        """
        with naming(path):
            weights = _network_weights(read_released(Path(path), _RELEASED))
            network = cls(*_sizes(weights))
            load_strictly(network, weights, official_name)
        return network

    def forward(self, coordinates: Tensor, features: Tensor) -> Tensor:
        """Features ``(P, F)`` before the head, in the order of the input.

        Coordinates are ``(P, 4)`` integers x, y, z, batch, each voxel once; features ``(P, C)``.
        """
        voxels, rows = Voxels.from_coordinates(coordinates)
        if len(voxels) != len(coordinates):
            raise ValueError(f"{len(coordinates)} rows are only {len(voxels)} voxels")
        features = torch.empty_like(features).index_copy(0, rows, features)
        levels = self._encode(self._stem(features, voxels), voxels)
        features = levels[-1][1]
        for index in range(_DEPTH):
            features = self._up(index, features, levels)
        return features[rows]

    def _stem(self, features: Tensor, voxels: Voxels) -> Tensor:
        for layer in self.stem:
            features = functional.relu(layer(features, voxels.neighbors), inplace=True)
        return features

    def _encode(self, features: Tensor, voxels: Voxels) -> list[tuple[Voxels, Tensor]]:
        """Compute voxels and features of strides 1, 2, 4, 8, 16 from the output of the stem."""
        levels = [(voxels, features)]
        for stage in self.encoder:
            change, voxels = voxels.to_coarser, voxels.coarser
            features = stage(features, change, voxels)
            levels.append((voxels, features))
        return levels

    def _up(self, index: int, features: Tensor, levels: list[tuple[Voxels, Tensor]]) -> Tensor:
        """Decoder stage ``index``: from the stride of its input to half of it."""
        voxels, joined = levels[_DEPTH - 1 - index]
        return self.decoder[index](features, voxels.to_coarser.transposed(), voxels, joined)


class Points(NamedTuple):
    """Points between the voxels of B clouds."""

    xyz: Tensor  #: ``(P, 3)`` float32 in units of the finest voxels
    batch: Tensor  #: ``(P,)`` int64 cloud of each point

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


class SPVCNN(MinkowskiNet):
    """Features of points: the U-Net with a point branch between its parts, without dropout.

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
        self.points = nn.ModuleList(
            named_layers(
                linear=nn.Linear(before, after), norm=nn.BatchNorm1d(after), relu=nn.ReLU(True)
            )
            for before, after in pairwise(stops)
        )

    def forward(self, coordinates: Tensor, features: Tensor) -> Tensor:
        """Run as :class:`MinkowskiNet` does, but average the rows of one voxel."""
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


def official_name(key: str) -> str:
    """Official name of a weight of MinkowskiNet or SPVCNN."""
    if key.startswith("head."):
        return key.replace("head", "classifier.0")
    area, *place, layer, weight = key.split(".")
    after = int(layer == "norm")  # the norm follows its convolution or linear layer
    if area == "points":
        return f"point_transforms.{place[0]}.{after}.{weight}"
    if area == "stem":
        return f"stem.{3 * int(place[0]) + after}.{weight}"
    index, part, *block = place
    stage = f"stage{int(index) + 1}" if area == "encoder" else f"up{int(index) + 1}"
    if part == "resample":
        return f"{stage}.0.net.{after}.{weight}"
    # The encoder keeps its blocks behind the change of the stride, the decoder in a list beside it.
    row = f"{int(block[0]) + 1}" if area == "encoder" else f"1.{block[0]}"
    layers, start = _BRANCHES[block[1]]
    return f"{stage}.{row}.{layers}.{start + after}.{weight}"


def _sizes(weights: Mapping[str, Tensor]) -> tuple[list[int], int, int]:
    stages = [f"stage{index + 1}.1.net.0.kernel" for index in range(_DEPTH)]
    ups = [f"up{index + 1}.0.net.0.kernel" for index in range(_DEPTH)]
    try:
        widths = [weights[name].shape[-1] for name in (_STEM, *stages, *ups)]
        return widths, weights[_STEM].shape[1], len(weights["classifier.0.weight"])
    except (KeyError, IndexError, TypeError) as error:
        raise ValueError(
            f"holds no such U-Net ({type(error).__name__}: {error}); give {_RELEASED}"
        ) from error


def _network_weights(content: Any) -> dict[str, Tensor]:
    weights = content.get("state_dict", content) if isinstance(content, Mapping) else None
    keys = [key for key in weights or () if isinstance(key, str)]
    prefixes = [key.removesuffix(_STEM) for key in keys if re.search(rf"(^|\.){_STEM}$", key)]
    if weights is None or len(prefixes) != 1:
        raise ValueError(
            f"must hold one network, but {len(prefixes)} weights are named {_STEM}; "
            f"give {_RELEASED}"
        )
    prefix = prefixes[0]
    return {key.removeprefix(prefix): weights[key] for key in keys if key.startswith(prefix)}

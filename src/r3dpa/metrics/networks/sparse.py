"""Voxels of scans, sparse 3D convolution over them in plain PyTorch, and pooling to one feature.

A voxel is one int64 key; keys are sorted, so that neighbours are found by bisection. For each
offset of the kernel, a convolution gathers the paired rows, multiplies them by the matrix of the
offset and adds them to the rows of the result.

Source: Choy, Gwak and Savarese, "4D Spatio-Temporal ConvNets" (CVPR 2019); same numbers as
torchsparse 1.4.0. Voxels and pooling: FSVD and FPVD of valeoai/R3DPA (``tests/parity``).
Letters: N voxels of all B clouds of a batch, P points or rows of coordinates given, K offsets of a
kernel, F channels of the features.
"""

from __future__ import annotations

from functools import cached_property
from itertools import product
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.nn.layers import at_least_float32

# A key is batch, x, y, z from the highest bits to the lowest; x, y, z have 16 bits each and are
# shifted to be non-negative.
_BITS = 16
_SHIFT = 1 << (_BITS - 1)
_PLACES = (2 * _BITS, _BITS, 0)  # lowest bit of x, y, z
_UNITS = tuple(1 << bits for bits in _PLACES)  # a step along x, y, z in a key
#: Largest stride: a neighbour at this stride cannot overflow into the next axis of a key.
MAX_STRIDE = 512
#: Coordinates lie in ``[-MAX_COORDINATE, MAX_COORDINATE)``: 1.5 km at voxels of 5 cm.
MAX_COORDINATE = _SHIFT - 2 * MAX_STRIDE
#: Clouds in a batch.
MAX_CLOUDS = 1 << 15
# Columns of a 3 x 3 x 3 kernel on one side of its middle column; the other side mirrors them.
_COLUMNS = ((1, -1), (0, 1), (1, 0), (1, 1))

VOXEL_M = 0.05
#: Fourth input channel, in place of the intensity, which generated scans lack.
NO_INTENSITY = -1.0
NUM_BINS = 16
_RINGS_FROM_M, _RINGS_TO_M = 4.0, 56.0


def kernel_offsets(size: int) -> list[tuple[int, int, int]]:
    """Offsets x, y, z of a kernel in units of the stride, in the order of its matrices.

    Size 3 is -1..1 with x fastest, size 2 is 0..1 with z fastest, as in torchsparse.
    """
    if size == 2:
        return [(x, y, z) for x, y, z in product(range(2), repeat=3)]
    return [(x, y, z) for z, y, x in product(range(-(size // 2), size // 2 + 1), repeat=3)]


class KernelMap(NamedTuple):
    """Pairs ``(inputs, outputs)`` of rows, int64 of equal length, for each of the K offsets.

    No row of the result appears twice at an offset; None if all rows pair with themselves.
    """

    pairs: list[tuple[Tensor, Tensor] | None]
    num_inputs: int
    num_outputs: int

    def transposed(self) -> KernelMap:
        """Map of the transposed convolution."""
        swapped = [pair and (pair[1], pair[0]) for pair in self.pairs]
        return KernelMap(swapped, self.num_outputs, self.num_inputs)


class Voxels:
    """Distinct occupied voxels of B clouds at one stride, sorted by (batch, x, y, z).

    Kernel maps and coarser voxels are computed at their first use and cached.

    Args:
        keys: ``(N,)`` int64, sorted, see :meth:`from_coordinates`.
        stride: Edge of a voxel in units of the coordinates, a power of two.
    """

    def __init__(self, keys: Tensor, stride: int = 1) -> None:
        self.keys, self.stride = keys, stride

    @classmethod
    def from_coordinates(cls, coordinates: Tensor) -> tuple[Voxels, Tensor]:
        """Voxels of stride 1 of rows ``(P, 4)`` x, y, z, batch, and the voxel ``(P,)`` of each."""
        keys, rows = torch.unique(voxel_keys(coordinates), return_inverse=True)
        return cls(keys), rows

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def coordinates(self) -> Tensor:
        """``(N, 4)`` int64 lowest corner x, y, z of each voxel, and its batch index."""
        fields = [((self.keys >> bits) & (1 << _BITS) - 1) - _SHIFT for bits in _PLACES]
        return torch.stack([*fields, self.keys >> 3 * _BITS], dim=1)

    def find(self, keys: Tensor) -> tuple[Tensor, Tensor]:
        """Row of each key (any shape, int64), and whether that voxel is occupied."""
        rows = torch.searchsorted(self.keys, keys)
        return rows, self._padded[rows] == keys

    def corners(self, keys: Tensor) -> tuple[Tensor, Tensor]:
        """As :meth:`find`, ``(P, 8)``, for the voxels at the offsets of size 2 from each key."""
        offsets = keys.new_tensor(kernel_offsets(2))
        steps = (offsets * offsets.new_tensor(_UNITS)).sum(dim=1) * self.stride
        return self.find(keys[:, None] + steps)

    @cached_property
    def _padded(self) -> Tensor:
        # A search may end one row behind the last one, and reads up to two rows beyond it.
        return torch.cat([self.keys, self.keys.new_full((3,), torch.iinfo(torch.int64).max)])

    @cached_property
    def neighbors(self) -> KernelMap:
        """Map of a convolution of size 3 from these voxels to themselves."""
        offsets = kernel_offsets(3)
        pairs: list[tuple[Tensor, Tensor] | None] = [None] * len(offsets)

        def add_pairs(offset: tuple[int, int, int], occupied: Tensor, rows: Tensor) -> None:
            outputs = occupied.nonzero().squeeze(1)
            inputs, index = rows[outputs], offsets.index(offset)
            pairs[index] = (inputs, outputs)
            # A neighbour sees this voxel at the opposite offset, which is as far from the end.
            pairs[-1 - index] = (outputs, inputs)

        rows = torch.arange(1, len(self) + 1, device=self.keys.device)
        add_pairs((0, 0, 1), self._padded[rows] == self.keys + self.stride, rows)
        for x, y in _COLUMNS:
            # z is fastest in the keys: three voxels on top of each other lie in adjacent rows, so
            # that one search finds all that are occupied.
            keys = self.keys + self.stride * (x * _UNITS[0] + y * _UNITS[1] - _UNITS[2])
            rows = torch.searchsorted(self.keys, keys)
            for z in (-1, 0, 1):
                occupied = self._padded[rows] == keys
                add_pairs((x, y, z), occupied, rows)
                rows, keys = rows + occupied, keys + self.stride
        return KernelMap(pairs, len(self), len(self))

    @cached_property
    def _halved(self) -> tuple[Voxels, KernelMap]:
        """Voxels of twice the stride, and the map of a convolution of size 2 to them."""
        dropped = (2 * self.stride - 1) * sum(_UNITS)  # bits below the coarser grid
        keys, parents = torch.unique(self.keys & ~dropped, return_inverse=True)
        lowest_bit = self.stride.bit_length() - 1
        x, y, z = ((self.keys >> bits + lowest_bit) & 1 for bits in _PLACES)
        offset = 4 * x + 2 * y + z
        children = [(offset == index).nonzero().squeeze(1) for index in range(8)]
        pairs = [(rows, parents[rows]) for rows in children]
        return Voxels(keys, 2 * self.stride), KernelMap([*pairs], len(self), len(keys))

    @property
    def coarser(self) -> Voxels:
        """Voxels of twice the stride that hold one of these."""
        return self._halved[0]

    @property
    def to_coarser(self) -> KernelMap:
        """Map of a convolution of size 2 and stride 2, from these voxels to :attr:`coarser`."""
        return self._halved[1]


def voxel_keys(coordinates: Tensor) -> Tensor:
    """Keys ``(P,)`` int64 of voxels ``(P, 4)`` x, y, z, batch, in the order of batch, x, y, z."""
    coordinates = coordinates.long()
    xyz, batch = coordinates[:, :3], coordinates[:, 3]
    outside = (xyz < -MAX_COORDINATE) | (xyz >= MAX_COORDINATE)
    outside = outside.any(dim=1) | (batch < 0) | (batch >= MAX_CLOUDS)
    if outside.any():
        raise ValueError(
            f"{int(outside.sum())} of {len(coordinates)} voxels are out of bounds: x, y, z must be "
            f"in [-{MAX_COORDINATE}, {MAX_COORDINATE}), batch in [0, {MAX_CLOUDS})"
        )
    return ((xyz + _SHIFT) * xyz.new_tensor(_UNITS)).sum(dim=1) + (batch << 3 * _BITS)


class SparseConv(nn.Module):
    """Convolution over occupied voxels with the given kernel map.

    The map is ``voxels.neighbors`` for size 3, ``voxels.to_coarser`` for size 2 and stride 2, its
    ``transposed()`` for the way back, None for size 1::

        result[p] = sum over offsets k of features[p + offset k] @ kernel[k]

    Products of half-precision features are summed in float32.
    """

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int) -> None:
        super().__init__()
        size = (in_channels, out_channels)
        shape = size if kernel_size == 1 else (kernel_size**3, *size)
        # Bound of PyTorch's dense layers, as if all offsets were occupied.
        bound = (in_channels * kernel_size**3) ** -0.5
        self.kernel = nn.Parameter(torch.empty(shape).uniform_(-bound, bound))

    def forward(self, features: Tensor, kernel_map: KernelMap | None = None) -> Tensor:
        """``(N, in_channels)`` to ``(N', out_channels)`` at the output voxels of the map."""
        if kernel_map is None:
            return features @ self.kernel
        matrices = list(zip(kernel_map.pairs, self.kernel, strict=True))
        centre = [features @ matrix for pair, matrix in matrices if pair is None]
        if centre:
            dtype, result = centre[0].dtype, at_least_float32(centre[0])
        else:
            dtype = (features[:0] @ self.kernel[0]).dtype  # autocast may change it
            wide = torch.promote_types(dtype, torch.float32)
            shape = (kernel_map.num_outputs, self.kernel.shape[-1])
            result = torch.zeros(shape, dtype=wide, device=features.device)
        for pair, matrix in matrices:
            if pair is not None and len(pair[0]):
                inputs, outputs = pair
                rows = features.index_select(0, inputs) @ matrix
                result = result.index_add_(0, outputs, rows.to(result.dtype))
        return result.to(dtype)


def voxelize(
    points: Tensor, voxel_m: float = VOXEL_M, *, range_min_m: float = 1.0, range_max_m: float = 56.0
) -> tuple[Tensor, Tensor]:
    """Occupied voxels of a scan, sorted by (x, y, z), and the first point in each.

    Voxels are counted from the lowest x, y, z of the scan::

        voxel = round(point / voxel_m), minus its minimum over the points

    Points ``(P, 3 or more)`` in metres beyond the range limits are dropped.

    Returns:
        Voxels ``(N, 3)`` int64 from 0, and inputs ``(N, 4)`` float32: x, y, z of the point of
        lowest index in the voxel, and -1 in place of the intensity.
    """
    xyz = points[:, :3].float()
    if not xyz.isfinite().all():
        raise ValueError(
            f"{int((~xyz.isfinite().all(dim=1)).sum())} of {len(xyz)} points are NaN or infinite: "
            "drop them first"
        )
    ranges = xyz.norm(dim=1)
    xyz = xyz[(ranges >= range_min_m) & (ranges <= range_max_m)]
    # The size is a tensor of the same device: division by a number may multiply by its inverse.
    voxels = (xyz / xyz.new_tensor(voxel_m)).round().long()
    if len(voxels):
        voxels = voxels - voxels.amin(dim=0)
    keys, order = voxel_keys(F.pad(voxels, (0, 1))).sort(stable=True)
    first = order[torch.cat([torch.ones_like(keys[:1]), keys.diff()]) > 0]
    return voxels[first], F.pad(xyz[first], (0, 1), value=NO_INTENSITY)


def pool_voxels(
    features: Tensor, coordinates: Tensor, num_clouds: int, voxel_m: float = VOXEL_M
) -> Tensor:
    """One feature per cloud: means over its voxels in 16 rings around the mean of its coordinates.

    Rings are distances in space with borders at 0, 7.25, 10.5, ..., 56 m; voxels beyond are left
    out.

    Features are ``(N, F)`` and coordinates ``(N, 4)`` x, y, z in voxels, batch. Returns
    ``(B, 16 * F)`` at least float32, ring after ring; zeros where a ring is empty.
    """
    features = at_least_float32(features)
    # In float64 the mean of whole numbers is exact: it does not depend on the order of the voxels.
    cloud, xyz = coordinates[:, 3].long(), coordinates[:, :3].double()
    centred = xyz - _means(xyz, cloud, num_clouds)[cloud]
    edges = torch.linspace(_RINGS_FROM_M, _RINGS_TO_M, NUM_BINS + 1).to(xyz)
    edges[0] = 0
    rings = torch.bucketize(centred.norm(dim=1) * voxel_m, edges, right=True) - 1
    inside = rings < NUM_BINS
    place = cloud[inside] * NUM_BINS + rings[inside]
    means = _means(features[inside], place, num_clouds * NUM_BINS).to(features)
    return means.reshape(num_clouds, -1)


def _means(values: Tensor, place: Tensor, num_places: int) -> Tensor:
    """Mean ``(num_places, F)`` float64 of the rows at each place, zeros where there is none."""
    values = values.double()  # float32 sums of 10^5 rows would depend on their order
    sums = values.new_zeros(num_places, values.shape[1]).index_add_(0, place, values)
    return sums / torch.bincount(place, minlength=num_places).clamp(min=1)[:, None]

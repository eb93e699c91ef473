"""Voxels of a scan, and pooling of voxel features to one feature of a scan.

Source: valeoai/R3DPA, the features of FSVD and FPVD (``tests/parity``).
Letters: P points, N voxels of all B clouds of a batch, F channels of the features.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from r3dpa.nn.backbones.sparse import voxel_keys
from r3dpa.nn.layers import at_least_float32

VOXEL_M = 0.05
#: Fourth input channel, in place of the intensity, which generated scans lack.
NO_INTENSITY = -1.0
NUM_BINS = 16
_RINGS_FROM_M, _RINGS_TO_M = 4.0, 56.0
# Added at both ends of the circle, as in the official code: moves sector borders by 1e-4 at most.
_SECTOR_MARGIN_RAD = 1e-4

Pooling = Literal["rings", "sectors", "all"]


def voxelize(
    points: Tensor,
    voxel_m: float = VOXEL_M,
    *,
    range_min_m: float = 1.0,
    range_max_m: float = 56.0,
) -> tuple[Tensor, Tensor]:
    """Occupied voxels of a scan, sorted by (x, y, z), and the first point in each.

    Voxels are counted from the lowest x, y, z of the scan::

        voxel = round(point / voxel_m), minus its minimum over the points

    Args:
        points: ``(P, 3)`` x, y, z in metres, finite; further columns are ignored.
        voxel_m: Edge of a voxel in metres.
        range_min_m: Points nearer than this are dropped.
        range_max_m: Points farther than this are dropped.

    Returns:
        Voxels ``(N, 3)`` int64 from 0, and inputs ``(N, 4)`` float32: x, y, z of the point of
        lowest index in the voxel, and -1 in place of the intensity.
    """
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points must be (P, 3) x, y, z in metres, got {tuple(points.shape)}.")
    xyz = points[:, :3].float()
    if not xyz.isfinite().all():
        raise ValueError(
            f"{int((~xyz.isfinite().all(dim=1)).sum())} of {len(xyz)} points are NaN or infinite: "
            "drop them first."
        )
    ranges = xyz.norm(dim=1)
    xyz = xyz[(ranges >= range_min_m) & (ranges <= range_max_m)]
    # The size is a tensor of the same device: division by a number may multiply by its inverse.
    voxels = (xyz / xyz.new_tensor(voxel_m)).round().long()
    if len(voxels):
        voxels = voxels - voxels.amin(dim=0)
    keys, order = voxel_keys(functional.pad(voxels, (0, 1))).sort(stable=True)
    first = order[torch.cat([torch.ones_like(keys[:1]), keys.diff()]) > 0]
    return voxels[first], functional.pad(xyz[first], (0, 1), value=NO_INTENSITY)


def pool_voxels(
    features: Tensor,
    coordinates: Tensor,
    num_clouds: int,
    pooling: Pooling = "rings",
    voxel_m: float = VOXEL_M,
) -> Tensor:
    """One feature per cloud: means over its voxels, in bins around the mean of its coordinates.

    ``rings``: 16 distances in space with borders at 0, 7.25, 10.5, ..., 56 m; voxels beyond are
    left out. ``sectors``: 16 azimuths, counter-clockwise from behind. ``all``: a single bin. FSVD
    and FPVD use rings.

    Args:
        features: ``(N, F)``.
        coordinates: ``(N, 4)`` x, y, z in voxels, batch.
        num_clouds: B; a cloud without voxels gives zeros.
        pooling: Kind of bins.
        voxel_m: Edge of a voxel in metres.

    Returns:
        ``(B, bins * F)`` at least float32, bin after bin; zeros where a bin is empty.
    """
    features = at_least_float32(features)
    # In float64 the mean of whole numbers is exact: it does not depend on the order of the voxels.
    cloud, xyz = coordinates[:, 3].long(), coordinates[:, :3].double()
    centred = xyz - _means(xyz, cloud, num_clouds)[cloud]
    if pooling == "rings":
        edges = torch.linspace(_RINGS_FROM_M, _RINGS_TO_M, NUM_BINS + 1).to(xyz)
        edges[0] = 0
        values = centred.norm(dim=1) * voxel_m
    elif pooling == "sectors":
        end = math.pi + _SECTOR_MARGIN_RAD
        edges = torch.linspace(-end, end, NUM_BINS + 1).to(xyz)
        values = torch.atan2(centred[:, 1], centred[:, 0])
    elif pooling == "all":
        return _means(features, cloud, num_clouds).to(features)
    else:
        raise ValueError(f"pooling must be rings, sectors or all, got {pooling!r}.")
    bins = torch.bucketize(values, edges, right=True) - 1
    inside = bins < NUM_BINS
    place = cloud[inside] * NUM_BINS + bins[inside]
    means = _means(features[inside], place, num_clouds * NUM_BINS).to(features)
    return means.reshape(num_clouds, -1)


def _means(values: Tensor, place: Tensor, num_places: int) -> Tensor:
    """Mean ``(num_places, F)`` float64 of the rows at each place, zeros where there is none."""
    values = values.double()  # float32 sums of 10^5 rows would depend on their order
    sums = values.new_zeros(num_places, values.shape[1]).index_add_(0, place, values)
    counts = torch.bincount(place, minlength=num_places)
    return sums / counts.clamp(min=1)[:, None]

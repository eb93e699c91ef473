"""Points to pixels and back; nearest-return images; pooling of point values into cells.

Axes are x forward, y left, z up, in metres, with the sensor at the origin. Row 0 is the
highest beam. Column 0 looks backwards, columns run clockwise seen from above, and the centre
column looks along +x.
Letters: B batch, P points, H beams, W columns, h x w cells, F feature width.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from lidarsim.sensors.view import LidarSensor
from r3dpa.geometry.beams import BeamProjection
from r3dpa.geometry.rings import RingProjection
from r3dpa.geometry.sensor import (
    EMPTY_RANGE_M,
    angles_of,
    check_points,
    column_azimuths,
    column_of,
    range_of,
)

_MARGIN_DEG = 1.5  # some lasers of a real sensor look further up or down than its nominal limits
_BAG = 32  # points of a cell that are added in float32; more are no faster


@dataclass(frozen=True)
class SphericalProjection:
    """Rows of equal pitch between the inclination limits of the sensor.

    Points outside the vertical field of view are moved to the first or last row::

        row    = floor(H * (inclination_max - inclination) / (inclination_max - inclination_min))
        column = floor(W * (pi - azimuth) / (2 * pi)) mod W

    Source: R3DPA (ICRA 2026), eq. 1, with atan2 in place of its arctan and arcsin; same pixels
    as valeoai/R3DPA.

    Args:
        sensor: Image size and field of view.
        legacy_seam: Put points with an azimuth of exactly -pi (y = -0.0 behind the sensor) into
            the last column, as the official code does, and not beside those with +pi.
        legacy_hiding: Let points outside the range limits hide those behind them, as R2DM does.

    Example:
        >>> projection = SphericalProjection(LidarSensor())
        >>> row, column = projection.pixel_of(torch.tensor([10.0, 0.0, 0.0]))
        >>> row.item(), column.item()
        (6, 512)
    """

    sensor: LidarSensor
    legacy_seam: bool = False
    legacy_hiding: bool = False

    def pixel_of(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Row and column ``(...)`` int64 of the range-image pixel of points ``(..., 3)``.

        Computed in float64: arcsin and float32 lose up to 4e-4 rad towards the zenith. A point that
        is not finite counts as the origin.
        """
        inclination, azimuth = angles_of(points)
        sensor = self.sensor
        row = ((sensor.inclination_max_rad - inclination) / self._pitch).floor().long()
        return row.clamp(0, sensor.beams - 1), column_of(azimuth, sensor.columns, self.legacy_seam)

    def ray_angles(self, corner: bool = False) -> tuple[Tensor, Tensor]:
        """Inclination ``(H,)`` and azimuth ``(W,)`` of the pixel centres or corners, radians."""
        sensor = self.sensor
        rows = torch.arange(sensor.beams, dtype=torch.float64) + (0.0 if corner else 0.5)
        inclination = sensor.inclination_max_rad - self._pitch * rows
        return inclination, column_azimuths(sensor.columns, corner)

    @property
    def _pitch(self) -> float:
        """Angle between two rows, radians."""
        return self.sensor.field_of_view_rad / self.sensor.beams

    def column_order(self) -> Tensor:
        """Columns ``(W,)`` int64 in the order in which the points of a row are listed."""
        return torch.arange(self.sensor.columns)


Projection = SphericalProjection | RingProjection | BeamProjection


@lru_cache(maxsize=16)
def ray_directions(
    projection: Projection,
    corner: bool = False,
    dtype: torch.dtype = torch.float32,
    device: torch.device | None = None,
) -> Tensor:
    """Unit vectors ``(H, W, 3)`` along the rays of the pixels.

    They are kept and shared by all callers, and must not be written to. With ``corner`` they pass
    the upper left corner of the pixel, not its centre, as in the official code: half a pixel (0.22
    degrees up, 0.18 sideways).
    """
    # A tensor made in inference mode could never take part in a backward pass again.
    with torch.inference_mode(False):
        if isinstance(projection, BeamProjection):
            return projection.directions(corner).to(device=device, dtype=dtype)
        inclination, azimuth = torch.meshgrid(*projection.ray_angles(corner), indexing="ij")
        horizontal = inclination.cos()
        directions = torch.stack(
            [horizontal * azimuth.cos(), horizontal * azimuth.sin(), inclination.sin()], dim=-1
        )
        return directions.to(device=device, dtype=dtype)


def in_range(points: Tensor, sensor: LidarSensor) -> Tensor:
    """Whether each point of ``(..., 3)`` is finite and strictly inside the range limits, bool."""
    check_points(points)
    return _inside_limits(range_of(points), sensor)


def view_limits_deg(projection: Projection) -> tuple[float, float]:
    """Inclinations of the lowest and highest rays, degrees."""
    lowest, highest = projection.ray_angles()[0].rad2deg().aminmax()
    return lowest.item(), highest.item()


def in_view(points: Tensor, projection: Projection) -> Tensor:
    """Whether points ``(P, 3)`` lie in the vertical field of view, up to 1.5 degrees beyond it."""
    inclination = angles_of(points)[0].rad2deg()
    lowest, highest = view_limits_deg(projection)
    return (inclination >= lowest - _MARGIN_DEG) & (inclination <= highest + _MARGIN_DEG)


def share_outside_view(points: Tensor, projection: Projection) -> float:
    """Share of the points ``(P, 3)`` within range that lie above or below the field of view."""
    seen = points[in_range(points, projection.sensor)]
    return 1 - in_view(seen, projection).double().mean().item()


def range_image(
    points: Tensor, projection: Projection, values: Tensor | None = None
) -> tuple[Tensor, Tensor | None]:
    """Range image of the nearest return in each pixel.

    Points outside the range limits or not finite are dropped, so NaN rows can pad scans to one
    length; with ``legacy_hiding`` of the projection, points outside the limits win pixels as well,
    which then have values but no range. Of points at equal distance the first one wins: the result
    is deterministic.

    Args:
        points: ``(P, 3)`` or ``(B, P, 3)`` metres.
        projection: Which pixel a point belongs to.
        values: ``(P, F)`` or ``(B, P, F)`` anything known per point, for example intensity.

    Returns:
        ``range_m`` ``(H, W)`` or ``(B, H, W)`` float32, ``EMPTY_RANGE_M`` without a return, and
        the values of the nearest returns ``(F, H, W)`` or ``(B, F, H, W)``, 0 without a return,
        or None.

    Raises:
        ValueError: If points are no tensor, or points or values have another shape.
    """
    check_points(points)
    if points.ndim not in (2, 3):
        raise ValueError(f"points must be (P, 3) or (B, P, 3), got shape {tuple(points.shape)}")
    if values is not None and (
        values.ndim != points.ndim or values.shape[:-1] != points.shape[:-1]
    ):
        raise ValueError(
            f"values must be ({', '.join(map(str, points.shape[:-1]))}, F), a row per point, got "
            f"shape {tuple(values.shape)}"
        )
    beams, columns = projection.sensor.beams, projection.sensor.columns
    leading = points.shape[:-2]
    distance = range_of(points)
    inside = _inside_limits(distance, projection.sensor)
    kept = distance.isfinite() if projection.legacy_hiding else inside
    row, column = projection.pixel_of(points)
    pixel = row * columns + column
    distance = torch.where(kept, distance, math.inf)

    nearest = distance.new_full((*leading, beams * columns), math.inf)
    nearest = nearest.scatter_reduce(-1, pixel, distance, "amin")
    empty = ~_inside_limits(nearest, projection.sensor)
    range_m = nearest.masked_fill(empty, EMPTY_RANGE_M).unflatten(-1, (beams, columns))
    if values is None:
        return range_m, None

    # One more minimum, over point indices: the first of the nearest points, never a race.
    num_points = points.shape[-2]
    index = torch.arange(num_points, device=points.device).expand(pixel.shape)
    is_nearest = kept & (distance == nearest.gather(-1, pixel))
    winner = torch.full(nearest.shape, num_points, device=points.device)
    winner = winner.scatter_reduce(-1, pixel, index.where(is_nearest, num_points), "amin")
    padded = torch.cat([values, values.new_zeros(*leading, 1, values.shape[-1])], dim=-2)
    image = padded.take_along_dim(winner.unsqueeze(-1), dim=-2)
    return range_m, image.transpose(-1, -2).unflatten(-1, (beams, columns))


def unproject(range_m: Tensor, projection: Projection, corner: bool = False) -> Tensor:
    """Point of every pixel of a range image.

    Args:
        range_m: ``(..., H, W)`` metres.
        projection: Which ray a pixel stands for.
        corner: Use the corner of the pixel as the official code does, not its centre.

    Returns:
        ``(..., H, W, 3)`` metres, in the dtype of ``range_m``; the origin where ``range_m`` is
        not positive, that is without a return. :func:`in_range` is False there.

    Raises:
        ValueError: If the image is of another size than the projection.
    """
    size = projection.sensor.beams, projection.sensor.columns
    if range_m.shape[-2:] != size:
        raise ValueError(
            f"range_m must be (..., {size[0]}, {size[1]}) for this projection, got shape "
            f"{tuple(range_m.shape)}"
        )
    directions = ray_directions(projection, corner, range_m.dtype, range_m.device)
    if isinstance(projection, BeamProjection):
        return _from_centres(range_m, directions, projection.origins(corner).to(range_m))
    return range_m.clamp(min=0).unsqueeze(-1) * directions


def _from_centres(range_m: Tensor, directions: Tensor, origins: Tensor) -> Tensor:
    """Points ``(..., H, W, 3)`` at these distances from the frame's origin, along their beams.

    With the optical centre c and the direction u of a pixel: |c + s u| = range.
    """
    ahead = (origins * directions).sum(dim=-1)
    beside = origins.square().sum(dim=-1) - ahead.square()
    along = (range_m.square() - beside).clamp(min=0).sqrt() - ahead
    points = origins + along.unsqueeze(-1) * directions
    return torch.where(range_m.unsqueeze(-1) > 0, points, 0.0)


def share_kept(points: Tensor, projection: Projection) -> float:
    """Share of the points ``(P, 3)`` within the range limits that an image gives back."""
    inside = in_range(points, projection.sensor)
    range_m, _ = range_image(points, projection)
    return int((range_m > 0).sum()) / max(int(inside.sum()), 1)


def describe_share_kept(scans: Sequence[Tensor], projection: Projection) -> str:
    """Return the mean of :func:`share_kept` over scans ``(P, 3)``, in a line."""
    share = sum(share_kept(points, projection) for points in scans) / len(scans)
    size = f"{projection.sensor.beams} x {projection.sensor.columns}"
    noun = "scan" if len(scans) == 1 else "scans"
    return (
        f"{share:.1%} of the points of {len(scans)} {noun} within the range limits come back from "
        f"the range image of {size}"
    )


def points_of(
    range_m: Tensor, projection: Projection, corner: bool = False, intensity: Tensor | None = None
) -> Tensor:
    """Points of the pixels ``(H, W)`` that hold a return, row after row.

    They are ``(P, 3)`` metres, or ``(P, 4)`` with the ``intensity`` ``(H, W)`` of the pixels.
    A row is in the order of the image, or for rings in the order of a scan, whose azimuth grows
    from 0, so that a written file can be read with the same projection. Otherwise as
    :func:`unproject`.
    """
    points = unproject(range_m, projection, corner)
    if intensity is not None:
        points = torch.cat([points, intensity[..., None].to(points)], dim=-1)
    return values_at_returns(points, range_m, projection)


def values_at_returns(values: Tensor, range_m: Tensor, projection: Projection) -> Tensor:
    """Values ``(P, ...)`` of the pixels with a return, in the order of :func:`points_of`.

    Args:
        values: ``(H, W, ...)`` anything known per pixel.
        range_m: ``(H, W)`` metres, not positive without a return.
        projection: Gives the order of the columns.
    """
    if range_m.ndim != 2:
        raise ValueError(f"images must be (H, W), one by one, got {tuple(range_m.shape)}")
    columns = projection.column_order().to(range_m.device)
    return values[:, columns][range_m[:, columns] > 0]


def pool_cells(
    points: Tensor,
    values: Tensor,
    projection: Projection,
    grid_size: tuple[int, int] = (8, 64),
    range_filter: bool = True,
) -> tuple[Tensor, Tensor]:
    """Mean of point values over the cells of a coarse grid laid over the range image.

    A cell is a block of pixels, so that an image and a grid of one projection never disagree.
    Sums of up to 32 points are formed in float32 and added in float64: a mean is off by at most
    33 * 2^-24 of the mean absolute value in its cell. The result does not depend on threads.

    Args:
        points: ``(P, 3)`` metres.
        values: ``(P, F)`` floating point, for example features.
        projection: Which pixel a point belongs to.
        grid_size: ``(h, w)`` cells, dividing H and W.
        range_filter: Drop points outside the range limits, as the image does. The official
            feature grids keep them.

    Returns:
        ``means`` ``(h * w, F)`` float32 (float64 for float64 values), row after row, zeros in
        empty cells, and ``counts`` ``(h * w,)`` int64. Points that are not finite never count.

    Raises:
        ValueError: If the grid does not divide the image, or the shapes are not those above.
    """
    check_points(points)
    if points.ndim != 2 or values.ndim != 2 or len(values) != len(points):
        raise ValueError(
            "points must be (P, 3) and values (P, F), got "
            f"{tuple(points.shape)} and {tuple(values.shape)}"
        )
    projection.sensor.cell_size(grid_size)  # refuses a grid before points are projected
    kept = in_range(points, projection.sensor) if range_filter else points.isfinite().all(dim=-1)
    cell = projection.sensor.cell_of(*projection.pixel_of(points), grid_size)
    num_cells = math.prod(grid_size)
    # Points that do not count have a cell of their own: leaving them out would copy all values.
    cell = torch.where(kept, cell, num_cells)

    means, counts = pool_by_cell(cell, values, num_cells + 1)
    return means[:num_cells], counts[:num_cells]


def pool_by_cell(cell: Tensor, values: Tensor, num_cells: int) -> tuple[Tensor, Tensor]:
    """Mean of values over cells, formed as in :func:`pool_cells`.

    Args:
        cell: ``(P,)`` int64 number of the cell of each value, in ``[0, num_cells)``.
        values: ``(P, F)`` floating point.
        num_cells: Number of cells.

    Returns:
        ``means`` ``(num_cells, F)`` and ``counts`` ``(num_cells,)``, zeros in empty cells.
    """
    counts = torch.bincount(cell, minlength=num_cells)
    num_bags = (counts + _BAG - 1) // _BAG
    bag_cell = torch.repeat_interleave(num_bags)
    place = (
        torch.arange(len(bag_cell), device=cell.device) - (num_bags.cumsum(0) - num_bags)[bag_cell]
    )
    first = (counts.cumsum(0) - counts)[bag_cell] + place * _BAG
    values = values.to(torch.promote_types(values.dtype, torch.float32))
    bags = embedding_bag(cell.argsort(stable=True), values, first, mode="sum").double()
    sums = bags.new_zeros(num_cells, values.shape[1])
    if bags.is_cuda:  # sorts: index_add_ would add in another order on every run
        sums.index_put_((bag_cell,), bags, accumulate=True)
    else:
        sums.index_add_(0, bag_cell, bags)
    means = sums / counts.clamp(min=1).unsqueeze(-1)
    return means.to(values.dtype), counts


def _inside_limits(distance: Tensor, sensor: LidarSensor) -> Tensor:
    return (distance > sensor.range_min_m) & (distance < sensor.range_max_m)

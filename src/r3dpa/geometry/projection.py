"""Points to pixels and back; nearest-return images; pooling of point values into cells.

Axes are x forward, y left, z up, in metres, with the sensor at the origin. Row 0 is the
highest beam. Column 0 looks backwards, columns run clockwise seen from above, and the centre
column looks along +x.
Letters: B batch, P points, H beams, W columns, h x w cells, F feature width.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import torch
from torch import Tensor

from r3dpa.geometry.range_codec import EMPTY_RANGE_M
from r3dpa.geometry.rings import match_in_order, mean_per_ring, rings_in_order
from r3dpa.geometry.sensor import LidarSensor

_POOL_CHUNK = 8192  # points whose values are held in float64 at a time


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
    """

    sensor: LidarSensor
    legacy_seam: bool = False

    def pixel_of(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Row and column of the range-image pixel that each point falls into.

        Computed in float64: arcsin and float32 lose up to 4e-4 rad towards the zenith.

        Args:
            points: ``(..., 3)`` metres. A point that is not finite counts as the origin.

        Returns:
            ``(row, column)``, each ``(...)`` int64, in ``[0, H)`` and ``[0, W)``.

        Raises:
            ValueError: If the last axis of ``points`` is not of size 3.

        Example:
            >>> projection = SphericalProjection(LidarSensor())
            >>> row, column = projection.pixel_of(torch.tensor([10.0, 0.0, 0.0]))
            >>> row.item(), column.item()
            (6, 512)
        """
        inclination, azimuth = _ray_angles_of(points)
        sensor = self.sensor
        pitch = (sensor.inclination_max_rad - sensor.inclination_min_rad) / sensor.beams
        row = ((sensor.inclination_max_rad - inclination) / pitch).floor().long()
        column = _column_of(azimuth, sensor.columns, self.legacy_seam)
        return row.clamp(0, sensor.beams - 1), column

    def ray_angles(self, corner: bool = False) -> tuple[Tensor, Tensor]:
        """Inclination of each row and azimuth of each column.

        Args:
            corner: Take the upper left corner of the pixel, not its centre.

        Returns:
            ``(H,)`` and ``(W,)`` radians, float64.
        """
        sensor = self.sensor
        pitch = (sensor.inclination_max_rad - sensor.inclination_min_rad) / sensor.beams
        rows = torch.arange(sensor.beams, dtype=torch.float64) + _pixel_offset(corner)
        return sensor.inclination_max_rad - pitch * rows, _column_azimuths(sensor.columns, corner)

    def ray_directions(
        self,
        corner: bool = False,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> Tensor:
        """Unit vector along the ray of each pixel.

        Args:
            corner: Take the upper left corner of the pixel, not its centre. The official code
                does, which turns points by half a pixel (0.22 degrees up, 0.18 sideways).
            dtype: Of the result.
            device: Of the result.

        Returns:
            ``(H, W, 3)``, a fresh tensor.
        """
        return _ray_directions(self, corner, dtype, torch.device(device)).clone()


@dataclass(frozen=True)
class RingProjection:
    """One row per laser ring ("scan unfolding") for scans stored ring after ring.

    The lasers of a real sensor neither start at one point nor have one pitch, so that rows of
    equal pitch leave many pixels empty; one row per laser fills them. The ring of a point
    follows from its place in the file: the azimuth of the returns runs through one turn per
    ring. Columns are those of :class:`SphericalProjection`. A point clipped off the vertical
    field of view cannot exist here; the inclination limits of the sensor only tell scans in
    ring order from others.

    Source: Triess et al., "Scan-based Semantic Segmentation of LiDAR Point Clouds" (IV 2020).

    Args:
        sensor: Image size and range limits.
        ring_inclinations_deg: H inclinations, first row first, degrees above the horizon; see
            :meth:`fit`.

    Raises:
        ValueError: If there are not H inclinations, or one is outside [-90, 90].
    """

    sensor: LidarSensor
    ring_inclinations_deg: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check the inclinations; a list, as YAML gives it, would not be hashable."""
        object.__setattr__(self, "ring_inclinations_deg", tuple(self.ring_inclinations_deg))
        if len(self.ring_inclinations_deg) != self.sensor.beams:
            raise ValueError(
                f"a sensor of {self.sensor.beams} beams needs as many ring inclinations, "
                f"got {len(self.ring_inclinations_deg)}"
            )
        if not all(-90.0 <= angle <= 90.0 for angle in self.ring_inclinations_deg):
            raise ValueError(
                f"ring inclinations must lie in [-90, 90] degrees, got {self.ring_inclinations_deg}"
            )

    @classmethod
    def fit(cls, scans: Iterable[Tensor], sensor: LidarSensor) -> Self:
        """Projection whose ring inclinations are the medians measured in real scans.

        Scans in which another number of rings than H is seen (a laser without any return) do
        not tell which laser is which, and are left out.

        Args:
            scans: Each ``(P, 3)`` metres, points in the order of the file.
            sensor: Image size, range limits and field of view.

        Returns:
            The fitted projection.

        Raises:
            ValueError: If a scan is not stored ring after ring, or none shows H rings.
        """
        measured: list[list[Tensor]] = [[] for _ in range(sensor.beams)]
        counts_seen = []
        for scan in scans:
            returns = scan[_is_return(scan, sensor)]
            inclination, azimuth = _ray_angles_of(returns)
            ring, num_rings = rings_in_order(inclination, azimuth, sensor)
            counts_seen.append(num_rings)
            if num_rings == sensor.beams:
                for index, values in enumerate(measured):
                    values.append(inclination[ring == index])
        if not measured[0]:
            raise ValueError(
                f"no scan shows the {sensor.beams} rings of the sensor; rings found per scan: "
                f"{counts_seen}. Give more scans, or a sensor with another number of beams"
            )
        medians = torch.stack([torch.cat(values).median() for values in measured])
        return cls(sensor, tuple(medians.rad2deg().tolist()))

    def pixel_of(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Row and column of the range-image pixel that each point of whole scans falls into.

        Where fewer than H rings are found they are matched in order to the known inclinations;
        fewer than H returns go to the nearest inclinations one by one.

        Args:
            points: ``(P, 3)`` or ``(B, P, 3)`` metres, each scan whole and in the order of the
                file. Points that are not finite (padding) or not beyond the shortest range take
                no part in the search for rings and get pixel (0, 0).

        Returns:
            ``(row, column)``, each ``(P,)`` or ``(B, P)`` int64, in ``[0, H)`` and ``[0, W)``.

        Raises:
            ValueError: If a scan is not stored ring after ring, shows more than H rings, or if
                ``points`` has another shape.
        """
        if points.ndim == 3:
            pixels = [self.pixel_of(scan) for scan in points]
            if not pixels:
                empty = torch.zeros(points.shape[:2], dtype=torch.int64, device=points.device)
                return empty, empty
            rows, columns = zip(*pixels, strict=True)
            return torch.stack(rows), torch.stack(columns)
        if points.ndim != 2:
            raise ValueError(
                f"points must be (P, 3) or (B, P, 3) whole scans, got shape {tuple(points.shape)}"
            )
        is_return = _is_return(points, self.sensor)
        inclination, azimuth = _ray_angles_of(points[is_return])
        row = torch.zeros(len(points), dtype=torch.int64, device=points.device)
        column = torch.zeros_like(row)
        column[is_return] = _column_of(azimuth, self.sensor.columns)
        row[is_return] = self._beam_of(inclination, azimuth)
        return row, column

    def ray_angles(self, corner: bool = False) -> tuple[Tensor, Tensor]:
        """Inclination of each row and azimuth of each column.

        Args:
            corner: Take the left border of the column, not its centre. A ring has no corner.

        Returns:
            ``(H,)`` and ``(W,)`` radians, float64.
        """
        return self._inclinations(), _column_azimuths(self.sensor.columns, corner)

    def ray_directions(
        self,
        corner: bool = False,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> Tensor:
        """Unit vector along the ray of each pixel.

        Args:
            corner: Take the left border of the column, not its centre. A ring has no corner.
            dtype: Of the result.
            device: Of the result.

        Returns:
            ``(H, W, 3)``, a fresh tensor.
        """
        return _ray_directions(self, corner, dtype, torch.device(device)).clone()

    def _beam_of(self, inclination: Tensor, azimuth: Tensor) -> Tensor:
        beams, known = self.sensor.beams, self._inclinations()
        if len(inclination) < beams:  # too few for turns of the azimuth to show
            return (inclination.unsqueeze(-1) - known.to(inclination.device)).abs().argmin(dim=-1)
        ring, num_rings = rings_in_order(inclination, azimuth, self.sensor)
        if num_rings > beams:
            raise ValueError(
                f"the scan shows {num_rings} rings but the sensor has {beams} beams; "
                "check that the scan is complete and the sensor is the right one"
            )
        if num_rings == beams:
            return ring
        measured = mean_per_ring(inclination, ring, num_rings)
        return match_in_order(measured, known).to(ring.device)[ring]

    def _inclinations(self) -> Tensor:
        return torch.tensor(self.ring_inclinations_deg, dtype=torch.float64).deg2rad()


Projection = SphericalProjection | RingProjection


def in_range(points: Tensor, sensor: LidarSensor) -> Tensor:
    """Whether each point is finite and strictly inside the range limits.

    Args:
        points: ``(..., 3)`` metres.
        sensor: Its range limits, both exclusive.

    Returns:
        ``(...)`` bool.

    Raises:
        ValueError: If the last axis of ``points`` is not of size 3.
    """
    _check_points(points)
    return _inside_limits(_range_of(points), sensor)


def range_image(
    points: Tensor, projection: Projection, values: Tensor | None = None
) -> tuple[Tensor, Tensor | None]:
    """Range image of the nearest return in each pixel.

    Points outside the range limits and points that are not finite are dropped; rows of NaN can
    therefore pad scans to one length. Of points at equal distance the first one wins, so the
    result is the same on every run and device.

    Args:
        points: ``(P, 3)`` or ``(B, P, 3)`` metres.
        projection: Which pixel a point belongs to.
        values: ``(P, F)`` or ``(B, P, F)`` anything known per point, for example intensity.

    Returns:
        ``range_m`` ``(H, W)`` or ``(B, H, W)`` float32, ``EMPTY_RANGE_M`` without a return, and
        the values of the nearest returns ``(F, H, W)`` or ``(B, F, H, W)``, 0 without a return,
        or None.

    Raises:
        ValueError: If the shapes of ``points`` and ``values`` are not those above.
    """
    _check_points(points)
    if points.ndim not in (2, 3):
        raise ValueError(f"points must be (P, 3) or (B, P, 3), got shape {tuple(points.shape)}")
    if values is not None and (
        values.ndim != points.ndim or values.shape[:-1] != points.shape[:-1]
    ):
        raise ValueError(
            f"values must be (..., P, F) beside points (..., P, 3), got {tuple(values.shape)} "
            f"beside {tuple(points.shape)}"
        )
    beams, columns = projection.sensor.beams, projection.sensor.columns
    leading = points.shape[:-2]
    distance = _range_of(points)
    kept = _inside_limits(distance, projection.sensor)
    row, column = projection.pixel_of(points)
    pixel = row * columns + column
    distance = torch.where(kept, distance, math.inf)

    nearest = distance.new_full((*leading, beams * columns), math.inf)
    nearest = nearest.scatter_reduce(-1, pixel, distance, "amin")
    empty = nearest.isinf()
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
        ValueError: If the image is not of the size of the sensor.
    """
    sensor = projection.sensor
    if range_m.shape[-2:] != (sensor.beams, sensor.columns):
        raise ValueError(
            f"range image must be (..., {sensor.beams}, {sensor.columns}) for this sensor, "
            f"got shape {tuple(range_m.shape)}"
        )
    directions = _ray_directions(projection, corner, range_m.dtype, range_m.device)
    return range_m.clamp(min=0).unsqueeze(-1) * directions


def points_of(range_m: Tensor, projection: Projection, corner: bool = False) -> Tensor:
    """Points of the pixels that hold a return, row after row.

    Args:
        range_m: ``(H, W)`` metres, not positive without a return.
        projection: Which ray a pixel stands for.
        corner: Use the corner of the pixel as the official code does, not its centre.

    Returns:
        ``(P, 3)`` metres, in the dtype of ``range_m``.

    Raises:
        ValueError: If the image is batched or not of the size of the sensor.
    """
    if range_m.ndim != 2:
        raise ValueError(
            f"range image must be (H, W), got shape {tuple(range_m.shape)}; scans differ in their "
            "number of points, so take them one by one"
        )
    return unproject(range_m, projection, corner)[range_m > 0]


def pool_cells(
    points: Tensor,
    values: Tensor,
    projection: Projection,
    grid_size: tuple[int, int] = (8, 64),
    range_filter: bool = True,
) -> tuple[Tensor, Tensor]:
    """Mean of point values over the cells of a coarse grid laid over the range image.

    A cell is a block of pixels, so that an image and a grid of one projection never disagree.
    Sums are formed in float64.

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
    _check_points(points)
    if points.ndim != 2 or values.ndim != 2 or len(values) != len(points):
        raise ValueError(
            "points must be (P, 3) and values (P, F), got "
            f"{tuple(points.shape)} and {tuple(values.shape)}"
        )
    sensor = projection.sensor
    grid_rows, grid_columns = grid_size
    if sensor.beams % grid_rows or sensor.columns % grid_columns:
        raise ValueError(
            f"a grid of {grid_rows} x {grid_columns} cells does not divide the "
            f"{sensor.beams} x {sensor.columns} range image"
        )
    kept = in_range(points, sensor) if range_filter else points.isfinite().all(dim=-1)
    row, column = projection.pixel_of(points)
    cell_row = row[kept] // (sensor.beams // grid_rows)
    cell = cell_row * grid_columns + column[kept] // (sensor.columns // grid_columns)
    values = values[kept]

    counts = torch.bincount(cell, minlength=grid_rows * grid_columns)
    sums = values.new_zeros((len(counts), values.shape[1]), dtype=torch.float64)
    for start in range(0, len(values), _POOL_CHUNK):
        part = slice(start, start + _POOL_CHUNK)
        sums.index_add_(0, cell[part], values[part].double())
    means = sums / counts.clamp(min=1).unsqueeze(-1)
    return means.to(torch.promote_types(values.dtype, torch.float32)), counts


def _check_points(points: Tensor) -> None:
    if points.ndim < 1 or points.shape[-1] != 3:
        raise ValueError(f"points must be (..., 3) x, y, z, got shape {tuple(points.shape)}")


def _range_of(points: Tensor) -> Tensor:
    """Distance from the sensor, correctly rounded float32; not finite for such points."""
    return torch.linalg.vector_norm(points.double(), dim=-1).float()


def _inside_limits(distance: Tensor, sensor: LidarSensor) -> Tensor:
    return (distance > sensor.range_min_m) & (distance < sensor.range_max_m)


def _is_return(points: Tensor, sensor: LidarSensor) -> Tensor:
    """Points that may show a ring: files hold dummies at the origin, and padding is NaN."""
    _check_points(points)
    distance = _range_of(points)
    return distance.isfinite() & (distance > sensor.range_min_m)


def _ray_angles_of(points: Tensor) -> tuple[Tensor, Tensor]:
    """Inclination and azimuth of points, float64 radians; 0, 0 where not finite."""
    _check_points(points)
    finite = points.isfinite().all(dim=-1, keepdim=True)
    x, y, z = torch.where(finite, points.double(), 0.0).unbind(-1)
    return torch.atan2(z, torch.hypot(x, y)), torch.atan2(y, x)


def _column_of(azimuth: Tensor, columns: int, legacy_seam: bool = False) -> Tensor:
    column = ((math.pi - azimuth) / (2 * math.pi) * columns).floor().long()
    return column.clamp(max=columns - 1) if legacy_seam else column % columns


def _pixel_offset(corner: bool) -> float:
    return 0.0 if corner else 0.5


def _column_azimuths(columns: int, corner: bool) -> Tensor:
    index = torch.arange(columns, dtype=torch.float64) + _pixel_offset(corner)
    return math.pi - index * (2 * math.pi / columns)


@lru_cache(maxsize=16)
def _ray_directions(
    projection: Projection, corner: bool, dtype: torch.dtype, device: torch.device
) -> Tensor:
    # A tensor made in inference mode could never take part in a backward pass again.
    with torch.inference_mode(False):
        inclination, azimuth = projection.ray_angles(corner)
        inclination, azimuth = torch.meshgrid(inclination, azimuth, indexing="ij")
        horizontal = inclination.cos()
        directions = torch.stack(
            [horizontal * azimuth.cos(), horizontal * azimuth.sin(), inclination.sin()], dim=-1
        )
        return directions.to(device=device, dtype=dtype)

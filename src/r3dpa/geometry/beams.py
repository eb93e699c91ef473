"""One row per beam of a sensor whose beams are known: any spinning LiDAR, without loss of points.

Letters: B batch, P points, H beams, W columns. All angles counter-clockwise, seen from above.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from lidarsim.sensors.files import load_sensor
from lidarsim.sensors.spinning import SpinningLidar
from lidarsim.sensors.view import LidarSensor
from r3dpa.geometry.sensor import angles_of, check_points, column_azimuths

_POINTS_AT_ONCE = 4096
_MOST_MOVED = 4  # columns, by which points move apart
_ROWS_MULTIPLE = 16  # of images, which networks halve several times
_TABLES = ("inclination_deg", "height_m", "lateral_m", "azimuth_shift_deg")


@dataclass(frozen=True)
class BeamProjection:
    """One row per beam, each with its inclination, optical centre and azimuth of the columns.

    The beam of a point is the one whose line is nearest, so that neither the order of the
    points nor a ring column matters; a beam starts ``height_m`` above the origin. The column
    follows from the azimuth seen from the optical centre, ``lateral_m`` to the left of the beam::

        row    = argmin over beams |(z - height) cos(inclination) - distance sin(inclination)|
        column = floor(W * (pi - azimuth + asin(lateral / distance) + shift) / (2 * pi)) mod W

    with the distance in the horizontal plane. Columns as in :class:`SphericalProjection`, shifted
    by less than half a column per beam, so that shots fall into the middle of a column where the
    image has a column per shot. There, points that share a column move apart, up to four columns,
    as the head of a real sensor turns unevenly.

    Args:
        sensor: Image size, field of view and range limits.
        inclination_deg: H falling inclinations, degrees above the horizon.
        height_m: H heights of the optical centres above the origin.
        lateral_m: H distances of the optical centres to the left of the beam.
        azimuth_shift_deg: H azimuths of the column centres, as differences from the usual ones.
        one_per_column: Move points of a beam apart that share a column. Only for images with a
            column per shot: with fewer, holes in a scan would be filled.

    Example:
        >>> projection = BeamProjection.of("vlp16", columns=1800)
        >>> row, column = projection.pixel_of(torch.tensor([[10.0, 0.0, 0.0]]))
        >>> row.tolist(), projection.sensor.beams
        ([7], 16)
    """

    sensor: LidarSensor
    inclination_deg: tuple[float, ...]
    height_m: tuple[float, ...]
    lateral_m: tuple[float, ...]
    azimuth_shift_deg: tuple[float, ...]
    one_per_column: bool = False
    legacy_hiding: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for name in _TABLES:
            table = tuple(getattr(self, name))  # a list, as YAML gives it, would not be hashable
            object.__setattr__(self, name, table)
            if len(table) != self.sensor.beams:
                raise ValueError(
                    f"a sensor of {self.sensor.beams} beams needs as many {name}, got {len(table)}"
                )

    @classmethod
    def of(
        cls, model: str | Path | SpinningLidar, columns: int | None = None, rows: int | None = None
    ) -> Self:
        """Projection of a sensor.

        Args:
            model: Sensor, or what :func:`lidarsim.load_sensor` takes: a preset or a YAML file.
            columns: Columns W of the image; default: the shots of a turn.
            rows: Rows H of the image; default: the beams. Further rows lie below and stay empty.
        """
        lidar = model if isinstance(model, SpinningLidar) else load_sensor(model)
        view = LidarSensor.of(lidar, columns, rows)
        lasers, num_further = lidar.lasers, view.beams - lidar.num_beams
        inclination = np.degrees(lasers.inclination_rad)
        pitch_deg = view.field_of_view_rad / view.beams * 180 / math.pi
        below = inclination[-1] - pitch_deg * np.arange(1, num_further + 1)
        step = 2 * math.pi / view.columns
        shift = np.zeros(lidar.num_beams)
        if view.columns == lidar.shots:
            from_border = (np.array(lasers.azimuth_offset_rad) - math.pi + step / 2) % step
            shift = np.where(from_border > step / 2, from_border - step, from_border)
        tables = {
            "inclination_deg": np.concatenate([inclination, below]),
            "height_m": _continued(lasers.height_m, num_further),
            "lateral_m": _continued(lasers.lateral_m, num_further),
            "azimuth_shift_deg": np.degrees(_continued(shift, num_further)),
        }
        rounded = {name: tuple(np.round(table, 6).tolist()) for name, table in tables.items()}
        return cls(view, **rounded, one_per_column=view.columns >= lidar.shots)

    @classmethod
    def for_networks(cls, model: str | Path | SpinningLidar, columns: int = 1024) -> Self:
        """Projection of a sensor to images whose rows are a multiple of 16, see :meth:`of`."""
        num_beams = LidarSensor.of(model).beams
        return cls.of(model, columns, math.ceil(num_beams / _ROWS_MULTIPLE) * _ROWS_MULTIPLE)

    def pixel_of(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Row and column of the pixel that each point falls into.

        Args:
            points: ``(..., 3)`` metres; with ``one_per_column`` ``(P, 3)`` or ``(B, P, 3)``, whole
                scans. A point that is not finite counts as the origin.

        Returns:
            ``(row, column)``, each ``(...)`` int64, in ``[0, H)`` and ``[0, W)``.
        """
        check_points(points)
        finite = points.isfinite().all(dim=-1, keepdim=True)
        x, y, z = torch.where(finite, points.double(), 0.0).unbind(-1)
        distance_m = torch.hypot(x, y)
        row = self._beam_of(distance_m, z)
        place = self._place(row, angles_of(points)[1], distance_m)
        if not self.one_per_column:
            return row, place.floor().long() % self.sensor.columns
        range_m = torch.hypot(distance_m, z)
        counts = (range_m > self.sensor.range_min_m) & (range_m < self.sensor.range_max_m)
        if points.ndim == 2:
            return row, self._spread(row, place, counts)
        scans = (part.reshape(-1, points.shape[-2]) for part in (row, place, counts))
        columns = [self._spread(*scan) for scan in zip(*scans, strict=True)]
        return row, torch.stack(columns).view_as(row)

    def ray_angles(self, corner: bool = False) -> tuple[Tensor, Tensor]:
        """Inclination ``(H,)`` and azimuth ``(W,)`` of the columns, radians, without the shifts.

        ``corner``: left column borders.
        """
        return self._table("inclination_deg").deg2rad(), column_azimuths(
            self.sensor.columns, corner
        )

    def directions(self, corner: bool = False) -> Tensor:
        """Unit vectors ``(H, W, 3)`` along the beams, float64."""
        inclination, azimuth = self.ray_angles(corner)
        azimuth = azimuth + self._table("azimuth_shift_deg").deg2rad()[:, None]
        level, up = inclination.cos()[:, None], inclination.sin()[:, None]
        return torch.stack(
            [level * azimuth.cos(), level * azimuth.sin(), up.expand_as(azimuth)], dim=-1
        )

    def origins(self, corner: bool = False) -> Tensor:
        """Optical centres ``(H, W, 3)`` from which the beams start, float64 metres."""
        azimuth = self.ray_angles(corner)[1] + self._table("azimuth_shift_deg").deg2rad()[:, None]
        lateral_m = self._table("lateral_m")[:, None]
        height_m = self._table("height_m")[:, None].expand_as(azimuth)
        return torch.stack([-lateral_m * azimuth.sin(), lateral_m * azimuth.cos(), height_m], -1)

    def mirrored_columns(self) -> Tensor:
        """Columns ``(H,)`` int64 by which the rows of a mirrored image move to the right.

        A beam that is turned by a part of a column to one side is turned to the other in a mirror.
        """
        step_deg = 360 / self.sensor.columns
        return (2 * self._table("azimuth_shift_deg") / step_deg).round().long()

    def column_order(self) -> Tensor:
        """Columns ``(W,)`` int64 in the order in which the points of a row are listed."""
        return torch.arange(self.sensor.columns)

    def _table(self, name: str) -> Tensor:
        return torch.tensor(getattr(self, name), dtype=torch.float64)

    def _beam_of(self, distance_m: Tensor, z_m: Tensor) -> Tensor:
        """Beam ``(...)`` whose line is nearest: in metres, which all have one factor to angles."""
        inclination = self._table("inclination_deg").deg2rad()
        lines = torch.stack(
            [
                inclination.cos(),
                -inclination.sin(),
                -inclination.cos() * self._table("height_m"),
            ]
        ).to(z_m.device)
        places = torch.stack([z_m, distance_m, torch.ones_like(z_m)], dim=-1)
        parts = places.reshape(-1, 3).split(_POINTS_AT_ONCE)
        nearest = torch.cat([(part @ lines).abs_().min(dim=1).indices for part in parts])
        return nearest.view(z_m.shape)

    def _place(self, row: Tensor, azimuth: Tensor, distance_m: Tensor) -> Tensor:
        """Place ``(...)`` of points along the columns: 0.5 in the middle of column 0."""
        lateral_m = self._table("lateral_m").to(row.device)[row]
        shift = self._table("azimuth_shift_deg").deg2rad().to(row.device)[row]
        sine = (lateral_m / distance_m.clamp(min=1e-9)).clamp(-1, 1)
        turned = math.pi - azimuth + sine.asin() + shift
        return turned / (2 * math.pi) * self.sensor.columns

    def _spread(self, row: Tensor, place: Tensor, counts: Tensor) -> Tensor:
        """Columns ``(P,)`` of a scan, one per point as far as points need not move far for it.

        In the order of the azimuth, a point is moved on where its column is taken, or back from the
        last point; halfway between both, columns still differ. Points that would move farther than
        ``_MOST_MOVED`` columns keep theirs, as where a scan is more than a turn. Points that do not
        count, outside the range limits, take no column.
        """
        columns = place.floor().long()
        used = counts.nonzero().flatten()
        order = used[_lexsort(row[used], place[used] % self.sensor.columns)]
        wanted, beam = columns[order] % self.sensor.columns, row[order]
        apart = beam * 4 * (self.sensor.columns + len(order))  # beams do not push each other
        number = torch.arange(len(order), device=row.device)
        gap = wanted - number + apart
        forward = gap.cummax(0).values
        backward = gap.flip(0).cummin(0).values.flip(0)
        moved = torch.div(forward + backward - 2 * apart, 2, rounding_mode="floor") + number
        is_near = (moved - wanted).abs() <= _MOST_MOVED
        columns[order] = torch.where(is_near, moved, wanted)
        return columns % self.sensor.columns


def _continued(table: tuple[float, ...] | np.ndarray, num_further: int) -> np.ndarray:
    """Table ``(H,)`` with its last value repeated."""
    return np.append(table, np.full(num_further, table[-1]))


def _lexsort(first: Tensor, second: Tensor) -> Tensor:
    """Order by ``first``, and by ``second`` where it is equal."""
    order = second.argsort(stable=True)
    return order[first[order].argsort(stable=True)]

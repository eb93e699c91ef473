"""The LiDAR sensor, range and angles of points, and the columns of pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

EMPTY_RANGE_M = -1.0  # a pixel without a return


@dataclass(frozen=True)
class LidarSensor:
    """Size of the range image, vertical field of view and range limits of a spinning LiDAR.

    The defaults are the ones R3DPA uses for the HDL-64E of KITTI-360.

    Args:
        beams: Rows H of the range image.
        columns: Columns W of the range image, one turn of the sensor.
        inclination_max_deg: Upper border of the first row, degrees above the horizon.
        inclination_min_deg: Lower border of the last row, degrees above the horizon.
        range_min_m: Points at this distance or nearer are dropped, metres.
        range_max_m: Points at this distance or farther are dropped, metres.
    """

    beams: int = 64
    columns: int = 1024
    inclination_max_deg: float = 3.0
    inclination_min_deg: float = -25.0
    range_min_m: float = 1.0
    range_max_m: float = 56.0

    def __post_init__(self) -> None:
        if self.beams < 1 or self.columns < 1:
            raise ValueError(
                "a sensor needs at least one beam and one column, "
                f"got beams={self.beams}, columns={self.columns}"
            )
        if not -90.0 <= self.inclination_min_deg < self.inclination_max_deg <= 90.0:
            raise ValueError(
                "the vertical field of view must satisfy -90 <= min < max <= 90 degrees, got "
                f"inclination_min_deg={self.inclination_min_deg}, "
                f"inclination_max_deg={self.inclination_max_deg}"
            )
        if not 0.0 <= self.range_min_m < self.range_max_m < math.inf:
            raise ValueError(
                "the range limits must satisfy 0 <= min < max < infinity metres, got "
                f"range_min_m={self.range_min_m}, range_max_m={self.range_max_m}"
            )

    def cell_size(self, grid_size: tuple[int, int]) -> tuple[int, int]:
        """Rows and columns of pixels in one cell of a grid ``(rows, columns)``."""
        rows, columns = grid_size
        if rows < 1 or columns < 1 or self.beams % rows or self.columns % columns:
            raise ValueError(
                f"a grid of {rows} x {columns} cells does not divide the "
                f"{self.beams} x {self.columns} range image"
            )
        return self.beams // rows, self.columns // columns

    @property
    def inclination_max_rad(self) -> float:
        """Upper border of the first row, radians."""
        return math.radians(self.inclination_max_deg)

    @property
    def field_of_view_rad(self) -> float:
        """Height of the vertical field of view, radians."""
        return self.inclination_max_rad - math.radians(self.inclination_min_deg)


def check_points(points: Tensor) -> None:
    """Refuse points whose last axis is not x, y, z with a ValueError."""
    if points.ndim < 1 or points.shape[-1] != 3:
        raise ValueError(f"points must be (..., 3) x, y, z, got shape {tuple(points.shape)}")


def range_of(points: Tensor) -> Tensor:
    """Distance from the sensor, correctly rounded float32; not finite for such points."""
    return torch.linalg.vector_norm(points.double(), dim=-1).float()


def angles_of(points: Tensor) -> tuple[Tensor, Tensor]:
    """Inclination and azimuth of points, float64 radians; 0, 0 where not finite."""
    check_points(points)
    finite = points.isfinite().all(dim=-1, keepdim=True)
    x, y, z = torch.where(finite, points.double(), 0.0).unbind(-1)
    return torch.atan2(z, torch.hypot(x, y)), torch.atan2(y, x)


def column_of(azimuth: Tensor, columns: int, legacy_seam: bool = False) -> Tensor:
    """Column of an azimuth in radians, int64; column 0 looks backwards."""
    column = ((math.pi - azimuth) / (2 * math.pi) * columns).floor().long()
    return column.clamp(max=columns - 1) if legacy_seam else column % columns


def column_azimuths(columns: int, corner: bool) -> Tensor:
    """Azimuth ``(W,)`` of the centres or left borders of the columns, float64 radians."""
    index = torch.arange(columns, dtype=torch.float64) + (0.0 if corner else 0.5)
    return math.pi - index * (2 * math.pi / columns)

"""Range and angles of points as tensors, and the columns of pixels."""

from __future__ import annotations

import math

import torch
from torch import Tensor

EMPTY_RANGE_M = -1.0  # a pixel without a return


def check_points(points: Tensor) -> None:
    """Refuse points that are no tensor, or whose last axis is not x, y, z, with a ValueError."""
    if not isinstance(points, Tensor):
        raise ValueError(
            f"points must be a tensor, got {type(points).__name__}; torch.from_numpy makes one of "
            "an array"
        )
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

"""Ground below a recorded scan: one robust plane per sector."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from r3dpa.weather.rings import angles

_SECTORS = 12
# Rings of each sector, by their borders in metres: slopes change with the distance.
_BORDERS_M = (0.0, 12.0, 25.0, np.inf)
# The lowest points of cells of this length, by this quantile, start the fit.
_CELL_M, _LOWEST = 2.0, 0.1
# Distances from the plane of the points that the fits use, one after the other; the last is that
# of the ground, to which the spread of far points is added.
_WITHIN_M, _FAR_SHARE = (1.0, 0.5, 0.3, 0.2, 0.15), 0.003
_LEAST_POINTS = 20
_LEVEL_COS = 0.95  # steeper planes are no ground
_STEP_M = 0.6  # between the plane of a sector and the one of the whole scan, beside 5 % of slope


def ground_of(points: NDArray[np.float32]) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Which points are ground ``(P,)``, and the upright normal ``(P, 3)`` of their sector's plane.

    Planes are fitted by least squares to the lowest points of cells, then again and again to the
    points ever nearer to the plane. A sector whose plane is steep, far from that of the whole scan
    or of few points has that of the whole scan.
    """
    _, azimuth = angles(points)
    away_m = np.hypot(points[:, 0], points[:, 1])
    sector = (azimuth / (2 * np.pi) * _SECTORS).astype(int) % _SECTORS
    ring = np.searchsorted(_BORDERS_M[1:-1], away_m)
    lowest = _lowest(points, sector, away_m)
    everywhere = _plane(points[away_m < _BORDERS_M[-2]], points[lowest])
    planes = np.tile(everywhere, (_SECTORS, len(_BORDERS_M) - 1, 1))
    for part in np.ndindex(planes.shape[:2]):
        inside = (sector == part[0]) & (ring == part[1])
        if inside.sum() >= _LEAST_POINTS:
            plane = _plane(points[inside], points[inside & lowest], everywhere)
            middle = points[inside].mean(axis=0)
            step_m = abs(_height(plane, middle) - _height(everywhere, middle))
            if step_m < _STEP_M + 0.05 * np.hypot(middle[0], middle[1]):
                planes[part] = plane
    plane = planes[sector, ring]
    normal = np.stack([-plane[:, 0], -plane[:, 1], np.ones(len(points))], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    above_m = points[:, 2] - plane[:, 0] * points[:, 0] - plane[:, 1] * points[:, 1] - plane[:, 2]
    return np.abs(above_m) < _WITHIN_M[-1] + _FAR_SHARE * away_m, normal.astype(np.float32)


def _lowest(
    points: NDArray[np.float32], sector: NDArray[np.int64], away_m: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """The lowest points of every cell of a sector."""
    cell = (away_m / _CELL_M).astype(np.int64) * _SECTORS + sector
    order = np.lexsort((points[:, 2], cell))
    _, start, count = np.unique(cell[order], return_index=True, return_counts=True)
    rank = np.arange(len(points)) - np.repeat(start, count)
    lowest = np.zeros(len(points), dtype=bool)
    lowest[order] = rank < np.ceil(_LOWEST * np.repeat(count, count))
    return lowest


def _plane(
    points: NDArray[np.float32],
    lowest: NDArray[np.float32],
    known: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Slopes along x and y, and height at the origin; ``known`` where none can be fitted."""
    middle = float(np.median(lowest[:, 2])) if len(lowest) else 0.0
    start = np.array([0.0, 0.0, middle]) if known is None else known
    plane, used = start, lowest
    for within_m in _WITHIN_M:
        near = used[np.abs(used[:, 2] - _height(plane, used.T)) < within_m].astype(float)
        if len(near) < _LEAST_POINTS:
            return start
        columns = np.column_stack([near[:, :2], np.ones(len(near))])
        plane = np.linalg.lstsq(columns, near[:, 2], rcond=None)[0]
        used = points
    steep = 1 / np.sqrt(1 + plane[0] ** 2 + plane[1] ** 2) < _LEVEL_COS
    return start if steep else plane


def _height(plane: NDArray[np.float64], at: NDArray) -> NDArray:
    """Height of a plane at ``(2 or 3, ...)``."""
    return plane[0] * at[0] + plane[1] * at[1] + plane[2]

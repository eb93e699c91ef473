"""Ground below a recorded scan: one robust plane per sector."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SECTORS = 12
# Rings of each sector, by their borders in metres: slopes change with the distance.
_BORDERS_M = (12.0, 25.0)
# The lowest points of cells of this length, by this quantile, start the fit.
_CELL_M, _LOWEST = 2.0, 0.1
# Distances from the plane of the points that the fits use, one after the other. The last one
# decides what is ground, plus the spread of far points.
_WITHIN_M, _FAR_SHARE = (1.0, 0.5, 0.3, 0.2, 0.15), 0.003
_LEAST_POINTS = 20
_LEVEL_COS = 0.95  # steeper planes are no ground
_STEP_M = 0.6  # between the plane of a sector and the one of the whole scan, beside 5 % of slope
# The lowest points of what stands on the ground are not part of it: cells of this angle and length
# with a point between these heights above the plane.
_UPRIGHT_RAD, _UPRIGHT_M, _HEIGHTS_M = np.radians(0.7), 0.2, (0.25, 2.0)
_AROUND_M, _FEWEST_AROUND = 25.0, 200
Plane = NDArray[np.float64]  # slopes along x and y, and height at the origin


def ground_of(points: NDArray[np.float32]) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Mask ``(P,)`` of the ground, and the upright normal ``(P, 3)`` of each point's sector plane.

    Planes are fitted by least squares to the lowest points of cells, then again and again to the
    points ever nearer to the plane. A sector takes the plane of the whole scan where its own is
    steep, far from that plane or fitted to few points. The feet of walls, trees and cars are not
    ground.
    """
    away_m = np.hypot(points[:, 0], points[:, 1])
    azimuth = np.arctan2(points[:, 1].astype(float), points[:, 0]) % (2 * np.pi)
    sector = (azimuth / (2 * np.pi) * _SECTORS).astype(int) % _SECTORS
    part = sector + _SECTORS * np.searchsorted(_BORDERS_M, away_m)
    cell = (away_m / _CELL_M).astype(int) * _SECTORS + sector
    order = np.lexsort((points[:, 2], cell))
    _, start, count = np.unique(cell[order], return_index=True, return_counts=True)
    rank = np.arange(len(points)) - np.repeat(start, count)
    lowest = np.zeros(len(points), dtype=bool)
    lowest[order] = rank < np.ceil(_LOWEST * np.repeat(count, count))

    level = np.array([0.0, 0.0, np.median(points[lowest, 2])])
    everywhere = _plane(points[away_m < _BORDERS_M[-1]], points[lowest], level)
    planes = np.tile(everywhere, (part.max() + 1, 1))
    for number in np.unique(part):
        inside = part == number
        plane = _plane(points[inside], points[inside & lowest], everywhere)
        x, y, z = points[inside].mean(axis=0)
        step_m = abs(_above(plane, (x, y, z)) - _above(everywhere, (x, y, z)))
        if inside.sum() >= _LEAST_POINTS and step_m < _STEP_M + 0.05 * np.hypot(x, y):
            planes[number] = plane
    plane = planes[part]
    normal = np.stack([-plane[:, 0], -plane[:, 1], np.ones(len(points))], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    above_m = _above(plane.T, points.T)
    near = np.abs(above_m) < _WITHIN_M[-1] + _FAR_SHARE * away_m
    cell = (away_m / _UPRIGHT_M).astype(int) * 1000 + (azimuth / _UPRIGHT_RAD).astype(int)
    near &= ~np.isin(cell, cell[(above_m > _HEIGHTS_M[0]) & (above_m < _HEIGHTS_M[1])])
    return near, normal.astype(np.float32)


def ground_around(points: NDArray[np.floating]) -> NDArray[np.float32] | None:
    """Points ``(Q, 3)`` of the ground within 25 m; None if little ground is seen."""
    near = points[np.hypot(points[:, 0], points[:, 1]) < _AROUND_M].astype(np.float32)
    if len(near) < _FEWEST_AROUND:
        return None
    ground = near[ground_of(near)[0]]
    return None if len(ground) < _FEWEST_AROUND else ground


def plane_of(points: NDArray[np.float32]) -> Plane:
    """Plane of least squares of points ``(P, 3)``."""
    columns = np.column_stack([points[:, :2].astype(float), np.ones(len(points))])
    return np.linalg.lstsq(columns, points[:, 2].astype(float), rcond=None)[0]


def _plane(points: NDArray[np.float32], lowest: NDArray[np.float32], known: Plane) -> Plane:
    """Plane of the ground; ``known``, where the fit starts, if there is none."""
    plane, used = known, lowest
    for within_m in _WITHIN_M:
        near = used[np.abs(_above(plane, used.T)) < within_m]
        if len(near) < _LEAST_POINTS:
            return known
        plane = plane_of(near)
        used = points
    steep = 1 / np.sqrt(1 + plane[0] ** 2 + plane[1] ** 2) < _LEVEL_COS
    return known if steep else plane


def _above(plane: NDArray, at: NDArray | tuple[float, ...]) -> NDArray:
    """Height of places ``(3, ...)`` above a plane."""
    return at[2] - plane[0] * at[0] - plane[1] * at[1] - plane[2]

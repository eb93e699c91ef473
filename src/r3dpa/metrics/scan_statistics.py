"""Counts over scans for the realism measures; they add up, so that data sets can be streamed.

Letters: P points, H beams.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray

from r3dpa.geometry import LidarSensor, SphericalProjection, range_image
from r3dpa.metrics.scan_structure import (
    GROUND_BAND_M,
    GROUND_DISTANCES_M,
    MAX_GAP_SHOTS,
    Ground,
    Sweep,
    Upright,
    fit_ground,
    level_enough,
    sweep_of,
    upright_surfaces,
)

Floats = NDArray[np.float64]


class Bins(NamedTuple):
    """Equal bins; the first and the last one also take the values beyond them."""

    width: float
    number: int
    start: float = 0.0

    def of(self, values: Floats) -> NDArray[np.int64]:
        """Bin of each value."""
        place = np.floor((values - self.start) / self.width)
        return place.astype(np.int64).clip(0, self.number - 1)


SENSOR = LidarSensor()
BEAMS = SENSOR.beams
MAX_RANGE_M = 80.0  # KITTI files hold no returns beyond
BEV_EXTENT_M = 50.0
RETURNS = Bins(100, 2001)
VALID_SHARE = Bins(0.001, 1001)
RANGE = Bins(1.0, 80)
CURVE_RANGE = Bins(4.0, 20)  # of curves over range
CURVE_ANGLE = Bins(5.0, 18)  # of curves over incidence, degrees
RUN = Bins(1.0, 4096, -0.5)
RESIDUAL = Bins(0.001, 200)  # coordinates in KITTI files are multiples of 1 mm
STEP = Bins(0.001, 400, -0.2)
GROUND_RESIDUAL = Bins(0.005, 80, -GROUND_BAND_M)
GROUND_REACH = Bins(0.5, 160)
BEV = Bins(0.5, 200, -BEV_EXTENT_M)
HEIGHT = Bins(0.05, 160, -3.0)
INTENSITY_LEVELS = 101  # steps of 0.01, as KITTI stores them

_MIN_RANGE_M = 1.0
_BLOCK_BORDER_RAD = math.radians(-8.67)  # between the lowest upper and the highest lower laser
_LOW_Z_M = -1.4
_SECTORS = Bins(1.0, 16)
_REACH_SECTORS = Bins(1.0, 72)
_MAX_RESIDUAL_M = 0.2
_REACH_RETURNS = 3  # ground returns a sector must hold beyond its reach, the last one included
_MIXED_GAP_M, _MIXED_JUMP_M, _JUMP_M = 0.3, 1.0, 0.5


# ruff: noqa: RUF009 - _zeros gives a dataclass field
def _zeros(*shape: int) -> Any:
    return field(default_factory=partial(np.zeros, shape))


@dataclass(frozen=True, eq=False)
class ScanStatistics:
    """Counts over scans; ``a + b`` holds the counts of both. Arrays are float64.

    Returns are the points between 1 and 80 m, so dummies at the origin are not counted. "Ring
    order" is that of KITTI files, beam after beam. Counts that a scan cannot give are zero.
    Surfaces are (ground, upright).
    """

    num_scans: int = 0
    num_ring_scans: int = 0  # in ring order
    num_beam_scans: int = 0  # in ring order, with 64 rings
    num_ground_scans: int = 0  # with a ground plane
    num_intensity_scans: int = 0  # with an intensity that is not zero everywhere

    # Of all scans
    points_per_scan: Floats = _zeros(RETURNS.number)  # scans by number of returns
    valid_share: Floats = _zeros(VALID_SHARE.number)  # scans by valid share of the 64 x 1024 image
    row_returns: Floats = _zeros(BEAMS)  # valid pixels (1 to 56 m) by image row
    range_counts: Floats = _zeros(2, RANGE.number)  # by block of lasers, above and below -8.67 deg
    low_points: float = 0.0  # returns below z = -1.4 m
    bev_counts: Floats = _zeros(BEV.number, BEV.number)  # returns by x and y, 0.5-m cells
    height_counts: Floats = _zeros(HEIGHT.number)  # 1-m cells by z of their highest return
    sector_cells: Floats = _zeros(_SECTORS.number)  # occupied 1-m cells within 50 m, from -pi

    # Of scans with intensity
    intensity_by_range: Floats = _zeros(CURVE_RANGE.number, INTENSITY_LEVELS)
    intensity_by_incidence: Floats = _zeros(2, CURVE_ANGLE.number, INTENSITY_LEVELS)  # by surface

    # Of scans with a ground plane
    ground_residual_counts: Floats = _zeros(GROUND_RESIDUAL.number)  # height over it, 3 to 20 m
    ground_reach_counts: Floats = _zeros(GROUND_REACH.number)  # sectors by 3rd farthest return

    # Of scans in ring order
    drop_runs: Floats = _zeros(RUN.number)  # runs of lost shots by length
    neighbours: Floats = _zeros(3)  # returns between two others; mixed pixels; jumps > 0.5 m
    keep_by_range: Floats = _zeros(3, CURVE_RANGE.number, 2)  # any or surface; range; (lost, kept)
    keep_by_incidence: Floats = _zeros(2, CURVE_ANGLE.number, 2)  # surface; angle; (lost, kept)

    # Of scans with 64 rings, by beam
    shots: float = 0.0  # of each beam and turn, summed over scans
    beam_returns: Floats = _zeros(BEAMS)
    ground_distance_m: Floats = _zeros(BEAMS)  # sum of horizontal distances of ground returns
    ground_returns: Floats = _zeros(BEAMS)
    residual_counts: Floats = _zeros(BEAMS, RESIDUAL.number)  # |residual| along the ring
    step_counts: Floats = _zeros(BEAMS, STEP.number)  # residual to the neighbouring rings

    def __add__(self, other: Self) -> Self:
        names = [column.name for column in fields(self)]
        return type(self)(**{name: getattr(self, name) + getattr(other, name) for name in names})

    @property
    def num_returns(self) -> float:
        """Returns over all scans."""
        return float(self.range_counts.sum())


def scan_statistics(points: NDArray[np.float32]) -> ScanStatistics:
    """Counts of one scan.

    Args:
        points: ``(P, 4)`` x, y, z in metres, x forward, z up, and intensity in [0, 1], in storage
            order.

    Raises:
        ValueError: If the shape is another or an intensity is outside [0, 1].
    """
    if points.ndim != 2 or points.shape[1] != 4:
        raise ValueError(f"points must be (P, 4) x, y, z, intensity, got shape {points.shape}")
    distance = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
    seen = (distance > _MIN_RANGE_M) & (distance < MAX_RANGE_M)
    xyz, range_m = points[seen, :3].astype(np.float64), distance[seen]
    intensity = points[seen, 3]
    if len(intensity) and not (intensity.min() >= 0 and intensity.max() <= 1):
        raise ValueError(
            f"intensity must lie in [0, 1], got {intensity.min():g} to {intensity.max():g}; "
            "divide by the largest value that the sensor can give"
        )
    ground, sweep = fit_ground(xyz), sweep_of(xyz, SENSOR)
    has_beams = sweep is not None and sweep.num_rings == BEAMS
    counts = _point_counts(points[:, :3], xyz, range_m) | _bev_counts(xyz)
    near_ground = np.zeros(len(xyz), dtype=bool)
    incidence_deg = np.full((2, len(xyz)), np.nan)  # ground, upright
    if ground is not None:
        near_ground = np.abs(ground.height_m(xyz)) < GROUND_BAND_M
        counts |= _ground_counts(xyz[near_ground], ground)
        incidence_deg[0, near_ground] = ground.incidence_deg(xyz[near_ground])
    if sweep is not None:
        order = sweep.order
        upright = upright_surfaces(xyz[order], range_m[order], sweep, near_ground[order])
        incidence_deg[1, order] = upright.incidence_deg
        counts |= _ring_counts(range_m[order], sweep, incidence_deg[:, order])
        if has_beams:
            counts |= _beam_counts(xyz[order], sweep, near_ground[order], upright)
    if intensity.any():
        counts |= _intensity_counts(intensity, range_m, incidence_deg)
    return ScanStatistics(
        num_scans=1,
        num_ring_scans=int(sweep is not None),
        num_beam_scans=int(has_beams),
        num_ground_scans=int(ground is not None),
        num_intensity_scans=int(intensity.any()),
        **counts,
    )


def _point_counts(points: NDArray[np.float32], xyz: Floats, range_m: Floats) -> dict[str, Any]:
    image, _ = range_image(torch.from_numpy(points.copy()), SphericalProjection(SENSOR))
    valid_mask = image.numpy() > 0
    is_lower = np.arcsin(xyz[:, 2] / range_m) < _BLOCK_BORDER_RAD
    return {
        "points_per_scan": _histogram(RETURNS, np.array([len(xyz)])),
        "valid_share": _histogram(VALID_SHARE, np.array([valid_mask.mean()])),
        "row_returns": valid_mask.sum(axis=1).astype(np.float64),
        "range_counts": _table((2, RANGE.number), is_lower, RANGE.of(range_m)),
        "low_points": float((xyz[:, 2] < _LOW_Z_M).sum()),
    }


def _bev_counts(xyz: Floats) -> dict[str, Any]:
    inside = xyz[(np.abs(xyz[:, :2]) < BEV_EXTENT_M).all(axis=1)]
    column, row = BEV.of(inside[:, 0]), BEV.of(inside[:, 1])
    number = BEV.number // 2  # cells of 1 m
    top = np.full(number**2, -np.inf)
    np.maximum.at(top, column // 2 * number + row // 2, inside[:, 2])
    occupied = np.isfinite(top)
    centre = np.arange(number) + 0.5 - BEV_EXTENT_M
    x, y = np.meshgrid(centre, centre, indexing="ij")
    within = (np.hypot(x, y) < BEV_EXTENT_M) & occupied.reshape(x.shape)
    return {
        "bev_counts": _table((BEV.number, BEV.number), column, row),
        "height_counts": _histogram(HEIGHT, top[occupied]),
        "sector_cells": _histogram(_SECTORS, _turn(x[within], y[within]) * _SECTORS.number),
    }


def _ground_counts(xyz: Floats, ground: Ground) -> dict[str, Any]:
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    near = (distance > GROUND_DISTANCES_M[0]) & (distance < GROUND_DISTANCES_M[1])
    number = _REACH_SECTORS.number
    sector = _REACH_SECTORS.of(_turn(xyz[:, 0], xyz[:, 1]) * number)
    outwards = np.lexsort((-distance, sector))
    ends = np.searchsorted(sector[outwards], np.arange(number + 1))
    enough = np.diff(ends) >= _REACH_RETURNS
    reach = np.zeros(number)
    reach[enough] = distance[outwards[ends[:-1][enough] + _REACH_RETURNS - 1]]
    return {
        "ground_residual_counts": _histogram(GROUND_RESIDUAL, ground.height_m(xyz[near])),
        "ground_reach_counts": _histogram(GROUND_REACH, reach),
    }


def _intensity_counts(
    intensity: NDArray[np.float32], range_m: Floats, incidence_deg: Floats
) -> dict[str, Any]:
    level = np.rint(intensity * (INTENSITY_LEVELS - 1)).astype(np.int64)
    surface, point = np.isfinite(incidence_deg).nonzero()
    angle = CURVE_ANGLE.of(incidence_deg[surface, point])
    shape = (CURVE_RANGE.number, INTENSITY_LEVELS)
    by_surface = (2, CURVE_ANGLE.number, INTENSITY_LEVELS)
    return {
        "intensity_by_range": _table(shape, CURVE_RANGE.of(range_m), level),
        "intensity_by_incidence": _table(by_surface, surface, angle, level[point]),
    }


def _ring_counts(range_m: Floats, sweep: Sweep, incidence_deg: Floats) -> dict[str, Any]:
    before, after = sweep.neighbour(-1), sweep.neighbour(1)
    unbroken = (sweep.missing[before] == 0) & (sweep.missing == 0)
    to_before, to_after = np.abs(range_m - range_m[before]), np.abs(range_m - range_m[after])
    mixed = np.minimum(to_before, to_after) >= _MIXED_GAP_M
    mixed &= np.abs(range_m[before] - range_m[after]) > _MIXED_JUMP_M
    groups = (unbroken, unbroken & mixed, unbroken & (to_after > _JUMP_M))

    by_range = np.zeros((3, CURVE_RANGE.number, 2))
    by_incidence = np.zeros((2, CURVE_ANGLE.number, 2))
    # Lost and kept shots alike are assigned to the surface of the returns on both sides.
    kept_shots = sweep.missing[before] + sweep.missing + 2
    lost = sweep.missing * (sweep.missing <= MAX_GAP_SHOTS)
    outcomes = (
        (np.arange(len(range_m)), sweep.missing + 1, lost),
        (before, kept_shots, kept_shots <= MAX_GAP_SHOTS + 1),
    )
    for outcome, (left, shots, number) in enumerate(outcomes):
        weight = number * level_enough(range_m[left], range_m[after], shots)
        ranges = CURVE_RANGE.of((range_m[left] + range_m[after]) / 2)
        by_range[0, :, outcome] = np.bincount(ranges, weight, CURVE_RANGE.number)
        for surface, angle_deg in enumerate((incidence_deg[:, left] + incidence_deg[:, after]) / 2):
            both = np.isfinite(angle_deg)
            near, angles = ranges[both], CURVE_ANGLE.of(angle_deg[both])
            by_range[1 + surface, :, outcome] = np.bincount(near, weight[both], CURVE_RANGE.number)
            by_incidence[surface, :, outcome] = np.bincount(
                angles, weight[both], CURVE_ANGLE.number
            )
    runs = sweep.missing[sweep.missing > 0].clip(max=RUN.number - 1)
    return {
        "neighbours": np.array([group.sum() for group in groups], dtype=np.float64),
        "drop_runs": _table((RUN.number,), runs),
        "keep_by_range": by_range,
        "keep_by_incidence": by_incidence,
    }


def _beam_counts(
    xyz: Floats, sweep: Sweep, ground: NDArray[np.bool_], upright: Upright
) -> dict[str, Any]:
    ring, residual_m, step_m = sweep.ring, np.abs(upright.residual_m), upright.step_m
    distance = np.hypot(xyz[ground, 0], xyz[ground, 1])
    small, level = residual_m < _MAX_RESIDUAL_M, np.abs(step_m) < _MAX_RESIDUAL_M
    residual, step = RESIDUAL.of(residual_m[small]), STEP.of(step_m[level])
    return {
        "shots": sweep.shots,
        "beam_returns": _table((BEAMS,), ring),
        "ground_returns": _table((BEAMS,), ring[ground]),
        "ground_distance_m": np.bincount(ring[ground], distance, BEAMS),
        "residual_counts": _table((BEAMS, RESIDUAL.number), ring[small], residual),
        "step_counts": _table((BEAMS, STEP.number), ring[level], step),
    }


def _turn(x: Floats, y: Floats) -> Floats:
    """Azimuth as a share of the turn, from 0 at -pi."""
    return (np.arctan2(y, x) + math.pi) / (2 * math.pi)


def _histogram(bins: Bins, values: Floats) -> Floats:
    return _table((bins.number,), bins.of(values))


def _table(shape: tuple[int, ...], *indices: NDArray[Any]) -> Floats:
    """How often each index occurs, ``(*shape)``."""
    flat = indices[0]
    for size, index in zip(shape[1:], indices[1:], strict=True):
        flat = flat * size + index
    return np.bincount(flat, minlength=math.prod(shape)).astype(np.float64).reshape(shape)

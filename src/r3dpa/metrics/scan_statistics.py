"""What scans contribute to the realism measures: counts that add up, so that data sets stream.

Letters: P points, H beams.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from r3dpa.geometry import LidarSensor, SphericalProjection, range_image
from r3dpa.metrics.sweep import (
    GROUND_BAND_M,
    GROUND_DISTANCES_M,
    MAX_GAP_SHOTS,
    Ground,
    Surfaces,
    Sweep,
    fit_ground,
    level_enough,
    surfaces_of,
    sweep_of,
)

Floats = NDArray[np.float64]

SENSOR = LidarSensor()
NUM_BEAMS = SENSOR.beams
RANGE_LIMITS_M = (1.0, 80.0)  # KITTI files end at 80 m
POINTS_BIN = 100
VALID_SHARE_BIN = 0.001
RANGE_BIN_M = 1.0
CURVE_BIN_M = 4.0  # bins of curves over range
CURVE_BIN_DEG = 5.0  # bins of curves over incidence
RESIDUAL_BIN_M = 0.001  # coordinates in KITTI files are multiples
GROUND_RESIDUAL_BIN_M = 0.005
GROUND_REACH_BIN_M = 0.5
BEV_CELL_M = 0.5
BEV_EXTENT_M = 50.0
HEIGHT_BIN_M = 0.05
HEIGHT_LIMITS_M = (-3.0, 5.0)
INTENSITY_LEVELS = 101  # steps of 0.01, as KITTI stores them
SURFACES = ("ground", "upright")  # axis of the counts by incidence

_BLOCK_BORDER_RAD = math.radians(-8.67)  # between the lowest upper and the highest lower laser
_LOW_Z_M = -1.4
_NUM_SECTORS = 16
_NUM_REACH_SECTORS = 72
_REACH_RETURNS = 3  # ground returns a sector must hold beyond its reach, the last one included
_MIXED_GAP_M, _MIXED_JUMP_M, _JUMP_M = 0.3, 1.0, 0.5
_NUM_RANGE_BINS = round(RANGE_LIMITS_M[1] / RANGE_BIN_M)
_NUM_CURVE_BINS = round(RANGE_LIMITS_M[1] / CURVE_BIN_M)
_NUM_ANGLE_BINS = round(90 / CURVE_BIN_DEG)
_NUM_BEV_CELLS = round(2 * BEV_EXTENT_M / BEV_CELL_M)
_MAX_RUN = 4096
_MAX_RESIDUAL_M = 0.2
_NUM_RESIDUAL_BINS = round(_MAX_RESIDUAL_M / RESIDUAL_BIN_M)


def _zeros(*shape: int) -> Callable[[], Floats]:
    return partial(np.zeros, shape)


@dataclass(frozen=True, eq=False)
class ScanStatistics:
    """Counts over scans; ``a + b`` holds what the scans of both contribute.

    Returns are the points between 1 and 80 m; KITTI files hold none beyond, and dummies at the
    origin are none. "Ring order" is that of KITTI files, beam after beam; counts by beam need all
    64 rings. Counts that a scan cannot give are zero. Arrays are float64.

    Args:
        num_scans: Scans.
        num_ring_scans: Those in ring order.
        num_beam_scans: Those in ring order with 64 rings.
        num_ground_scans: Those with a ground plane.
        num_intensity_scans: Those whose intensity is not zero everywhere.
        points_per_scan: Scans by number of returns, bins of 100.
        valid_share: Scans by share of valid pixels of the 64 x 1024 image (1 to 56 m), bins of
            0.001.
        row_returns: Valid pixels by image row.
        range_counts: Returns by block of lasers (above and below -8.67 degrees as seen from the
            origin) and range, 1-m bins.
        low_points: Returns below z = -1.4 m.
        bev_counts: Returns by x and y, cells of 0.5 m within 50 m to each side.
        height_counts: Cells of 1 m by z of their highest return, bins of 5 cm from -3 to 5 m.
        sector_cells: Cells of 1 m within 50 m that hold a return, by azimuth sector of 22.5
            degrees, counted from azimuth -pi.
        intensity_by_range: Returns by range (4 m) and intensity (0.01).
        intensity_by_incidence: Returns by surface (ground, upright), incidence (5 degrees) and
            intensity.
        ground_residual_counts: Ground returns between 3 and 20 m by height over the plane, 5 mm.
        ground_reach_counts: Sectors of 5 degrees by the distance of their third-farthest ground
            return, bins of 0.5 m; the first bin holds those without.
        ground_distance_m: Sum of horizontal distances of the ground returns by beam.
        ground_returns: Ground returns by beam.
        shots: Shots per beam and turn, summed over the scans with 64 rings.
        beam_returns: Returns by beam.
        drop_runs: Runs of shots without a return along a ring, by length in shots.
        neighbours: Returns whose neighbouring shots both came back; of these, mixed pixels and
            those that jump by more than 0.5 m to the next return.
        keep_by_range: Shots by surface (any, ground, upright), range (4 m) and fate (lost, kept).
        keep_by_incidence: The same by surface (ground, upright) and incidence (5 degrees).
        residual_counts: Returns by beam and absolute residual along the ring, 1 mm up to 0.2 m.
        step_counts: Returns by beam and signed residual to the neighbouring rings, 1 mm within
            0.2 m.
    """

    num_scans: int = 0
    num_ring_scans: int = 0
    num_beam_scans: int = 0
    num_ground_scans: int = 0
    num_intensity_scans: int = 0
    points_per_scan: Floats = field(default_factory=_zeros(2001))
    valid_share: Floats = field(default_factory=_zeros(1001))
    row_returns: Floats = field(default_factory=_zeros(NUM_BEAMS))
    range_counts: Floats = field(default_factory=_zeros(2, _NUM_RANGE_BINS))
    low_points: float = 0.0
    bev_counts: Floats = field(default_factory=_zeros(_NUM_BEV_CELLS, _NUM_BEV_CELLS))
    height_counts: Floats = field(default_factory=_zeros(160))
    sector_cells: Floats = field(default_factory=_zeros(_NUM_SECTORS))
    intensity_by_range: Floats = field(default_factory=_zeros(_NUM_CURVE_BINS, INTENSITY_LEVELS))
    intensity_by_incidence: Floats = field(
        default_factory=_zeros(len(SURFACES), _NUM_ANGLE_BINS, INTENSITY_LEVELS)
    )
    ground_residual_counts: Floats = field(default_factory=_zeros(80))
    ground_reach_counts: Floats = field(default_factory=_zeros(160))
    ground_distance_m: Floats = field(default_factory=_zeros(NUM_BEAMS))
    ground_returns: Floats = field(default_factory=_zeros(NUM_BEAMS))
    shots: float = 0.0
    beam_returns: Floats = field(default_factory=_zeros(NUM_BEAMS))
    drop_runs: Floats = field(default_factory=_zeros(_MAX_RUN))
    neighbours: Floats = field(default_factory=_zeros(3))
    keep_by_range: Floats = field(default_factory=_zeros(1 + len(SURFACES), _NUM_CURVE_BINS, 2))
    keep_by_incidence: Floats = field(default_factory=_zeros(len(SURFACES), _NUM_ANGLE_BINS, 2))
    residual_counts: Floats = field(default_factory=_zeros(NUM_BEAMS, _NUM_RESIDUAL_BINS))
    step_counts: Floats = field(default_factory=_zeros(NUM_BEAMS, 2 * _NUM_RESIDUAL_BINS))

    def __add__(self, other: Self) -> Self:
        """Counts of the scans of both."""
        names = [column.name for column in fields(self)]
        return type(self)(**{name: getattr(self, name) + getattr(other, name) for name in names})

    @property
    def num_returns(self) -> float:
        """Returns over all scans."""
        return float(self.range_counts.sum())


def scan_statistics(points: NDArray[np.float32]) -> ScanStatistics:
    """What one scan contributes.

    Args:
        points: ``(P, 4)`` x, y, z in metres, x forward, z up, and intensity in [0, 1], in storage
            order.

    Raises:
        ValueError: If the shape is another or an intensity is outside [0, 1].
    """
    if points.ndim != 2 or points.shape[1] != 4:
        raise ValueError(f"points must be (P, 4) x, y, z, intensity, got shape {points.shape}")
    distance = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
    seen = (distance > RANGE_LIMITS_M[0]) & (distance < RANGE_LIMITS_M[1])
    xyz, range_m = points[seen, :3].astype(np.float64), distance[seen]
    intensity = points[seen, 3]
    if len(intensity) and not (intensity.min() >= 0 and intensity.max() <= 1):
        raise ValueError(
            f"intensity must lie in [0, 1], got {intensity.min():g} to {intensity.max():g}; "
            "divide by the largest value that the sensor can give"
        )
    ground = fit_ground(xyz)
    sweep = sweep_of(xyz, SENSOR)
    counts = _image_counts(points[:, :3]) | _point_counts(xyz, range_m) | _bev_counts(xyz)
    incidence_deg = np.full((len(SURFACES), len(xyz)), np.nan)
    if ground is not None:
        near_ground = np.abs(ground.height_m(xyz)) < GROUND_BAND_M
        counts |= _ground_counts(xyz[near_ground], ground)
        incidence_deg[0, near_ground] = ground.incidence_deg(xyz[near_ground])
    if sweep is not None:
        ordered, ordered_m = xyz[sweep.order], range_m[sweep.order]
        surfaces = surfaces_of(ordered, ordered_m, sweep, ground)
        incidence_deg[1, sweep.order] = np.where(surfaces.upright, surfaces.incidence_deg, np.nan)
        counts |= _ring_counts(ordered_m, sweep, surfaces)
        if sweep.num_rings == NUM_BEAMS:
            counts |= _beam_counts(ordered, sweep, surfaces)
    if intensity.any():
        counts |= _intensity_counts(intensity, range_m, incidence_deg)
    return ScanStatistics(
        num_scans=1,
        num_ring_scans=int(sweep is not None),
        num_beam_scans=int(sweep is not None and sweep.num_rings == NUM_BEAMS),
        num_ground_scans=int(ground is not None),
        num_intensity_scans=int(intensity.any()),
        **counts,
    )


def _image_counts(points: NDArray[np.float32]) -> dict[str, Any]:
    image, _ = range_image(torch.from_numpy(points.copy()), SphericalProjection(SENSOR))
    valid_mask = image.numpy() > 0
    return {
        "valid_share": _histogram(np.array([valid_mask.mean() / VALID_SHARE_BIN]), 1001),
        "row_returns": valid_mask.sum(axis=1).astype(np.float64),
    }


def _point_counts(xyz: Floats, range_m: Floats) -> dict[str, Any]:
    is_lower = np.arcsin(xyz[:, 2] / range_m) < _BLOCK_BORDER_RAD
    flat = is_lower * _NUM_RANGE_BINS + _bins(range_m / RANGE_BIN_M, _NUM_RANGE_BINS)
    return {
        "points_per_scan": _histogram(np.array([len(xyz) / POINTS_BIN]), 2001),
        "range_counts": _table(flat, (2, _NUM_RANGE_BINS)),
        "low_points": float((xyz[:, 2] < _LOW_Z_M).sum()),
    }


def _bev_counts(xyz: Floats) -> dict[str, Any]:
    inside = xyz[(np.abs(xyz[:, :2]) < BEV_EXTENT_M).all(axis=1)]
    fine = _bins((inside[:, :2] + BEV_EXTENT_M) / BEV_CELL_M, _NUM_BEV_CELLS)
    num_cells = _NUM_BEV_CELLS // 2
    cell = fine[:, 0] // 2 * num_cells + fine[:, 1] // 2
    top = np.full(num_cells**2, -np.inf)
    np.maximum.at(top, cell, inside[:, 2])
    occupied = np.isfinite(top)
    centre = (np.arange(num_cells) + 0.5) * 2 * BEV_CELL_M - BEV_EXTENT_M
    x, y = np.meshgrid(centre, centre, indexing="ij")
    within = (np.hypot(x, y) < BEV_EXTENT_M).ravel() & occupied
    turn = (np.arctan2(y, x).ravel()[within] + math.pi) / (2 * math.pi)
    low, high = HEIGHT_LIMITS_M
    heights = top[occupied].clip(low, high)
    return {
        "bev_counts": _table(fine[:, 0] * _NUM_BEV_CELLS + fine[:, 1], (_NUM_BEV_CELLS,) * 2),
        "height_counts": _histogram((heights - low) / HEIGHT_BIN_M, 160),
        "sector_cells": _histogram(turn * _NUM_SECTORS, _NUM_SECTORS),
    }


def _ground_counts(xyz: Floats, ground: Ground) -> dict[str, Any]:
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    near = (distance > GROUND_DISTANCES_M[0]) & (distance < GROUND_DISTANCES_M[1])
    residual = (ground.height_m(xyz[near]) + GROUND_BAND_M) / GROUND_RESIDUAL_BIN_M
    turn = (np.arctan2(xyz[:, 1], xyz[:, 0]) + math.pi) / (2 * math.pi)
    sector = _bins(turn * _NUM_REACH_SECTORS, _NUM_REACH_SECTORS)
    outwards = np.lexsort((-distance, sector))
    ends = np.searchsorted(sector[outwards], np.arange(_NUM_REACH_SECTORS + 1))
    enough = np.diff(ends) >= _REACH_RETURNS
    reach = np.zeros(_NUM_REACH_SECTORS)
    reach[enough] = distance[outwards[ends[:-1][enough] + _REACH_RETURNS - 1]]
    return {
        "ground_residual_counts": _histogram(residual, 80),
        "ground_reach_counts": _histogram(reach / GROUND_REACH_BIN_M, 160),
    }


def _intensity_counts(
    intensity: NDArray[np.float32], range_m: Floats, incidence_deg: Floats
) -> dict[str, Any]:
    level = np.rint(intensity * (INTENSITY_LEVELS - 1)).astype(np.int64)
    by_range = _bins(range_m / CURVE_BIN_M, _NUM_CURVE_BINS) * INTENSITY_LEVELS + level
    by_incidence = []
    for angles in incidence_deg:
        known = np.isfinite(angles)
        row = _bins(angles[known] / CURVE_BIN_DEG, _NUM_ANGLE_BINS)
        shape = (_NUM_ANGLE_BINS, INTENSITY_LEVELS)
        by_incidence.append(_table(row * INTENSITY_LEVELS + level[known], shape))
    return {
        "intensity_by_range": _table(by_range, (_NUM_CURVE_BINS, INTENSITY_LEVELS)),
        "intensity_by_incidence": np.stack(by_incidence),
    }


def _ring_counts(range_m: Floats, sweep: Sweep, surfaces: Surfaces) -> dict[str, Any]:
    before, after = sweep.neighbour(-1), sweep.neighbour(1)
    unbroken = (sweep.missing[before] == 0) & (sweep.missing == 0)
    to_before, to_after = np.abs(range_m - range_m[before]), np.abs(range_m - range_m[after])
    mixed = np.minimum(to_before, to_after) >= _MIXED_GAP_M
    mixed &= np.abs(range_m[before] - range_m[after]) > _MIXED_JUMP_M
    found = (unbroken, unbroken & mixed, unbroken & (to_after > _JUMP_M))
    runs = sweep.missing[sweep.missing > 0].clip(max=_MAX_RUN - 1)

    by_range = np.zeros((1 + len(SURFACES), _NUM_CURVE_BINS, 2))
    by_incidence = np.zeros((len(SURFACES), _NUM_ANGLE_BINS, 2))
    # A shot is judged by the returns to both sides of it, whether it came back or not.
    here = np.arange(len(range_m))
    kept_shots = sweep.missing[before] + sweep.missing + 2
    fates = (
        (here, after, sweep.missing + 1, sweep.missing * (sweep.missing <= MAX_GAP_SHOTS)),
        (before, after, kept_shots, (kept_shots <= MAX_GAP_SHOTS + 1).astype(np.int64)),
    )
    for fate, (left, right, shots, weight) in enumerate(fates):
        weight = weight * level_enough(range_m[left], range_m[right], shots)
        middle_m = (range_m[left] + range_m[right]) / 2
        angle_deg = (surfaces.incidence_deg[left] + surfaces.incidence_deg[right]) / 2
        bins = _bins(middle_m / CURVE_BIN_M, _NUM_CURVE_BINS)
        by_range[0, :, fate] = np.bincount(bins, weight, _NUM_CURVE_BINS)
        for index, on in enumerate((surfaces.ground, surfaces.upright)):
            both = on[left] & on[right]
            angles = _bins(angle_deg[both] / CURVE_BIN_DEG, _NUM_ANGLE_BINS)
            by_range[1 + index, :, fate] = np.bincount(bins[both], weight[both], _NUM_CURVE_BINS)
            by_incidence[index, :, fate] = np.bincount(angles, weight[both], _NUM_ANGLE_BINS)
    return {
        "neighbours": np.array([group.sum() for group in found], dtype=np.float64),
        "drop_runs": np.bincount(runs, minlength=_MAX_RUN).astype(np.float64),
        "keep_by_range": by_range,
        "keep_by_incidence": by_incidence,
    }


def _beam_counts(xyz: Floats, sweep: Sweep, surfaces: Surfaces) -> dict[str, Any]:
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    ring = sweep.ring
    on_ground = ring[surfaces.ground]
    residual_m, step_m = np.abs(surfaces.residual_m), surfaces.step_m
    has_residual, has_step = residual_m < _MAX_RESIDUAL_M, np.abs(step_m) < _MAX_RESIDUAL_M
    bins = _NUM_RESIDUAL_BINS
    residual = _bins(residual_m[has_residual] / RESIDUAL_BIN_M, bins)
    step = _bins((step_m[has_step] + _MAX_RESIDUAL_M) / RESIDUAL_BIN_M, 2 * bins)
    return {
        "shots": sweep.shots,
        "beam_returns": np.bincount(ring, minlength=NUM_BEAMS).astype(np.float64),
        "ground_returns": np.bincount(on_ground, minlength=NUM_BEAMS).astype(np.float64),
        "ground_distance_m": np.bincount(on_ground, distance[surfaces.ground], NUM_BEAMS),
        "residual_counts": _table(ring[has_residual] * bins + residual, (NUM_BEAMS, bins)),
        "step_counts": _table(ring[has_step] * 2 * bins + step, (NUM_BEAMS, 2 * bins)),
    }


def _bins(values: Floats, num_bins: int) -> NDArray[np.int64]:
    """Bin of each value, which is given in bin widths; the border bins take what lies beyond."""
    return np.floor(values).astype(np.int64).clip(0, num_bins - 1)


def _histogram(values: Floats, num_bins: int) -> Floats:
    return np.bincount(_bins(values, num_bins), minlength=num_bins).astype(np.float64)


def _table(flat: NDArray[np.int64], shape: tuple[int, ...]) -> Floats:
    return np.bincount(flat, minlength=math.prod(shape)).astype(np.float64).reshape(shape)

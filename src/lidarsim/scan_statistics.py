"""Counts over scans for the realism measures; they add up, so that data sets can be streamed.

Letters: P points, H beams.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from lidarsim import scan_structure as structure
from lidarsim.cloud_formats import ODD_SHARE
from lidarsim.scan_structure import GROUND_BAND_M, Floats, Ground, Indices, Mask, RingReturns
from lidarsim.sensors.view import LidarSensor, hit_pixels


class Bins(NamedTuple):
    """Equal bins; the first and the last one also take the values beyond them."""

    width: float
    number: int
    start: float = 0.0

    def of(self, values: Floats) -> Indices:
        """Bin of each value."""
        place = np.floor((values - self.start) / self.width)
        return place.astype(np.int64).clip(0, self.number - 1)


SENSOR = LidarSensor()
BEAMS = SENSOR.beams
BEV_EXTENT_M = 50.0
INTENSITY_LEVELS = 101  # steps of 0.01, as KITTI stores them

_RANGES_M = (1.0, 80.0)  # KITTI files hold no returns beyond
_BLOCK_BORDER_RAD = math.radians(-8.67)  # between the lowest upper and the highest lower laser
_LOW_Z_M = -1.4
_SECTORS, _REACH_SECTORS = 16, 72
_CURVE_RANGE = Bins(4.0, 20)
_CURVE_ANGLE = Bins(5.0, 18)  # degrees
_MAX_RESIDUAL_M = 0.2
_REACH_RETURNS = 3  # ground returns a sector must hold beyond its reach, the last one included
_MIXED_GAP_M, _MIXED_JUMP_M, _JUMP_M = 0.3, 1.0, 0.5


# ruff: noqa: RUF009 - _table gives a dataclass field
def _table(*axes: int | Bins) -> Any:
    """Counts over axes of indices and of binned values."""
    shape = [axis.number if isinstance(axis, Bins) else axis for axis in axes]
    return field(default_factory=partial(np.zeros, shape), metadata={"axes": axes})


@dataclass(eq=False)
class ScanStatistics:
    """Counts over scans; ``a + b`` holds the counts of both. Arrays are float64.

    Returns are the points between 1 and 80 m, so dummies at the origin are not counted. "Ring
    order" is as in KITTI files, beam after beam. Counts that a scan cannot give are zero.
    Surfaces are (ground, upright).
    """

    num_scans: int = 0
    num_ring_scans: int = 0  # in ring order
    num_beam_scans: int = 0  # in ring order, with 64 rings
    num_ground_scans: int = 0  # with a ground plane
    num_intensity_scans: int = 0  # with an intensity that is not zero everywhere

    # Of all scans
    num_returns: float = 0.0
    low_points: float = 0.0  # returns below z = -1.4 m
    points_per_scan: Floats = _table(Bins(100, 6001))  # scans by number of returns
    valid_share: Floats = _table(Bins(0.001, 1001))  # scans by valid share of the 64 x 1024 image
    row_returns: Floats = _table(BEAMS)  # valid pixels (1 to 56 m) by image row
    range_counts: Floats = _table(2, Bins(1.0, 80))  # by block of lasers, above and below -8.67 deg
    bev_counts: Floats = _table(*[Bins(0.5, 200, -BEV_EXTENT_M)] * 2)  # returns by x and y
    height_counts: Floats = _table(Bins(0.05, 160, -3.0))  # 1-m cells by z of the highest return
    sector_cells: Floats = _table(Bins(1.0, _SECTORS))  # occupied 1-m cells within 50 m, from -pi

    # Of scans with intensity
    intensity_by_range: Floats = _table(_CURVE_RANGE, INTENSITY_LEVELS)
    intensity_by_incidence: Floats = _table(2, _CURVE_ANGLE, INTENSITY_LEVELS)  # by surface

    # Of scans with a ground plane
    ground_residual_counts: Floats = _table(Bins(0.005, 80, -GROUND_BAND_M))  # height, 3 to 20 m
    ground_reach_counts: Floats = _table(Bins(0.5, 160))  # sectors by 3rd farthest return

    # Of scans in ring order
    drop_runs: Floats = _table(Bins(1.0, 4096, -0.5))  # runs of lost shots by length
    neighbours: Floats = _table(3)  # returns between two others; mixed pixels; jumps > 0.5 m
    keep_by_range: Floats = _table(_CURVE_RANGE, 2)  # (lost, kept)
    surface_keep_by_range: Floats = _table(2, _CURVE_RANGE, 2)  # surface; range; (lost, kept)
    keep_by_incidence: Floats = _table(2, _CURVE_ANGLE, 2)  # surface; angle; (lost, kept)

    # Of scans with 64 rings, by beam
    shots: float = 0.0  # of each beam and turn, summed over scans
    beam_returns: Floats = _table(BEAMS)
    ground_distance_m: Floats = _table(BEAMS)  # sum of horizontal distances of ground returns
    ground_returns: Floats = _table(BEAMS)
    residual_counts: Floats = _table(BEAMS, Bins(0.001, 200))  # |residual| along the ring, by 1 mm
    step_counts: Floats = _table(BEAMS, Bins(0.001, 400, -0.2))  # to the neighbouring rings

    def __add__(self, other: Self) -> Self:
        names = [column.name for column in fields(self)]
        return type(self)(*(getattr(self, name) + getattr(other, name) for name in names))

    def count(self, name: str, *columns: NDArray[Any], weight: NDArray[Any] | None = None) -> None:
        """Add rows to a table; its columns are indices, or values of a binned axis."""
        table = getattr(self, name)
        index = []
        for axis, column in zip(_AXES[name], columns, strict=True):
            index.append(axis.of(column) if isinstance(axis, Bins) else column.astype(np.int64))
        flat = np.ravel_multi_index(tuple(index), table.shape)
        table += np.bincount(flat, weight, table.size).reshape(table.shape)


_AXES = {table.name: table.metadata["axes"] for table in fields(ScanStatistics) if table.metadata}
#: Bins of the last binned axis of each table, which replaces the ones before it.
BINS: dict[str, Bins] = {
    name: axis for name, axes in _AXES.items() for axis in axes if isinstance(axis, Bins)
}


def scan_statistics(points: NDArray[np.float32]) -> ScanStatistics:
    """Counts of one scan ``(P, 4)`` x, y, z (metres), intensity in [0, 1], in storage order.

    Raises:
        ValueError: If the points have another shape, or intensities lie outside of [0, 1].
    """
    if points.ndim != 2 or points.shape[1] != 4:
        raise ValueError(f"points must be (P, 4) x, y, z, intensity, got shape {points.shape}")
    distance = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
    seen = (distance > _RANGES_M[0]) & (distance < _RANGES_M[1])
    xyz, range_m = points[seen, :3].astype(np.float64), distance[seen]
    intensity = points[seen, 3]
    is_odd = ~((intensity >= 0) & (intensity <= 1))
    if np.count_nonzero(is_odd) > ODD_SHARE * len(intensity):
        raise ValueError(
            f"intensity must lie in [0, 1], got {intensity.min():g} to {intensity.max():g}; "
            "divide by the largest value that the sensor can give"
        )
    intensity = np.nan_to_num(intensity).clip(0, 1)
    s = ScanStatistics(num_scans=1, num_returns=float(len(xyz)))
    s.low_points = float((xyz[:, 2] < _LOW_Z_M).sum())
    valid_mask = hit_pixels(points[:, :3], SENSOR)
    s.row_returns += valid_mask.sum(axis=1)
    s.count("points_per_scan", np.array([len(xyz)]))
    s.count("valid_share", np.array([valid_mask.mean()]))
    s.count("range_counts", np.arcsin(xyz[:, 2] / range_m) < _BLOCK_BORDER_RAD, range_m)
    _count_cells(s, xyz)

    near_ground = np.zeros(len(xyz), dtype=bool)
    incidence_deg = np.full((2, len(xyz)), np.nan)  # ground, upright
    if ground := structure.fit_ground(xyz):
        near_ground = np.abs(ground.height_m(xyz)) < GROUND_BAND_M
        incidence_deg[0, near_ground] = ground.incidence_deg(xyz[near_ground])
        _count_ground(s, xyz[near_ground], ground)
    if sweep := structure.sweep_of(xyz, SENSOR):
        order = sweep.order
        near, in_order_m = near_ground[order], range_m[order]
        upright = structure.upright_surfaces(xyz[order], in_order_m, sweep, near)
        incidence_deg[1, order] = upright.incidence_deg
        _count_rings(s, in_order_m, sweep, incidence_deg[:, order])
        if sweep.ring[-1] + 1 == BEAMS:
            _count_beams(s, np.hypot(*xyz[order, :2].T), sweep, near, upright)
    if intensity.any():
        s.num_intensity_scans = 1
        level = np.rint(intensity * (INTENSITY_LEVELS - 1)).astype(np.int64)
        surface, point = np.isfinite(incidence_deg).nonzero()
        angle_deg = incidence_deg[surface, point]
        s.count("intensity_by_range", range_m, level)
        s.count("intensity_by_incidence", surface, angle_deg, level[point])
    return s


def _count_cells(s: ScanStatistics, xyz: Floats) -> None:
    inside = xyz[(np.abs(xyz[:, :2]) < BEV_EXTENT_M).all(axis=1)]
    bins = BINS["bev_counts"]
    column, row = bins.of(inside[:, 0]), bins.of(inside[:, 1])
    number = bins.number // 2  # cells of 1 m
    top = np.full(number**2, -np.inf)
    np.maximum.at(top, column // 2 * number + row // 2, inside[:, 2])
    occupied = np.isfinite(top)
    centre = np.arange(number) + 0.5 - BEV_EXTENT_M
    x, y = np.meshgrid(centre, centre, indexing="ij")
    within = (np.hypot(x, y) < BEV_EXTENT_M) & occupied.reshape(x.shape)
    s.count("bev_counts", inside[:, 0], inside[:, 1])
    s.count("height_counts", top[occupied])
    s.count("sector_cells", _turn_share(x[within], y[within]) * _SECTORS)


def _count_ground(s: ScanStatistics, xyz: Floats, ground: Ground) -> None:
    s.num_ground_scans = 1
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    nearest, farthest = structure.GROUND_DISTANCES_M
    near = (distance > nearest) & (distance < farthest)
    s.count("ground_residual_counts", ground.height_m(xyz[near]))
    sector = Bins(1.0, _REACH_SECTORS).of(_turn_share(xyz[:, 0], xyz[:, 1]) * _REACH_SECTORS)
    outwards = np.lexsort((-distance, sector))
    ends = np.searchsorted(sector[outwards], np.arange(_REACH_SECTORS + 1))
    enough = np.diff(ends) >= _REACH_RETURNS
    reach = np.zeros(_REACH_SECTORS)
    reach[enough] = distance[outwards[ends[:-1][enough] + _REACH_RETURNS - 1]]
    s.count("ground_reach_counts", reach)


def _count_rings(
    s: ScanStatistics, range_m: Floats, sweep: RingReturns, incidence_deg: Floats
) -> None:
    s.num_ring_scans = 1
    before, after, missing = sweep.neighbour(-1), sweep.neighbour(1), sweep.missing
    s.count("drop_runs", missing[missing > 0])
    unbroken = (missing[before] == 0) & (missing == 0)
    to_before, to_after = np.abs(range_m - range_m[before]), np.abs(range_m - range_m[after])
    mixed = np.minimum(to_before, to_after) >= _MIXED_GAP_M
    mixed &= np.abs(range_m[before] - range_m[after]) > _MIXED_JUMP_M
    groups = (unbroken, unbroken & mixed, unbroken & (to_after > _JUMP_M))
    s.neighbours += [group.sum() for group in groups]

    _count_kept_and_lost(s, range_m, sweep, incidence_deg)


def _count_kept_and_lost(
    s: ScanStatistics, range_m: Floats, sweep: RingReturns, incidence_deg: Floats
) -> None:
    """Count the shots that came back and those that did not, by range and incidence.

    Both count for the surface between two returns: a lost shot between the ones beside its gap, a
    kept one between the ones beside it.
    """
    before, after, missing = sweep.neighbour(-1), sweep.neighbour(1), sweep.missing
    num_lost = np.where(missing <= structure.MAX_GAP_SHOTS, missing, 0)
    shots_across = missing[before] + missing + 2
    num_kept = (shots_across <= structure.MAX_GAP_SHOTS + 1).astype(np.int64)
    left, right = np.concatenate([np.arange(len(range_m)), before]), np.concatenate([after, after])
    outcome = np.repeat([0, 1], len(range_m))  # lost, kept
    shots = np.concatenate([missing + 1, shots_across])
    is_level = structure.level_enough(range_m[left], range_m[right], shots)
    weight = np.concatenate([num_lost, num_kept]) * is_level
    middle_m = (range_m[left] + range_m[right]) / 2
    angle_deg = (incidence_deg[:, left] + incidence_deg[:, right]) / 2
    surface, pair = np.isfinite(angle_deg).nonzero()
    s.count("keep_by_range", middle_m, outcome, weight=weight)
    s.count("surface_keep_by_range", surface, middle_m[pair], outcome[pair], weight=weight[pair])
    s.count(
        "keep_by_incidence", surface, angle_deg[surface, pair], outcome[pair], weight=weight[pair]
    )


def _count_beams(
    s: ScanStatistics,
    distance: Floats,
    sweep: RingReturns,
    ground: Mask,
    upright: structure.Upright,
) -> None:
    s.num_beam_scans = 1
    s.shots = 2 * math.pi / sweep.shot_rad
    ring, residual_m, step_m = sweep.ring, np.abs(upright.residual_m), upright.step_m
    small, level = residual_m < _MAX_RESIDUAL_M, np.abs(step_m) < _MAX_RESIDUAL_M
    s.count("beam_returns", ring)
    s.count("ground_returns", ring[ground])
    s.count("ground_distance_m", ring[ground], weight=distance[ground])
    s.count("residual_counts", ring[small], residual_m[small])
    s.count("step_counts", ring[level], step_m[level])


def _turn_share(x: Floats, y: Floats) -> Floats:
    """Azimuth as a share of the turn, from 0 at -pi."""
    return (np.arctan2(y, x) + math.pi) / (2 * math.pi)

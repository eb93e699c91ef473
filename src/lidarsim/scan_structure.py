"""Structure of one scan: neighbours along each ring, ground plane, and surface directions.

Letters: P returns. All functions take float64 points in metres, sensor frame.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarsim.ring_order import rings_in_order
from lidarsim.sensors.view import LidarSensor, angles_of

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

GROUND_BAND_M = 0.2  # ground returns are at most this far above or below the plane
GROUND_DISTANCES_M = (3.0, 20.0)  # nearer is the car, farther the road bends away from a plane
MAX_GAP_SHOTS = 10  # the surface across a longer gap is unknown

_MOUNT_HEIGHT_M = 1.73  # KITTI and KITTI-360
_GROUND_BANDS_M = (0.5, 0.3, GROUND_BAND_M, GROUND_BAND_M, GROUND_BAND_M)
_MIN_GROUND_RETURNS = 500
_MAX_GROUND_SLOPE = 0.2
_JITTER_RAD = 0.1  # the azimuth of a real ring may step back by some milliradians
_UNBROKEN = 1.35  # times the median step; real steps are 0.09 or 0.18 degrees, a loss gives 0.27
_SLOPE_PER_SHOT = 0.02  # change of range per shot, as a share of the range: incidence < 81 degrees
_SMOOTH_M = 0.1  # 4 standard deviations of the interpolation error at 2 cm noise
_VERTICAL_SMOOTH_M = 0.4  # lasers of the real HDL-64E are biased by up to 0.1 m against each other
_REACH = 3  # returns to each side that give the direction along the ring
_MAX_STEP_DEG = 60.0
_MAX_UPRIGHT_NORMAL_Z = 0.5  # normals less than 30 degrees from the horizon


class RingReturns(NamedTuple):
    """Returns of one scan in ring order, with their neighbours along azimuth."""

    order: Indices  # (P,) index of each return in the scan
    ring: Indices  # (P,) from 0 (highest), ascending
    azimuth: Floats  # (P,) radians in [0, 2 pi)
    shot_rad: float  # mean azimuth between two shots of a laser
    missing: Indices  # (P,) shots without a return up to the next return; a ring is a circle

    def neighbour(self, offset: int) -> Indices:
        """Index ``(P,)`` of the return ``offset`` places further along its ring."""
        return _around(self.ring, offset)

    def other_ring(self, step: int) -> tuple[Indices, Mask]:
        """Index ``(P,)`` of the return of nearest azimuth ``step`` rings lower.

        The mask is True where it lies within 1.5 shots and in that ring.
        """
        key = self.ring * 2 * math.pi + self.azimuth
        ascending = np.argsort(key, kind="stable")
        wanted = key + step * 2 * math.pi
        after = np.searchsorted(key, wanted, sorter=ascending).clip(1, len(key) - 1)
        before_key, after_key = key[ascending[after - 1]], key[ascending[after]]
        index = ascending[np.where(wanted - before_key < after_key - wanted, after - 1, after)]
        close = np.abs(key[index] - wanted) < 1.5 * self.shot_rad
        return index, close & (self.ring[index] == self.ring + step)

    def azimuth_between(self, start: Indices, end: Indices) -> Floats:
        """Azimuth from each return ``start`` forward to ``end``, radians in [-0.1, 2 pi - 0.1)."""
        return _forward(self.azimuth[end] - self.azimuth[start])


def sweep_of(points: Floats, sensor: LidarSensor) -> RingReturns | None:
    """Ring structure of the returns of one scan; None if it is not stored ring after ring.

    The shots per turn follow from the mean azimuth step over unbroken neighbours; the median would
    be wrong, as the encoder of the real HDL-64E gives steps of 0.09 and 0.18 degrees.
    """
    inclination, azimuth = angles_of(points)
    try:
        ring = rings_in_order(inclination, azimuth, sensor)[0]
    except ValueError:
        return None
    order = np.argsort(ring, kind="stable")
    ring, turn = ring[order], azimuth[order] % (2 * math.pi)
    step = _forward(turn[_around(ring, 1)] - turn)
    ahead = step[step > 0]
    if len(ahead) == 0:
        return None
    shot_rad = float(ahead[ahead < _UNBROKEN * np.median(ahead)].mean())
    missing = np.maximum(np.rint(step / shot_rad).astype(np.int64) - 1, 0)
    return RingReturns(order, ring, turn, shot_rad, missing)


class Ground(NamedTuple):
    """Plane ``z = slope_x * x + slope_y * y + offset_m``."""

    slope_x: float
    slope_y: float
    offset_m: float

    def height_m(self, points: Floats) -> Floats:
        """Vertical distance ``(P,)`` of points ``(P, 3)`` above the plane."""
        return points[:, 2] - (
            self.slope_x * points[:, 0] + self.slope_y * points[:, 1] + self.offset_m
        )

    def incidence_deg(self, points: Floats) -> Floats:
        """Angle ``(P,)`` between the plane's normal and the ray to each of ``(P, 3)`` points."""
        normal = np.array([-self.slope_x, -self.slope_y, 1.0])
        return _incidence_deg(points, np.broadcast_to(normal, points.shape))


def fit_ground(points: Floats) -> Ground | None:
    """Ground plane around the car by least squares in a band that narrows step by step.

    Starts from a level plane 1.73 m below the sensor, the mount of KITTI and KITTI-360.
    """
    distance = np.hypot(points[:, 0], points[:, 1])
    near = points[(distance > GROUND_DISTANCES_M[0]) & (distance < GROUND_DISTANCES_M[1])]
    ground = Ground(0.0, 0.0, -_MOUNT_HEIGHT_M)
    for band_m in _GROUND_BANDS_M:
        close = near[np.abs(ground.height_m(near)) < band_m]
        if len(close) < _MIN_GROUND_RETURNS:
            return None
        design = np.column_stack([close[:, :2], np.ones(len(close))])
        coefficients = np.linalg.lstsq(design.T @ design, design.T @ close[:, 2], rcond=None)[0]
        ground = Ground(*map(float, coefficients))
    return None if math.hypot(ground.slope_x, ground.slope_y) > _MAX_GROUND_SLOPE else ground


class Upright(NamedTuple):
    """Smooth surfaces that stand up (facades, sides of cars), for returns in sweep order."""

    incidence_deg: Floats  # (P,) between ray and surface normal; NaN off upright surfaces
    residual_m: Floats  # (P,) of :func:`_residual`; NaN off the ground and off upright surfaces
    step_m: Floats  # (P,) range minus the line through the neighbouring rings; NaN from 60 degrees


def upright_surfaces(points: Floats, range_m: Floats, sweep: RingReturns, ground: Mask) -> Upright:
    """Surfaces met by the returns ``(P, 3)`` of one scan, all in the order of the sweep."""
    on_line = _on_line(range_m, sweep)
    up, has_up = sweep.other_ring(-1)
    down, has_down = sweep.other_ring(1)
    bend = np.abs(range_m[up] - 2 * range_m + range_m[down])
    upright = ~ground & on_line & has_up & has_down & (bend < _VERTICAL_SMOOTH_M)
    along = points[sweep.neighbour(_REACH)] - points[sweep.neighbour(-_REACH)]
    normal = np.cross(along, points[up] - points[down])
    upright &= np.abs(normal[:, 2]) < _MAX_UPRIGHT_NORMAL_Z * np.linalg.norm(normal, axis=1)
    angle_deg = np.full(len(points), np.nan)
    angle_deg[upright] = _incidence_deg(points[upright], normal[upright])

    inclination = np.arcsin((points[:, 2] / range_m).clip(-1, 1))
    span = inclination[up] - inclination[down]
    half = np.full(len(points), 0.5)
    share = np.divide(inclination - inclination[down], span, out=half, where=span > 0)
    step_m = range_m - (range_m[down] + share * (range_m[up] - range_m[down]))
    residual_m = np.where(on_line & (ground | upright), _residual(range_m, sweep), np.nan)
    return Upright(angle_deg, residual_m, np.where(angle_deg < _MAX_STEP_DEG, step_m, np.nan))


def level_enough(left_m: Floats, right_m: Floats, shots: Indices) -> Mask:
    """Whether two ranges ``shots`` shots apart along a ring may belong to one surface."""
    return np.abs(left_m - right_m) <= _SLOPE_PER_SHOT * np.minimum(left_m, right_m) * shots


def _around(ring: Indices, offset: int) -> Indices:
    counts = np.bincount(ring)
    start = (np.cumsum(counts) - counts)[ring]
    return (start + (np.arange(len(ring)) - start + offset) % counts[ring]).astype(np.int64)


def _forward(angle: Floats) -> Floats:
    return (angle + _JITTER_RAD) % (2 * math.pi) - _JITTER_RAD


def _on_line(range_m: Floats, sweep: RingReturns) -> Mask:
    """Whether the outer neighbours along the ring lie on a line.

    The inner ones and the return itself are not tested: that would cut the tails of the residuals.
    """
    first, last = sweep.neighbour(-_REACH), sweep.neighbour(_REACH)
    whole = sweep.azimuth_between(first, last)
    smooth = (whole > 0) & (whole < 2 * (_REACH + MAX_GAP_SHOTS) * sweep.shot_rad)
    shots = np.maximum(np.rint(whole / sweep.shot_rad).astype(np.int64), 1)
    smooth &= level_enough(range_m[first], range_m[last], shots)
    for inner in (sweep.neighbour(1 - _REACH), sweep.neighbour(_REACH - 1)):
        share = sweep.azimuth_between(first, inner) / np.where(whole > 0, whole, 1.0)
        line = range_m[first] + share * (range_m[last] - range_m[first])
        smooth &= np.abs(range_m[inner] - line) < _SMOOTH_M
    return smooth


def _residual(range_m: Floats, sweep: RingReturns) -> Floats:
    """Range minus the line through both neighbours along the ring, NaN next to a lost shot.

    Divided by the error growth of this line, it deviates as a single range does.
    """
    before, after = sweep.neighbour(-1), sweep.neighbour(1)
    whole = sweep.azimuth_between(before, after)
    unbroken = (sweep.missing[before] == 0) & (sweep.missing == 0) & (whole > 0)
    share = sweep.azimuth_between(before, np.arange(len(before))) / np.where(unbroken, whole, 1.0)
    line = range_m[before] + share * (range_m[after] - range_m[before])
    growth = np.sqrt(1 + share**2 + (1 - share) ** 2)
    return np.where(unbroken & (share > 0) & (share < 1), (range_m - line) / growth, np.nan)


def _incidence_deg(points: Floats, normal: Floats) -> Floats:
    scale = np.linalg.norm(points, axis=1) * np.linalg.norm(normal, axis=1)
    cosine = np.abs((points * normal).sum(axis=1)) / scale
    return np.degrees(np.arccos(cosine.clip(0, 1)))

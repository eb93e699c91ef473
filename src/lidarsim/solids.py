"""Primitives as columns in the scene frame, and the rays of a turn that can meet each.

The *scene frame* is the sensor frame in the middle of the sweep, levelled by the pose's roll and
pitch, so that z points straight up. Letters: N solids, H beams, W shots.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarsim.scene import Pose, Primitive

Floats = NDArray[np.float32]

#: Surfaces that are no solid of the scene, beside the indices of those.
EGO_BODY, NO_SURFACE, GROUND = -3, -2, -1
# Slack of the windows that choose which rays are tested against a solid: too much only costs
# time, too little would cut off an object's rim.
_WINDOW_SLACK_RAD = 2e-3
# Solids nearer than this many times the spread of the rays' origins may be seen all around.
_LEAST_GAP = 1.01


class Solids(NamedTuple):
    """Primitives as columns in the scene frame."""

    shape: NDArray[np.int64]  # (N,)
    centre: Floats  # (N, 3)
    half_size: Floats  # (N, 3)
    cos_yaw: Floats  # (N,)
    sin_yaw: Floats  # (N,)
    grade: Floats  # (N, 2)
    matrix: Floats  # (N, 3, 3) and
    offset: Floats  # (N, 3): matrix @ point - offset are the unit coordinates of ``Primitive``
    velocity: Floats  # (N, 2), metres per second
    extinction: Floats  # (N,)
    slats: Floats  # (N, 4) pitch, filled share, lowest and highest opening, see ``Primitive``
    ground_m: float  # height of the ground


def solids_of(primitives: tuple[Primitive, ...], pose: Pose, ground_m: float) -> Solids:
    """Primitives of the world, seen from a pose."""
    cosine, sine = np.cos(pose.heading_rad), np.sin(pose.heading_rad)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    centre = np.array([p.centre for p in primitives], dtype=float).reshape(-1, 3)
    centre -= (pose.x_m, pose.y_m, pose.z_m)
    centre[:, :2] = centre[:, :2] @ turn
    velocity = np.array([p.velocity_m_s for p in primitives], dtype=float).reshape(-1, 2) @ turn
    yaw = np.array([p.yaw_rad for p in primitives], dtype=float) - pose.heading_rad
    half_size = np.array([p.half_size for p in primitives], dtype=float).reshape(-1, 3)
    grade = np.array([p.grade for p in primitives], dtype=float).reshape(-1, 2)
    matrix = np.zeros((len(primitives), 3, 3))
    matrix[:, 0, 0] = matrix[:, 1, 1] = np.cos(yaw)
    matrix[:, 0, 1] = np.sin(yaw)
    matrix[:, 1, 0] = -matrix[:, 0, 1]
    matrix[:, 2, 2] = 1
    matrix[:, 2] -= np.einsum("ni,nij->nj", grade, matrix[:, :2])
    matrix /= half_size[:, :, None]
    return Solids(
        shape=np.array([p.shape for p in primitives], dtype=np.int64),
        centre=centre.astype(np.float32),
        half_size=half_size.astype(np.float32),
        cos_yaw=np.cos(yaw).astype(np.float32),
        sin_yaw=np.sin(yaw).astype(np.float32),
        grade=grade.astype(np.float32),
        matrix=matrix.astype(np.float32),
        offset=np.einsum("nij,nj->ni", matrix, centre).astype(np.float32),
        velocity=velocity.astype(np.float32),
        extinction=np.array([p.extinction_per_m for p in primitives], dtype=np.float32),
        slats=np.array([p.slats + p.open_m for p in primitives], dtype=np.float32).reshape(-1, 4),
        ground_m=ground_m - pose.z_m,
    )


def level(vectors: Floats, pose: Pose) -> Floats:
    """Vectors ``(3, ...)`` of the sensor frame, tilted by roll and pitch."""
    x, y, z = vectors
    cos_roll, sin_roll = np.float32(np.cos(pose.roll_rad)), np.float32(np.sin(pose.roll_rad))
    cos_pitch, sin_pitch = np.float32(np.cos(pose.pitch_rad)), np.float32(np.sin(pose.pitch_rad))
    y, z = cos_roll * y - sin_roll * z, sin_roll * y + cos_roll * z
    x, z = cos_pitch * x + sin_pitch * z, cos_pitch * z - sin_pitch * x
    return np.stack([x, y, z])


class Windows(NamedTuple):
    """For each solid the beams and shots that can meet it, its nearest range, and the order."""

    beams: NDArray[np.int64]  # (N, 2) first and one past the last
    shots: NDArray[np.int64]  # (N, 2) may be negative or pass W: the turn wraps
    near_m: NDArray[np.float64]  # (N,)
    order: NDArray[np.int64]  # solids within reach, near to far

    def num_rays(self) -> NDArray[np.int64]:
        """Rays ``(N,)`` in each window."""
        return np.diff(self.beams)[:, 0] * np.diff(self.shots)[:, 0]


def windows_of(
    solids: Solids,
    origin: Floats,
    direction: Floats,
    max_range_m: float,
    actor_time_s: Floats | None = None,
) -> Windows:
    """Beams and shots whose rays can meet each solid, from its bounding box seen from above.

    The path of the sensor, relative to a solid that moves, spreads the origins of the rays over
    metres. The first pass allows each ray to start anywhere on it; the second uses the part of the
    path in the first window.
    """
    fan = _fan(origin, direction)
    num_shots = fan.num_shots
    speed = np.hypot(*solids.velocity.T)
    # Place and time of each shot: their middle over the beams, and the largest distance from it.
    # Where the turn ends and begins, some beams are at its end and others at its beginning.
    middle = origin[:2].mean(axis=1)
    apart_m = np.hypot(*(origin[:2] - middle[:, None])).max(axis=0)
    time_s, apart_s = np.zeros(num_shots), np.zeros(num_shots)
    if actor_time_s is not None:
        time_s = actor_time_s.mean(axis=0)
        apart_s = np.abs(actor_time_s - time_s).max(axis=0)

    here = np.zeros((len(speed), 2))
    spread_m = np.hypot(*middle).max() + apart_m.max() + speed * (np.abs(time_s) + apart_s).max()
    wide = _windows_from(solids, fan, max_range_m, here, spread_m)
    if spread_m.max(initial=0.0) < 2 * apart_m.min():
        return wide
    # Of the first windows that are no full turn, which may go on past the last shot.
    index = wide.order[np.diff(wide.shots)[wide.order, 0] < num_shots]
    first, last = wide.shots[index].T
    shots = np.stack([first % num_shots, first % num_shots + last - first], axis=1)
    path = np.stack([*middle, time_s])  # of the sensor: place and time
    high, low = _largest(path, shots), -_largest(-path, shots)
    (x, y, at_s), (far_x, far_y, far_s) = (high + low) / 2, (high - low) / 2
    here[index] = np.stack([x, y], axis=1) - solids.velocity[index] * at_s[:, None]
    spread_m[index] = np.hypot(far_x, far_y) + _largest(apart_m, shots)
    spread_m[index] += speed[index] * (far_s + _largest(apart_s, shots))
    return _windows_from(solids, fan, max_range_m, here, spread_m)


def _largest(values: NDArray, shots: NDArray[np.int64]) -> NDArray:
    """Largest of values (..., W) in ranges (K, 2) of shots: first, one past the last, below 2 W."""
    twice = np.concatenate([values, values, values[..., :1]], axis=-1)
    return np.maximum.reduceat(twice, shots.reshape(-1), axis=-1)[..., ::2]


def pieces(index: int, windows: Windows, num_shots: int) -> list[tuple[slice, slice]]:
    """The window of a solid as one or two rectangles of beams and shots."""
    first, last = windows.shots[index]
    turn = first // num_shots * num_shots
    first, last = first - turn, last - turn
    beams = slice(*windows.beams[index])
    parts = [(beams, slice(first, min(last, num_shots)))]
    if last > num_shots:
        parts.append((beams, slice(0, last - num_shots)))
    return parts


class _Fan(NamedTuple):
    """Deviations of the rays of a turn from their nominal azimuth and inclination."""

    num_shots: int
    least_deviation: float  # of the azimuth from shot * 2 pi / W, radians
    most_deviation: float
    highest: Floats  # (H,) sine of the inclination
    lowest: Floats
    least_height_m: float  # of the origins
    most_height_m: float


def _fan(origin: Floats, direction: Floats) -> _Fan:
    num_shots = origin.shape[2]
    azimuth = 2 * np.pi / num_shots * np.arange(num_shots)
    cosine, sine = np.cos(azimuth).astype(np.float32), np.sin(azimuth).astype(np.float32)
    across = cosine * direction[1] - sine * direction[0]
    highest, lowest = direction[2].max(axis=1), direction[2].min(axis=1)
    # |across| <= sin(deviation) * level length, so that this is never too little.
    steepest = max(abs(float(highest.max())), abs(float(lowest.min())))
    length = np.sqrt(1 - steepest**2)
    most, least = max(float(across.max()), 0.0), min(float(across.min()), 0.0)
    least = float(np.arcsin(max(least / length, -1.0)))
    most = float(np.arcsin(min(most / length, 1.0)))
    lowest_m, highest_m = float(origin[2].min()), float(origin[2].max())
    return _Fan(num_shots, least, most, highest, lowest, lowest_m, highest_m)


def _windows_from(
    solids: Solids,
    fan: _Fan,
    max_range_m: float,
    here: NDArray[np.float64],
    spread_m: NDArray[np.float64],
) -> Windows:
    """Windows for rays that start within ``spread_m`` (N,) of ``here`` (N, 2)."""
    step = 2 * np.pi / fan.num_shots
    centre, half = solids.centre.astype(float), solids.half_size.astype(float)
    centre[:, :2] -= here
    # Corners of the footprint, and the distance from the rays' origins to it.
    along = np.array([1, 1, -1, -1]) * half[:, :1]
    across = np.array([1, -1, 1, -1]) * half[:, 1:2]
    cos_yaw, sin_yaw = solids.cos_yaw[:, None], solids.sin_yaw[:, None]
    corner_x = centre[:, :1] + cos_yaw * along - sin_yaw * across
    corner_y = centre[:, 1:2] + sin_yaw * along + cos_yaw * across
    local_x = cos_yaw[:, 0] * centre[:, 0] + sin_yaw[:, 0] * centre[:, 1]
    local_y = cos_yaw[:, 0] * centre[:, 1] - sin_yaw[:, 0] * centre[:, 0]
    gap_x, gap_y = np.abs(local_x) - half[:, 0], np.abs(local_y) - half[:, 1]
    near_m = np.hypot(gap_x.clip(min=0), gap_y.clip(min=0))
    far_m = np.hypot(corner_x, corner_y).max(axis=1) + spread_m

    # Shots: angles of the corners about the centre's direction, widened by how far the rays leave
    # their column's nominal azimuth and by the spread of their origins.
    heading = np.arctan2(centre[:, 1], centre[:, 0])
    angle = np.arctan2(corner_y, corner_x) - heading[:, None]
    angle = (angle + np.pi) % (2 * np.pi) - np.pi
    # A ray that starts elsewhere sees a corner at the distance d by at most asin(spread / d) aside.
    around = near_m <= _LEAST_GAP * spread_m
    spread_rad = np.arcsin(np.where(around, 1.0, spread_m / np.where(around, 1.0, near_m)))
    near_m = (near_m - spread_m).clip(min=0)
    margin = _WINDOW_SLACK_RAD + spread_rad
    first = heading + angle.min(axis=1) - margin - fan.most_deviation
    last = heading + angle.max(axis=1) + margin - fan.least_deviation
    shots = np.stack([np.floor(first / step), np.ceil(last / step) + 1], axis=1).astype(int)
    whole_turn = around | (shots[:, 1] - shots[:, 0] >= fan.num_shots)
    shots[whole_turn] = (0, fan.num_shots)

    # Beams: the steepest and flattest lines from the optical centres to top and bottom.
    half_height = half[:, 2] + (np.abs(solids.grade) * half[:, :2]).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        top = centre[:, 2] + half_height - fan.least_height_m
        bottom = centre[:, 2] - half_height - fan.most_height_m
        steepest_up = np.arctan2(top, np.where(top > 0, near_m, far_m)) + _WINDOW_SLACK_RAD
        steepest_down = np.arctan2(bottom, np.where(bottom < 0, near_m, far_m)) - _WINDOW_SLACK_RAD
    meets = fan.lowest <= np.sin(steepest_up)[:, None]
    meets &= fan.highest >= np.sin(steepest_down)[:, None]
    num_beams = len(fan.highest)
    beams = np.stack([meets.argmax(axis=1), num_beams - meets[:, ::-1].argmax(axis=1)], axis=1)
    reachable = np.flatnonzero(meets.any(axis=1) & (near_m < max_range_m))
    return Windows(beams, shots, near_m, reachable[np.argsort(near_m[reachable], kind="stable")])

"""Rays against primitives: nearest surface and normal.

Everything happens in the *scene frame*: the sensor frame in the middle of the sweep, levelled by
the pose's roll and pitch, so that z points straight up. Letters: N solids, H beams, W shots, M
single rays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from r3dpa.simulation.scene import Pose, Primitive, Scene, Shape

Floats = NDArray[np.float32]

EGO_BODY, NO_SURFACE, GROUND = -3, -2, -1

# Slack of the windows that choose which rays are tested against a primitive; too much only costs
# time, too little would cut off an object's rim.
_WINDOW_SLACK_RAD = 2e-3
# A secondary ray starts on a surface; nearer hits are that surface.
_START_M = 1e-3
# Slack of the heights that choose which solids are tested against a secondary ray.
_SLACK_M = 1e-2
# Secondary rays whose table of distances to all solids stays in the cache of a core.
_BLOCK_RAYS = 512
# How single foliage draws are told apart from solid to solid; any odd numbers do.
_BEAM_STRIDE, _SHOT_STRIDE = 17, 641


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
    ground_m: float  # height of the ground


class Windows(NamedTuple):
    """For each solid the beams and shots that can meet it, its nearest range, and the order."""

    beams: NDArray[np.int64]  # (N, 2) first and one past the last
    shots: NDArray[np.int64]  # (N, 2) may be negative or pass W: the turn wraps
    near_m: NDArray[np.float64]  # (N,)
    order: NDArray[np.int64]  # solids within reach, near to far


class _Solid(NamedTuple):
    """Matrix and offset of one solid, or of one solid per ray as ``(3, 3, M)`` and ``(3, M)``."""

    matrix: Floats
    offset: Floats
    sloped: bool


def level(vectors: Floats, pose: Pose) -> Floats:
    """Vectors ``(3, ...)`` of the sensor frame, tilted by roll and pitch."""
    x, y, z = vectors
    cos_roll, sin_roll = np.float32(np.cos(pose.roll_rad)), np.float32(np.sin(pose.roll_rad))
    cos_pitch, sin_pitch = np.float32(np.cos(pose.pitch_rad)), np.float32(np.sin(pose.pitch_rad))
    y, z = cos_roll * y - sin_roll * z, sin_roll * y + cos_roll * z
    x, z = cos_pitch * x + sin_pitch * z, cos_pitch * z - sin_pitch * x
    return np.stack([x, y, z])


def solids_of(primitives: tuple[Primitive, ...], pose: Pose, ground_m: float) -> Solids:
    """Primitives of the world, seen from a pose."""
    turn = np.array(
        [
            [np.cos(pose.heading_rad), -np.sin(pose.heading_rad)],
            [np.sin(pose.heading_rad), np.cos(pose.heading_rad)],
        ]
    )
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
        ground_m=ground_m - pose.z_m,
    )


def subset(solids: Solids, chosen: NDArray) -> Solids:
    """Some of the solids, by mask or index, over the same ground."""
    columns = solids._asdict()
    ground_m = columns.pop("ground_m")
    return Solids(**{name: column[chosen] for name, column in columns.items()}, ground_m=ground_m)


def scene_solids(scene: Scene) -> Solids:
    """The solids of a scene in its scene frame."""
    return solids_of(scene.primitives, scene.pose, scene.ground_m)


def cast(
    solids: Solids,
    origin: Floats,
    direction: Floats,
    max_range_m: float,
    actor_time_s: Floats | None = None,
    optical_depth: Floats | None = None,
) -> tuple[Floats, NDArray[np.int32]]:
    """Nearest surface along each ray of a turn.

    Every solid is scaled to its unit shape, where a ray ``p + t d`` meets a box by its slabs and a
    cylinder or ellipsoid by a quadratic whose discriminant is written with the cross product,
    ``|d|^2 - |p x d|^2``, which float32 can hold where ``b^2 - a c`` cancels. A ray that starts
    inside a solid does not see it. No ray may point straight up or down.

    Args:
        solids: Solids and ground.
        origin: ``(3, H, W)`` where the rays start, metres.
        direction: ``(3, H, W)`` unit vectors; shots of growing azimuth that fill the turn.
        max_range_m: Hits from here on are left out.
        actor_time_s: ``(H, W)`` time at which each ray meets the moving solids, seconds from the
            middle of the sweep; None leaves them where they are then.
        optical_depth: ``(H, W)`` draws of the exponential distribution: how deep each ray gets
            into foliage, see ``Primitive.extinction_per_m``; None makes foliage a surface.

    Returns:
        Distance ``(H, W)``, infinite where nothing is hit, and index of the solid, ``GROUND`` or
        ``NO_SURFACE``.
    """
    nearest = np.full(origin.shape[1:], max_range_m, dtype=np.float32)
    surface = np.full(nearest.shape, NO_SURFACE, dtype=np.int32)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        _keep_nearer(
            (np.float32(solids.ground_m) - origin[2]) / direction[2], GROUND, nearest, surface
        )
        windows = windows_of(solids, origin, direction, max_range_m, actor_time_s)
        for index in windows.order:
            sloped = bool(solids.grade[index].any())
            solid = _Solid(solids.matrix[index], solids.offset[index], sloped)
            moving = actor_time_s is not None and solids.velocity[index].any()
            foliage = optical_depth is not None and solids.extinction[index] > 0
            for window in pieces(index, windows, origin.shape[2]):
                near = nearest[window]
                if near.max() <= windows.near_m[index]:
                    continue
                rays = (slice(None), *window)
                start = origin[rays].reshape(3, -1)
                if moving:
                    assert actor_time_s is not None
                    start = _relative(start, solids.velocity[index], actor_time_s[window].ravel())
                towards = direction[rays].reshape(3, -1)
                distance, leave = _crossing(solids.shape[index], solid, start, towards)
                if foliage:
                    assert optical_depth is not None
                    drawn = _draws_of(index, window, optical_depth)
                    deep = distance + drawn.ravel() / solids.extinction[index]
                    distance = np.where(distance > 0, deep, np.float32(np.nan))
                distance = np.where(distance <= leave, distance, np.float32(np.nan))
                _keep_nearer(distance.reshape(near.shape), index, near, surface[window])
    return np.where(surface == NO_SURFACE, np.float32(np.inf), nearest), surface


def cast_single(
    solids: Solids,
    origin: Floats,
    direction: Floats,
    time_s: Floats,
    max_range_m: NDArray[np.floating],
    excluded: NDArray[np.int32],
    hollow: NDArray[np.int32],
) -> tuple[Floats, NDArray[np.int32]]:
    """Nearest surface along single rays that start anywhere, such as reflected ones.

    Foliage counts as a surface, and the ground is only seen from above.

    Args:
        solids: Solids and ground.
        origin: ``(3, M)`` where the rays start.
        direction: ``(3, M)`` unit vectors.
        time_s: ``(M,)`` when they do, for the moving solids.
        max_range_m: ``(M,)`` hits from here on are left out.
        excluded: ``(M,)`` solid, or ``GROUND``, that the ray does not see.
        hollow: ``(M,)`` solid that the ray sees from inside, such as the house behind a window;
            ``NO_SURFACE`` for none.

    Returns:
        Distance ``(M,)``, infinite where nothing is hit, and index as for ``cast``.
    """
    nearest = max_range_m.astype(np.float32)
    surface = np.full(len(nearest), NO_SURFACE, dtype=np.int32)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        to_ground = (np.float32(solids.ground_m) - origin[2]) / direction[2]
        to_ground[(direction[2] >= 0) | (excluded == GROUND)] = np.nan
        _keep_nearer(to_ground, GROUND, nearest, surface)
        ray, index = _close_pairs(solids, origin, direction, nearest, time_s)
        keep = excluded[ray] != index
        ray, index = ray[keep], index[keep]
        velocity = solids.velocity.T.take(index, axis=1)
        start = _relative(origin.take(ray, axis=1), velocity, time_s[ray])
        distance, leave = surface_distance(solids, index, start, direction.take(ray, axis=1))
        distance = np.where(hollow[ray] == index, leave, distance)
        distance[~((distance > _START_M) & (distance < nearest[ray]))] = np.inf
        np.minimum.at(nearest, ray, distance)
        # Backwards, so that of solids equally far the first one is left standing.
        hit = np.flatnonzero(distance == nearest[ray])[::-1]
        surface[ray[hit]] = index[hit]
    return np.where(surface == NO_SURFACE, np.float32(np.inf), nearest), surface


def surface_distance(
    solids: Solids, index: NDArray[np.integer], origin: Floats, direction: Floats
) -> tuple[Floats, Floats]:
    """Where each ray ``(3, M)`` enters and leaves its own solid ``index`` (M,); NaN for a miss."""
    enter = np.full(len(index), np.nan, dtype=np.float32)
    leave = enter.copy()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for shape in Shape:
            chosen = np.flatnonzero(solids.shape[index] == shape)
            solid = _gather(solids, index[chosen])
            start, towards = (array.take(chosen, axis=1) for array in (origin, direction))
            enter[chosen], leave[chosen] = _crossing(shape, solid, start, towards)
    missed = ~(enter <= leave)
    enter[missed] = leave[missed] = np.nan
    return enter, leave


def normals(
    solids: Solids, surface: NDArray[np.integer], position: Floats, time_s: Floats | None
) -> Floats:
    """Unit normals ``(3, M)`` of surfaces at points ``(3, M)`` on them, in the scene frame.

    Args:
        solids: Solids and ground.
        surface: ``(M,)`` index of the solid, or ``GROUND``.
        position: Points on these surfaces.
        time_s: ``(M,)`` when the moving solids were hit; None in the middle of the sweep.
    """
    normal = np.zeros_like(position)
    normal[2] = 1
    hit = np.flatnonzero(surface >= 0)
    index = surface[hit]
    at = position.take(hit, axis=1)
    if time_s is not None and solids.velocity.any():
        at = _relative(at, solids.velocity.T.take(index, axis=1), time_s[hit])
    solid = _gather(solids, index)
    unit = np.stack(_unit_frame(solid, at, True))
    # The gradient of a solid's equation, by its unit coordinates; of a box the face that is met.
    x, y, z = np.abs(unit)
    face = np.where(z >= np.maximum(x, y), 2, np.where(y > x, 1, 0))
    shape = solids.shape[index]
    round_ones = np.flatnonzero(shape != Shape.BOX)
    gradient = unit.take(round_ones, axis=1)
    upright = shape[round_ones] == Shape.CYLINDER
    on_cap = upright & (np.abs(gradient[2]) > np.hypot(gradient[0], gradient[1]))
    gradient[:2, on_cap] = 0
    gradient[2, upright & ~on_cap] = 0
    rows = np.moveaxis(solids.matrix, 2, 0).reshape(3, -1)
    towards = rows.take(3 * index + face, axis=1)
    towards *= np.sign(unit[face, np.arange(len(face))])
    matrix = solid.matrix.take(round_ones, axis=2)
    towards[:, round_ones] = np.einsum("ijm,im->jm", matrix, gradient)
    towards /= np.sqrt(np.einsum("im,im->m", towards, towards))
    if len(hit) == len(surface):
        return towards
    for axis in range(3):
        normal[axis, hit] = towards[axis]
    return normal


def pieces(index: int, windows: Windows, num_shots: int) -> list[tuple[slice, slice]]:
    """The window of a solid as one or two rectangles of beams and shots."""
    first, last = windows.shots[index]
    turn = first // num_shots * num_shots
    first, last = first - turn, last - turn
    beams = slice(*windows.beams[index])
    found = [(beams, slice(first, min(last, num_shots)))]
    if last > num_shots:
        found.append((beams, slice(0, last - num_shots)))
    return found


def windows_of(
    solids: Solids,
    origin: Floats,
    direction: Floats,
    max_range_m: float,
    actor_time_s: Floats | None = None,
) -> Windows:
    """Beams and shots whose rays can meet each solid, from its bounding box seen from above.

    Two passes: the first takes the rays to start anywhere that any of them does, which a moving
    sensor spreads over a metre; the second looks up where those of the first window really start.
    """
    fan = _fan(origin, direction)
    reach = np.zeros(len(solids.shape))
    if actor_time_s is not None:
        reach = np.hypot(*solids.velocity.T) * float(np.abs(actor_time_s).max())
    spread_m = float(np.hypot(origin[0], origin[1]).max()) + reach
    here = np.zeros((len(solids.shape), 2))
    wide = _windows_from(solids, fan, max_range_m, here, spread_m)
    # The origins of each shot: their middle over the beams, and how far the farthest is from it.
    middle = origin[:2].mean(axis=1)
    around = np.hypot(*(origin[:2] - middle[:, None])).max(axis=0)
    if spread_m.max(initial=0.0) < 2 * around.min():
        return wide
    for index in wide.order:
        first, last = wide.shots[index]
        if last - first < fan.num_shots:
            inside = np.arange(first, last) % fan.num_shots
            here[index] = middle[:, inside[len(inside) // 2]]
            away = np.hypot(*(middle[:, inside] - here[index][:, None])) + around[inside]
            spread_m[index] = away.max() + reach[index]
    return _windows_from(solids, fan, max_range_m, here, spread_m)


class _Fan(NamedTuple):
    """How far the rays of a turn leave their nominal azimuth and inclination."""

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
    return _Fan(
        num_shots,
        float(np.arcsin(max(least / length, -1.0))),
        float(np.arcsin(min(most / length, 1.0))),
        highest,
        lowest,
        float(origin[2].min()),
        float(origin[2].max()),
    )


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
    near_m = np.hypot(
        (np.abs(local_x) - half[:, 0]).clip(min=0), (np.abs(local_y) - half[:, 1]).clip(min=0)
    )
    near_m = (near_m - spread_m).clip(min=0)
    far_m = np.hypot(corner_x, corner_y).max(axis=1) + spread_m

    # Shots: angles of the corners about the centre's direction, widened by how far the rays leave
    # their column's nominal azimuth and by the spread of their origins.
    heading = np.arctan2(centre[:, 1], centre[:, 0])
    angle = np.arctan2(corner_y, corner_x) - heading[:, None]
    angle = (angle + np.pi) % (2 * np.pi) - np.pi
    around = near_m <= 2 * spread_m
    margin = _WINDOW_SLACK_RAD + np.arcsin(
        np.where(around, 1.0, spread_m / np.where(around, 1.0, near_m))
    )
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


def _draws_of(index: int, window: tuple[slice, slice], drawn: Floats) -> Floats:
    """The window's draws for one solid: those of the turn, moved on from solid to solid."""
    num_beams, num_shots = drawn.shape
    beams = np.arange(window[0].start, window[0].stop) + _BEAM_STRIDE * index
    shots = np.arange(window[1].start, window[1].stop) + _SHOT_STRIDE * index
    return drawn[np.ix_(beams % num_beams, shots % num_shots)]


def _close_pairs(
    solids: Solids, origin: Floats, direction: Floats, reach_m: Floats, time_s: Floats
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rays and solids (each (K,), sorted by ray) whose upright bounding cylinders they cross."""
    level_length = np.hypot(direction[0], direction[1])
    along = direction[:2] / level_length
    speed = np.hypot(*solids.velocity.T)
    radius = np.hypot(solids.half_size[:, 0], solids.half_size[:, 1])
    radius = radius + speed * np.abs(time_s).max(initial=0.0)
    centre = np.concatenate([solids.centre[:, :2].T, np.ones((1, len(radius)), np.float32)])
    # Signed distances of the centres from each ray's line, and along it, seen from above.
    offset = origin[0] * along[1] - origin[1] * along[0]
    lines = np.stack([along[1], -along[0], -offset], axis=1)
    start = np.stack([*along, -(origin[0] * along[0] + origin[1] * along[1])], axis=1)
    reach_m = reach_m * level_length
    found = []
    for some in range(0, len(lines), _BLOCK_RAYS):
        block = slice(some, some + _BLOCK_RAYS)
        ahead = start[block] @ centre
        close = np.abs(lines[block] @ centre) <= radius
        close &= ahead >= -radius
        close &= ahead <= reach_m[block, None] + radius
        ray, index = np.nonzero(close)
        found.append((ray + some, index, ahead[ray, index]))
    if not found:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    ray, index, ahead_m = (np.concatenate(column) for column in zip(*found, strict=True))
    # Heights of the ray where it enters and leaves the circle, and of the solid.
    rise = (direction[2] / level_length)[ray]
    enter = origin[2, ray] + rise * (ahead_m - radius[index]).clip(min=0)
    leave = origin[2, ray] + rise * np.minimum(ahead_m + radius[index], reach_m[ray])
    half_height = solids.half_size[:, 2] + _SLACK_M
    half_height += (np.abs(solids.grade) * solids.half_size[:, :2]).sum(axis=1)
    top, bottom = solids.centre[:, 2] + half_height, solids.centre[:, 2] - half_height
    meets = (np.minimum(enter, leave) <= top[index]) & (np.maximum(enter, leave) >= bottom[index])
    return ray[meets], index[meets]


def _gather(solids: Solids, index: NDArray[np.integer]) -> _Solid:
    # Taken from rows, so that every row of the result lies in one piece.
    matrix = np.ascontiguousarray(np.moveaxis(solids.matrix, 0, 2)).take(index, axis=2)
    offset = np.ascontiguousarray(solids.offset.T).take(index, axis=1)
    return _Solid(matrix, offset, bool(solids.grade.any()))


def _relative(position: Floats, velocity: Floats, time_s: Floats) -> Floats:
    """Positions (3, M) seen from a solid that moves with ``velocity`` ((2,) or (2, M))."""
    moved = position.copy()
    moved[0] -= velocity[0] * time_s
    moved[1] -= velocity[1] * time_s
    return moved


def _keep_nearer(distance: Floats, index: int, nearest: Floats, surface: NDArray[np.int32]) -> None:
    nearer = (distance > 0) & (distance < nearest)
    np.copyto(nearest, distance, where=nearer)
    np.copyto(surface, index, where=nearer)


def _unit_frame(solid: _Solid, vectors: Floats, is_point: bool) -> tuple[Floats, Floats, Floats]:
    """Vectors (3, M) of the scene frame in the coordinates where the solid is its unit shape."""
    matrix = solid.matrix
    x = matrix[0, 0] * vectors[0]
    x += matrix[0, 1] * vectors[1]
    y = matrix[1, 0] * vectors[0]
    y += matrix[1, 1] * vectors[1]
    z = matrix[2, 2] * vectors[2]
    if solid.sloped:
        z += matrix[2, 0] * vectors[0]
        z += matrix[2, 1] * vectors[1]
    if is_point:
        x -= solid.offset[0]
        y -= solid.offset[1]
        z -= solid.offset[2]
    return x, y, z


def _crossing(
    shape: int, solid: _Solid, origin: Floats, direction: Floats
) -> tuple[Floats, Floats]:
    """Distances (R,) at which rays (3, R) enter and leave a solid.

    A ray that misses it has NaN, or enters after it leaves.
    """
    px, py, pz = _unit_frame(solid, origin, True)
    dx, dy, dz = _unit_frame(solid, direction, False)
    if shape == Shape.ELLIPSOID:
        squared = dx * dx + dy * dy + dz * dz
        cross = (py * dz - pz * dy) ** 2 + (pz * dx - px * dz) ** 2 + (px * dy - py * dx) ** 2
        middle = px * dx + py * dy + pz * dz
        half_chord = np.sqrt(squared - cross)
        return -(middle + half_chord) / squared, (half_chord - middle) / squared
    enter_z, leave_z = _slab(pz, dz)
    if shape == Shape.CYLINDER:
        squared = dx * dx + dy * dy
        middle = px * dx + py * dy
        half_chord = np.sqrt(squared - (px * dy - py * dx) ** 2)
        enter = np.maximum((-middle - half_chord) / squared, enter_z)
        leave = np.minimum((-middle + half_chord) / squared, leave_z)
    else:
        enter_x, leave_x = _slab(px, dx)
        enter_y, leave_y = _slab(py, dy)
        enter = np.maximum(np.maximum(enter_x, enter_y), enter_z)
        leave = np.minimum(np.minimum(leave_x, leave_y), leave_z)
    return enter, leave


def _slab(position: Floats, velocity: Floats) -> tuple[Floats, Floats]:
    """Where ``position + t velocity`` enters and leaves [-1, 1]."""
    # Not 0, because a ray along the slab would give inf - inf.
    inverse = np.reciprocal(velocity + np.float32(1e-30))
    middle = position * inverse
    half = np.abs(inverse)
    return -half - middle, half - middle

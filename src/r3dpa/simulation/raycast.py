"""Rays against primitives: nearest hit, surface and incidence of every shot of one turn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from r3dpa.simulation.scene import Pose, Primitive, Scene, Semantic, Shape
from r3dpa.simulation.sensor import Rays

Floats = NDArray[np.float32]

MAX_RANGE_M = 120.0
NO_SURFACE, GROUND = -2, -1

# Slack of the windows that choose which rays are tested against a primitive; too much only costs
# time, too little would cut off an object's rim.
_WINDOW_SLACK_RAD = 2e-3


@dataclass(frozen=True)
class Returns:
    """What comes back for each shot; every array but the rays is ``(H, W)``, beams by shots.

    Args:
        rays: The shots, in the sensor frame; a point is ``origin + range_m * direction``.
        range_m: Distance along the ray, float32; infinity where nothing comes back.
        surface: Index of the primitive that was hit, ``GROUND`` or ``NO_SURFACE``; int32.
        cos_incidence: Cosine between the ray and the surface normal, float32 in [0, 1].
        reflectivity: Lambertian reflectivity of the surface, float32.
        semantic: Class id of the surface, uint16; 0 where there is none.
        instance: Object number of the surface, uint16.
        power: Received over emitted power, m^-2, float32; 1 before any effect has been applied.
    """

    rays: Rays
    range_m: Floats
    surface: NDArray[np.int32]
    cos_incidence: Floats
    reflectivity: Floats
    semantic: NDArray[np.uint16]
    instance: NDArray[np.uint16]
    power: Floats


def cast(scene: Scene, rays: Rays) -> Returns:
    """Nearest surface along each ray, up to ``MAX_RANGE_M``.

    Every solid is scaled to its unit shape, where a ray ``p + t d`` meets a box by its slabs and a
    cylinder or ellipsoid by a quadratic whose discriminant is written with the cross product,
    ``|d|^2 - |p x d|^2``, which float32 can hold where ``b^2 - a c`` cancels. A ray that starts
    inside a solid does not see it. No ray may point straight up or down.

    Args:
        scene: Solids, ground and pose; the effects are not applied here.
        rays: Rays of one turn in the sensor frame, beams from top to bottom, shots by azimuth.

    Returns:
        The hits, with ``power`` 1 everywhere.
    """
    levelled = np.stack([_level(rays.origin, scene.pose), _level(rays.direction, scene.pose)])
    nearest = np.full(levelled.shape[2:], MAX_RANGE_M, dtype=np.float32)
    surface = np.full(nearest.shape, NO_SURFACE, dtype=np.int32)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        height_m = levelled[0, 2] + np.float32(scene.pose.z_m)
        _keep_nearer(-height_m / levelled[1, 2], GROUND, nearest, surface)
        solids = _solids(scene.primitives, scene.pose)
        windows = _windows(solids, levelled)
        for index in windows.order:
            _cast_solid(index, solids, windows, levelled, nearest, surface)
        cos_incidence = _cos_incidence(solids, levelled, nearest, surface)

    def of_surface(values: list[float], ground: float, dtype: type) -> NDArray:
        # GROUND and NO_SURFACE are the last and the last but one entry of the table.
        return np.array([*values, 0, ground], dtype=dtype)[surface]

    return Returns(
        rays=rays,
        range_m=np.where(surface == NO_SURFACE, np.float32(np.inf), nearest),
        surface=surface,
        cos_incidence=cos_incidence,
        reflectivity=of_surface(
            [p.reflectivity for p in scene.primitives], scene.ground_reflectivity, np.float32
        ),
        semantic=of_surface([p.semantic for p in scene.primitives], Semantic.ROAD, np.uint16),
        instance=of_surface([p.instance for p in scene.primitives], 0, np.uint16),
        power=np.ones_like(nearest),
    )


class _Solids(NamedTuple):
    """Primitives as columns, moved into the levelled sensor frame (origin at the frame origin)."""

    shape: NDArray[np.int64]  # (N,)
    centre: Floats  # (N, 3)
    half_size: Floats  # (N, 3)
    cos_yaw: Floats  # (N,)
    sin_yaw: Floats  # (N,)


class _Windows(NamedTuple):
    """For each solid the beams and shots that can meet it, its nearest range, and the order."""

    beams: NDArray[np.int64]  # (N, 2) first and one past the last
    shots: NDArray[np.int64]  # (N, 2) may be negative or pass W: the turn wraps
    near_m: NDArray[np.float64]  # (N,)
    order: NDArray[np.int64]  # solids within reach, near to far


def _level(vectors: Floats, pose: Pose) -> Floats:
    """Vectors ``(3, H, W)`` of the sensor frame, tilted by roll and pitch."""
    x, y, z = vectors
    cos_roll, sin_roll = np.float32(np.cos(pose.roll_rad)), np.float32(np.sin(pose.roll_rad))
    cos_pitch, sin_pitch = np.float32(np.cos(pose.pitch_rad)), np.float32(np.sin(pose.pitch_rad))
    y, z = cos_roll * y - sin_roll * z, sin_roll * y + cos_roll * z
    x, z = cos_pitch * x + sin_pitch * z, cos_pitch * z - sin_pitch * x
    return np.stack([x, y, z])


def _solids(primitives: tuple[Primitive, ...], pose: Pose) -> _Solids:
    centre = np.array([p.centre for p in primitives], dtype=float).reshape(-1, 3)
    centre -= (pose.x_m, pose.y_m, pose.z_m)
    cos_heading, sin_heading = np.cos(pose.heading_rad), np.sin(pose.heading_rad)
    x, y = centre[:, 0].copy(), centre[:, 1].copy()
    centre[:, 0] = cos_heading * x + sin_heading * y
    centre[:, 1] = cos_heading * y - sin_heading * x
    yaw = np.array([p.yaw_rad for p in primitives], dtype=float) - pose.heading_rad
    return _Solids(
        np.array([p.shape for p in primitives], dtype=np.int64),
        centre.astype(np.float32),
        np.array([p.half_size for p in primitives], dtype=np.float32).reshape(-1, 3),
        np.cos(yaw).astype(np.float32),
        np.sin(yaw).astype(np.float32),
    )


def _windows(solids: _Solids, levelled: Floats) -> _Windows:
    """Beams and shots whose rays can meet each solid, from its bounding box seen from above."""
    origin, direction = levelled.astype(np.float32)
    num_shots = origin.shape[2]
    step = 2 * np.pi / num_shots
    centre, half = solids.centre.astype(float), solids.half_size.astype(float)
    # Corners of the footprint, and the distance from the frame origin to it.
    along = np.array([1, 1, -1, -1]) * half[:, :1]
    across = np.array([1, -1, 1, -1]) * half[:, 1:2]
    cos_yaw, sin_yaw = solids.cos_yaw[:, None], solids.sin_yaw[:, None]
    corner_x = centre[:, :1] + cos_yaw * along - sin_yaw * across
    corner_y = centre[:, 1:2] + sin_yaw * along + cos_yaw * across
    local_x = cos_yaw[:, 0] * centre[:, 0] + sin_yaw[:, 0] * centre[:, 1]
    local_y = cos_yaw[:, 0] * centre[:, 1] - sin_yaw[:, 0] * centre[:, 0]
    spread_m = float(np.hypot(origin[0], origin[1]).max())
    near_m = np.hypot(
        (np.abs(local_x) - half[:, 0]).clip(min=0), (np.abs(local_y) - half[:, 1]).clip(min=0)
    )
    near_m = (near_m - spread_m).clip(min=0)
    far_m = np.hypot(corner_x, corner_y).max(axis=1) + spread_m

    # Shots: angles of the corners about the centre's direction, widened by how far the rays leave
    # their column's nominal azimuth and by the spread of their origins.
    nominal = step * np.arange(num_shots)
    deviation = np.arctan2(direction[1], direction[0]) - nominal
    deviation = (deviation + np.pi) % (2 * np.pi) - np.pi
    heading = np.arctan2(centre[:, 1], centre[:, 0])
    angle = np.arctan2(corner_y, corner_x) - heading[:, None]
    angle = (angle + np.pi) % (2 * np.pi) - np.pi
    around = near_m <= 2 * spread_m
    margin = _WINDOW_SLACK_RAD + np.arcsin(
        np.where(around, 1.0, spread_m / np.where(around, 1.0, near_m))
    )
    first = heading + angle.min(axis=1) - margin - deviation.max()
    last = heading + angle.max(axis=1) + margin - deviation.min()
    shots = np.stack([np.floor(first / step), np.ceil(last / step) + 1], axis=1).astype(int)
    whole_turn = around | (shots[:, 1] - shots[:, 0] >= num_shots)
    shots[whole_turn] = (0, num_shots)

    # Beams: the steepest and flattest lines from the optical centres to top and bottom.
    with np.errstate(divide="ignore", invalid="ignore"):
        top = centre[:, 2] + half[:, 2] - float(origin[2].min())
        bottom = centre[:, 2] - half[:, 2] - float(origin[2].max())
        steepest_up = np.arctan2(top, np.where(top > 0, near_m, far_m)) + _WINDOW_SLACK_RAD
        steepest_down = np.arctan2(bottom, np.where(bottom < 0, near_m, far_m)) - _WINDOW_SLACK_RAD
    inclination = np.arcsin(direction[2].clip(-1, 1))
    highest, lowest = inclination.max(axis=1), inclination.min(axis=1)
    meets = (lowest <= steepest_up[:, None]) & (highest >= steepest_down[:, None])
    num_beams = len(highest)
    beams = np.stack([meets.argmax(axis=1), num_beams - meets[:, ::-1].argmax(axis=1)], axis=1)
    reachable = np.flatnonzero(meets.any(axis=1) & (near_m < MAX_RANGE_M))
    return _Windows(beams, shots, near_m, reachable[np.argsort(near_m[reachable], kind="stable")])


def _cast_solid(
    index: int,
    solids: _Solids,
    windows: _Windows,
    levelled: Floats,
    nearest: Floats,
    surface: NDArray[np.int32],
) -> None:
    """Test one solid against the rays of its window; updates ``nearest`` and ``surface``."""
    num_shots = nearest.shape[1]
    first, last = windows.shots[index]
    turn = first // num_shots * num_shots
    first, last = first - turn, last - turn
    pieces = [(first, min(last, num_shots))]
    if last > num_shots:
        pieces.append((0, last - num_shots))
    beams = slice(*windows.beams[index])
    for piece in pieces:
        window = (beams, slice(*piece))
        near = nearest[window]
        if near.max() <= windows.near_m[index]:
            continue
        origin, direction = levelled[(slice(None), slice(None), *window)].reshape(2, 3, -1)
        distance = _hit_distance(index, solids, origin, direction)
        _keep_nearer(distance.reshape(near.shape), index, near, surface[window])


def _keep_nearer(distance: Floats, index: int, nearest: Floats, surface: NDArray[np.int32]) -> None:
    nearer = (distance > 0) & (distance < nearest)
    np.copyto(nearest, distance, where=nearer)
    np.copyto(surface, index, where=nearer)


def _hit_distance(index: int, solids: _Solids, origin: Floats, direction: Floats) -> Floats:
    """Distance (R,) at which rays (3, R) enter a solid; NaN or negative where they do not."""
    cos_yaw, sin_yaw = solids.cos_yaw[index], solids.sin_yaw[index]
    half_x, half_y, half_z = solids.half_size[index]
    x, y, z = solids.centre[index]
    offset_x = (cos_yaw * x + sin_yaw * y) / half_x
    offset_y = (cos_yaw * y - sin_yaw * x) / half_y
    cos_x, sin_x = cos_yaw / half_x, sin_yaw / half_x
    cos_y, sin_y = cos_yaw / half_y, sin_yaw / half_y
    px = cos_x * origin[0] + sin_x * origin[1] - offset_x
    py = cos_y * origin[1] - sin_y * origin[0] - offset_y
    pz = (origin[2] - z) / half_z
    dx = cos_x * direction[0] + sin_x * direction[1]
    dy = cos_y * direction[1] - sin_y * direction[0]
    dz = direction[2] / half_z
    if solids.shape[index] == Shape.ELLIPSOID:
        squared = dx * dx + dy * dy + dz * dz
        cross = (py * dz - pz * dy) ** 2 + (pz * dx - px * dz) ** 2 + (px * dy - py * dx) ** 2
        middle = px * dx + py * dy + pz * dz
        return -(middle + np.sqrt(squared - cross)) / squared
    enter_z, leave_z = _slab(pz, dz)
    if solids.shape[index] == Shape.CYLINDER:
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
    return np.where(enter <= leave, enter, np.float32(np.nan))


def _slab(position: Floats, velocity: Floats) -> tuple[Floats, Floats]:
    """Where ``position + t velocity`` enters and leaves [-1, 1]."""
    # Bounded, because a ray along the slab (velocity 0) would give inf - inf.
    inverse = np.clip(np.reciprocal(velocity), np.float32(-1e30), np.float32(1e30))
    middle = -position * inverse
    half = np.abs(inverse)
    return middle - half, middle + half


def _cos_incidence(
    solids: _Solids, levelled: Floats, nearest: Floats, surface: NDArray[np.int32]
) -> Floats:
    """Cosine (H, W) between the rays and the normals of the surfaces that they hit."""
    cosine = np.where(surface == GROUND, np.abs(levelled[1, 2]), np.float32(0))
    hit = surface >= 0
    index = surface[hit]
    origin, direction = levelled[:, :, hit]
    shape, half, centre = solids.shape[index], solids.half_size[index].T, solids.centre[index].T
    cos_yaw, sin_yaw = solids.cos_yaw[index], solids.sin_yaw[index]

    def local(x: Floats, y: Floats, z: Floats) -> Floats:
        return np.stack([cos_yaw * x + sin_yaw * y, cos_yaw * y - sin_yaw * x, z])

    direction_local = local(*direction)
    unit = local(*(origin + nearest[hit] * direction - centre)) / half
    height = np.abs(unit[2])
    rim = np.hypot(unit[0], unit[1])
    gradient = unit / half
    gradient[2, shape == Shape.CYLINDER] = 0
    on_cap = (shape == Shape.CYLINDER) & (height > rim)
    # On a cap the height is 1 and the largest coordinate, as on the top of a box.
    on_face = (shape == Shape.BOX) | on_cap
    flat = (np.arange(3)[:, None] == np.abs(unit).argmax(axis=0)).astype(np.float32)
    normal = np.where(on_face, flat, gradient)
    along = np.abs((normal * direction_local).sum(axis=0))
    cosine[hit] = along / np.sqrt((normal * normal).sum(axis=0))
    return cosine

"""The footprint of a beam: the rim around a ray, where it reaches over edges, and what it meets.

Six points stand for the rim, on a ring of sqrt(2/3) of the beam's radius. Letters: M chosen rays, K
pairs of a ray and a surface that its rim may meet.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from r3dpa.simulation.raycast import surface_distance
from r3dpa.simulation.solids import GROUND, Floats
from r3dpa.simulation.sweep import IS_GROUND, Origin, Sweep

Indices = NDArray[np.int64]
Surfaces = NDArray[np.int32]

#: Ranges that differ by more make an edge.
EDGE_M = 0.3
# Seven points that integrate polynomials up to the fifth degree over a disk of radius 1 exactly
# (Radon 1948): the axis, and six on a ring.
_RING = math.sqrt(2 / 3) * np.exp(1j * np.pi / 3 * np.arange(6))
#: Where the points of the rim lie, ``(6,)`` in radii of the beam.
RING_LEFT, RING_UP = _RING.real.astype(np.float32), _RING.imag.astype(np.float32)


def at_edges(sweep: Sweep) -> Indices:
    """Rays beside a jump whose rim reaches over the edge of the nearer surface."""
    first = sweep.first
    near, far, left, up = _jumps(sweep)
    surface = first.surface[near]
    edge = (surface >= 0) & (surface != first.surface[far])
    edge &= (first.origin[near] == Origin.SURFACE) & ~IS_GROUND[sweep.material[near]]
    near, far, surface = near[edge], far[edge], surface[edge]
    radius = np.float32(sweep.sensor.divergence_rad / 2)
    left, up = radius * left[edge], radius * up[edge]
    both = np.concatenate([near, far])
    direction = turned_aside(sweep, both, np.concatenate([left, -left]), np.concatenate([up, -up]))
    met_m = _range_to(sweep, both, np.tile(surface, 2), direction)
    missed = np.isinf(met_m[: len(near)])
    reached = met_m[len(near) :] < first.range_m[far] - EDGE_M
    return np.concatenate([near[missed], far[reached]])


def beside_thin_solids(sweep: Sweep) -> tuple[Indices, Indices]:
    """Rays (K,) and the solids (K,), narrower than the pitch of the shots, that they may touch."""
    solids, (num_beams, num_shots) = sweep.solids, sweep.shape
    pitch = 2 * np.pi / num_shots
    centre_x, centre_y, _ = solids.centre.T
    half_x, half_y, _ = solids.half_size.T
    distance = np.hypot(centre_x, centre_y)
    ahead = centre_x * solids.cos_yaw + centre_y * solids.sin_yaw
    aside = centre_y * solids.cos_yaw - centre_x * solids.sin_yaw
    half_length = np.hypot(half_x, half_y)
    # Half the width seen from here, times the distance.
    half_width = half_x * np.abs(aside) + half_y * np.abs(ahead)
    thin = 2 * half_width < pitch * (distance - half_length) * distance
    if sweep.optical_depth is not None:
        thin &= solids.extinction == 0
    thin = np.flatnonzero(thin & (distance - half_length < sweep.sensor.max_range_m))

    # The shot of each beam that passes nearest; it starts where the sensor is when it is fired.
    beam, solid = (axis.ravel() for axis in np.meshgrid(np.arange(num_beams), thin, indexing="ij"))
    shot = np.rint(np.arctan2(centre_y, centre_x)[solid] / pitch).astype(np.int64)
    for _ in range(3):
        ahead, left = _seen_from(sweep, beam * num_shots + shot % num_shots, solid)
        shot += np.rint(np.arctan2(left, ahead) / pitch).astype(np.int64)
    rays = beam * num_shots + shot % num_shots
    radius = np.float32(sweep.sensor.divergence_rad / 2)
    x, y, z = sweep.direction[:, rays]
    slope = z / np.sqrt(x * x + y * y)
    off = np.abs(sweep.start[2, rays] + slope * ahead - solids.centre[solid, 2])
    slack = np.abs(slope) + np.abs(solids.grade[solid]).sum(axis=1)
    level = off <= solids.half_size[solid, 2] + slack * half_length[solid] + radius * ahead
    beam, shot, solid = beam[level], shot[level], solid[level]

    # Half a pitch to the nearest shot, half for the width, and the rim.
    around = math.ceil(0.5 + radius / pitch)
    offsets = np.arange(-around, around + 1)
    rays = (beam[:, None] * num_shots + (shot[:, None] + offsets) % num_shots).ravel()
    solid = np.repeat(solid, len(offsets))
    ahead, left = _seen_from(sweep, rays, solid)
    touched = np.abs(left) <= half_width[solid] / distance[solid] + radius * ahead
    return rays[touched & (ahead > 0)], solid[touched & (ahead > 0)]


def rim_ranges(sweep: Sweep, rays: Indices, surface: Surfaces) -> Floats:
    """Where the points of the rims of rays ``(K,)`` meet their surfaces, ``(6, K)``."""
    radius = np.float32(sweep.sensor.divergence_rad / 2)
    six = np.tile(rays, len(RING_LEFT))
    left, up = (np.repeat(radius * side, len(rays)) for side in (RING_LEFT, RING_UP))
    range_m = _range_to(
        sweep, six, np.tile(surface, len(RING_LEFT)), turned_aside(sweep, six, left, up)
    )
    return range_m.reshape(len(RING_LEFT), -1)


def _range_to(sweep: Sweep, rays: Indices, surface: Surfaces, direction: Floats) -> Floats:
    """Where rays ``(M,)`` in other directions meet given surfaces; infinite where they miss."""
    start = sweep.start[:, rays]
    solid = np.flatnonzero(surface >= 0)
    index = surface[solid]
    seen_from = start[:, solid]
    if sweep.actor_time_s is not None:
        seen_from[:2] -= sweep.solids.velocity[index].T * sweep.actor_time_s[rays[solid]]
    range_m = np.full(len(rays), np.inf, dtype=np.float32)
    range_m[solid], _ = surface_distance(sweep.solids, index, seen_from, direction[:, solid])
    ground = np.flatnonzero((surface == GROUND) & (direction[2] < 0))
    range_m[ground] = (np.float32(sweep.solids.ground_m) - start[2, ground]) / direction[2, ground]
    return np.where(range_m > 0, range_m, np.float32(np.inf))


def turned_aside(sweep: Sweep, rays: Indices, left: Floats, up: Floats) -> Floats:
    """Directions ``(3, M)`` at small angles to the left of rays and above them, radians."""
    x, y, z = sweep.direction[:, rays]
    level = np.sqrt(x * x + y * y)
    left, up = left / level, up / level
    # Their length is 1 to within the square of the angle: less than the step of a float32.
    return np.stack([x - left * y - up * z * x, y + left * x - up * z * y, z + up * level * level])


def _seen_from(sweep: Sweep, rays: Indices, solid: Indices) -> tuple[Floats, Floats]:
    """How far the centres of solids lie ahead of rays and to their left, seen from above."""
    x, y = sweep.solids.centre[solid, :2].T - sweep.start[:2, rays]
    if sweep.actor_time_s is not None:
        velocity, time_s = sweep.solids.velocity[solid].T, sweep.actor_time_s[rays]
        x, y = x + velocity[0] * time_s, y + velocity[1] * time_s
    along, across = sweep.direction[:2, rays]
    length = np.sqrt(along * along + across * across)
    return (along * x + across * y) / length, (along * y - across * x) / length


def _jumps(sweep: Sweep) -> tuple[Indices, Indices, Floats, Floats]:
    """Pairs of neighbouring rays that differ in range, and the way from one to the other.

    Returns:
        The nearer rays, the farther ones, and how far the rim of the nearer one reaches towards
        the farther, to the left and up, in radii of the beam; each ``(K,)``.
    """
    rays = sweep.grid(np.arange(sweep.num_rays))
    range_m = sweep.grid(sweep.first.range_m)
    closed_m = np.hstack([range_m, range_m[:, :1]])
    with np.errstate(invalid="ignore"):
        sides = (
            (np.diff(closed_m), rays, np.roll(rays, -1, axis=1), RING_LEFT.max(), 0),
            (np.diff(range_m, axis=0), rays[:-1], rays[1:], 0, RING_UP.min()),
        )
    found = []
    for rise_m, here, there, left, up in sides:
        jump = np.abs(rise_m) > EDGE_M
        rises, here, there = rise_m[jump] > 0, here[jump], there[jump]
        sign = np.where(rises, np.float32(1), np.float32(-1))
        near, far = np.where(rises, here, there), np.where(rises, there, here)
        found.append((near, far, sign * left, sign * up))
    near, far, left, up = (np.concatenate(columns) for columns in zip(*found, strict=True))
    return near, far, left, up

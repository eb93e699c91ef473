"""Mixed pixels: beams of finite width at edges.

The rim of the beam's footprint is six points on a ring of sqrt(2/3) of its radius. Letters:
M chosen rays, K pairs of a ray and a surface that its rim may meet.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarsim.draws import Draws, RayIndex
from lidarsim.effects.surface import surface_power
from lidarsim.raycast import normals, surface_distance
from lidarsim.scene import Scene
from lidarsim.sensors.spinning import SpinningLidar
from lidarsim.solids import EGO_BODY, GROUND, NO_SURFACE, Floats
from lidarsim.sweep import IS_GROUND, Echoes, Effect, Origin, Sweep

Indices = NDArray[np.int64]
Surfaces = NDArray[np.int32]
# Number of the ray among those chosen, surface, and the ray that sees the surface; each ``(K,)``.
_Layer = tuple[Indices, Surfaces, Indices]

#: Ranges that differ by more make an edge.
_EDGE_M = 0.3
# Seven points that integrate polynomials up to the fifth degree over a disk of radius 1 exactly
# (Radon 1948): the axis, and six on a ring.
_RING = math.sqrt(2 / 3) * np.exp(1j * np.pi / 3 * np.arange(6))
#: Where the points of the rim lie, ``(6,)`` in radii of the beam.
_RING_LEFT, _RING_UP = _RING.real.astype(np.float32), _RING.imag.astype(np.float32)
# Of the power of a beam: its axis, and each point of its rim.
_SHARES = np.array([2, 1, 1, 1, 1, 1, 1], dtype=np.float32)[:, None] / 8


class _Targets(NamedTuple):
    """Candidate pairs of ray and surface; the first M are each ray's own surface."""

    row: Indices  # (K,) number of the ray
    surface: Surfaces  # (K,)
    range_m: Floats  # (6, K) where the points of the rim meet it; infinite where they miss
    brightness: Floats  # (K,) power times range squared, if it fills the beam
    cosine: Floats  # (K,) of the incidence
    bounds: Indices  # pairs between two bounds are of different rays


class _Peak(NamedTuple):
    """An echo of each of M rays."""

    range_m: Floats
    power: Floats
    target: Indices  # the pair that gives most of the power
    mixed: NDArray[np.bool_]  # whether others give some


class MixedPixels(Effect):
    """Echoes of both sides of an edge, where a beam meets it with a part of its width.

    A ray is the axis of a beam whose full angle is ``divergence_rad``. Where its footprint reaches
    over the edge of a surface with another one more than 0.3 m behind it, or nothing, six rays are
    cast around it, on a ring of sqrt(2/3) of the beam's radius. The axis has the weight 1/4 and
    each point of the ring 1/8, which integrates over a uniform disk. A surface that fills a share
    of the footprint returns that share of its power.

    Echoes nearer to each other than ``pulse_depth_m`` (0.75 m at 5 ns) merge to one at their
    energy-weighted range. The strongest becomes the first echo, the next one the second.
    A pole of width w is met by ``(w + sqrt(2/3) * footprint) / pitch`` shots of a beam, some of
    them too weak to be detected.

    The ring is tested against the surfaces that the ray and its four neighbours meet, with the
    power of those echoes, and against solids so thin that all rays may miss them. Ground has no
    edge of its own: it only appears behind others. Leaves have no edge either: they fill the beam
    whose axis meets them and no other. Rays diverted by a pane or a mirror keep their echo.

    Real scans of an HDL-64E have returns between two smooth surfaces up to a gap of 0.75 to 0.9 m
    and few beyond, as a pulse of 5 to 6 ns gives.

    Source: HDL-64E datasheet (beam, pulse). Sub-rays per beam as in HELIOS++ (Winiwarter et al.,
    Remote Sensing of Environment 2022).
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        if not sensor.divergence_rad or not scene.primitives:
            return None
        return f"beam of {1e3 * sensor.divergence_rad:g} mrad, {len(scene.primitives)} solids"

    def rays(self, sweep: Sweep) -> RayIndex:
        """Rays whose rim reaches over an edge, and rays beside a thin solid."""
        chosen = np.zeros(sweep.num_rays, dtype=bool)
        chosen[_at_edges(sweep)] = True
        chosen[_beside_thin_solids(sweep)[0]] = True
        index = np.flatnonzero(chosen)
        origin, surface = sweep.first.origin[index], sweep.first.surface[index]
        straight = (origin == Origin.SURFACE) | (origin == Origin.FOLIAGE)
        return index[straight & (surface != EGO_BODY)]

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        chosen = np.arange(sweep.num_rays)[rays]
        targets = _targets_of(sweep, chosen)
        met, rim_m = _nearest(targets, len(chosen))
        axis_m = sweep.first.range_m[chosen]
        axis = np.where(np.isfinite(axis_m), np.arange(len(chosen)), -1)
        with np.errstate(invalid="ignore"):
            edge = (met != axis) & ~(np.abs(rim_m - axis_m) <= _EDGE_M)
        at = np.flatnonzero(edge.any(axis=0))
        # The hit of the axis is measured there: the surface's own slope makes no edge.
        range_m = np.vstack([axis_m, np.where(met == axis, axis_m, rim_m)])[:, at]
        met = np.vstack([axis, met])[:, at]
        first, second = _peaks(targets, met, range_m, sweep.sensor.pulse_depth_m)
        _record(sweep, chosen[at], at, targets, first, second)


def _targets_of(sweep: Sweep, rays: Indices) -> _Targets:
    """Own surfaces, neighbours' surfaces and thin solids that the rims of rays may meet."""
    first, beside = sweep.first, _neighbours(rays, sweep.shape)
    solid, solid_m = first.surface[rays], first.range_m[rays]
    other, other_m = first.surface[beside], first.range_m[beside]
    # Only a solid that ends before something else is missed by the rim of the ray that meets it.
    ends = (solid >= 0) & ((other != solid) & (other_m > solid_m + _EDGE_M)).any(axis=0)
    ends &= (first.origin[rays] == Origin.SURFACE) & ~IS_GROUND[sweep.material[rays]]
    wanted = (other >= GROUND) & (first.origin[beside] == Origin.SURFACE) & (other != solid)
    wanted &= ends | (other_m < solid_m - _EDGE_M)
    for later in range(1, len(beside)):
        wanted[later] &= ~(wanted[:later] & (other[:later] == other[later])).any(axis=0)

    layers: list[_Layer] = [(np.arange(len(rays)), solid, rays)]
    for side, chosen in enumerate(wanted):
        layers.append((np.flatnonzero(chosen), other[side, chosen], beside[side, chosen]))
    known = np.vstack([solid, np.where(wanted, other, np.int32(NO_SURFACE))])
    layers += _thin_layers(sweep, rays, known)
    bounds = np.cumsum([0, *(len(layer[0]) for layer in layers)])
    row, surface, seen_by = (np.concatenate(columns) for columns in zip(*layers, strict=True))
    # Surfaces without an edge fill the beam of the ray whose axis meets them.
    range_m = np.repeat(solid_m[row][None], len(_RING_LEFT), axis=0)
    tested = np.append(np.flatnonzero(ends), np.arange(len(rays), len(row)))
    range_m[:, tested] = _rim_ranges(sweep, rays[row[tested]], surface[tested])
    seen_m = first.range_m[seen_by]
    brightness = first.power[seen_by] * np.where(np.isfinite(seen_m), seen_m, 0) ** 2
    cosine = sweep.cos_incidence[seen_by]
    unseen = np.arange(bounds[1 + len(beside)], len(row))
    brightness[unseen], cosine[unseen] = _brightness_of_solids(
        sweep, rays[row[unseen]], surface[unseen], range_m[:, unseen]
    )
    return _Targets(row, surface, range_m, brightness, cosine, bounds)


def _neighbours(rays: Indices, shape: tuple[int, int]) -> Indices:
    """Rays ``(4, M)`` to the left, to the right, above and below; the same ones at the borders."""
    num_beams, num_shots = shape
    beam, shot = np.divmod(rays, num_shots)
    return np.stack(
        [
            beam * num_shots + (shot + 1) % num_shots,
            beam * num_shots + (shot - 1) % num_shots,
            np.where(beam > 0, rays - num_shots, rays),
            np.where(beam < num_beams - 1, rays + num_shots, rays),
        ]
    )


def _thin_layers(sweep: Sweep, rays: Indices, known: Surfaces) -> list[_Layer]:
    """Pairs of rays and thin solids that are not ``known`` ``(L, M)``, each ray once in a layer."""
    thin_ray, thin = _beside_thin_solids(sweep)
    row = np.searchsorted(rays, thin_ray).clip(max=len(rays) - 1)
    is_new = (rays[row] == thin_ray) & (known[:, row] != thin).all(axis=0)
    row, thin = row[is_new], thin[is_new].astype(np.int32)
    order = np.lexsort((thin, row))
    row, thin = row[order], thin[order]
    rank = np.arange(len(row)) - np.searchsorted(row, row)
    layers = []
    for layer in range(rank.max(initial=-1) + 1):
        chosen = rank == layer
        layers.append((row[chosen], thin[chosen], rays[row[chosen]]))
    return layers


def _brightness_of_solids(
    sweep: Sweep, rays: Indices, solid: Surfaces, rim_m: Floats
) -> tuple[Floats, Floats]:
    """Power times range squared of whole beams, and cosine, where rims meet solids first."""
    brightness, cosine = (np.zeros(len(rays), dtype=np.float32) for _ in range(2))
    point, nearest_m = rim_m.argmin(axis=0), rim_m.min(axis=0)
    hit = np.flatnonzero(np.isfinite(nearest_m))
    rays, solid, point = rays[hit], solid[hit], point[hit]
    radius = np.float32(sweep.sensor.divergence_rad / 2)
    direction = _turned_aside(sweep, rays, radius * _RING_LEFT[point], radius * _RING_UP[point])
    position = sweep.start[:, rays] + nearest_m[hit] * direction
    time_s = None if sweep.actor_time_s is None else sweep.actor_time_s[rays]
    cosine[hit] = np.abs((normals(sweep.solids, solid, position, time_s) * direction).sum(axis=0))
    reflectivity, material = sweep.look_of(solid)
    brightness[hit] = surface_power(reflectivity, cosine[hit], material, np.float32(1))
    return brightness, cosine


def _nearest(targets: _Targets, num_rays: int) -> tuple[Indices, Floats]:
    """Pair that each point of the rims meets first, -1 for none, and where; each ``(6, M)``."""
    met = np.full((len(_RING_LEFT), num_rays), -1)
    nearest_m = np.full(met.shape, np.inf, dtype=np.float32)
    for first, last in zip(targets.bounds[:-1], targets.bounds[1:], strict=True):
        row, there_m = targets.row[first:last], targets.range_m[:, first:last]
        nearer = there_m < nearest_m[:, row]
        met[:, row] = np.where(nearer, np.arange(first, last), met[:, row])
        nearest_m[:, row] = np.where(nearer, there_m, nearest_m[:, row])
    return met, nearest_m


def _peaks(targets: _Targets, met: Indices, range_m: Floats, merge_m: float) -> tuple[_Peak, _Peak]:
    """The two strongest echoes of M rays; echoes nearer than ``merge_m`` to each other are one.

    ``met``: ``(7, M)`` pair that each point of the footprint meets, -1 for none; ``range_m`` where.
    """
    # Every surface once, at the first point that meets it: its share and its mean range.
    same = (met[:, None] == met) & (met >= 0)
    share = (same * _SHARES[:, None]).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.where(same, _SHARES[:, None] * (range_m[:, None] - range_m), np.float32(0))
        range_m = range_m + off.sum(axis=0) / share
    once = (met >= 0) & (same.argmax(axis=0) == np.arange(len(met))[:, None])
    range_m = np.where(once, range_m, np.float32(np.inf))
    energy = np.where(once, share * targets.brightness[met] / range_m**2, np.float32(0))

    order = range_m.argsort(axis=0, kind="stable")
    met, range_m, energy = (np.take_along_axis(a, order, axis=0) for a in (met, range_m, energy))
    with np.errstate(invalid="ignore"):
        apart = np.diff(range_m, axis=0) >= merge_m
    peak_of = np.vstack([np.zeros_like(apart[:1]), apart]).cumsum(axis=0)
    columns = np.arange(met.shape[1])
    num_rays = met.shape[1]
    none = np.zeros(num_rays, dtype=np.float32)
    first = second = _Peak(none + np.inf, none, np.full(num_rays, -1), none > 0)
    for number in range(peak_of.max(initial=-1) + 1):
        part = np.where(peak_of == number, energy, np.float32(0))
        power, brightest = part.sum(axis=0), part.argmax(axis=0)
        at_m = range_m[brightest, columns]
        # Counted from the brightest, so that a peak of one surface keeps its range bitwise.
        with np.errstate(invalid="ignore", divide="ignore"):
            off = np.where(part > 0, part * (range_m - at_m), np.float32(0)).sum(axis=0) / power
        peak = _Peak(at_m + off, power, met[brightest, columns], (part > 0).sum(axis=0) > 1)
        wins, follows = power > first.power, power > second.power
        second = _either(wins, first, _either(follows, peak, second))
        first = _either(wins, peak, first)
    return first, second


def _either(chosen: NDArray[np.bool_], first: _Peak, other: _Peak) -> _Peak:
    pairs = ((np.asarray(a), np.asarray(b)) for a, b in zip(first, other, strict=True))
    return _Peak(*(np.where(chosen, a, b) for a, b in pairs))


def _record(
    sweep: Sweep,
    rays: Indices,
    own_pair: Indices,
    targets: _Targets,
    strongest: _Peak,
    next_one: _Peak,
) -> None:
    """Replace the echoes of rays whose own pairs are ``own_pair``."""
    first = sweep.first
    own_origin = first.origin[rays]

    def columns(peak: _Peak, seen: Indices) -> tuple[Floats, Floats, Surfaces, NDArray[np.uint8]]:
        origin = np.where(peak.target == own_pair, own_origin, np.uint8(Origin.SURFACE))
        origin = np.where(peak.mixed, np.uint8(Origin.MIXED), origin)
        surface = targets.surface[peak.target[seen]]
        return peak.range_m[seen], peak.power[seen], surface, origin[seen]

    seen = np.flatnonzero(strongest.power > 0)
    for old, new in zip(first.columns(), columns(strongest, seen), strict=True):
        old[rays[seen]] = new
    if sweep.second is not None:
        for old, none in zip(sweep.second.columns(), Echoes.none(1).columns(), strict=True):
            old[rays[seen]] = none
    again = np.flatnonzero(next_one.power > 0)
    sweep.offer(rays[again], *columns(next_one, again))
    # The properties of the surface change with it.
    hit = rays[seen]
    sweep.cos_incidence[hit] = targets.cosine[strongest.target[seen]]
    sweep.reflectivity[hit], sweep.material[hit] = sweep.look_of(first.surface[hit])


def _at_edges(sweep: Sweep) -> Indices:
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
    direction = _turned_aside(sweep, both, np.concatenate([left, -left]), np.concatenate([up, -up]))
    met_m = _range_to(sweep, both, np.tile(surface, 2), direction)
    missed = np.isinf(met_m[: len(near)])
    reached = met_m[len(near) :] < first.range_m[far] - _EDGE_M
    return np.concatenate([near[missed], far[reached]])


def _beside_thin_solids(sweep: Sweep) -> tuple[Indices, Indices]:
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


def _rim_ranges(sweep: Sweep, rays: Indices, surface: Surfaces) -> Floats:
    """Intersections of the rims of rays ``(K,)`` with their surfaces, ``(6, K)``."""
    radius = np.float32(sweep.sensor.divergence_rad / 2)
    six, surfaces = np.tile(rays, len(_RING_LEFT)), np.tile(surface, len(_RING_LEFT))
    left, up = (np.repeat(radius * side, len(rays)) for side in (_RING_LEFT, _RING_UP))
    direction = _turned_aside(sweep, six, left, up)
    return _range_to(sweep, six, surfaces, direction).reshape(len(_RING_LEFT), -1)


def _range_to(sweep: Sweep, rays: Indices, surface: Surfaces, direction: Floats) -> Floats:
    """Ranges where rays ``(M,)`` in other directions meet given surfaces; infinite for a miss."""
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


def _turned_aside(sweep: Sweep, rays: Indices, left: Floats, up: Floats) -> Floats:
    """Directions ``(3, M)`` at small angles to the left of rays and above them, radians."""
    x, y, z = sweep.direction[:, rays]
    level = np.sqrt(x * x + y * y)
    left, up = left / level, up / level
    # Their length is 1 to within the square of the angle: less than the step of a float32.
    return np.stack([x - left * y - up * z * x, y + left * x - up * z * y, z + up * level * level])


def _seen_from(sweep: Sweep, rays: Indices, solid: Indices) -> tuple[Floats, Floats]:
    """Distances of the centres of solids ahead of rays and to their left, seen from above."""
    x, y = sweep.solids.centre[solid, :2].T - sweep.start[:2, rays]
    if sweep.actor_time_s is not None:
        velocity = sweep.solids.velocity[solid].T
        time_s = sweep.actor_time_s[rays]
        x, y = x + velocity[0] * time_s, y + velocity[1] * time_s
    along, across = sweep.direction[:2, rays]
    length = np.sqrt(along * along + across * across)
    return (along * x + across * y) / length, (along * y - across * x) / length


def _jumps(sweep: Sweep) -> tuple[Indices, Indices, Floats, Floats]:
    """Pairs of neighbouring rays that differ in range, the nearer first.

    Also how far the rim of the nearer one reaches towards the farther one, to the left and up, in
    radii of the beam; each ``(K,)``.
    """
    rays = sweep.grid(np.arange(sweep.num_rays))
    range_m = sweep.grid(sweep.first.range_m)
    closed_m = np.hstack([range_m, range_m[:, :1]])
    with np.errstate(invalid="ignore"):
        sides = (
            (np.diff(closed_m), rays, np.roll(rays, -1, axis=1), _RING_LEFT.max(), 0),
            (np.diff(range_m, axis=0), rays[:-1], rays[1:], 0, _RING_UP.min()),
        )
    pairs = []
    for rise_m, here, there, left, up in sides:
        jump = np.abs(rise_m) > _EDGE_M
        rises, here, there = rise_m[jump] > 0, here[jump], there[jump]
        sign = np.where(rises, np.float32(1), np.float32(-1))
        near, far = np.where(rises, here, there), np.where(rises, there, here)
        pairs.append((near, far, sign * left, sign * up))
    near, far, left, up = (np.concatenate(columns) for columns in zip(*pairs, strict=True))
    return near, far, left, up

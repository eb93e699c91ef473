"""Surfaces: diffuse reflection, texture and sheeting; glass, polished metal and water.

Secondary rays, through glass and from mirrors, go one step: every surface that they meet is treated
as diffuse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from lidarsim.draws import Draws, RayIndex, generator_for, smooth_field
from lidarsim.raycast import cast_single, normals, surface_distance
from lidarsim.scene import Material, Scene
from lidarsim.sensors.spinning import SpinningLidar
from lidarsim.solids import NO_SURFACE, Floats
from lidarsim.sweep import Effect, Origin, Sweep

# Oren-Nayar coefficients of each material by the standard deviation of its facets' slope: fitted
# to the intensity of KITTI's scans for all but paint, glass, metal and sheeting, which are smooth.
_SLOPE_SD_RAD = np.full(len(Material), 0.5)
_SLOPE_SD_RAD[
    [Material.PAINT, Material.GLASS, Material.POLISHED_METAL, Material.RETROREFLECTOR]
] = 0.0
_VARIANCE = _SLOPE_SD_RAD**2
_SMOOTH_PART = (1 - 0.5 * _VARIANCE / (_VARIANCE + 0.33)).astype(np.float32)
_ROUGH_PART = (0.45 * _VARIANCE / (_VARIANCE + 0.09)).astype(np.float32)
# Power of a weak patch in units of the detection limit: intensity 0, and rarely lost.
_WEAK_POWER = 2.4
# Beams and shots over which weak patches are alike.
_PATCH_RAYS = (1.0, 3.5)
# The coefficient of retroreflection falls with this power of the cosine of incidence.
_FALL = 6
_GLASS_INDEX, _WATER_INDEX = 1.52, 1.33
# Solids of glass that are thinner than this are single panes.
_PANE_M = 0.1
# Depth from which on water covers the ground.
_FULL_FILM_MM = 1.2
# Largest distance of a pane from the wall that it belongs to.
_ATTACHED_M = 0.25
# Water stands only where the normal of the ground is this close to upright.
_LEVEL_COS = 0.9


def surface_power(
    reflectivity: Floats,
    cos_incidence: Floats,
    material: NDArray[np.integer],
    range_m: Floats | np.float32,
) -> Floats:
    """Received over emitted power of a diffuse surface that is larger than the beam, m^-2.

    A surface of facets whose slopes have the standard deviation s returns in the direction of the
    light (Oren and Nayar, SIGGRAPH 1994)::

        power = reflectivity * (A cos(theta) + B sin(theta)^2) / range^2
        A = 1 - s^2 / 2 / (s^2 + 0.33)        B = 0.45 s^2 / (s^2 + 0.09)

    which is Lambert's law for s = 0. With s = 0.5, asphalt of reflectivity 0.1 that is seen from
    1.73 m above has the power 1.43e-5 at 50 m. With Lambert's law alone the detection limit would
    have to be 1.38e-6 for the same range, and paint of 5 % would be detected at 100 m.

    All arguments have one shape; ``range_m`` of infinity gives 0.
    """
    sine_squared = 1 - cos_incidence * cos_incidence
    factor = _SMOOTH_PART[material] * cos_incidence + _ROUGH_PART[material] * sine_squared
    return reflectivity * factor / (range_m * range_m)


class DiffuseReflection(Effect):
    """Diffuse reflection, see :func:`surface_power`: power falls with range and incidence."""

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        return "base"

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        sweep.first.power[rays] *= surface_power(
            sweep.reflectivity[rays],
            sweep.cos_incidence[rays],
            sweep.material[rays],
            sweep.first.range_m[rays],
        )


@dataclass(frozen=True)
class SurfaceTexture(Effect):
    """Variation of the reflectivity within a surface, from shot to shot.

    With n drawn from the standard normal distribution::

        power -> power * exp(s n)

    which keeps the median. Source: from shot to shot the logarithm of the intensity, the
    root of the power, scatters by 0.15 to 0.23 on the ground and on smooth things and by 0.26 to
    0.35 where neighbours differ by 6 cm to 0.5 m in range, in four drives of 30 scans of KITTI.

    Args:
        spread: s of all surfaces but leaves.
        leaf_spread: s of leaves, whose orientation is random.
    """

    spread: float = 0.32
    leaf_spread: float = 0.62

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        return "base"

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        spread = np.full(len(Material), self.spread, dtype=np.float32)
        spread[Material.FOLIAGE] = self.leaf_spread
        sweep.first.power[rays] *= np.exp(spread[sweep.material[rays]] * draws.normal(rays))


class WeakPatches(Effect):
    """Patches whose echoes are barely detected, with intensity 0.

    With the normal field g of :func:`smooth_field` over beams and shots::

        power -> min(power, 2.4 min_power)        where g exceeds its quantile 1 - weak_share

    except on sheeting.

    Source: in KITTI's scans 3 to 7 % of the returns of the ground at 5 to 15 m and 5 to 10 % of
    the returns of upright surfaces have intensity 0, and so has the next shot in 83 to 90 % of
    these (30 scans of four drives).
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        share = sensor.weak_share
        return f"{share:.1%} of the echoes are weak" if share > 0 else None

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        shift = int(sweep.num_rays * draws.uniform(slice(0, 1))[0])
        field = np.roll(_patches(sweep.shape), shift)
        chosen = field > ndtri(1 - sweep.sensor.weak_share)
        weak = np.flatnonzero(chosen & (sweep.material != Material.RETROREFLECTOR))
        most = np.float32(_WEAK_POWER * sweep.sensor.min_power)
        for echoes in sweep.echoes():
            echoes.power[weak] = np.minimum(echoes.power[weak], most)


@lru_cache(maxsize=4)
def _patches(shape: tuple[int, int]) -> Floats:
    """Normal field ``(R,)`` that chooses the patches."""
    field = smooth_field(shape, _PATCH_RAYS, generator_for("patches", *shape))
    return field.astype(np.float32).reshape(-1)


def sheets(scene: Scene) -> str | None:
    """Number of retro-reflecting sheets, or of their recorded points, as a text; None without."""
    if scene.sheet_points:
        return f"{scene.sheet_points} points as bright as sheeting"
    count = sum(p.material is Material.RETROREFLECTOR for p in scene.primitives)
    return f"{count} retro-reflecting sheets" if count else None


@dataclass(frozen=True)
class RetroReflection(Effect):
    """Retro-reflection of sheeting: hundreds of times the echo of paint.

    The coefficient of retroreflection R_A is the intensity returned by an area of the sheet,
    divided by the illuminance across the beam and by the area; for a diffuse surface of
    reflectivity 1 at normal incidence it is 1 / pi. It falls with the angle of incidence t about
    as cos(t)^6, from 70 at 5 degrees to 30 at 30 degrees and 10 at 40 degrees, so that with the
    diffuse echo::

        power -> power * (1 + pi R_A cos(t)^4 / reflectivity)

    which is 220 times white paint at normal incidence and no more than a few times from 60
    degrees on.

    Source: CIE 17-24-103 (definition); class RA1 of EN 12899-1, white, seen at 0.2 degrees.

    Args:
        retroreflection: R_A at normal incidence, cd / (lx m^2).
    """

    retroreflection: float = 70.0

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        return sheets(scene)

    def rays(self, sweep: Sweep) -> RayIndex:
        return sweep.of_material(Material.RETROREFLECTOR)

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        # One power of the cosine is in the diffuse echo, another in the illuminated area.
        falling = sweep.cos_incidence[rays] ** (_FALL - 2)
        gain = np.float32(math.pi * self.retroreflection) * falling / sweep.reflectivity[rays]
        sweep.first.power[rays] *= 1 + gain


def fresnel_reflectance(cos_incidence: Floats, index: float) -> Floats:
    """Share of unpolarised light that one smooth surface from air to a medium reflects.

    With c the cosine of incidence and c' the cosine of refraction, ``c'^2 = 1 - (1 - c^2) / n^2``::

        F = ((c - n c') / (c + n c'))^2 / 2 + ((n c - c') / (n c + c'))^2 / 2

    Source: Fresnel's equations. Glass (n = 1.52): 0.043 at 0 and 0.61 at 85 degrees; water
    (n = 1.33): 0.020, 0.35 at 80 and 0.80 at 88 degrees.
    """
    cosine = cos_incidence
    refracted = np.sqrt(1 - (1 - cosine * cosine) / np.float32(index * index))
    across = (cosine - index * refracted) / (cosine + index * refracted)
    along = (index * cosine - refracted) / (index * cosine + refracted)
    return (across * across + along * along) / 2


class Glass(Effect):
    """Glass returns the strongest of three echoes: its dirt, the object behind, the mirror image.

    A pane has two surfaces of reflectance F. With all reflections between them, its transmittance
    and reflectance are::

        T = (1 - F) / (1 + F)        1 - T = 2 F / (1 + F)

    0.918 and 0.082 at normal incidence, 0.24 and 0.76 at 85 degrees (where F of one surface is
    0.61). With ``surface_power`` along the whole path, the echoes have the power::

        dirt      as of the pane's own reflectivity        its surface, as cast
        behind    T^2 * surface_power(object)              0.843 of it at normal incidence
        mirrored  (1 - T)^2 * surface_power(object)        at the first direction

    A thick solid of glass is a hollow shell, such as a cabin: a ray that leaves it passes a second
    pane. A thin pane attached to a closed solid of the same instance is a window: through it the
    solid is seen from inside. Panes in the openings of a wall (slats) have curtains: what stands
    behind them is met from outside. The glint of a pane that faces the sensor to within the beam's
    divergence is not modelled.
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        count = sum(p.material is Material.GLASS for p in scene.primitives)
        return f"{count} panes and cabins of glass" if count else None

    def rays(self, sweep: Sweep) -> RayIndex:
        return sweep.of_material(Material.GLASS)

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        struck = _struck(sweep, rays)
        is_shell = 2 * sweep.solids.half_size[struck.surface].min(axis=1) >= _PANE_M
        hollow = np.where(is_shell, NO_SURFACE, _attached_solid(sweep, struck.surface))
        passed = self._transmittance(_cosine(struck.direction, struck.normal))
        seen = _look(sweep, struck, struck.direction, hollow.astype(np.int32))
        two_way = passed * passed
        again = np.flatnonzero(is_shell & np.isfinite(seen.distance_m))
        leaving = self._leaving(sweep, struck.only(again), seen.distance_m[again])
        two_way[again] *= leaving * leaving
        sweep.offer(struck.rays, seen.range_m, two_way * seen.power, seen.surface, Origin.GLASS)
        _offer_mirrored(sweep, struck, 1 - passed)

    def _transmittance(self, cos_incidence: Floats) -> Floats:
        reflectance = fresnel_reflectance(cos_incidence, _GLASS_INDEX)
        return (1 - reflectance) / (1 + reflectance)

    def _leaving(self, sweep: Sweep, struck: _Struck, distance_m: Floats) -> Floats:
        """Transmittance where rays leave their shell; 1 for those that end within it."""
        start = struck.at.copy()
        start[:2] -= sweep.solids.velocity[struck.surface].T * struck.time_s
        _, leave_m = surface_distance(sweep.solids, struck.surface, start, struck.direction)
        beyond = np.flatnonzero(distance_m > leave_m)
        out = struck.only(beyond)
        exit_at = out.at + leave_m[beyond] * out.direction
        normal = normals(sweep.solids, out.surface, exit_at, out.time_s)
        transmittance = np.ones_like(distance_m)
        transmittance[beyond] = self._transmittance(_cosine(out.direction, normal))
        return transmittance


@dataclass(frozen=True)
class PolishedMetal(Effect):
    """Mirror images in polished metal, at the first direction and the length of the path.

    With the reflectance q, and ``surface_power`` along the whole path::

        mirrored  q^2 * surface_power(object)        direct  (1 - q) * (the metal's own echo)

    so that the image of a point lies where a flat mirror shows it. Curved metal mirrors as its
    tangent plane; the widening of the beam is not modelled.

    Args:
        reflectance: Share of the light that is mirrored, 0.9 for steel and aluminium at 905 nm.
    """

    reflectance: float = 0.9

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        count = sum(p.material is Material.POLISHED_METAL for p in scene.primitives)
        return f"{count} solids of polished metal" if count else None

    def rays(self, sweep: Sweep) -> RayIndex:
        return sweep.of_material(Material.POLISHED_METAL)

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        sweep.first.power[rays] *= np.float32(1 - self.reflectance)
        struck = _struck(sweep, rays)
        _offer_mirrored(sweep, struck, np.full_like(struck.leg_m, self.reflectance))


class WetGround(Effect):
    """Water darkens the ground, most at grazing incidence; puddles mirror.

    Beam and echo pass the surface of a film that covers the share f of the ground, of reflectance F
    each time, and refraction spreads the echo by n^2::

        f = min(film / full film, 1)
        power -> power * (1 - f + f (1 - F)^2 / n^2)

    0.54 at normal incidence and 0.023 at 88 degrees. In a puddle f = 1, and there is a mirrored
    echo of F^2 * ``surface_power(object)``, below the ground. A puddle has its size of the scene at
    the full film; its area is proportional to the film.

    Source: film model of Hahner et al. (LiDAR snowfall simulation, CVPR 2022), depth 1.2 mm.
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        film_mm = scene.weather.water_film_mm
        return f"{film_mm:.2g} mm of water, {len(scene.puddles)} puddles" if film_mm > 0 else None

    def rays(self, sweep: Sweep) -> RayIndex:
        return sweep.on_ground()

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        assert not isinstance(rays, slice)
        film = min(sweep.scene.weather.water_film_mm / _FULL_FILM_MM, 1.0)
        cover = np.full(len(rays), film, dtype=np.float32)
        cosine = sweep.cos_incidence[rays]
        standing = self._in_puddles(sweep, rays, film)
        cover[standing] = 1
        # Water stands level, whatever the slope of the ground.
        cosine[standing] = np.abs(sweep.direction[2, rays[standing]])
        reflectance = fresnel_reflectance(cosine, _WATER_INDEX)
        passed = 1 - reflectance
        sweep.first.power[rays] *= 1 - cover + cover * passed * passed / np.float32(_WATER_INDEX**2)
        struck = _struck(sweep, rays[standing])
        struck.normal[:] = np.array([0, 0, 1], dtype=np.float32)[:, None]
        _offer_mirrored(sweep, struck, reflectance[standing])

    def _in_puddles(self, sweep: Sweep, rays: NDArray[np.int64], film: float) -> NDArray[np.int64]:
        pose = sweep.scene.pose
        cosine, sine = np.cos(pose.heading_rad), np.sin(pose.heading_rad)
        x, y, _ = sweep.position(rays)
        inside = np.zeros(len(rays), dtype=bool)
        for puddle in sweep.scene.puddles:
            east, north = puddle.x_m - pose.x_m, puddle.y_m - pose.y_m
            ahead, left = cosine * east + sine * north, cosine * north - sine * east
            inside |= (x - ahead) ** 2 + (y - left) ** 2 < film * puddle.radius_m**2
        wet = np.flatnonzero(inside)
        return wet[_struck(sweep, rays[wet]).normal[2] > _LEVEL_COS]


class _Struck(NamedTuple):
    """Hits of the rays on their surfaces."""

    rays: NDArray[np.int64]  # (M,)
    surface: NDArray[np.int32]  # (M,)
    leg_m: Floats  # (M,) range
    time_s: Floats  # (M,) when they meet moving solids
    at: Floats  # (3, M)
    direction: Floats  # (3, M)
    normal: Floats  # (3, M)

    def only(self, chosen: NDArray[np.int64]) -> _Struck:
        """A selection of the hits."""
        columns: list[Any] = [column[..., chosen] for column in self]
        return _Struck(*columns)


def _struck(sweep: Sweep, rays: RayIndex) -> _Struck:
    rays = np.arange(sweep.num_rays)[rays]
    surface, at = sweep.first.surface[rays], sweep.position(rays)
    time_s = np.zeros(len(rays), dtype=np.float32)
    if sweep.actor_time_s is not None:
        time_s = sweep.actor_time_s[rays]
    normal = normals(sweep.solids, surface, at, time_s)
    leg_m, direction = sweep.first.range_m[rays], sweep.direction[:, rays]
    return _Struck(rays, surface, leg_m, time_s, at, direction, normal)


class _Seen(NamedTuple):
    """Hits of secondary rays, ``(M,)``; infinite distance and power 0 for a miss."""

    distance_m: Floats  # from where they start
    range_m: Floats  # of the whole path
    power: Floats  # as if nothing lay on the path
    surface: NDArray[np.int32]


def _look(sweep: Sweep, struck: _Struck, direction: Floats, hollow: NDArray[np.int32]) -> _Seen:
    """Cast secondary rays from the hits, see ``cast_single``."""
    reach_m, solids = sweep.sensor.max_range_m - struck.leg_m, sweep.solids
    distance_m, surface = cast_single(
        solids, struck.at, direction, struck.time_s, reach_m, struck.surface, hollow
    )
    onward_m = np.nan_to_num(distance_m, posinf=0.0)
    at = struck.at + onward_m * direction
    normal = normals(solids, surface, at, struck.time_s)
    range_m = struck.leg_m + distance_m
    reflectivity, material = sweep.look_of(surface)
    power = surface_power(reflectivity, _cosine(direction, normal), material, range_m)
    return _Seen(distance_m, range_m, power, surface)


def _offer_mirrored(sweep: Sweep, struck: _Struck, reflectance: Floats) -> None:
    """Add mirror images in surfaces of this reflectance, where a white object would be recorded."""
    best = (reflectance / struck.leg_m) ** 2
    chosen = np.flatnonzero(best > sweep.weakest_recorded()[struck.rays])
    struck, two_way = struck.only(chosen), reflectance[chosen] ** 2
    across = (struck.direction * struck.normal).sum(axis=0)
    mirrored = struck.direction - 2 * across * struck.normal
    seen = _look(sweep, struck, mirrored, np.full(len(chosen), NO_SURFACE, dtype=np.int32))
    sweep.offer(struck.rays, seen.range_m, two_way * seen.power, seen.surface, Origin.MIRROR)


def _attached_solid(sweep: Sweep, panes: NDArray[np.int32]) -> NDArray[np.int64]:
    """The closed solid of the same instance that each pane ``(M,)`` is attached to, if any."""
    solids, primitives = sweep.solids, sweep.scene.primitives
    instance = np.array([p.instance for p in primitives])
    closed = np.array([p.material is not Material.GLASS for p in primitives], dtype=bool)
    closed &= (instance > 0) & (solids.extinction == 0)
    different, back = np.unique(panes, return_inverse=True)
    attached = np.full(len(different), NO_SURFACE)
    for row, pane in enumerate(different):
        mates = np.flatnonzero(closed & (instance == instance[pane]))
        if not len(mates):
            continue
        # Distance of the middle of the pane from the bounding box of each.
        x, y, z = (solids.centre[pane] - solids.centre[mates]).T
        cosine, sine = solids.cos_yaw[mates], solids.sin_yaw[mates]
        turned = np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=1)
        gap_m = np.hypot.reduce((np.abs(turned) - solids.half_size[mates]).clip(min=0), axis=1)
        if gap_m.min() < _ATTACHED_M:
            attached[row] = mates[gap_m.argmin()]
    return attached[back]


def _cosine(direction: Floats, normal: Floats) -> Floats:
    return np.abs((direction * normal).sum(axis=0))

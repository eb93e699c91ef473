"""State of one simulated turn (rays, hits and echoes), and the interface of its effects.

Letters: R shots of the turn, beam after beam (R = H * W); M chosen rays.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from lidarsim.draws import Draws, RayIndex
from lidarsim.raycast import cast, cast_single, normals
from lidarsim.scene import Material, Scene, Semantic
from lidarsim.sensors.spinning import SpinningLidar
from lidarsim.solids import (
    GROUND,
    NO_SURFACE,
    Floats,
    Solids,
    level,
    pieces,
    solids_of,
    windows_of,
)

#: Whether water can lie on each ``Material``: road, pavement, soil.
IS_GROUND = np.zeros(len(Material), dtype=bool)
IS_GROUND[[Material.ASPHALT, Material.PAVING, Material.SOIL]] = True

# Leaves have random orientation: mean of |cos| over a sphere.
_FOLIAGE_COS = 0.5
_BLOCK_RAYS = 16384


class Origin(IntEnum):
    """Origin of a point."""

    SURFACE = 0
    MIXED = 1
    FOLIAGE = 2
    GLASS = 3
    MIRROR = 4
    FOG = 5
    RAIN = 6
    SNOW = 7
    SPRAY = 8
    BLOOMING = 9
    SUN = 10
    SECOND_RETURN = 11


@dataclass(slots=True)
class Echoes:
    """One echo of every shot; all arrays are ``(R,)``."""

    range_m: Floats  # length of the path; infinite without an echo
    power: Floats  # received over emitted, m^-2; 0 without an echo
    surface: NDArray[np.int32]  # index of the primitive, GROUND, EGO_BODY or NO_SURFACE
    origin: NDArray[np.uint8]  # Origin of the echo

    @classmethod
    def none(cls, num: int) -> Echoes:
        """No echo of any shot."""
        return cls(
            np.full(num, np.inf, dtype=np.float32),
            np.zeros(num, dtype=np.float32),
            np.full(num, NO_SURFACE, dtype=np.int32),
            np.zeros(num, dtype=np.uint8),
        )

    def columns(self) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """The arrays, in the order of the arguments."""
        return self.range_m, self.power, self.surface, self.origin


class Sweep:
    """One turn of the sensor in a scene; effects change it in place.

    ``first`` is the strongest echo of each shot. It stays the first where the air attenuates it
    below the second, so that single and dual return modes report the same first echo.
    """

    def __init__(self, scene: Scene, sensor: SpinningLidar) -> None:
        origin, direction = (level(array, scene.pose).reshape(3, -1) for array in sensor.rays)
        self.shape = (sensor.num_beams, sensor.shots)
        self._begin(scene, sensor, origin, direction, sensor.time_s.reshape(-1))

    def _begin(
        self,
        scene: Scene,
        sensor: SpinningLidar,
        start: Floats,
        direction: Floats,
        time_s: Floats,
    ) -> None:
        """State of a turn with these rays before anything is known of their hits."""
        self.scene = scene
        self.sensor = sensor
        self.num_rays = len(time_s)
        zeros = np.zeros(self.num_rays, dtype=np.float32)
        self.start = start  # (3, R) of the rays in the scene frame, metres
        self.direction = direction  # (3, R) unit vectors in the scene frame
        self.time_s = time_s  # from the middle of the sweep
        # Power (R,) of echoes that are known to have been detected; None before the detection.
        self.recorded_power: Floats | None = None
        self.actor_time_s: Floats | None = None  # when rays meet moving solids; None: at time 0
        self.optical_depth: Floats | None = None  # depth of rays in foliage; None: it is closed
        self.solids = solids_of(scene.primitives, scene.pose, scene.ground_m)
        self.first = Echoes.none(self.num_rays)
        self.second: Echoes | None = None  # the next echo, if it is recorded
        # Of the surface that was hit:
        self.cos_incidence: Floats = zeros  # cosine between ray and normal
        self.reflectivity: Floats = zeros.copy()
        self.material: NDArray[np.uint8] = zeros.astype(np.uint8)
        self.extinction_per_m = 0.0  # of the air, as far as effects have attenuated the echoes
        self.min_power: Floats = zeros + np.float32(sensor.min_power)  # weakest detected, m^-2

    def grid(self, values: NDArray) -> NDArray:
        """Values ``(..., R)`` as ``(..., H, W)``."""
        return values.reshape(*values.shape[:-1], *self.shape)

    def cast(self) -> None:
        """Cast the rays; every echo has power 1 until an effect sets it."""
        depth, actor_time_s = (
            None if field is None else self.grid(field)
            for field in (self.optical_depth, self.actor_time_s)
        )
        start, direction = self.grid(self.start), self.grid(self.direction)
        limit_m = self.sensor.max_range_m
        range_m, surface = cast(self.solids, start, direction, limit_m, actor_time_s, depth)
        first = self.first
        first.range_m, first.surface = range_m.reshape(-1), surface.reshape(-1)
        first.power = (first.surface != NO_SURFACE).astype(np.float32)
        self.reflectivity, self.material = self.look_of(first.surface)
        self.cos_incidence = self._cos_incidence()
        if depth is not None:
            is_medium = [p.extinction_per_m > 0 for p in self.scene.primitives]
            inside = np.flatnonzero(self.of_surface(is_medium, 0, bool))
            first.origin[inside] = Origin.FOLIAGE
            self.cos_incidence[inside] = _FOLIAGE_COS

    def _cos_incidence(self) -> Floats:
        surface = self.first.surface
        cosine = np.where(surface == GROUND, np.abs(self.direction[2]), np.float32(0))
        every_hit = np.flatnonzero(surface >= 0)
        # In blocks, whose temporaries stay in the cache: twice as fast.
        for first in range(0, len(every_hit), _BLOCK_RAYS):
            hit = every_hit[first : first + _BLOCK_RAYS]
            time_s = None if self.actor_time_s is None else self.actor_time_s[hit]
            normal = normals(self.solids, surface[hit], self.position(hit), time_s)
            cosine[hit] = np.abs(np.einsum("im,im->m", normal, self.direction.take(hit, axis=1)))
        return cosine

    def position(self, rays: NDArray[np.int64]) -> Floats:
        """Hit of the first echo of rays ``(M,)``, ``(3, M)`` in the scene frame."""
        # Much faster than indexing the second axis.
        towards = self.direction.take(rays, axis=1)
        towards *= self.first.range_m[rays]
        towards += self.start.take(rays, axis=1)
        return towards

    def rays_near(self, solids: Solids) -> list[NDArray[np.int64]]:
        """Rays (M,) that can meet each solid where it is at their time, from its bounding box."""
        near = [np.empty(0, dtype=np.int64)] * len(solids.shape)
        if not near:
            return near
        start, direction = self.grid(self.start), self.grid(self.direction)
        limit_m, time_s = self.sensor.max_range_m, self.grid(self.time_s)
        windows = windows_of(solids, start, direction, limit_m, time_s)
        every_ray = self.grid(np.arange(self.num_rays))
        for index in windows.order:
            parts = pieces(index, windows, self.shape[1])
            near[index] = np.concatenate([every_ray[part].ravel() for part in parts])
        return near

    def of_surface(
        self,
        values: list,
        ground: float,
        dtype: type,
        surface: NDArray[np.int32] | None = None,
        ego: float = 0,
    ) -> NDArray:
        """Values ``(M,)`` of surfaces, by default the cast ones, 0 for ``NO_SURFACE``.

        ``values``: one per primitive of the scene. ``ego``: of the recording car.
        """
        # EGO_BODY, NO_SURFACE and GROUND are the last entries of the table.
        table: NDArray = np.array([*values, ego, 0, ground], dtype=dtype)
        return table[self.first.surface if surface is None else surface]

    def look_of(self, surface: NDArray[np.int32]) -> tuple[Floats, NDArray[np.uint8]]:
        """Reflectivity and ``Material`` of surfaces ``(M,)``."""
        solids, ground = self.scene.primitives, self.scene.ground_reflectivity
        share, kind = [p.reflectivity for p in solids], [p.material for p in solids]
        return (
            self.of_surface(share, ground, np.float32, surface),
            self.of_surface(kind, Material.ASPHALT, np.uint8, surface),
        )

    def on_ground(self) -> NDArray[np.int64]:
        """Rays that hit ground on which water can lie: road, pavement, soil."""
        return np.flatnonzero(IS_GROUND[self.material] & (self.first.surface >= GROUND))

    def on_sheets(self) -> NDArray[np.bool_]:
        """Mask of the rays ``(R,)`` whose echo comes from retro-reflecting sheeting."""
        is_sheet = [p.material is Material.RETROREFLECTOR for p in self.scene.primitives]
        return self.of_surface(is_sheet, 0, bool)

    def pairs_around(
        self, rays: NDArray[np.int64], reach_rad: float
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Pairs of a ray and a neighbour; they contain all neighbours within ``reach_rad``."""
        num_beams, num_shots = self.shape
        lasers = np.array(self.sensor.lasers.inclination_rad)
        steepest = min(np.abs(lasers).max() + reach_rad, math.radians(85))
        # One more on either side: the azimuths of the beams are shifted within a step.
        reach = math.ceil(reach_rad / math.cos(steepest) * num_shots / (2 * math.pi)) + 1
        shots = np.arange(-min(reach, (num_shots - 1) // 2), min(reach, num_shots // 2) + 1)
        level = -lasers
        beams_around = np.searchsorted(level, level + reach_rad, "right") - np.arange(num_beams)
        beams = np.arange(1 - beams_around.max(), beams_around.max())
        beam, shot = np.divmod(rays, num_shots)
        beam = beam[:, None, None] + beams[:, None]
        shot = (shot[:, None, None] + shots) % num_shots
        beside = beam * num_shots + shot
        inside = np.broadcast_to((beam >= 0) & (beam < num_beams), beside.shape)
        return np.broadcast_to(rays[:, None, None], beside.shape)[inside], beside[inside]

    def is_open(self, direction: Floats) -> bool:
        """Whether nothing stands in a direction ``(3,)`` in the middle of the sweep."""
        nothing = np.full(1, NO_SURFACE, dtype=np.int32)
        here, towards = self.start.mean(axis=1, keepdims=True), direction[:, None]
        now = np.zeros(1, dtype=np.float32)
        reach_m = np.full(1, 1e3)
        _, surface = cast_single(self.solids, here, towards, now, reach_m, nothing, nothing)
        return bool(surface[0] == NO_SURFACE)

    def of_material(self, material: Material) -> NDArray[np.int64]:
        """Rays that hit a material of the scene; the recording car counts as diffuse."""
        return np.flatnonzero((self.material == material) & (self.first.surface >= GROUND))

    def echoes(self) -> Iterator[Echoes]:
        """The recorded echoes: the first, and the second where there is one."""
        yield self.first
        if self.second is not None:
            yield self.second

    def weakest_recorded(self) -> Floats:
        """Power ``(R,)`` from which on a further echo is recorded."""
        if self.second is None:
            return self.first.power
        return np.minimum(self.first.power, self.second.power)

    def offer(
        self,
        rays: NDArray[np.int64],
        range_m: Floats,
        power: Floats,
        surface: NDArray[np.int32] | int,
        origin: NDArray[np.uint8] | int,
    ) -> None:
        """Add echoes ``(M,)`` of different rays: a stronger one replaces the first.

        The stronger of the remaining echo and the second one becomes the second. Echoes of power
        0 are ignored.
        """
        offered = [
            np.broadcast_to(np.asarray(values), rays.shape)
            for values in (range_m, power, surface, origin)
        ]
        first = self.first.columns()
        stronger = power > self.first.power[rays]
        if self.second is not None:
            left_over = [
                np.where(stronger, old[rays], values)
                for old, values in zip(first, offered, strict=True)
            ]
            again = left_over[1] > self.second.power[rays]
            for old, values in zip(self.second.columns(), left_over, strict=True):
                old[rays[again]] = values[again]
        for old, values in zip(first, offered, strict=True):
            old[rays[stronger]] = values[stronger]

    def labels(self, surface: NDArray[np.int32], origin: NDArray[np.uint8]) -> NDArray[np.uint32]:
        """Labels ``(M,)``: semantic class in the lower 16 bits, instance in the upper.

        Points whose origin is in the air are unlabelled.
        """
        codes = [p.semantic | p.instance << 16 for p in self.scene.primitives]
        coded = self.of_surface(codes, Semantic.ROAD, np.uint32, surface, Semantic.EGO_VEHICLE)
        # Other echoes from the air have no surface; echoes of a halo keep the label of their sheet.
        coded[origin == Origin.BLOOMING] = Semantic.UNLABELED
        return coded


class Effect(ABC):
    """One physical effect: the condition under which it runs, its rays, and the change to them."""

    @abstractmethod
    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """Reason why the scene or the instrument calls for the effect; None if neither does."""

    def rays(self, sweep: Sweep) -> RayIndex:
        """Rays that the effect may change, by default all."""
        return slice(None)

    @abstractmethod
    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Change these rays of the sweep."""

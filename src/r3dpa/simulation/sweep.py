"""The state of one turn while it is simulated: rays, what they hit, what comes back.

Letters: R shots of the turn, beam after beam (R = H * W); M chosen rays.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from r3dpa.simulation.raycast import cast, normals
from r3dpa.simulation.scene import GROUND_MATERIALS, Material, Scene, Semantic
from r3dpa.simulation.sensor import SpinningLidar
from r3dpa.simulation.solids import GROUND, NO_SURFACE, Floats, Solids, level, scene_solids
from r3dpa.simulation.windows import pieces, windows_of

#: Rays that an effect touches: indices ``(M,)``, or ``slice(None)`` for all.
RayIndex = NDArray[np.int64] | slice

#: Whether water can lie on each ``Material``: road, pavement, soil.
IS_GROUND = np.isin(np.arange(len(Material)), GROUND_MATERIALS)

# Leaves are turned every way: mean of |cos| over a sphere.
_FOLIAGE_COS = 0.5
_BLOCK_RAYS = 16384


class Origin(IntEnum):
    """What made a point."""

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


#: Origins whose points show no surface, so that they have no label.
IN_THE_AIR = (Origin.FOG, Origin.RAIN, Origin.SNOW, Origin.SPRAY, Origin.BLOOMING, Origin.SUN)


@dataclass(slots=True)
class Echoes:
    """One echo of every shot; all arrays are ``(R,)``.

    Args:
        range_m: Range that is measured: length of the path; infinite without an echo.
        power: Received over emitted power, m^-2; 0 without an echo.
        surface: Index of the primitive, ``GROUND``, ``EGO_BODY`` or ``NO_SURFACE``.
        origin: ``Origin`` of the echo.
    """

    range_m: Floats
    power: Floats
    surface: NDArray[np.int32]
    origin: NDArray[np.uint8]

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

    Args:
        scene: What is scanned.
        sensor: What scans it.

    Attributes:
        shape: ``(H, W)`` beams and shots.
        start: ``(3, R)`` where the rays start in the scene frame, metres.
        direction: ``(3, R)`` unit vectors in the scene frame.
        time_s: ``(R,)`` when they are fired, seconds from the middle of the sweep.
        actor_time_s: ``(R,)`` when each ray meets the moving solids, or None: all at time 0.
        optical_depth: ``(R,)`` how deep each ray gets into foliage, or None: foliage is closed.
        solids: The primitives as the ray cast wants them.
        cos_incidence: ``(R,)`` cosine between ray and normal of the surface that was hit.
        reflectivity: ``(R,)`` of that surface.
        material: ``(R,)`` of that surface; meaningless where nothing is hit.
        first: The strongest echo of each shot. It stays the first where the air weakens it below
            the second: an instrument that records one echo knows of no other.
        second: The next echo of each shot, or None where it is not recorded.
        min_power: ``(R,)`` weakest power that is detected, m^-2.
    """

    def __init__(self, scene: Scene, sensor: SpinningLidar) -> None:
        self.scene = scene
        self.sensor = sensor
        self.shape = (sensor.num_beams, sensor.shots)
        self.num_rays = sensor.num_beams * sensor.shots
        origin, direction = (level(array, scene.pose).reshape(3, -1) for array in sensor.rays)
        self.start: Floats = origin
        self.direction: Floats = direction
        self.time_s: Floats = sensor.time_s.reshape(-1)
        self.actor_time_s: Floats | None = None
        self.optical_depth: Floats | None = None
        self.solids = scene_solids(scene)
        self.first = Echoes.none(self.num_rays)
        self.second: Echoes | None = None
        self.cos_incidence: Floats = np.zeros(self.num_rays, dtype=np.float32)
        self.reflectivity: Floats = np.zeros(self.num_rays, dtype=np.float32)
        self.material: NDArray[np.uint8] = np.zeros(self.num_rays, dtype=np.uint8)
        self.min_power: Floats = np.full(self.num_rays, sensor.min_power, dtype=np.float32)

    def grid(self, values: NDArray) -> NDArray:
        """Values ``(..., R)`` as ``(..., H, W)``."""
        return values.reshape(*values.shape[:-1], *self.shape)

    def cast(self) -> None:
        """Find what the rays hit; every echo has power 1 until a surface gives it another."""
        depth, actor_time_s = (
            None if field is None else self.grid(field)
            for field in (self.optical_depth, self.actor_time_s)
        )
        range_m, surface = cast(
            self.solids,
            self.grid(self.start),
            self.grid(self.direction),
            self.sensor.max_range_m,
            actor_time_s,
            depth,
        )
        first = self.first
        first.range_m, first.surface = range_m.reshape(-1), surface.reshape(-1)
        first.power = (first.surface != NO_SURFACE).astype(np.float32)
        self.reflectivity = self.of_surface(
            [p.reflectivity for p in self.scene.primitives],
            self.scene.ground_reflectivity,
            np.float32,
        )
        self.material = self.of_surface(
            [p.material for p in self.scene.primitives], Material.ASPHALT, np.uint8
        )
        self.cos_incidence = self._cos_incidence()
        if depth is not None:
            inside = np.flatnonzero(
                self.of_surface([p.extinction_per_m > 0 for p in self.scene.primitives], 0, bool)
            )
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

    def position(self, rays: RayIndex) -> Floats:
        """Where rays meet the surface of their first echo, ``(3, M)`` in the scene frame."""
        if isinstance(rays, slice):
            return self.start[:, rays] + self.first.range_m[rays] * self.direction[:, rays]
        # Much faster than indexing the second axis.
        towards = self.direction.take(rays, axis=1)
        towards *= self.first.range_m[rays]
        towards += self.start.take(rays, axis=1)
        return towards

    def rays_near(self, solids: Solids, actor_time_s: Floats | None) -> list[NDArray[np.int64]]:
        """For each solid the rays (M,) that can meet it, from its bounding box.

        Args:
            solids: Solids in the scene frame.
            actor_time_s: ``(R,)`` when the rays meet those that move; None in the middle of the
                sweep.
        """
        found = [np.empty(0, dtype=np.int64)] * len(solids.shape)
        if not found:
            return found
        windows = windows_of(
            solids,
            self.grid(self.start),
            self.grid(self.direction),
            self.sensor.max_range_m,
            None if actor_time_s is None else self.grid(actor_time_s),
        )
        every_ray = self.grid(np.arange(self.num_rays))
        for index in windows.order:
            parts = pieces(index, windows, self.shape[1])
            found[index] = np.concatenate([every_ray[part].ravel() for part in parts])
        return found

    def of_surface(
        self,
        values: list,
        ground: float,
        dtype: type,
        surface: NDArray[np.int32] | None = None,
        ego: float = 0,
    ) -> NDArray:
        """What a table of values per primitive says of surfaces, by default those of the cast.

        Args:
            values: One value per primitive of the scene.
            ground: Value of the ground.
            dtype: Of the result; 0 stands where there is no surface.
            surface: ``(M,)`` surfaces.
            ego: Value of the recording car.
        """
        # EGO_BODY, NO_SURFACE and GROUND are the last entries of the table.
        table: NDArray = np.array([*values, ego, 0, ground], dtype=dtype)
        return table[self.first.surface if surface is None else surface]

    def on_ground(self) -> NDArray[np.int64]:
        """Rays that hit ground on which water can lie: road, pavement, soil."""
        return np.flatnonzero(IS_GROUND[self.material] & (self.first.surface >= GROUND))

    def of_material(self, material: Material) -> NDArray[np.int64]:
        """Rays that hit a material of the scene; the recording car is matt, whatever it is of."""
        return np.flatnonzero((self.material == material) & (self.first.surface >= GROUND))

    def echoes(self) -> Iterator[Echoes]:
        """The recorded echoes: the first, and the second where there is one."""
        yield self.first
        if self.second is not None:
            yield self.second

    def weakest_recorded(self) -> Floats:
        """Power ``(R,)`` that an echo needs to be recorded beside those there are."""
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
        """Further echoes of some rays: one that is stronger than the first takes its place.

        Of the echo that is left over and the second one, the stronger is the second.

        Args:
            rays: ``(M,)`` different rays.
            range_m: ``(M,)`` ranges of the echoes.
            power: ``(M,)`` their power; an echo of power 0 is none.
            surface: ``(M,)`` or one for all.
            origin: ``(M,)`` or one for all.
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
        """Label of each point: semantic class in the lower 16 bits, instance in the upper.

        Args:
            surface: ``(M,)`` surfaces of the points.
            origin: ``(M,)`` what made them; points in the air are unlabelled.
        """
        coded = self.of_surface(
            [p.semantic | p.instance << 16 for p in self.scene.primitives],
            Semantic.ROAD,
            np.uint32,
            surface,
            Semantic.EGO_VEHICLE,
        )
        coded[np.isin(origin, IN_THE_AIR)] = Semantic.UNLABELED
        return coded

"""Motion of the sensor and of solids during the sweep; foliage and the recording car."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

from lidarsim.draws import Draws, RayIndex, generator_for, smooth_field
from lidarsim.raycast import cast, normals
from lidarsim.scene import Pose, Primitive, Scene
from lidarsim.sensors.spinning import SpinningLidar
from lidarsim.solids import EGO_BODY, NO_SURFACE, Floats, level, solids_of
from lidarsim.sweep import Effect, Origin, Sweep

# Widths of a clump in beams and shots, smaller and larger ones alike, and the spread of the
# logarithm of the density of leaves.
_CLUMP_RAYS, _CLUMP_SPREAD = ((0.7, 1.2), (2.0, 6.0)), 0.7
# Correlation of a ray's own depth with the field of the clumps.
_ALIKE = 0.94


class RollingShutter(Effect):
    """Distortion by the motion of the sensor during the sweep; the points are not corrected.

    Each shot starts and points as the sensor has moved and turned, see
    :meth:`lidarsim.scene.EgoMotion.moved`, while the point is stored as if it had stood still. At
    50 km/h the two ends of the sweep, which meet behind the car, differ by 1.39 m.

    Source: raw scans of KITTI-360 are not motion-compensated; its development kit "curls" them.
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        motion = scene.motion
        if not motion.speed_m_s and not motion.yaw_rate_rad_s:
            return None
        turn_deg = np.degrees(motion.yaw_rate_rad_s)
        return f"ego moves at {motion.speed_m_s:.1f} m/s, {turn_deg:.1f} deg/s"

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        motion, pose = sweep.scene.motion, sweep.scene.pose
        ahead, aside, angle = motion.moved(sweep.time_s)
        cosine, sine = np.cos(angle), np.sin(angle)
        origin, direction = (array.reshape(3, -1) for array in sweep.sensor.rays)

        def turned(vectors: Floats) -> Floats:
            x = cosine * vectors[0] - sine * vectors[1]
            y = sine * vectors[0] + cosine * vectors[1]
            return np.stack([x, y, vectors[2]])

        start = turned(origin)
        start[0] += ahead
        start[1] += aside
        sweep.start = level(start.astype(np.float32), pose)
        sweep.direction = level(turned(direction), pose)


class MovingActors(Effect):
    """Position of moving solids at the time of each shot.

    An object crossing at v is sheared by ``v * (its width in azimuth) / (2 pi) * 0.1 s``.
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        count = sum(any(p.velocity_m_s) for p in scene.primitives)
        return f"{count} moving solids" if count else None

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        sweep.actor_time_s = sweep.time_s


class FoliageOcclusion(Effect):
    """Penetration of rays into media: crowns, meadows and wire mesh.

    With the extinction k per metre, the depth s at which a leaf, a blade or a wire is hit has the
    density::

        p(s) = k exp(-k s)        mean depth 1 / k

    and a ray that leaves the solid before that depth continues. Leaves sit in clumps, so
    neighbouring rays get about as deep, and k is not the same everywhere. With a Gaussian field g
    of unit variance over beams and shots and a draw n of each ray::

        s = -ln(1 - Phi(r g + sqrt(1 - r^2) n)) exp(a g) / c k        c: so that the mean is 1 / k

    The widths of g were chosen for holes in leaves that are as alike as in a few scans of KITTI
    (correlation 0.4, 0.25 and 0.15 at one, two and four shots), r and a for the share of
    neighbouring shots that differ by more than 0.5 m at one, two and four shots. Every ray draws a
    depth; only those that meet leaves use it.
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        count = sum(p.extinction_per_m > 0 for p in scene.primitives)
        return f"{count} solids of leaves, grass or mesh" if count else None

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        shift = int(sweep.num_rays * draws.uniform(slice(0, 1))[0])
        shared, factor = (np.roll(values, shift) for values in _clumps(sweep.shape))
        single = np.float32(math.sqrt(1 - _ALIKE**2)) * draws.normal(slice(None))
        sweep.optical_depth = -np.log(ndtr(-shared - single)) * factor


@lru_cache(maxsize=4)
def _clumps(shape: tuple[int, int]) -> tuple[Floats, Floats]:
    """Normal field ``(R,)`` that neighbouring rays share, and factors ``(R,)`` of their depths."""
    generator = generator_for("clumps", *shape)
    field = np.zeros(shape)
    for width in _CLUMP_RAYS:
        field += smooth_field(shape, width, generator) / math.sqrt(len(_CLUMP_RAYS))
    factor = np.exp(_CLUMP_SPREAD * field - _CLUMP_SPREAD**2 / 2) / _mean_of_product()
    shared = _ALIKE * field
    return shared.astype(np.float32).reshape(-1), factor.astype(np.float32).reshape(-1)


def _mean_of_product() -> float:
    """Mean of depth times factor; exp(a g - a^2 / 2) moves the mean of g to a."""
    normal, weight = np.polynomial.hermite_e.hermegauss(40)
    return -float((weight * log_ndtr(-normal - _ALIKE * _CLUMP_SPREAD)).sum() / weight.sum())


class EgoOcclusion(Effect):
    """Occlusion by the roof of the recording car; the mask is the same in every scan."""

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        return f"{len(scene.ego_body)} parts of the recording car" if scene.ego_body else None

    def rays(self, sweep: Sweep) -> RayIndex:
        return _ego_mask(sweep.scene.ego_body, sweep.sensor).rays

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        mask = _ego_mask(sweep.scene.ego_body, sweep.sensor)
        nearer = mask.range_m < sweep.first.range_m[mask.rays]
        hit = mask.rays[nearer]
        sweep.first.range_m[hit] = mask.range_m[nearer]
        sweep.first.surface[hit] = EGO_BODY
        sweep.first.power[hit] = 1
        sweep.first.origin[hit] = Origin.SURFACE
        sweep.cos_incidence[hit] = mask.cos_incidence[nearer]
        sweep.reflectivity[hit] = mask.reflectivity[nearer]
        sweep.material[hit] = mask.material[nearer]


class _EgoMask(NamedTuple):
    """The M rays that meet the car, and their hits; all arrays are ``(M,)``."""

    rays: NDArray[np.int64]
    range_m: Floats
    cos_incidence: Floats
    reflectivity: Floats
    material: NDArray[np.uint8]


@lru_cache(maxsize=8)
def _ego_mask(ego_body: tuple[Primitive, ...], sensor: SpinningLidar) -> _EgoMask:
    body = solids_of(ego_body, Pose(z_m=0.0), ground_m=-1e6)
    origin, direction = sensor.rays
    range_m, surface = cast(body, origin, direction, sensor.max_range_m)
    hit = surface != NO_SURFACE
    normal = normals(body, surface[hit], origin[:, hit] + range_m[hit] * direction[:, hit], None)
    cosine = np.abs((normal * direction[:, hit]).sum(axis=0))
    reflectivity = np.array([p.reflectivity for p in ego_body], dtype=np.float32)[surface[hit]]
    material = np.array([p.material for p in ego_body], dtype=np.uint8)[surface[hit]]
    return _EgoMask(np.flatnonzero(hit), range_m[hit], cosine, reflectivity, material)

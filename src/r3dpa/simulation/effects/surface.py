"""Power returned by surfaces: diffuse reflection, texture, retro-reflecting sheeting."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from r3dpa.simulation.draws import Draws, RayIndex
from r3dpa.simulation.scene import Material, Scene
from r3dpa.simulation.sensor import SpinningLidar
from r3dpa.simulation.solids import Floats
from r3dpa.simulation.sweep import Effect, Sweep

# Oren-Nayar coefficients of each material by the standard deviation of its facets' slope: fitted
# to the intensity of KITTI's scans for all but paint, glass, metal and sheeting, which are smooth.
_SLOPE_SD_RAD = np.full(len(Material), 0.5)
_SLOPE_SD_RAD[
    [Material.PAINT, Material.GLASS, Material.POLISHED_METAL, Material.RETROREFLECTOR]
] = 0.0
_VARIANCE = _SLOPE_SD_RAD**2
_SMOOTH_PART = (1 - 0.5 * _VARIANCE / (_VARIANCE + 0.33)).astype(np.float32)
_ROUGH_PART = (0.45 * _VARIANCE / (_VARIANCE + 0.09)).astype(np.float32)
# The coefficient of retroreflection falls with this power of the cosine of incidence.
_FALL = 6


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
    """Diffuse reflection: echoes fall with the square of the range and with incidence.

    ::

        power = reflectivity * (A cos(theta) + B sin(theta)^2) / range^2

    Source and coefficients: :func:`surface_power`; smooth surfaces (B = 0) follow Lambert's law.
    """

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
    root of the power, scatters by 0.15 to 0.23 on the ground and on smooth things and by 0.42 to
    0.45 in foliage, in all four drives of 30 scans of KITTI.

    Args:
        spread: s of all surfaces but leaves.
        leaf_spread: s of leaves, whose orientation is random.
    """

    spread: float = 0.36
    leaf_spread: float = 0.86

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        return "base"

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        spread = np.full(len(Material), self.spread, dtype=np.float32)
        spread[Material.FOLIAGE] = self.leaf_spread
        sweep.first.power[rays] *= np.exp(spread[sweep.material[rays]] * draws.normal(rays))


def sheets(scene: Scene) -> str | None:
    """Number of retro-reflecting sheets as a text; None without any."""
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

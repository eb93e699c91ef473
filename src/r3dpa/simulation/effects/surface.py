"""How strongly surfaces send the beam back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from r3dpa.simulation.effects.base import Draws, Stage
from r3dpa.simulation.scene import Material, Scene
from r3dpa.simulation.sensor import SpinningLidar
from r3dpa.simulation.solids import Floats
from r3dpa.simulation.sweep import RayIndex, Sweep

# Oren-Nayar coefficients of each material by the standard deviation of its facets' slope: fitted
# to the intensity of KITTI's scans for all but paint, glass, metal and sheeting, which are smooth.
_SLOPE_SD_RAD = np.full(len(Material), 0.5)
_SLOPE_SD_RAD[
    [Material.PAINT, Material.GLASS, Material.POLISHED_METAL, Material.RETROREFLECTOR]
] = 0.0
_VARIANCE = _SLOPE_SD_RAD**2
_SMOOTH_PART = (1 - 0.5 * _VARIANCE / (_VARIANCE + 0.33)).astype(np.float32)
_ROUGH_PART = (0.45 * _VARIANCE / (_VARIANCE + 0.09)).astype(np.float32)


def surface_power(
    reflectivity: Floats,
    cos_incidence: Floats,
    material: NDArray[np.integer],
    range_m: Floats | np.float32,
) -> Floats:
    """Received over emitted power of a diffuse surface that is larger than the beam, m^-2.

    Seen from where it is lit, a surface of facets whose slopes have the standard deviation s
    returns (Oren and Nayar, SIGGRAPH 1994, in the direction of the light)::

        power = reflectivity * (A cos(theta) + B sin(theta)^2) / range^2
        A = 1 - s^2 / 2 / (s^2 + 0.33)        B = 0.45 s^2 / (s^2 + 0.09)

    which is Lambert's law for s = 0. With s = 0.5, asphalt of reflectivity 0.1 that is seen from
    1.73 m above has the power 1.43e-5 at 50 m. Lambert's law alone needs a limit of 1.38e-6 for
    that, with which paint of 5 % would be seen at 100 m and nothing but the road ever vanished.

    Args:
        reflectivity: Of the surfaces, any shape.
        cos_incidence: Cosine between ray and normal.
        material: ``Material`` of the surfaces.
        range_m: Range, metres; infinity gives 0.
    """
    sine_squared = 1 - cos_incidence * cos_incidence
    factor = _SMOOTH_PART[material] * cos_incidence + _ROUGH_PART[material] * sine_squared
    return reflectivity * factor / (range_m * range_m)


@dataclass(frozen=True)
class DiffuseReflection:
    """Surfaces are diffuse: their echo falls with the square of the range and with incidence.

    ::

        power = reflectivity * (A cos(theta) + B sin(theta)^2) / range^2

    Source and coefficients: :func:`surface_power`; smooth surfaces (B = 0) follow Lambert's law.
    """

    stage: ClassVar[Stage] = Stage.SURFACE

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """Every scene has a ground."""
        return "base"

    def rays(self, sweep: Sweep) -> RayIndex:
        """All; those that hit nothing get power 0, as they have."""
        return slice(None)

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Give every echo its power."""
        sweep.first.power[rays] *= surface_power(
            sweep.reflectivity[rays],
            sweep.cos_incidence[rays],
            sweep.material[rays],
            sweep.first.range_m[rays],
        )


@dataclass(frozen=True)
class SurfaceTexture:
    """No surface is of one reflectivity: each shot meets a spot that is brighter or darker.

    With n drawn from the standard normal distribution::

        power -> power * exp(s n)

    which leaves the median alone. Source: from shot to shot the logarithm of the intensity, the
    root of the power, scatters by 0.15 to 0.23 on the ground and on smooth things and by 0.42 to
    0.45 in foliage, in all four drives of 30 scans of KITTI.

    Args:
        spread: s of all surfaces but leaves.
        leaf_spread: s of leaves, which are turned every way.

    Raises:
        ValueError: If a spread is negative or infinite.
    """

    spread: float = 0.36
    leaf_spread: float = 0.86
    stage: ClassVar[Stage] = Stage.SURFACE

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("spread", "leaf_spread"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be 0 or greater, got {getattr(self, name)}")

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """Every scene has surfaces."""
        return "base"

    def rays(self, sweep: Sweep) -> RayIndex:
        """All."""
        return slice(None)

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Scale the power of every echo."""
        spread = np.full(len(Material), self.spread, dtype=np.float32)
        spread[Material.FOLIAGE] = self.leaf_spread
        sweep.first.power[rays] *= np.exp(spread[sweep.material[rays]] * draws.normal(rays))

"""Retro-reflecting sheeting on signs and licence plates, and how it dazzles the receiver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from r3dpa.simulation.effects.base import Draws, Stage
from r3dpa.simulation.scene import Material, Scene
from r3dpa.simulation.sensor import SpinningLidar
from r3dpa.simulation.solids import Floats
from r3dpa.simulation.sweep import Origin, RayIndex, Sweep

# How the coefficient of retroreflection falls with incidence, as a power of its cosine.
_FALL = 6


def _sheets(scene: Scene) -> str | None:
    count = sum(p.material is Material.RETROREFLECTOR for p in scene.primitives)
    return f"{count} retro-reflecting sheets" if count else None


@dataclass(frozen=True)
class RetroReflection:
    """Sheeting sends the beam back to where it came from, hundreds of times what paint does.

    The coefficient of retroreflection R_A is the intensity that an area of the sheet sends back,
    over the illuminance across the beam and the area; that of a matt surface of reflectivity 1,
    at normal incidence, is 1 / pi. It falls with the angle of incidence t about as cos(t)^6, from
    70 at 5 degrees to 30 at 30 degrees and 10 at 40 degrees, so that beside its matt echo::

        power -> power * (1 + pi R_A cos(t)^4 / reflectivity)

    which is 220 times white paint at normal incidence and no more than a few times from 60
    degrees on.

    Source: CIE 17-24-103 (definition); class RA1 of EN 12899-1, white, seen at 0.2 degrees.

    Args:
        retroreflection: R_A at normal incidence, cd / (lx m^2).

    Raises:
        ValueError: If the coefficient is negative or infinite.
    """

    retroreflection: float = 70.0
    stage: ClassVar[Stage] = Stage.SURFACE

    def __post_init__(self) -> None:
        """Check the value."""
        if not 0 <= self.retroreflection < math.inf:
            raise ValueError(f"retroreflection must be 0 or greater, got {self.retroreflection}")

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """Solids of such sheeting."""
        return _sheets(scene)

    def rays(self, sweep: Sweep) -> RayIndex:
        """Those that hit sheeting."""
        return sweep.of_material(Material.RETROREFLECTOR)

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Strengthen their echoes."""
        # One power of the cosine is in the matt echo, another in the area that the beam lights.
        falling = sweep.cos_incidence[rays] ** (_FALL - 2)
        gain = np.float32(math.pi * self.retroreflection) * falling / sweep.reflectivity[rays]
        sweep.first.power[rays] *= 1 + gain


@dataclass(frozen=True)
class Blooming:
    """An echo of sheeting spills into shots that pass beside it: a halo at the same range.

    A shot at the angle a from one that hits sheeting with power P receives::

        with the chance  exp(-(a / halo)^2) * min(1, sqrt(P / P_sat))     an echo of  spill * P

    out to 2.5 times the halo; of several such shots the likeliest counts. ``P_sat`` is the
    strongest echo that a matt surface gives: that of a white one where the receiver first sees the
    whole beam, ``1 / overlap_range_m^2``. Sheeting that is seen straight on stays above it out to
    15 times that range (74 m), with a halo of one angle; beyond, and for weaker or tilted
    sheeting, the halo thins with 1 / R.

    Source: bright runs in 30 scans of KITTI's HDL-64E have one dimmer shot at the same range on
    either side (median at all ranges from 5 to 80 m; the mean falls beyond 45 m), of an intensity
    of 0.45 to 0.8: these agree with the default halo and give the spill. The form is chosen.

    Args:
        halo_deg: Angle at which the chance has fallen to 1 / e.
        spill: Share of the power that a neighbouring shot receives.

    Raises:
        ValueError: If the angle does not lie in (0, 5] or the share not in [0, 1].
    """

    halo_deg: float = 0.2
    spill: float = 2e-3
    stage: ClassVar[Stage] = Stage.DETECTION

    def __post_init__(self) -> None:
        """Check the values."""
        if not 0 < self.halo_deg <= 5:
            raise ValueError(f"halo_deg must lie in (0, 5], got {self.halo_deg}")
        if not 0 <= self.spill <= 1:
            raise ValueError(f"spill must lie in [0, 1], got {self.spill}")

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """Solids of sheeting."""
        return _sheets(scene)

    def rays(self, sweep: Sweep) -> RayIndex:
        """The neighbours of those with an echo of sheeting."""
        return self._likeliest(sweep)[0]

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Draw which neighbours are dazzled and offer them the echo."""
        beside, source, chance = self._likeliest(sweep)
        dazzled = draws.uniform(beside) < chance
        beside, source = beside[dazzled], source[dazzled]
        first = sweep.first
        sweep.offer(
            beside,
            first.range_m[source],
            np.float32(self.spill) * first.power[source],
            first.surface[source],
            Origin.BLOOMING,
        )

    def _likeliest(self, sweep: Sweep) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
        """Rays beside sheeting, the ray that each is most likely dazzled with, and the chance."""
        is_sheet = sweep.of_surface(
            [p.material is Material.RETROREFLECTOR for p in sweep.scene.primitives], 0, bool
        )
        bright = np.flatnonzero(is_sheet & (sweep.first.power > 0))
        halo_rad = math.radians(self.halo_deg)
        source, beside = _pairs(bright, sweep, 2.5 * halo_rad)
        keep = ~is_sheet[beside]
        source, beside = source[keep], beside[keep]
        # The chord of unit vectors; the cosine of so small an angle is lost in float32.
        apart = sweep.direction[:, source] - sweep.direction[:, beside]
        squared = (apart * apart).sum(axis=0)
        keep = squared <= (2.5 * halo_rad) ** 2
        source, beside, squared = source[keep], beside[keep], squared[keep]
        saturated_power = np.float32(sweep.sensor.overlap_range_m**-2)
        chance = np.exp(-squared / np.float32(halo_rad**2))
        chance *= np.sqrt(sweep.first.power[source] / saturated_power).clip(max=1)
        order = np.lexsort((-chance, beside))
        likeliest = order[np.diff(beside[order], prepend=-1) > 0]
        return beside[likeliest], source[likeliest], chance[likeliest]


def _pairs(
    rays: NDArray[np.int64], sweep: Sweep, reach_rad: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rays, and shots and beams around each that contain all within ``reach_rad``, as pairs."""
    num_beams, num_shots = sweep.shape
    lasers = np.array(sweep.sensor.lasers.inclination_rad)
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

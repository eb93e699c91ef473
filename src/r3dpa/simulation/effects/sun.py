"""A low sun shines into the receiver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from r3dpa.simulation.effects.base import Draws, Stage
from r3dpa.simulation.raycast import cast_single
from r3dpa.simulation.scene import Scene, Weather
from r3dpa.simulation.sensor import SpinningLidar
from r3dpa.simulation.solids import NO_SURFACE
from r3dpa.simulation.sweep import Origin, RayIndex, Sweep

_REACH_DEG = 10.0
# Optical depth of the clear air overhead at 905 nm.
_AIR_DEPTH = 0.1


@dataclass(frozen=True)
class SunGlare:
    """Near the sun its light raises the detection threshold and makes returns of nothing.

    At the angle g from the sun, within 10 degrees of it, and the elevation e::

        glare = cos^4(90 deg g / 10 deg) * exp(-0.1 / (sin e + 0.50572 (e + 6.07995 deg)^-1.6364))
        min_power -> min_power * (1 + rise * glare)
        a return of noise with the probability noise * glare, at any range, of twice that power

    The angle is scaled so that the effect ends at 10 degrees without a jump; the second factor,
    what the air leaves of the sun's light, dims it towards the horizon. A sun that a solid hides
    from the sensor does not glare.

    Source: Kasten and Young 1989 for the air on the way.

    Args:
        rise: Rise of the threshold in the direction of a sun that no air dims.
        noise: Probability of a return of noise there.

    Raises:
        ValueError: If the rise is negative or infinite, or the probability lies outside [0, 1].
    """

    rise: float = 3.0
    noise: float = 1e-3

    stage: ClassVar[Stage] = Stage.DETECTION

    def __post_init__(self) -> None:
        """Check the values."""
        if not 0 <= self.rise < math.inf:
            raise ValueError(f"rise must be 0 or greater, got {self.rise}")
        if not 0 <= self.noise <= 1:
            raise ValueError(f"noise must lie in [0, 1], got {self.noise}")

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """A sun in a clear sky, near the highest beam or lower."""
        elevation_deg = scene.weather.sun_elevation_deg
        tilt_rad = math.hypot(scene.pose.pitch_rad, scene.pose.roll_rad)
        highest_deg = math.degrees(sensor.lasers.inclination_rad[0] + tilt_rad)
        # The hundredth of a degree is for what float32 does to the rays.
        within = elevation_deg <= highest_deg + _REACH_DEG + 0.01
        return f"sun {elevation_deg:.1f} deg high" if _shines(scene.weather) and within else None

    def rays(self, sweep: Sweep) -> RayIndex:
        """Those within 10 degrees of a sun that is seen."""
        if not _shines(sweep.scene.weather) or _is_hidden(sweep):
            return np.empty(0, dtype=np.int64)
        return np.flatnonzero(
            _sun_direction(sweep.scene) @ sweep.direction > math.cos(math.radians(_REACH_DEG))
        )

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Raise the thresholds and offer the noise."""
        indices = np.arange(sweep.num_rays)[rays]
        elevation_deg = sweep.scene.weather.sun_elevation_deg
        haze = 0.50572 * (elevation_deg + 6.07995) ** -1.6364
        air_mass = 1 / (math.sin(math.radians(elevation_deg)) + haze)
        cosine = _sun_direction(sweep.scene) @ sweep.direction[:, indices]
        angle_deg = np.degrees(np.arccos(cosine.clip(max=1)))
        scaled_rad = np.float32(np.pi / 2) * (angle_deg / _REACH_DEG).clip(max=1)
        glare = np.float32(math.exp(-_AIR_DEPTH * air_mass)) * np.cos(scaled_rad) ** 4
        sweep.min_power[indices] *= 1 + np.float32(self.rise) * glare
        noisy = np.flatnonzero(draws.uniform(indices) < self.noise * glare)
        if len(noisy):
            noisy_rays = indices[noisy]
            limits = sweep.sensor.min_range_m, sweep.sensor.max_range_m
            range_m = np.float32(limits[0]) + draws.uniform(noisy_rays) * np.float32(
                limits[1] - limits[0]
            )
            power = 2 * sweep.min_power[noisy_rays]
            sweep.offer(noisy_rays, range_m, power, NO_SURFACE, Origin.SUN)


def _shines(weather: Weather) -> bool:
    """Whether the sun is up and neither clouds nor fog, rain or snow cover it."""
    falling = weather.rain_mm_h > 0 or weather.snow_mm_h > 0 or math.isfinite(weather.visibility_m)
    return weather.clear_sky and weather.sun_elevation_deg > 0 and not falling


def _sun_direction(scene: Scene) -> np.ndarray:
    """Unit vector (3,) towards the sun in the scene frame."""
    elevation = math.radians(scene.weather.sun_elevation_deg)
    azimuth = math.radians(scene.weather.sun_azimuth_deg) - scene.pose.heading_rad
    level = math.cos(elevation)
    return np.array(
        [level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)],
        dtype=np.float32,
    )


def _is_hidden(sweep: Sweep) -> bool:
    """Whether a solid stands between the sensor and the sun, in the middle of the sweep."""
    nothing = np.full(1, NO_SURFACE, dtype=np.int32)
    _, surface = cast_single(
        sweep.solids,
        sweep.start.mean(axis=1, keepdims=True),
        _sun_direction(sweep.scene)[:, None],
        np.zeros(1, dtype=np.float32),
        np.full(1, 1e3),
        nothing,
        nothing,
    )
    return bool(surface[0] != NO_SURFACE)

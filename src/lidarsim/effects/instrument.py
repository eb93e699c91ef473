"""The instrument: detection and measurement of echoes, glare of a low sun and of sheeting."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from lidarsim.draws import Draws, RayIndex
from lidarsim.effects.surface import sheets
from lidarsim.scene import Material, Scene
from lidarsim.sensors.spinning import SpinningLidar
from lidarsim.solids import NO_SURFACE, Floats
from lidarsim.sweep import IS_GROUND, Echoes, Effect, Origin, Sweep

#: No threshold is farther from its middle than this many spreads.
MAX_SPREADS = 4.0
_MAX_SIGMA_M = 0.1
# Longest run of shots that the instrument loses.
_LONGEST_LOSS = 5
_SUN_REACH_DEG = 10.0
# Optical depth of the clear air overhead at 905 nm.
_AIR_DEPTH = 0.1


class DualReturn(Effect):
    """The instrument reports the two strongest echoes of a shot, if more than 1 m apart.

    Second echoes come from other effects: behind a pane, beside an edge, behind a drop. An
    instrument in the mode "strongest" does not report them.
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        return "instrument in dual mode" if sensor.return_mode == "dual" else None

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        sweep.second = Echoes.none(sweep.num_rays)


class SoftRaydrop(Effect):
    """The detection threshold varies from shot to shot.

    With w the spread of its logarithm, an echo is kept with the probability::

        p_keep = Phi(ln(power / min_power) / w)        1/2 at min_power

    cut off at four spreads. The threshold of a recorded echo is drawn from those that it exceeded.
    Source: a matched filter's decision on a noisy amplitude.
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        spread = sensor.threshold_spread
        return f"threshold varies by {spread:g} e-fold" if spread > 0 else None

    def rays(self, sweep: Sweep) -> RayIndex:
        """Rays with an echo near the threshold."""
        reach = np.exp(np.float32(MAX_SPREADS * sweep.sensor.threshold_spread))
        near = np.zeros(sweep.num_rays, dtype=bool)
        for echoes in sweep.echoes():
            near |= (echoes.power * reach >= sweep.min_power) & (
                echoes.power <= sweep.min_power * reach
            )
        return np.flatnonzero(near)

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        drawn = draws.normal(rays).clip(-MAX_SPREADS, MAX_SPREADS)
        spread = np.float32(sweep.sensor.threshold_spread)
        if sweep.recorded_power is not None:
            highest = np.log(sweep.recorded_power[rays] / np.float32(sweep.sensor.min_power))
            drawn = ndtri(ndtr(drawn) * ndtr(highest / spread)).clip(-MAX_SPREADS, highest / spread)
        sweep.min_power[rays] *= np.exp(spread * drawn)


class DetectionLimit(Effect):
    """Echoes that are too weak, too near or too far give no return.

    ::

        power < min_power    or    not min_range_m <= range <= max_range_m

    The default power makes asphalt of reflectivity 0.1, seen from 1.73 m above, vanish at 50 m, see
    ``surface_power``.
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        return "base"

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        for echoes in sweep.echoes():
            range_m = echoes.range_m[rays]
            lost = echoes.power[rays] < sweep.min_power[rays]
            lost |= (range_m < sweep.sensor.min_range_m) | (range_m > sweep.sensor.max_range_m)
            echoes.range_m[rays] = np.where(lost, np.float32(np.inf), range_m)


@dataclass(frozen=True)
class LostShots(Effect):
    """Shots that give no return although the echo is strong enough.

    A run of lost shots of one laser starts with the probability ``lost_share`` of the sensor times
    the factor of the material, and goes on to each next shot with the probability ``goes_on``.

    Source: between two returns of one smooth surface at 4 to 24 m, KITTI's HDL-64E loses 0.1 to
    0.4 % of the shots at the ground, 0.5 to 1.4 % at upright surfaces and 0.8 to 2.6 % at all
    surfaces together (30 scans of four drives), at strong echoes as well as at weak ones.

    Args:
        upright: Factor of all materials except ground materials.
        rough: Factor of leaves, cloth and paint, whose echoes come from several depths or leave
            in the direction of a mirror.
        goes_on: Probability that the next shot is lost as well, in [0, 1).
    """

    upright: float = 1.2
    rough: float = 10.0
    goes_on: float = 0.25

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        share = sensor.lost_share
        return f"{share:.1%} of the shots are lost" if share > 0 else None

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        factor = np.full(len(Material), self.upright, dtype=np.float32)
        factor[IS_GROUND] = 1.0
        factor[[Material.FOLIAGE, Material.CLOTH, Material.PAINT]] = self.rough
        starts = draws.uniform(slice(None)) < sweep.sensor.lost_share * factor[sweep.material]
        further = draws.uniform(slice(None))  # a run of at least k further shots: goes_on ** k
        lost = starts.copy()
        for shots in range(1, _LONGEST_LOSS):
            lost[shots:] |= (starts & (further < self.goes_on**shots))[:-shots]
        for echoes in sweep.echoes():
            echoes.range_m[lost] = np.float32(np.inf)


class RangeNoise(Effect):
    """Range noise, larger for weak echoes, and rounding to steps; ranges are never negative.

    ::

        sigma = sqrt(sigma_0^2 + sigma_w^2 / (2 SNR)),  at most 0.1 m        SNR = power / min_power

    A recorded range already has the noise of its own power; what is added to it is the rest of the
    variance.

    Source: HDL-64E datasheet (accuracy below 2 cm), its driver (2 mm steps).
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        if not sensor.range_sigma_m and not sensor.weak_range_sigma_m and not sensor.range_step_m:
            return None
        return f"sigma {sensor.range_sigma_m:g} m, steps of {sensor.range_step_m:g} m"

    def rays(self, sweep: Sweep) -> RayIndex:
        return np.flatnonzero(np.isfinite(sweep.first.range_m))

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        sensor = sweep.sensor
        for echoes in sweep.echoes():
            drawn = draws.normal(rays)
            variance = self._variance(echoes.power[rays], sensor)
            if sweep.recorded_power is not None:
                known = self._variance(sweep.recorded_power[rays], sensor)
                variance -= np.where(echoes.origin[rays] == Origin.SURFACE, known, 0)
            sigma = np.sqrt(variance.clip(min=0))
            range_m = (echoes.range_m[rays] + sigma * drawn).clip(min=0)
            if sensor.range_step_m:
                step = np.float32(sensor.range_step_m)
                range_m = np.round(range_m / step) * step
            echoes.range_m[rays] = range_m

    def _variance(self, power: Floats, sensor: SpinningLidar) -> Floats:
        weak = np.float32(sensor.weak_range_sigma_m**2 / 2) * np.float32(sensor.min_power)
        # Shots without a second echo have the power 0.
        power = np.maximum(power, np.finfo(np.float32).tiny)
        variance = np.float32(sensor.range_sigma_m**2) + weak / power
        return variance.clip(max=_MAX_SIGMA_M**2)


class LaserCalibration(Effect):
    """Range bias and gain of each laser.

    ::

        range -> range + bias        power -> power * gain^2

    because the stored intensity is the root of the power. Both are applied after the noise: they
    are the residual errors of calibration in ranges that have been measured and rounded.
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        biased = sum(bias != 0 for bias in sensor.lasers.range_bias_m)
        weighted = sum(gain != 1 for gain in sensor.lasers.intensity_gain)
        called = biased or weighted
        return f"{biased} lasers with a bias, {weighted} with a gain" if called else None

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        bias = np.array(sweep.sensor.lasers.range_bias_m, dtype=np.float32)[:, None]
        gain = np.array(sweep.sensor.lasers.intensity_gain, dtype=np.float32)[:, None]
        for echoes in sweep.echoes():
            range_m, power = sweep.grid(echoes.range_m), sweep.grid(echoes.power)
            range_m += bias
            power *= gain * gain


@dataclass(frozen=True)
class SunGlare(Effect):
    """Sunlight raises the detection threshold near the sun and causes false returns.

    At the angle g from the sun, within 10 degrees of it, and the elevation e::

        glare = cos^4(90 deg g / 10 deg) * exp(-0.1 / (sin e + 0.50572 (e + 6.07995 deg)^-1.6364))
        min_power -> min_power * (1 + rise * glare)
        a return of noise with the probability noise * glare, at any range, of twice that power

    The angle is scaled so that the effect ends at 10 degrees without a jump; the second factor is
    the transmittance of the air, which falls towards the horizon. A sun that is hidden by a solid
    has no effect.

    Source: Kasten and Young 1989 for the air mass.

    Args:
        rise: Rise of the threshold in the direction of the sun without attenuation by air.
        noise: Probability of a false return in that direction.
    """

    rise: float = 3.0
    noise: float = 1e-3

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        weather, elevation_deg = scene.weather, scene.weather.sun_elevation_deg
        falling = weather.rain_mm_h > 0 or weather.snow_mm_h > 0
        covered = falling or math.isfinite(weather.visibility_m) or not weather.clear_sky
        tilt_rad = math.hypot(scene.pose.pitch_rad, scene.pose.roll_rad)
        highest_deg = math.degrees(sensor.lasers.inclination_rad[0] + tilt_rad)
        # 0.01 degrees of slack for the rounding of the rays to float32.
        within = elevation_deg <= highest_deg + _SUN_REACH_DEG + 0.01
        shines = elevation_deg > 0 and within and not covered
        return f"sun {elevation_deg:.1f} deg high" if shines else None

    def rays(self, sweep: Sweep) -> RayIndex:
        """Rays within 10 degrees of a visible sun."""
        if not sweep.is_open(_sun_direction(sweep.scene)):
            return np.empty(0, dtype=np.int64)
        return np.flatnonzero(
            _sun_direction(sweep.scene) @ sweep.direction > math.cos(math.radians(_SUN_REACH_DEG))
        )

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        indices = np.arange(sweep.num_rays)[rays]
        elevation_deg = sweep.scene.weather.sun_elevation_deg
        haze = 0.50572 * (elevation_deg + 6.07995) ** -1.6364
        air_mass = 1 / (math.sin(math.radians(elevation_deg)) + haze)
        cosine = _sun_direction(sweep.scene) @ sweep.direction[:, indices]
        angle_deg = np.degrees(np.arccos(cosine.clip(max=1)))
        scaled_rad = np.float32(np.pi / 2) * (angle_deg / _SUN_REACH_DEG).clip(max=1)
        glare = np.float32(math.exp(-_AIR_DEPTH * air_mass)) * np.cos(scaled_rad) ** 4
        sweep.min_power[indices] *= 1 + np.float32(self.rise) * glare
        noisy = np.flatnonzero(draws.uniform(indices) < self.noise * glare)
        if len(noisy):
            noisy_rays = indices[noisy]
            nearest, farthest = sweep.sensor.min_range_m, sweep.sensor.max_range_m
            along = draws.uniform(noisy_rays) * np.float32(farthest - nearest)
            range_m = np.float32(nearest) + along
            power = 2 * sweep.min_power[noisy_rays]
            sweep.offer(noisy_rays, range_m, power, NO_SURFACE, Origin.SUN)


def _sun_direction(scene: Scene) -> np.ndarray:
    """Unit vector (3,) towards the sun in the scene frame."""
    elevation = math.radians(scene.weather.sun_elevation_deg)
    azimuth = math.radians(scene.weather.sun_azimuth_deg) - scene.pose.heading_rad
    level, up = math.cos(elevation), math.sin(elevation)
    return np.array([level * math.cos(azimuth), level * math.sin(azimuth), up], dtype=np.float32)


@dataclass(frozen=True)
class Blooming(Effect):
    """Halo of sheeting: its echo spills into neighbouring shots at the same range.

    A shot at the angle a from one that hits sheeting with power P receives::

        with probability exp(-(a / halo)^2) * min(1, sqrt(P / P_sat))     an echo of  spill * P

    out to 2.5 times the halo; of several such shots the most probable one is used. ``P_sat`` is the
    strongest echo of a diffuse surface: a white one at the range where the receiver first sees the
    whole beam, ``1 / overlap_range_m^2``. Sheeting at normal incidence exceeds it up to 15 times
    that range (74 m), with a halo of constant angle; beyond, and for weaker or tilted sheeting,
    the probability falls with 1 / R.

    Source: bright runs in 30 scans of KITTI's HDL-64E have one dimmer shot at the same range on
    either side (median at all ranges from 5 to 80 m; the mean falls beyond 45 m), of an intensity
    of 0.45 to 0.8: these agree with the default halo and give the spill. The form is an assumption.

    Args:
        halo_deg: Angle at which the probability has fallen to 1 / e, in (0, 5].
        spill: Share of the power received by a neighbouring shot.
    """

    halo_deg: float = 0.2
    spill: float = 2e-3

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        return sheets(scene)

    def rays(self, sweep: Sweep) -> RayIndex:
        """Neighbours of the rays that hit sheeting."""
        return self._likeliest(sweep)[0]

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        beside, source, chance = self._likeliest(sweep)
        dazzled = draws.uniform(beside) < chance
        beside, source = beside[dazzled], source[dazzled]
        first = sweep.first
        range_m, power = first.range_m[source], np.float32(self.spill) * first.power[source]
        sweep.offer(beside, range_m, power, first.surface[source], Origin.BLOOMING)

    def _likeliest(self, sweep: Sweep) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
        """Rays beside sheeting, the most probable source ray of each, and the probability."""
        is_sheet = sweep.on_sheets()
        bright = np.flatnonzero(is_sheet & (sweep.first.power > 0))
        halo_rad = math.radians(self.halo_deg)
        source, beside = sweep.pairs_around(bright, 2.5 * halo_rad)
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

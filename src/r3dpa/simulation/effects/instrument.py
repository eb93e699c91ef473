"""Detection and measurement of echoes by the instrument."""

from __future__ import annotations

import numpy as np

from r3dpa.simulation.draws import Draws, RayIndex
from r3dpa.simulation.scene import Scene
from r3dpa.simulation.sensor import SpinningLidar
from r3dpa.simulation.sweep import Echoes, Effect, Sweep

#: No threshold is farther from its middle than this many spreads.
MAX_SPREADS = 4.0
_MAX_SIGMA_M = 0.1


class DualReturn(Effect):
    """The instrument reports the two strongest echoes of a shot, if more than 1 m apart.

    ::

        second = the next strongest echo with |range_second - range_first| > 1 m

    Second echoes come from other effects: behind a pane, beside an edge, behind a drop. An
    instrument in the mode "strongest" does not report them.
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        return "instrument in dual mode" if sensor.return_mode == "dual" else None

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Record second echoes from now on."""
        sweep.second = Echoes.none(sweep.num_rays)


class SoftRaydrop(Effect):
    """The detection threshold varies from shot to shot.

    With w the spread of its logarithm, an echo is kept with the probability::

        p_keep = Phi(ln(power / min_power) / w)        1/2 at min_power

    cut off at four spreads. Source: a matched filter's decision on a noisy amplitude.
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
        sweep.min_power[rays] *= np.exp(np.float32(sweep.sensor.threshold_spread) * drawn)


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
        """Set the range of undetected echoes to infinity."""
        for echoes in sweep.echoes():
            range_m = echoes.range_m[rays]
            lost = echoes.power[rays] < sweep.min_power[rays]
            lost |= (range_m < sweep.sensor.min_range_m) | (range_m > sweep.sensor.max_range_m)
            echoes.range_m[rays] = np.where(lost, np.float32(np.inf), range_m)


class RangeNoise(Effect):
    """Range noise, larger for weak echoes, and rounding to steps; ranges are never negative.

    ::

        sigma = sqrt(sigma_0^2 + sigma_w^2 / (2 SNR)),  at most 0.1 m        SNR = power / min_power

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
            weak = np.float32(sensor.weak_range_sigma_m**2 / 2) * np.float32(sensor.min_power)
            # Shots without a second echo have the power 0.
            power = np.maximum(echoes.power[rays], np.finfo(np.float32).tiny)
            variance = np.float32(sensor.range_sigma_m**2) + weak / power
            sigma = np.sqrt(variance.clip(max=_MAX_SIGMA_M**2))
            range_m = (echoes.range_m[rays] + sigma * drawn).clip(min=0)
            if sensor.range_step_m:
                step = np.float32(sensor.range_step_m)
                range_m = np.round(range_m / step) * step
            echoes.range_m[rays] = range_m


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
        """Add the biases and apply the gains, laser by laser."""
        bias = np.array(sweep.sensor.lasers.range_bias_m, dtype=np.float32)[:, None]
        gain = np.array(sweep.sensor.lasers.intensity_gain, dtype=np.float32)[:, None]
        for echoes in sweep.echoes():
            range_m, power = sweep.grid(echoes.range_m), sweep.grid(echoes.power)
            range_m += bias
            power *= gain * gain

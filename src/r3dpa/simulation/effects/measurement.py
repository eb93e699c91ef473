"""How the instrument measures the echoes that it detects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from r3dpa.simulation.effects.base import Draws, Stage
from r3dpa.simulation.scene import Scene
from r3dpa.simulation.sensor import SpinningLidar
from r3dpa.simulation.sweep import Echoes, RayIndex, Sweep

_MAX_SIGMA_M = 0.1


@dataclass(frozen=True)
class DualReturn:
    """The instrument reports the two strongest echoes of a shot, if more than 1 m apart.

    ::

        second = the strongest echo but the first, where |range_second - range_first| > 1 m

    The second echoes are those that other effects find on the way: behind a pane, beside an edge,
    behind a drop. An instrument in the mode "strongest" does not report them.
    """

    stage: ClassVar[Stage] = Stage.RAYS

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """An instrument in dual mode."""
        return "instrument in dual mode" if sensor.return_mode == "dual" else None

    def rays(self, sweep: Sweep) -> RayIndex:
        """All."""
        return slice(None)

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Record second echoes from now on."""
        sweep.second = Echoes.none(sweep.num_rays)


@dataclass(frozen=True)
class LaserCalibration:
    """Each laser has its own range bias and gain.

    ::

        range -> range + bias        power -> power * gain^2

    because the stored intensity is the root of the power. Both come after the noise: they are what
    the calibration leaves in ranges that have been measured and rounded.
    """

    stage: ClassVar[Stage] = Stage.MEASUREMENT

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """A laser table with biases or gains."""
        lasers = sensor.lasers
        biased = sum(bias != 0 for bias in lasers.range_bias_m)
        weighted = sum(gain != 1 for gain in lasers.intensity_gain)
        if not biased and not weighted:
            return None
        return f"{biased} lasers with a bias, {weighted} with a gain"

    def rays(self, sweep: Sweep) -> RayIndex:
        """All."""
        return slice(None)

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Add the biases and apply the gains, laser by laser."""
        bias = np.array(sweep.sensor.lasers.range_bias_m, dtype=np.float32)[:, None]
        gain = np.array(sweep.sensor.lasers.intensity_gain, dtype=np.float32)[:, None]
        for echoes in sweep.echoes():
            range_m, power = sweep.grid(echoes.range_m), sweep.grid(echoes.power)
            range_m += bias
            power *= gain * gain


@dataclass(frozen=True)
class RangeNoise:
    """Ranges scatter, weak echoes more than strong ones, come in steps, and are never negative.

    ::

        sigma = sqrt(sigma_0^2 + sigma_w^2 / (2 SNR)),  at most 0.1 m        SNR = power / min_power

    Source: HDL-64E datasheet (accuracy below 2 cm), its driver (2 mm steps).
    """

    stage: ClassVar[Stage] = Stage.MEASUREMENT

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """An instrument with noise or steps."""
        if not sensor.range_sigma_m and not sensor.weak_range_sigma_m and not sensor.range_step_m:
            return None
        return f"sigma {sensor.range_sigma_m:g} m, steps of {sensor.range_step_m:g} m"

    def rays(self, sweep: Sweep) -> RayIndex:
        """Those with an echo."""
        return np.flatnonzero(np.isfinite(sweep.first.range_m))

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Add the noise and round."""
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

"""Which echoes the instrument detects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from r3dpa.simulation.effects.base import Draws, Stage
from r3dpa.simulation.scene import Scene
from r3dpa.simulation.sensor import SpinningLidar
from r3dpa.simulation.sweep import RayIndex, Sweep

#: No threshold is farther from its middle than this many spreads.
MAX_SPREADS = 4.0


@dataclass(frozen=True)
class SoftRaydrop:
    """The detection threshold varies from shot to shot.

    With w the spread of its logarithm, an echo is kept with the probability::

        p_keep = Phi(ln(power / min_power) / w)        1/2 at min_power

    cut off at four spreads. Source: a matched filter's decision on a noisy amplitude.
    """

    stage: ClassVar[Stage] = Stage.DETECTION

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """An instrument whose threshold varies."""
        spread = sensor.threshold_spread
        return f"threshold varies by {spread:g} e-fold" if spread > 0 else None

    def rays(self, sweep: Sweep) -> RayIndex:
        """Those with an echo near the threshold."""
        reach = np.exp(np.float32(MAX_SPREADS * sweep.sensor.threshold_spread))
        near = np.zeros(sweep.num_rays, dtype=bool)
        for echoes in sweep.echoes():
            near |= (echoes.power * reach >= sweep.min_power) & (
                echoes.power <= sweep.min_power * reach
            )
        return np.flatnonzero(near)

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Scale the thresholds of these rays."""
        drawn = draws.normal(rays).clip(-MAX_SPREADS, MAX_SPREADS)
        sweep.min_power[rays] *= np.exp(np.float32(sweep.sensor.threshold_spread) * drawn)


@dataclass(frozen=True)
class DetectionLimit:
    """Echoes that are too weak, too near or too far give no return.

    ::

        power < min_power    or    not min_range_m <= range <= max_range_m

    The default power makes asphalt of reflectivity 0.1, seen from 1.73 m above, vanish at 50 m, see
    ``surface_power``.
    """

    stage: ClassVar[Stage] = Stage.DETECTION

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """Every instrument has a limit."""
        return "base"

    def rays(self, sweep: Sweep) -> RayIndex:
        """All."""
        return slice(None)

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Put undetected echoes at infinity."""
        for echoes in sweep.echoes():
            range_m = echoes.range_m[rays]
            lost = echoes.power[rays] < sweep.min_power[rays]
            lost |= (range_m < sweep.sensor.min_range_m) | (range_m > sweep.sensor.max_range_m)
            echoes.range_m[rays] = np.where(lost, np.float32(np.inf), range_m)

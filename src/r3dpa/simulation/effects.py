"""What happens to the returns between the ray cast and the stored scan.

Each effect is a frozen dataclass: a function ``(returns, scene, generator) -> returns`` with a
``stage``. A scene lists the effects it calls for, ordered by stage.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np

from r3dpa.simulation.raycast import MAX_RANGE_M, Returns
from r3dpa.simulation.scene import Scene

SURFACE_RADIOMETRY_STAGE = 5
DETECTION_STAGE = 7

MIN_POWER = 1.38e-6


class Effect(Protocol):
    """One physical effect; ``stage`` is its place in the fixed order of the pipeline."""

    @property
    def stage(self) -> int:
        """Place in the order: 4 optical path, 5 surface, 6 medium, 7 detection, 8 measurement."""

    def __call__(self, returns: Returns, scene: Scene, generator: np.random.Generator) -> Returns:
        """Returns after the effect; the arguments are left as they were."""


@dataclass(frozen=True)
class LambertianReflection:
    """Received power of a matt surface that is larger than the beam.

    ::

        power = power * reflectivity * cos(incidence) / range^2

    Source: lidar range equation for a target that fills the beam, with its constants (aperture,
    transmission) left out, so that power is counted in m^-2.
    """

    stage: ClassVar[int] = SURFACE_RADIOMETRY_STAGE

    def __call__(self, returns: Returns, scene: Scene, generator: np.random.Generator) -> Returns:
        """Returns with the power in m^-2; 0 where there is no surface."""
        gain = returns.reflectivity * returns.cos_incidence / returns.range_m**2
        return replace(returns, power=returns.power * gain)


@dataclass(frozen=True)
class DetectionLimit:
    """Shots that are too weak, too near or too far give no return.

    The default power makes asphalt of reflectivity 0.1, seen from 1.73 m above, vanish at 50 m:
    ``reflectivity * height / R^3 = min_power``.

    Args:
        min_power: Weakest power that is detected, m^-2.
        min_range_m: Nearest range that the instrument reports.
        max_range_m: Farthest range that the instrument reports.

    Raises:
        ValueError: If ``min_power`` is negative or the ranges are not in order.
    """

    min_power: float = MIN_POWER
    min_range_m: float = 0.9
    max_range_m: float = MAX_RANGE_M
    stage: ClassVar[int] = DETECTION_STAGE

    def __post_init__(self) -> None:
        """Check the values."""
        if not self.min_power >= 0:
            raise ValueError(f"min_power must be 0 or greater, got {self.min_power}")
        if not 0 <= self.min_range_m < self.max_range_m:
            raise ValueError(
                f"ranges must satisfy 0 <= min_range_m < max_range_m, "
                f"got {self.min_range_m} and {self.max_range_m}"
            )

    def __call__(self, returns: Returns, scene: Scene, generator: np.random.Generator) -> Returns:
        """Returns with an infinite range where the instrument sees nothing."""
        range_m = returns.range_m
        seen = (
            (returns.power >= self.min_power)
            & (range_m >= self.min_range_m)
            & (range_m <= self.max_range_m)
        )
        return replace(returns, range_m=np.where(seen, range_m, np.float32(np.inf)))

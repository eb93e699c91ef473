"""Random weather for training scans."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r3dpa.simulation.scene import Interval
from r3dpa.weather.recorded import RecordedScan
from r3dpa.weather.recorded_sweep import Instrument
from r3dpa.weather.weather import Weather

_FIELDS = ("visibility_m", "rain_mm_h", "snow_mm_h")
_FULL_FILM_MM = 1.5
_INSTRUMENT = Instrument()


@dataclass(frozen=True)
class WeatherPrior:
    """Weather drawn anew for each training scan and epoch: fog, rain on a wet road, or snow.

    The three are equally likely; visibility and rates are log-uniform.

    Args:
        probability: Of bad weather; other scans stay as they are.
        visibility_m: Least and largest visibility in fog.
        rain_mm_h: Least and largest rate.
        snow_mm_h: Least and largest rate, as water.
        instrument: What is assumed of the instrument.
    """

    probability: float = 0.5
    visibility_m: Interval = (30.0, 1000.0)
    rain_mm_h: Interval = (1.0, 30.0)
    snow_mm_h: Interval = (0.5, 3.0)
    instrument: Instrument = _INSTRUMENT

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= 1:
            raise ValueError(f"probability must lie in [0, 1], got {self.probability}")
        for name in _FIELDS:
            low, high = getattr(self, name)
            if not 0 < low <= high < math.inf:
                raise ValueError(f"{name} must be a positive interval, got {low}..{high}")
            for limit in (low, high):
                Weather(**{name: limit})

    def draw(self, generator: np.random.Generator) -> Weather | None:
        """Weather of one scan; None where it stays as it is."""
        chance, kind, share, film = generator.random(4)
        if chance >= self.probability:
            return None
        name = _FIELDS[int(3 * kind)]
        low, high = np.log(getattr(self, name))
        values: dict[str, Any] = {name: math.exp(low + share * (high - low))}
        if name == "rain_mm_h":
            values["water_film_mm"] = _FULL_FILM_MM * film
        return Weather(**values)

    def points(self, points: NDArray[np.float32], seed: tuple[int, ...]) -> NDArray[np.float32]:
        """Points ``(P, 4)`` in the weather of a seed, such as that of training, epoch and scan."""
        weather = self.draw(np.random.default_rng(seed))
        if weather is None:
            return points
        scan = RecordedScan(points[:, :3], points[:, 3])
        result = weather.apply(scan, ("training", *seed), self.instrument)
        assert result.intensity is not None
        return np.column_stack([result.points, result.intensity])

"""What the weather is like, as a declared prior over the weather of a scene."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from r3dpa.simulation.scene import Weather

Interval = tuple[float, float]


@dataclass(frozen=True)
class WeatherPrior:
    """How often it is clear and dry, how often the road is wet, and how bad weather is.

    What remains of the probability is fog, rain or snow, a third each. Visibility and rates are
    drawn evenly on a logarithmic scale, the rest evenly. In rain the road is wet; a sun below the
    horizon is night.

    Args:
        clear_dry: Probability of clear air and a dry road.
        wet: Probability of clear air over a wet road.
        visibility_m: Meteorological optical range in fog.
        rain_mm_h: Rain rate in rain.
        snow_mm_h: Snow rate in snow, as millimetres of water.
        water_film_mm: Depth of the water on a wet road.
        sun_elevation_deg: Height of the sun.
        clear_sky: Probability that nothing covers the sun in clear air over a dry road.

    Raises:
        ValueError: If a probability lies outside [0, 1], the two of the air exceed 1 together, or
            an interval falls, or one of visibility, rates or film is not positive.
    """

    clear_dry: float = 0.85
    wet: float = 0.10
    visibility_m: Interval = (30.0, 1000.0)
    rain_mm_h: Interval = (1.0, 30.0)
    snow_mm_h: Interval = (0.5, 3.0)
    water_film_mm: Interval = (0.1, 1.5)
    sun_elevation_deg: Interval = (-18.0, 62.0)
    clear_sky: float = 0.6

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("clear_dry", "wet", "clear_sky"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must lie in [0, 1], got {getattr(self, name)}")
        if self.clear_dry + self.wet > 1:
            raise ValueError(
                f"clear_dry and wet must add up to 1 or less, got {self.clear_dry} and {self.wet}"
            )
        for field in fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, tuple):
                continue
            low, high = value
            positive = low > 0 or field.name == "sun_elevation_deg"
            if not (low <= high < math.inf and positive):
                raise ValueError(
                    f"{field.name} must be a finite interval (low, high), positive for depths, "
                    f"rates and visibility, got {value}"
                )

    def draw(self, generator: np.random.Generator) -> Weather:
        """One weather."""
        air, third, sky = generator.random(3)
        film_mm = generator.uniform(*self.water_film_mm)
        elevation_deg = generator.uniform(*self.sun_elevation_deg)
        azimuth_deg = generator.uniform(-180.0, 180.0)
        if air < self.clear_dry:
            return Weather(
                clear_sky=sky < self.clear_sky,
                sun_elevation_deg=elevation_deg,
                sun_azimuth_deg=azimuth_deg,
            )
        visibility_m, rain_mm_h, snow_mm_h = math.inf, 0.0, 0.0
        if air >= self.clear_dry + self.wet:
            kind = int(3 * third)
            if kind == 0:
                visibility_m, film_mm = _even_logarithm(generator, self.visibility_m), 0.0
            elif kind == 1:
                rain_mm_h = _even_logarithm(generator, self.rain_mm_h)
            else:
                snow_mm_h, film_mm = _even_logarithm(generator, self.snow_mm_h), 0.0
        return Weather(
            visibility_m, rain_mm_h, snow_mm_h, film_mm, False, elevation_deg, azimuth_deg
        )


def _even_logarithm(generator: np.random.Generator, interval: Interval) -> float:
    return math.exp(generator.uniform(*np.log(interval)))

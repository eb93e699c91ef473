"""Random weather of training scans."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lidarsim.recorded import Instrument
from lidarsim.weather import WeatherPrior


@pytest.fixture(scope="module")
def drawn():
    """Weather of training scans."""
    return [WeatherPrior(1.0).draw(np.random.default_rng(seed)) for seed in range(3000)]


class TestPrior:
    """Rates are log-uniform, films have all depths."""

    @pytest.mark.parametrize("name", ["visibility_m", "rain_mm_h", "snow_mm_h"])
    def test_as_many_are_below_the_geometric_mean_as_above(self, drawn, name):
        values = np.array([getattr(weather, name) for weather in drawn])
        values = values[np.isfinite(values) & (values > 0)]
        low, high = getattr(WeatherPrior(), name)
        assert abs(len(values) - 1000) < 5 * math.sqrt(3000 * 2 / 9)
        assert low <= values.min() < 1.1 * low
        assert high / 1.1 < values.max() <= high
        below = (values < math.sqrt(low * high)).mean()
        assert abs(below - 0.5) < 5 * 0.5 / math.sqrt(len(values))

    def test_films_in_rain_have_all_depths(self, drawn):
        films = np.array([weather.water_film_mm for weather in drawn if weather.rain_mm_h])
        assert all(weather.water_film_mm == 0 for weather in drawn if not weather.rain_mm_h)
        assert 0 < films.min() < 0.05
        assert 1.45 < films.max() < 1.5
        assert abs(films.mean() - 0.75) < 5 * 1.5 / math.sqrt(12 * len(films))

    def test_half_of_the_scans_stay_as_they_are(self):
        weathers = [WeatherPrior().draw(np.random.default_rng(seed)) for seed in range(1000)]
        bad = sum(weather is not None for weather in weathers)
        assert abs(bad - 500) < 5 * math.sqrt(250)

    def test_default_rates_are_those_of_the_documentation(self):
        prior = WeatherPrior()
        assert prior.visibility_m == (30, 1000)
        assert prior.rain_mm_h == (1, 30)
        assert prior.snow_mm_h == (0.5, 3)

    def test_an_interval_may_be_one_value(self):
        prior = WeatherPrior(1, (50, 50), (5, 5), (1, 1))
        drawn = [prior.draw(np.random.default_rng(seed)) for seed in range(50)]
        assert {round(weather.visibility_m, 9) for weather in drawn} == {50, math.inf}

    @pytest.mark.parametrize(
        ("wrong", "message"),
        [
            ({"probability": 1.5}, r"probability must lie in \[0, 1\], got 1.5"),
            ({"probability": -0.1}, r"probability must lie in \[0, 1\], got -0.1"),
            ({"rain_mm_h": (5, 1)}, "rain_mm_h must be a positive interval, got 5..1"),
            ({"rain_mm_h": (0, 1)}, "rain_mm_h must be a positive interval, got 0..1"),
            ({"visibility_m": (0.5, 10)}, "visibility_m must be 1 or greater"),
            ({"rain_mm_h": (1, 1000)}, "rain_mm_h must be at most 500"),
        ],
    )
    def test_a_prior_of_impossible_weather_is_refused(self, wrong, message):
        with pytest.raises(ValueError, match=message):
            WeatherPrior(**wrong)

    def test_points_are_in_the_weather_of_the_seed_with_its_draws(self):
        """The same fog for each seed; what it hides and adds differs, and the instrument counts."""
        instrument = Instrument(returns="dual", response="linear")
        prior = WeatherPrior(1, (60, 60), instrument=instrument)
        in_fog = [
            seed
            for seed in range(20)
            if prior.draw(np.random.default_rng((7, 0, seed))).visibility_m < math.inf
        ]
        first, second = ((7, 0, seed) for seed in in_fog[:2])
        rng = np.random.default_rng(0)
        points = rng.uniform(5, 40, (2000, 4)).astype(np.float32)
        points[:, 3] = rng.uniform(0, 1, 2000)
        weather = prior.draw(np.random.default_rng(first))
        expected = weather.apply(points, ("training", *first), instrument)
        assert np.array_equal(prior.points(points, first), expected)
        assert not np.array_equal(prior.points(points, second), expected)
        assert not np.array_equal(WeatherPrior(1, (60, 60)).points(points, first), expected)

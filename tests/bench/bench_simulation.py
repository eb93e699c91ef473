"""A simulated scan on one core, by weather; the budget of a plain street is 60 ms cast, 100 ms."""

import pytest

from lidarsim import Street, hdl64e, simulate_scan
from lidarsim.scene import Conditions

pytestmark = [pytest.mark.bench, pytest.mark.benchmark(group="simulate one scan", min_rounds=9)]

STREET = (0, 2, 40)  # seed, drive, scan
WEATHERS = {
    "plain": Conditions(),
    "wet": Conditions(water_film_mm=1.0, clear_sky=False),
    "rain": Conditions(rain_mm_h=10.0, water_film_mm=1.0, clear_sky=False),
    "fog": Conditions(visibility_m=100.0, clear_sky=False),
    "snow": Conditions(snow_mm_h=1.5, clear_sky=False),
    "low sun": Conditions(sun_elevation_deg=3.0),
}


@pytest.mark.parametrize("weather", WEATHERS)
def bench_scan(benchmark, weather):
    seed, drive, number = STREET
    scene, sensor = Street(seed, drive, WEATHERS[weather]).scene(number), hdl64e()
    benchmark(simulate_scan, scene, sensor, (seed, "effects", drive, number))


def bench_scene(benchmark):
    street = Street(0, 2, Conditions())
    street.scene(40)  # a scan shares its blocks with the one before
    benchmark(street.scene, 41)

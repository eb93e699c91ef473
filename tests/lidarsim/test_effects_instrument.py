"""Detection and measurement, on echoes made by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from sweeps import applied, box, pole

from lidarsim.effects import (
    DetectionLimit,
    DualReturn,
    LaserCalibration,
    LostShots,
    RangeNoise,
    SoftRaydrop,
    WeakPatches,
)
from lidarsim.scan import calibrated_intensity, simulate_scan
from lidarsim.scene import Conditions, EgoMotion, Material, Scene, Semantic
from lidarsim.sensors import hdl64e
from lidarsim.street import Street
from lidarsim.sweep import Origin, Sweep

NOISE = {"range_sigma_m": 0.015, "weak_range_sigma_m": 0.09, "range_step_m": 0.002}
SENSOR = replace(hdl64e(), **NOISE)
SMALL = replace(hdl64e(shots=360), **NOISE)


def swept(sensor, range_m=20.0, power=1.0):
    """A turn in which every shot has the same echo."""
    sweep = Sweep(Scene(), sensor)
    sweep.first.range_m[:] = range_m
    sweep.first.power[:] = power
    return sweep


@pytest.mark.parametrize("snr", [0.1, 4.0, 1e6])
def test_spread_of_the_range(snr):
    """sigma^2 = 0.015^2 + 0.09^2 / (2 SNR), at most 0.1^2; steps of 2 mm add step^2 / 12."""
    sweep = applied(swept(SENSOR, power=snr * SENSOR.min_power), RangeNoise())
    jitter = min(math.hypot(0.015, 0.09 / math.sqrt(2 * snr)), 0.1)
    sigma = math.hypot(jitter, 0.002 / math.sqrt(12))
    noise = sweep.first.range_m - np.float32(20)
    standard_error = sigma / math.sqrt(2 * sweep.num_rays)
    assert noise.std(dtype=np.float64) == pytest.approx(sigma, abs=4 * standard_error)
    assert abs(noise.mean(dtype=np.float64)) < 4 * sigma / math.sqrt(sweep.num_rays)
    # Steps of 2 mm: float32 holds 20 m to 2e-6 m.
    np.testing.assert_allclose(sweep.first.range_m / 0.002 % 1 % 0.999, 0, atol=1.5e-3)


def test_each_laser_has_its_bias_and_gain():
    sweep = applied(swept(SMALL, 10.0, 0.25), LaserCalibration())
    bias = sweep.grid(sweep.first.range_m) - 10
    gain = sweep.grid(sweep.first.power) / 0.25
    lasers = SMALL.lasers
    # float32 holds 10 m to 1e-6 m.
    np.testing.assert_allclose(bias, np.repeat([lasers.range_bias_m], 360, 0).T, atol=1e-6)
    np.testing.assert_allclose(gain, np.repeat([lasers.intensity_gain], 360, 0).T ** 2, rtol=1e-6)
    assert np.ptp(lasers.range_bias_m) > 0.01


@pytest.mark.parametrize("spreads", [-5.0, -1.0, 0.0, 0.5, 5.0])
def test_share_that_is_kept_near_the_threshold(spreads):
    """Phi(ln(P / P_min) / w): 0.5 at P_min; certain at more than four spreads from it."""
    power = SENSOR.min_power * math.exp(spreads * SENSOR.threshold_spread)
    sweep = swept(SENSOR, power=power)
    if abs(spreads) > 4:
        assert len(SoftRaydrop().rays(sweep)) == 0
    else:
        applied(sweep, SoftRaydrop())
    applied(sweep, DetectionLimit())
    kept = np.isfinite(sweep.first.range_m).mean()
    expected = 0.5 * math.erfc(-spreads / math.sqrt(2))
    standard_error = math.sqrt(expected * (1 - expected) / sweep.num_rays)
    assert kept == pytest.approx(expected, abs=4 * standard_error + 1e-5)


def test_limits_of_power_and_range():
    sensor = replace(SMALL, min_range_m=1.0, max_range_m=100.0)
    sweep = swept(sensor)
    power = np.float32(sensor.min_power)
    sweep.first.power[:4] = 0, np.nextafter(power, 0, dtype=np.float32), power, 2 * power
    sweep.first.range_m[4:8] = 0.99, 1.0, 100.0, 100.01
    applied(sweep, DetectionLimit())
    kept = np.isfinite(sweep.first.range_m)
    assert list(kept[:8]) == [False, False, True, True, False, True, True, False]
    assert kept[8:].all()


@pytest.mark.parametrize(("material", "factor"), [("ASPHALT", 1), ("BRICK", 3), ("FOLIAGE", 10)])
def test_share_of_lost_shots_by_material(material, factor):
    """A start with probability s loses 1 + g + g^2 + g^3 + g^4 shots; overlaps are of order s^2."""
    start, goes_on = 0.002, 0.25
    sweep = swept(replace(SENSOR, lost_share=start), power=1.0)
    sweep.material[:] = Material[material]
    applied(sweep, LostShots(upright=3.0, rough=10.0, goes_on=goes_on))
    lost = np.isinf(sweep.first.range_m)
    expected = 1 - np.prod([1 - factor * start * goes_on**k for k in range(5)])
    # Shots of one run are lost together: the variance is up to 1 + 2 g / (1 - g) times larger.
    deviation = math.sqrt(2 * expected * (1 - expected) / sweep.num_rays)
    assert lost.mean() == pytest.approx(expected, abs=4 * deviation)


def test_strongest_returns_are_the_first_of_dual_returns():
    """In a scene with edges, a pane, leaves and rain: every source of second echoes."""
    street = Street(0, 3).scene(40)
    scene = replace(street, weather=Conditions(rain_mm_h=30.0), motion=EgoMotion(10.0, 0.1))
    key = ("seed", 7)
    strongest = simulate_scan(scene, SENSOR, key)
    dual = simulate_scan(scene, replace(SENSOR, return_mode="dual"), key)
    first = dual.origins != Origin.SECOND_RETURN
    for column in ("points", "labels", "origins"):
        np.testing.assert_array_equal(getattr(dual, column)[first], getattr(strongest, column))
    assert (~first).sum() > 100
    assert DualReturn().called_by(scene, SENSOR) is None


def test_second_returns_are_more_than_a_metre_apart():
    """A pole that fills a part of the beams, 0.9 and 3 m before a wall."""
    for gap_m, expected in ((0.9, False), (3.0, True)):
        post = pole((20.0, 0.0, 3.0), 0.05, 3.0, material=Material.PAINT)
        wall = box((20.5 + gap_m, 0.0, 3.0), (0.5, 9.0, 3.0))
        quiet = replace(SENSOR, return_mode="dual", range_sigma_m=0.0, weak_range_sigma_m=0.0)
        scan = simulate_scan(Scene((post, wall)), quiet, ("seed", 1))
        # At its foot the pole stands before the road, which lies farther away at once.
        second = set(scan.labels[scan.origins == Origin.SECOND_RETURN] & 0xFFFF)
        assert (Semantic.WALL in second) == expected


def test_weak_patches_are_runs_of_shots_with_intensity_0():
    """The share of the sensor at every surface but sheeting; 83 to 90 % of the next shots too."""
    sensor = replace(SENSOR, weak_share=0.07)
    sweep = swept(sensor, power=1.0)
    sheeting = slice(0, 2 * sensor.shots)
    sweep.material[sheeting] = Material.RETROREFLECTOR
    applied(sweep, WeakPatches())
    weak = sweep.first.power < 1
    assert not weak[sheeting].any()
    assert weak.mean() == pytest.approx(0.07, abs=0.01)
    rows = sweep.grid(weak)
    goes_on = (rows[:, :-1] & rows[:, 1:]).sum() / rows[:, :-1].sum()
    assert 0.83 < goes_on < 0.9
    power = sweep.first.power[weak]
    assert (power > sensor.min_power).all()
    assert (calibrated_intensity(power, np.full_like(power, 10.0), sensor.min_power) == 0).all()

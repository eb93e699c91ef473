import math
from dataclasses import replace

import numpy as np
import pytest
import sweeps
from sweeps import box

from lidarsim.draws import Draws
from lidarsim.effects import DiffuseReflection, DualReturn, Fog, Rain, Snow, Spray
from lidarsim.effects.medium import attenuate, soft_waveform
from lidarsim.scan import effect_name
from lidarsim.scene import Conditions, Material, Scene, Semantic
from lidarsim.sensors import Lasers, hdl64e
from lidarsim.solids import NO_SURFACE
from lidarsim.sweep import Origin, Sweep

# Fixed here, so that the numbers below do not depend on the fit of the default instrument.
FIXED = {"min_power": 1.43e-5, "min_range_m": 1.45, "overlap_range_m": 5.0}
SENSOR = replace(hdl64e(shots=360), threshold_spread=0.0, **FIXED)
WALL = box((31.0, 0, 2), (1, 40, 6), reflectivity=0.6, material=Material.CONCRETE)
OF_CAR = {"semantic": Semantic.CAR, "instance": 7, "velocity_m_s": (15.0, 0.0)}
CAR = box((25.0, 1.0, 0.85), (2.0, 0.9, 0.85), reflectivity=0.2, **OF_CAR)
# Effect and a weather that calls for it.
CALLED = (
    (Fog(), Conditions(visibility_m=60)),
    (Rain(), Conditions(rain_mm_h=20)),
    (Snow(), Conditions(snow_mm_h=2)),
    (Spray(), Conditions(water_film_mm=1.0)),
)
NAMES = [effect_name(effect) for effect, _ in CALLED]


def surfaces(scene, sensor=SENSOR):
    """The echoes of the solids."""
    return sweeps.swept(scene, sensor, after=[DiffuseReflection()])


def applied(effect, scene, sensor=SENSOR, before=()):
    return sweeps.swept(scene, sensor, before=before, after=[DiffuseReflection(), effect])


@pytest.mark.parametrize(("effect", "weather"), CALLED, ids=NAMES)
def test_echoes_of_the_air_lie_before_the_target_and_second_ones_leave_the_first(effect, weather):
    scene = Scene((replace(CAR, centre=(16.0, 1.0, 0.85)),), weather=weather)
    before, after = surfaces(scene), applied(effect, scene)
    dual = applied(effect, scene, before=[DualReturn()])
    for one, two in zip(after.first.columns(), dual.first.columns(), strict=True):
        assert (one == two).all()
    # A hard echo that lost against the air, or one from the air that lost, comes second.
    assert (dual.second.power > 0).any()
    assert (dual.second.power <= dual.first.power).all()
    air = after.first.origin > 0
    assert air.any()
    assert (after.first.range_m[air] <= before.first.range_m[air] + 1e-4).all()
    assert (after.first.range_m[air] >= SENSOR.min_range_m).all()
    assert (after.first.surface[air] == NO_SURFACE).all()


@pytest.mark.parametrize(
    ("visibility_m", "last_m"), [(50, 17.9), (100, 24.7), (200, 31.7), (math.inf, 50.0)]
)
def test_last_ground_ring_in_fog(visibility_m, last_m):
    """10 % asphalt from 1.73 m falls below the limit at 50 m in clear air.

    There 0.358 * 0.1 / 50^2 = 1.43e-5, with 0.358 = A cos + B sin^2 of ``surface_power``; in fog
    the last ring is where 0.0358 / R^2 * 20^(-2 R / MOR) comes to the same, but for the factor
    (0.388 at 18 m, 0.376 at 25 m, 0.369 at 32 m).
    """
    slope = 1.73 / np.linspace(15, 55, 801)
    none = (0.0,) * len(slope)
    steep_first = tuple(map(float, -np.arctan(slope[::-1])))
    lasers = Lasers(steep_first, none, none, none, none, (1.0,) * len(slope))
    sensor = replace(SENSOR, lasers=lasers, shots=8, pulse_s=0.0)
    scene = Scene(ground_reflectivity=0.1, weather=Conditions(visibility_m=visibility_m))
    after = (
        applied(Fog(), scene, sensor) if math.isfinite(visibility_m) else surfaces(scene, sensor)
    )
    seen = after.first.range_m[after.first.power >= SENSOR.min_power]
    assert seen.max() == pytest.approx(last_m, abs=0.1)


def test_waveform_of_fog():
    """Inside the overlap backscatter c tau / 2 / r0^2 exp(-2 alpha r); beyond it falls as r^-2."""
    edges, waveform = soft_waveform(50.0, SENSOR)
    alpha = math.log(20) / 50
    flat = 0.046 / 50 * 0.7495 / 25
    at = np.searchsorted(edges, [3.0, 15.0])
    expected = flat * np.exp(-2 * alpha * edges[at]) * np.array([1, (5 / edges[at[1]]) ** 2])
    np.testing.assert_allclose(waveform[at], expected, rtol=3e-3)


def test_soft_echoes_of_the_sky_follow_the_waveform():
    sweep = applied(Fog(), Scene(weather=Conditions(visibility_m=50)))
    ranges = sweep.first.range_m[np.isinf(surfaces(Scene()).first.range_m)]
    edges, waveform = soft_waveform(50.0, SENSOR)
    steps = np.append(0.0, ((waveform[1:] + waveform[:-1]) / 2).cumsum())
    share = np.interp(np.sort(ranges), edges, steps / steps[-1])
    # Kolmogorov-Smirnov distance; 1.63 / sqrt(n) is exceeded once in 100 keys.
    assert len(ranges) > 1000
    distance = np.abs(share - (np.arange(len(share)) + 0.5) / len(share)).max()
    assert distance < 1.63 / math.sqrt(len(share))
    sky_power = sweep.first.power[sweep.first.range_m < np.inf].min()
    assert sky_power == pytest.approx(waveform.max(), rel=1e-6)


def test_no_fog_is_heard_before_a_target_nearer_than_is_reported():
    sweep = Sweep(Scene(weather=Conditions(visibility_m=20)), SENSOR)
    sweep.first.range_m[:] = SENSOR.min_range_m - 0.1
    Fog().apply(sweep, slice(None), Draws(sweep.num_rays, "draws"))
    assert not sweep.first.power.any()


def test_extinction_of_rain_and_snow():
    """The plan's figures: 1.0e-3, 1.6e-3, 3.1e-3 at 5, 10, 30 mm/h; snow 1.4e-3 at 1 mm/h."""
    found = [Rain().extinction_per_m(rate) for rate in (5, 10, 30)]
    np.testing.assert_allclose(found, [1.0e-3, 1.56e-3, 3.11e-3], rtol=0.01)
    assert Snow().extinction_per_m(1) == pytest.approx(1.44e-3, rel=0.01)
    # By quadrature of 2 (pi D^2 / 4) N(D), D in mm.
    diameter = np.linspace(0, 20, 200_001)
    number = 8000 * np.exp(-4.1 * 10**-0.21 * diameter)
    section = (2 * math.pi / 4 * diameter**2 * number).sum() * (diameter[1] - diameter[0])
    assert Rain().extinction_per_m(10) == pytest.approx(1e-6 * section, rel=1e-4)


def strongest_drops(num_rays, target_m, reflectivity, intercept, slope, extinction):
    """Power and range of the strongest drop of each ray, drop by drop; power 0 for none."""
    generator = np.random.default_rng(5)
    near, half_angle, smallest = SENSOR.min_range_m, SENSOR.divergence_rad / 2, 0.1
    volume = math.pi * half_angle**2 * (target_m**3 - near**3) / 3
    mean = intercept / slope * math.exp(-slope * smallest) * volume
    count = generator.poisson(mean, num_rays)
    ray = np.repeat(np.arange(num_rays), count)
    range_m = (near**3 + generator.random(len(ray)) * (target_m**3 - near**3)) ** (1 / 3)
    diameter = smallest + generator.exponential(1 / slope, len(ray))
    filled = np.minimum(diameter / (1000 * 2 * half_angle * range_m), 1)
    overlap = np.minimum(1, (range_m / SENSOR.overlap_range_m) ** 2)
    power = reflectivity * filled**2 * np.exp(-2 * extinction * range_m) * overlap / range_m**2
    best, best_range = np.zeros(num_rays), np.zeros(num_rays)
    order = np.argsort(power)
    best[ray[order]], best_range[ray[order]] = power[order], range_m[order]
    return best, best_range


@pytest.mark.parametrize(
    ("effect", "weather", "intercept", "slope", "fog_per_m"),
    [
        (Rain(), Conditions(rain_mm_h=20), 8000.0, 4.1 * 20**-0.21, 0.0),
        (Snow(), Conditions(snow_mm_h=1), 7600.0, 2.55, 0.0),
        (Snow(), Conditions(snow_mm_h=1), 7600.0, 2.55, 0.05),
    ],
    ids=["rain", "snow", "snow in fog"],
)
def test_drops_against_drop_by_drop(effect, weather, intercept, slope, fog_per_m):
    """Sky and rays at a target at 6 m, against a simulation of each drop in the beam."""
    rate = getattr(weather, effect.field)
    sensor = replace(SENSOR, shots=480)
    for target_m in (6.0, 20.0):
        sweep = Sweep(Scene(weather=weather), sensor)
        sweep.first.range_m[:] = target_m
        sweep.first.power[:] = SENSOR.min_power
        attenuate(sweep, fog_per_m)
        effect.apply(sweep, slice(None), Draws(sweep.num_rays, "drops"))
        extinction = fog_per_m + effect.extinction_per_m(rate)
        dark = SENSOR.min_power * math.exp(-2 * extinction * target_m)
        medium = effect.reflectivity, intercept, slope, extinction
        power, range_m = strongest_drops(sweep.num_rays, target_m, *medium)
        weakest = SENSOR.min_power
        drops, expected = (sweep.first.origin > 0) & (sweep.first.power > weakest), power > weakest
        seen, where = sweep.first.power[drops], sweep.first.range_m[drops]
        assert dark < weakest
        # Four standard errors of the difference of two counts and two means.
        assert abs(len(seen) - expected.sum()) < 4 * math.sqrt(len(seen) + expected.sum())
        for mine, theirs in ((np.log(seen), np.log(power[expected])), (where, range_m[expected])):
            error = math.hypot(mine.std() / math.sqrt(len(mine)), theirs.std() / len(theirs) ** 0.5)
            assert abs(mine.mean() - theirs.mean()) < 4 * error + 0.005 * abs(theirs.mean())
            np.testing.assert_allclose(mine.std(), theirs.std(), rtol=0.1)


def test_the_echo_of_a_drop_is_weakened_there_and_back():
    """The strongest echo of a drop at r0, where it fills the beam, is q exp(-2 k r0) / r0^2.

    A beam of 0.01 mrad is full of any drop; in 1e4 mm/h of rain k = 0.10 per metre, so that from
    5 m the drop's echo comes back with 0.36 of its power; with the loss of one way it had 0.60.
    """
    line = replace(SENSOR, divergence_rad=1e-5, min_range_m=5.0)
    k = Rain().extinction_per_m(1e4)
    edges, powers, _ = Rain().drop_table(1e4, line, k)
    middle = 5.0 + (edges[1] - edges[0]) / 2
    assert powers[-1] == pytest.approx(0.02 * math.exp(-2 * k * middle) / middle**2, rel=1e-6)
    assert math.exp(-2 * k * middle) < 0.5


def test_plume_of_a_car():
    """A car of 1.8 m width at 15 m/s, rear at x = 14 m: the plume spans 5..14 m, |y - 1| < 0.9."""
    scene = Scene((replace(CAR, centre=(16.0, 1.0, 0.85)),), weather=Conditions(water_film_mm=1.2))
    sensor = replace(SENSOR, spin_hz=1e6)  # no time for the car to move
    before, after = surfaces(scene, sensor), applied(Spray(), scene, sensor)
    # Rays at the car's rear have 9 m of spray with 0.2 * 0.5 per metre before them.
    x, y, z = before.position(np.arange(before.num_rays))
    rear = np.isclose(x, 14, atol=0.01) & (np.abs(y - 1) < 0.4) & (z < -0.5)
    ratio = after.first.power[rear] / before.first.power[rear]
    slant = before.first.range_m[rear] * 9 / 14
    assert rear.sum() > 3
    np.testing.assert_allclose(ratio, np.exp(-2 * 0.1 * slant), rtol=0.03)
    # Its own echoes lie within it, most of them near its near side.
    spray = np.flatnonzero(after.first.origin == Origin.SPRAY)
    x, y, z = after.position(spray)
    assert len(spray) > 10
    assert (x.min() > 4.99) & (np.median(x) < 9.5) & (x.max() < 14.01)
    assert np.abs(y - 1).max() < 0.91
    assert z.max() < 1.8 - 1.73 + 0.01
    # A car that leaves to the left leaves its plume to the right of it.
    car = replace(CAR, centre=(15.0, 10.0, 0.85), yaw_rad=math.pi / 2, velocity_m_s=(0.0, 15.0))
    after = applied(Spray(), replace(scene, primitives=(car,)), sensor)
    x, y, _ = after.position(np.flatnonzero(after.first.origin == Origin.SPRAY))
    assert (y.min() > -1.01) & (y.max() < 8.01)
    assert np.abs(x - 15).max() < 0.91


def test_one_plume_per_vehicle():
    roof = replace(CAR, centre=(25.0, 1.0, 2.0), half_size=(1.0, 0.8, 0.3))
    beside = replace(CAR, centre=(25.0, -3.0, 0.85), instance=0)
    wet = Conditions(water_film_mm=1.2)
    one = applied(Spray(), Scene((CAR,), weather=wet))
    same = applied(Spray(), Scene((CAR, roof), weather=wet))
    two = applied(Spray(), Scene((CAR, beside), weather=wet))
    sprayed = [(sweep.first.origin == Origin.SPRAY).sum() for sweep in (one, same, two)]
    assert sprayed[1] == pytest.approx(sprayed[0], abs=5)  # the roof hides some ground behind it
    assert sprayed[2] > 1.5 * sprayed[0]


def test_a_plume_is_the_same_behind_a_car_whose_wheels_are_cast_and_one_far_away():
    wheels = replace(CAR, centre=(25.0, 1.0, 0.31), half_size=(0.31, 0.9, 0.31))
    wet = Conditions(water_film_mm=1.2)
    near, far = Scene((CAR, wheels), weather=wet), Scene((CAR,), weather=wet, unseen=(wheels,))
    sprayed = [Spray().rays(Sweep(scene, SENSOR)) for scene in (near, far)]
    np.testing.assert_array_equal(*sprayed)


def test_fog_before_a_plume_weakens_its_echoes():
    """A plume 5 to 14 m away: its echoes carry the extinction of fog up to its near side."""
    scene = Scene((replace(CAR, centre=(16.0, 1.0, 0.85)),), weather=Conditions(water_film_mm=1.2))
    foggy = replace(scene, weather=replace(scene.weather, visibility_m=200.0))
    clear, fog = applied(Spray(), scene), applied(Fog(), foggy)
    after = sweeps.swept(foggy, SENSOR, after=[DiffuseReflection(), Fog(), Spray()])
    is_spray = (clear.first.origin == Origin.SPRAY) & (after.first.origin == Origin.SPRAY)
    sprayed = np.flatnonzero(is_spray & (fog.first.origin == Origin.SURFACE))  # fog ends no plume
    assert len(sprayed) > 10
    ratio = after.first.power[sprayed] / clear.first.power[sprayed]
    loss = 2 * math.log(20) / 200
    assert (ratio < np.exp(-loss * 4.9)).all()
    assert (ratio > np.exp(-loss * clear.first.range_m[sprayed] * 1.01)).all()


def test_slow_vehicles_and_dry_roads_spray_nothing():
    slow = replace(CAR, velocity_m_s=(0.0, 10.0))
    for scene in (Scene((slow,), weather=Conditions(water_film_mm=1.0)), Scene((CAR,))):
        assert Spray().called_by(scene, SENSOR) is None


def test_plume_moves_with_its_car():
    """Seen from a car at 40 m/s that passes on the left, 25 ms after the middle of the sweep."""
    car = replace(CAR, centre=(8.0, 5.0, 0.85), velocity_m_s=(40.0, 0.0))
    after = applied(Spray(), Scene((car,), weather=Conditions(water_film_mm=1.2)))
    spray = np.flatnonzero(after.first.origin == Origin.SPRAY)
    x = after.position(spray)[0]
    left = np.abs(x) < 3
    assert after.time_s[spray][left].min() > 0.01
    seen_from_car = x - 40 * after.time_s[spray]
    assert np.abs(seen_from_car).max() < 6.01
    assert x.max() > 6.1

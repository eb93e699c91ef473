import math
from dataclasses import replace

import numpy as np
import pytest

from r3dpa.simulation.draws import Draws
from r3dpa.simulation.effects import SunGlare
from r3dpa.simulation.scene import Pose, Primitive, Scene, Semantic, Shape, Weather
from r3dpa.simulation.sensor import hdl64e
from r3dpa.simulation.sweep import Origin, Sweep

SENSOR = hdl64e(shots=720)
LOW = Weather(sun_elevation_deg=5.0, sun_azimuth_deg=90.0)
HOUSE = Primitive(Shape.BOX, (0, 20, 5), (20, 4, 5), Semantic.BUILDING, 0.3)


def applied(scene, effect=None, sensor=SENSOR, key="draws"):
    effect = effect or SunGlare()
    sweep = Sweep(scene, sensor)
    sweep.cast()
    rays = effect.rays(sweep)
    if len(rays):
        effect.apply(sweep, rays, Draws(sweep.num_rays, key))
    return sweep, rays


def angle_from(sweep, elevation_deg, azimuth_deg):
    """Angle of each ray from a direction of the scene frame, degrees."""
    elevation, azimuth = math.radians(elevation_deg), math.radians(azimuth_deg)
    x, y, z = sweep.direction.astype(float)
    along = math.cos(elevation) * (math.cos(azimuth) * x + math.sin(azimuth) * y)
    return np.degrees(np.arccos(np.clip(along + math.sin(elevation) * z, -1, 1)))


def test_called_by_a_low_sun_in_a_clear_sky():
    """The highest beam of an HDL-64E rises by 1.96 degrees or little more, the glare 10 more."""
    highest = math.degrees(SENSOR.lasers.inclination_rad[0])
    assert highest == pytest.approx(2, abs=1)
    for elevation_deg, called in ((-1, False), (0.0, False), (1, True), (45, False)):
        weather = replace(LOW, sun_elevation_deg=elevation_deg)
        assert bool(SunGlare().called_by(Scene(weather=weather), SENSOR)) is called
    for elevation_deg, called in ((highest + 9.9, True), (highest + 10.1, False)):
        weather = replace(LOW, sun_elevation_deg=elevation_deg)
        assert bool(SunGlare().called_by(Scene(weather=weather), SENSOR)) is called
        assert bool(len(applied(Scene(weather=weather))[1])) is called
    # A sensor that leans towards the sun sees it higher.
    leaning = Scene(pose=Pose(roll_rad=0.1), weather=replace(LOW, sun_elevation_deg=highest + 14))
    assert SunGlare().called_by(leaning, SENSOR)
    assert len(applied(leaning)[1])
    assert not len(applied(replace(leaning, pose=Pose(roll_rad=-0.1)))[1])


@pytest.mark.parametrize(
    "covered",
    [{"clear_sky": False}, {"visibility_m": 200.0}, {"rain_mm_h": 1.0}, {"snow_mm_h": 1.0}],
)
def test_not_called_under_a_covered_sky(covered):
    scene = Scene(weather=replace(LOW, **covered))
    assert SunGlare().called_by(scene, SENSOR) is None
    assert len(applied(scene)[1]) == 0


def test_threshold_near_the_sun():
    """1 + 3 * cos^4(9 g) * exp(-0.1 * 10.3): Kasten and Young's air mass at 5 degrees is 10.3."""
    sweep, rays = applied(Scene(weather=LOW))
    angle = angle_from(sweep, 5.0, 90.0)
    rise = sweep.min_power / SENSOR.min_power
    assert (rise[angle > 10.01] == 1).all()
    assert set(rays) >= set(np.flatnonzero(angle < 9.99))
    glare = np.cos(np.radians(9 * angle[rays])) ** 4
    np.testing.assert_allclose(rise[rays], 1 + 3 * math.exp(-1.03) * glare, rtol=3e-3)
    assert rise.max() > 1.5
    # Without a jump: at the border nothing has changed yet.
    assert rise[(angle > 9.5) & (angle < 10)].max() < 1.001


def test_azimuth_of_the_sun_is_that_of_the_world():
    """Heading +60 degrees, sun at 90: it stands 30 degrees to the left."""
    sweep, _ = applied(Scene(pose=Pose(heading_rad=math.radians(60)), weather=LOW))
    raised = sweep.min_power > 1.01 * SENSOR.min_power
    assert raised.any()
    assert angle_from(sweep, 5.0, 30.0)[raised].max() < 10


def test_a_hidden_sun_does_not_glare():
    sweep, rays = applied(Scene((HOUSE,), weather=LOW))
    assert len(rays) == 0
    assert (sweep.min_power == np.float32(SENSOR.min_power)).all()
    opposite = replace(LOW, sun_azimuth_deg=-90.0)
    assert len(applied(Scene((HOUSE,), weather=opposite))[1])


def test_noise_is_as_frequent_as_said():
    """Expected number = sum of noise * glare over the rays; ranges even over those reported."""
    effect = SunGlare(noise=1.0)
    sweep = Sweep(Scene(weather=LOW), hdl64e())  # not cast: every ray looks into the sky
    rays = effect.rays(sweep)
    effect.apply(sweep, rays, Draws(sweep.num_rays, "draws"))
    noise = sweep.first.origin == Origin.SUN
    glare = (sweep.min_power[rays] / SENSOR.min_power - 1) / 3
    expected = glare.sum()
    assert expected > 30
    assert abs(noise.sum() - expected) < 4 * math.sqrt(expected)
    assert (sweep.first.power[noise] > sweep.min_power[noise]).all()
    middle = (SENSOR.min_range_m + SENSOR.max_range_m) / 2
    spread = (SENSOR.max_range_m - SENSOR.min_range_m) / math.sqrt(12)
    assert abs(sweep.first.range_m[noise].mean() - middle) < 4 * spread / math.sqrt(noise.sum())

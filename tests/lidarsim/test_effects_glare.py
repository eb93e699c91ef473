"""Retro-reflecting sheets, their halo, and the low sun, against hand-made figures."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import sweeps
from sweeps import applied, box

from lidarsim.draws import Draws
from lidarsim.effects import Blooming, DiffuseReflection, RetroReflection, SunGlare
from lidarsim.scan import simulate_scan
from lidarsim.scene import Conditions, Material, Pose, Scene, Semantic
from lidarsim.sensors import hdl64e
from lidarsim.sweep import Origin, Sweep

SENSOR = hdl64e()
COARSE = hdl64e(shots=720)
LOW = Conditions(sun_elevation_deg=5.0, sun_azimuth_deg=90.0)
HOUSE = box((0, 20, 5), (20, 4, 5), semantic=Semantic.BUILDING, reflectivity=0.3)


def sheet(x, y, half_m, yaw_rad=0.0):
    size, material = (0.01, half_m, half_m), Material.RETROREFLECTOR
    sign = {"semantic": Semantic.SIGN, "reflectivity": 0.9, "material": material}
    return box((x, y, 1.9), size, yaw_rad=yaw_rad, **sign)


def swept(scene, effects):
    return sweeps.swept(scene, SENSOR, after=(DiffuseReflection(), *effects))


def angles_to(sweep, rays, sources):
    """Smallest angle in degrees between each ray and the sources."""
    cosine = sweep.direction[:, rays].astype(float).T @ sweep.direction[:, sources].astype(float)
    return np.degrees(np.arccos(cosine.clip(max=1))).min(axis=1)


@pytest.mark.parametrize(("degrees", "coefficient"), [(0, 70.0), (30, 30.0), (60, 1.1)])
def test_gain_is_that_of_the_norm(degrees, coefficient):
    scene = Scene((sheet(10, 0, 0.6, np.radians(degrees)),))
    matt, bright = swept(scene, []), swept(scene, [RetroReflection()])
    rays = RetroReflection().rays(bright)
    gain = bright.first.power[rays] / matt.first.power[rays]
    nearest = np.abs(np.degrees(np.arccos(bright.cos_incidence[rays])) - degrees).argmin()
    # Intensity of a matt surface: reflectivity / pi times the cosine of its area to either side.
    expected = 1 + np.pi * coefficient / (0.9 * np.cos(np.radians(degrees)) ** 2)
    assert gain[nearest] == pytest.approx(expected, rel=0.06)
    scan = simulate_scan(scene, SENSOR, (1,), {"blooming": "off", "laser_calibration": "off"})
    on_sheet = (scan.labels & 0xFFFF) == Semantic.SIGN
    if degrees < 60:
        assert (scan.points[on_sheet, 3] > 0.98).all()


def halo_counts(sweep, turns, effect):
    """How often each ray of the turn is dazzled in so many turns."""
    count = np.zeros(sweep.num_rays)
    echoes = sweep.first
    for turn in range(turns):
        sweep.first = copy.deepcopy(echoes)
        effect.apply(sweep, effect.rays(sweep), Draws(sweep.num_rays, "test", turn))
        count += sweep.first.origin == Origin.BLOOMING
    sweep.first = echoes
    return count


def test_chance_of_a_halo_is_gaussian_in_the_angle():
    sweep = swept(Scene((sheet(20, 3, 0.4),)), [RetroReflection()])
    sources = RetroReflection().rays(sweep)
    beside = Blooming().rays(sweep)
    # All neighbours within half a degree, and no others.
    around = np.flatnonzero(sweep.direction[:, sources].mean(axis=1) @ sweep.direction > 0.99)
    candidates = np.setdiff1d(around, sources)
    angle = angles_to(sweep, candidates, sources)
    inner, outer = candidates[angle < 0.4999], candidates[angle < 0.5001]
    assert set(inner) <= set(beside) <= set(outer)
    turns = 100
    count = halo_counts(sweep, turns, Blooming(spill=1.0))[beside]
    chance = np.exp(-((angles_to(sweep, beside, sources) / 0.2) ** 2))
    # Five standard errors of each count, and of their sum.
    variance = turns * chance * (1 - chance)
    assert (np.abs(count - turns * chance) < 5 * np.sqrt(variance) + 3).all()
    assert abs(count.sum() - turns * chance.sum()) < 5 * np.sqrt(variance.sum())


def test_halo_of_weak_sheeting_shrinks_with_range():
    """Below saturation the chance goes with the root of the power, as 1 / R; above it is 1."""

    def points_of_halo(distance_m, retroreflection):
        scene = Scene((sheet(distance_m, 0, 0.05 * distance_m),), ground_reflectivity=1e-3)
        sweep = swept(scene, [RetroReflection(retroreflection)])
        return halo_counts(sweep, 60, Blooming(spill=1.0)).sum()

    assert points_of_halo(20, 0.05) / points_of_halo(40, 0.05) == pytest.approx(2, rel=0.15)
    assert points_of_halo(20, 70.0) / points_of_halo(40, 70.0) == pytest.approx(1, rel=0.15)


def test_halo_has_the_range_of_the_sheet_and_no_label():
    scene = Scene((sheet(15, 5, 0.4),))
    plain = dict.fromkeys(
        ("range_noise", "laser_calibration", "surface_texture", "weak_patches"), "off"
    )
    scan = simulate_scan(scene, SENSOR, (4,), plain)
    halo, sheeting = (scan.origins == Origin.BLOOMING), (scan.labels & 0xFFFF) == Semantic.SIGN
    assert halo.sum() > 3
    assert (scan.labels[halo] == 0).all()
    range_m = np.linalg.norm(scan.points[:, :3], axis=1)
    assert range_m[sheeting].min() - 0.02 < range_m[halo].min()
    assert range_m[halo].max() < range_m[sheeting].max() + 0.02
    # sqrt(0.002 * 220), a little less off the sheet's normal, and less beside its rim.
    assert scan.points[halo, 3].max() == pytest.approx(0.62, abs=0.08)


def test_halo_runs_across_the_end_of_the_turn():
    """The sheet begins just to the left of azimuth 0: its halo reaches the last shots."""
    sweep = swept(Scene((sheet(20, 0.46, 0.4),)), [RetroReflection()])
    assert (RetroReflection().rays(sweep) % SENSOR.shots).max() < SENSOR.shots // 2
    assert (Blooming().rays(sweep) % SENSOR.shots).max() >= SENSOR.shots - 2


def glared(scene):
    """A sweep with the glare of the sun, and its rays."""
    sweep = sweeps.swept(scene, COARSE)
    rays = SunGlare().rays(sweep)
    return applied(sweep, SunGlare()), rays


def angle_from(sweep, elevation_deg, azimuth_deg):
    """Angle of each ray from a direction of the scene frame, degrees."""
    elevation, azimuth = math.radians(elevation_deg), math.radians(azimuth_deg)
    x, y, z = sweep.direction.astype(float)
    along = math.cos(elevation) * (math.cos(azimuth) * x + math.sin(azimuth) * y)
    return np.degrees(np.arccos(np.clip(along + math.sin(elevation) * z, -1, 1)))


def test_called_by_a_low_sun_in_a_clear_sky():
    """The highest beam of an HDL-64E rises by 1.96 degrees or little more, the glare 10 more."""
    highest = math.degrees(COARSE.lasers.inclination_rad[0])
    assert highest == pytest.approx(2, abs=1)
    leaning = Pose(roll_rad=0.1)  # towards the sun: it sees the sun higher
    for elevation_deg, pose, called in (
        (0.5, Pose(), True),
        (highest + 9.9, Pose(), True),
        (highest + 10.1, Pose(), False),
        (highest + 14, leaning, True),
        (highest + 14, Pose(roll_rad=-0.1), False),
    ):
        scene = Scene(pose=pose, weather=replace(LOW, sun_elevation_deg=elevation_deg))
        assert bool(len(glared(scene)[1])) is called
        if called or pose == Pose():
            assert bool(SunGlare().called_by(scene, COARSE)) is called
    covered = [{name: 1.0} for name in ("visibility_m", "rain_mm_h", "snow_mm_h")]
    for change in (*covered, {"clear_sky": False}, {"sun_elevation_deg": 0.0}):
        assert SunGlare().called_by(Scene(weather=replace(LOW, **change)), COARSE) is None


@pytest.mark.parametrize("heading_deg", [0.0, 60.0])
def test_threshold_near_the_sun(heading_deg):
    """1 + 3 * cos^4(9 g) * exp(-0.1 * 10.3): Kasten and Young's air mass at 5 degrees is 10.3.

    The azimuth of the sun is that of the world.
    """
    sweep, rays = glared(Scene(pose=Pose(heading_rad=math.radians(heading_deg)), weather=LOW))
    angle = angle_from(sweep, 5.0, 90.0 - heading_deg)
    rise = sweep.min_power / COARSE.min_power
    assert (rise[angle > 10.01] == 1).all()
    assert set(rays) >= set(np.flatnonzero(angle < 9.99))
    glare = np.cos(np.radians(9 * angle[rays])) ** 4
    np.testing.assert_allclose(rise[rays], 1 + 3 * math.exp(-1.03) * glare, rtol=3e-3)
    assert rise.max() > 1.5
    # Without a jump: at the border nothing has changed yet.
    assert rise[(angle > 9.5) & (angle < 10)].max() < 1.001


def test_a_hidden_sun_does_not_glare():
    sweep, rays = glared(Scene((HOUSE,), weather=LOW))
    assert len(rays) == 0
    assert (sweep.min_power == np.float32(COARSE.min_power)).all()
    opposite = replace(LOW, sun_azimuth_deg=-90.0)
    assert len(glared(Scene((HOUSE,), weather=opposite))[1])


def test_noise_is_as_frequent_as_said():
    """Expected number = sum of noise * glare over the rays; ranges even over those reported."""
    effect = SunGlare(noise=1.0)
    sweep = Sweep(Scene(weather=LOW), hdl64e())  # not cast: every ray looks into the sky
    rays = effect.rays(sweep)
    applied(sweep, effect)
    noise = sweep.first.origin == Origin.SUN
    glare = (sweep.min_power[rays] / COARSE.min_power - 1) / 3
    expected = glare.sum()
    assert expected > 30
    assert abs(noise.sum() - expected) < 4 * math.sqrt(expected)
    assert (sweep.first.power[noise] > sweep.min_power[noise]).all()
    middle = (COARSE.min_range_m + COARSE.max_range_m) / 2
    spread = (COARSE.max_range_m - COARSE.min_range_m) / math.sqrt(12)
    assert abs(sweep.first.range_m[noise].mean() - middle) < 4 * spread / math.sqrt(noise.sum())

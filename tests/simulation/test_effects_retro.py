"""Retro-reflecting sheets and their halo, against hand-made figures."""

import copy

import numpy as np
import pytest

from r3dpa.simulation import (
    Material,
    Origin,
    Primitive,
    Scene,
    Semantic,
    Shape,
    Sweep,
    hdl64e,
    simulate_scan,
)
from r3dpa.simulation.draws import Draws
from r3dpa.simulation.effects import Blooming, DiffuseReflection, RetroReflection

SENSOR = hdl64e()


def sheet(x, y, half_m, yaw_rad=0.0, reflectivity=0.9, material=Material.RETROREFLECTOR):
    return Primitive(
        Shape.BOX, (x, y, 1.9), (0.01, half_m, half_m), Semantic.SIGN, reflectivity, yaw_rad,
        material=material,
    )  # fmt: skip


def swept(scene, effects):
    sweep = Sweep(scene, SENSOR)
    sweep.cast()
    for effect in (DiffuseReflection(), *effects):
        effect.apply(sweep, effect.rays(sweep), Draws(sweep.num_rays, "test"))
    return sweep


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
    turns = 200
    count = halo_counts(sweep, turns, Blooming(spill=1.0))[beside]
    chance = np.exp(-((angles_to(sweep, beside, sources) / 0.2) ** 2))
    # Five standard errors of each count, and of their sum.
    variance = turns * chance * (1 - chance)
    assert (np.abs(count - turns * chance) < 5 * np.sqrt(variance) + 3).all()
    assert abs(count.sum() - turns * chance.sum()) < 5 * np.sqrt(variance.sum())


def test_halo_of_weak_sheeting_shrinks_with_range():
    """Below saturation the chance goes with the root of the power, as 1 / R; above it is 1."""

    def points_of_halo(distance_m, retroreflection):
        scene = Scene((sheet(distance_m, 0, 0.02 * distance_m),), ground_reflectivity=1e-3)
        sweep = swept(scene, [RetroReflection(retroreflection)])
        return halo_counts(sweep, 60, Blooming(spill=1.0)).sum()

    assert points_of_halo(20, 0.05) / points_of_halo(40, 0.05) == pytest.approx(2, rel=0.15)
    assert points_of_halo(20, 70.0) / points_of_halo(40, 70.0) == pytest.approx(1, rel=0.15)


def test_halo_has_the_range_of_the_sheet_and_no_label():
    scene = Scene((sheet(15, 5, 0.4),))
    plain = dict.fromkeys(("range_noise", "laser_calibration", "surface_texture"), "off")
    scan = simulate_scan(scene, SENSOR, (4,), plain)
    halo, sheeting = (scan.origins == Origin.BLOOMING), (scan.labels & 0xFFFF) == Semantic.SIGN
    assert halo.sum() > 3
    assert (scan.labels[halo] == 0).all()
    range_m = np.linalg.norm(scan.points[:, :3], axis=1)
    assert range_m[sheeting].min() - 0.02 < range_m[halo].min()
    assert range_m[halo].max() < range_m[sheeting].max() + 0.02
    # sqrt(0.002 * 220), a little less off the sheet's normal.
    assert np.median(scan.points[halo, 3]) == pytest.approx(0.62, abs=0.08)


def test_halo_runs_across_the_end_of_the_turn():
    """The sheet begins just to the left of azimuth 0: its halo reaches the last shots."""
    sweep = swept(Scene((sheet(20, 0.46, 0.4),)), [RetroReflection()])
    _, shot = np.divmod(RetroReflection().rays(sweep), SENSOR.shots)
    assert shot.max() < SENSOR.shots // 2
    _, beside = np.divmod(Blooming().rays(sweep), SENSOR.shots)
    assert (beside >= SENSOR.shots - 2).any()
    assert (beside < SENSOR.shots // 2).any()

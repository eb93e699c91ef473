"""Diffuse reflection and the link budget, against hand-made figures."""

from dataclasses import replace

import numpy as np
import pytest
from sweeps import box, swept

from lidarsim import Material, Pose, Scene, Semantic, hdl64e
from lidarsim.effects import (
    DetectionLimit,
    DiffuseReflection,
    SurfaceTexture,
    surface_power,
)

SENSOR = hdl64e(shots=1040)


def power_of_wall(distance_m, tilt_deg=0.0, material=Material.PAINT):
    """Power of the shot that meets a wall closest to straight on."""
    centre = (distance_m + 0.5 / np.cos(np.radians(tilt_deg)), 0, 2)
    turned = {"yaw_rad": np.radians(tilt_deg), "material": material}
    wall = box(centre, (0.5, 90, 9), reflectivity=0.6, **turned)
    sweep = swept(Scene((wall,)), SENSOR, after=[DiffuseReflection()])
    _, direction = SENSOR.rays
    ahead = int((direction[0] - np.abs(direction[2])).reshape(-1).argmax())
    assert sweep.first.surface[ahead] == 0
    assert sweep.first.range_m[ahead] == pytest.approx(distance_m, rel=0.01)
    return sweep.first.power[ahead]


def test_power_of_a_smooth_wall_follows_lambert():
    assert power_of_wall(10.0) == pytest.approx(0.6 / 100, rel=1e-3)
    assert power_of_wall(10.0) / power_of_wall(20.0) == pytest.approx(4, rel=0.01)
    assert power_of_wall(10.0, 60) / power_of_wall(10.0) == pytest.approx(0.5, rel=0.02)


def test_rough_surfaces_return_more_at_grazing_incidence():
    """Oren-Nayar with s = 0.5: A = 1 - 0.125 / 0.58, B = 0.1125 / 0.34."""
    smooth_part, rough_part = 1 - 0.125 / 0.58, 0.1125 / 0.34
    for degrees in (0.0, 60.0, 89.0):
        cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        power = surface_power(
            np.float32(0.3), np.float32(cosine), np.array(Material.BRICK), np.float32(5.0)
        )
        expected = 0.3 * (smooth_part * cosine + rough_part * sine**2) / 25
        assert power == pytest.approx(expected, rel=1e-5)
    assert power_of_wall(10.0, 0, Material.BRICK) == pytest.approx(
        0.6 * smooth_part / 100, rel=1e-3
    )


@pytest.mark.parametrize("smooth", [False, True])
def test_last_ground_return(smooth):
    """Asphalt of 10 %, 1.73 m below the shot's start, vanishes at 50.0 m.

    A smooth floor obeys Lambert, P = rho h / R^3, and vanishes at (rho h / P_min)^(1/3) under the
    limit that gives 50 m there, 1.38e-6.
    """
    # Raised, so that the shots of a beam of each height start 1.73 m above it.
    lasers = replace(SENSOR.lasers, height_m=(0.0,) * 64)
    sensor = replace(SENSOR, lasers=lasers, min_power=1.38e-6 if smooth else SENSOR.min_power)
    floor = box((0, 0, -1), (200, 200, 1), semantic=Semantic.ROAD, reflectivity=0.1)
    farthest = 0.0
    # A pitch of the sensor sweeps its beams over the ground in steps far below their pitch.
    for pitch in np.linspace(0, 0.006, 13):
        pose = Pose(pitch_rad=pitch)
        scene = Scene((), pose, ground_reflectivity=0.1)
        if smooth:
            scene = Scene((floor,), pose, ground_m=-3)
        sweep = swept(scene, sensor, after=[DiffuseReflection(), DetectionLimit()])
        farthest = max(farthest, sweep.first.range_m[np.isfinite(sweep.first.range_m)].max())
    expected = (0.1 * 1.73 / 1.38e-6) ** (1 / 3) if smooth else 50.0
    assert expected == pytest.approx(50.0, abs=0.1)
    assert farthest == pytest.approx(expected, abs=0.15)


def test_texture_scatters_the_power_around_its_median():
    """ln(power) of one material at one range has the standard deviation of its spread."""
    wall = box((12, 0, 2), (2, 60, 9), material=Material.BRICK)
    hedge = replace(wall, centre=(-12, 0, 2), material=Material.FOLIAGE)
    sweep = swept(Scene((wall, hedge)), SENSOR, after=[SurfaceTexture(0.3, 0.8)])
    for index, spread in enumerate((0.3, 0.8)):
        drawn = np.log(sweep.first.power[sweep.first.surface == index]) / spread
        assert len(drawn) > 5000
        # Standard errors of mean and standard deviation of n normal draws.
        assert drawn.mean() == pytest.approx(0, abs=4 / np.sqrt(len(drawn)))
        assert drawn.std() == pytest.approx(1, abs=4 / np.sqrt(2 * len(drawn)))
    assert (sweep.first.power[np.isinf(sweep.first.range_m)] == 0).all()

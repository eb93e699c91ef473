import doctest
from dataclasses import replace

import numpy as np
import pytest
from sweeps import box

from lidarsim import scan as module
from lidarsim.scan import Simulator, calibrated_intensity, simulate_scan
from lidarsim.scene import (
    Conditions,
    EgoMotion,
    Material,
    Pose,
    Primitive,
    Scene,
    Semantic,
    Shape,
)
from lidarsim.sensors import Lasers, hdl64e
from lidarsim.street import Street
from lidarsim.sweep import Origin

DRY = Conditions()
WALL = box((11, 0, 2), (1, 30, 4), material=Material.CONCRETE)
# Nothing but geometry and the limit of detection.
EXACT = dict.fromkeys(("laser_calibration", "lost_shots", "range_noise", "soft_raydrop"), "off")


@pytest.fixture(scope="module")
def street_scan():
    return simulate_scan(Street(0, 3, DRY).scene(60), hdl64e(), (0,))


def rings_of(points):
    """Laser index by counting the falls of azimuth, as for the real scans."""
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
    return np.append(0, np.cumsum(np.diff(azimuth) < 0))


def test_points_labels_and_origins_have_their_types_and_ranges(street_scan):
    points, labels, origins = street_scan.points, street_scan.labels, street_scan.origins
    assert rings_of(points).max() == 63
    assert (points.dtype, labels.dtype, origins.dtype) == (np.float32, np.uint32, np.uint8)
    assert points.shape == (len(labels), 4)
    assert len(origins) == len(labels)
    assert np.isfinite(points).all()
    intensity = points[:, 3]
    assert intensity.min() >= 0
    assert intensity.max() <= np.float32(0.99)
    np.testing.assert_allclose(intensity * 100, np.round(intensity * 100), atol=1e-4)
    assert set(np.unique(labels & 0xFFFF)) <= set(Semantic)
    assert set(np.unique(origins)) <= set(Origin)
    assert np.linalg.norm(points[:, :3], axis=1).max() < 120


def test_labels_name_the_object_and_points_in_the_air_have_none():
    car = Primitive(Shape.BOX, (8, 0, 1), (2, 1, 0.8), Semantic.CAR, 0.5, 0.0, 1234)
    scanned = simulate_scan(Scene((car,)), hdl64e(360), (0,), EXACT)
    points = scanned.points
    on_car = (points[:, 0] > 5) & (points[:, 0] < 11) & (points[:, 2] > -1.6)
    on_car &= np.abs(points[:, 1]) < 2
    assert on_car.sum() > 50
    assert (scanned.labels[on_car] == Semantic.CAR | 1234 << 16).all()
    assert (scanned.labels[~on_car] == Semantic.ROAD).all()
    foggy = Scene((WALL,), weather=Conditions(visibility_m=40))
    scanned = simulate_scan(foggy, hdl64e(360), (0,))
    in_fog = scanned.origins == Origin.FOG
    assert in_fog.sum() > 500
    assert (scanned.labels[in_fog] == 0).all()
    assert (scanned.labels[scanned.origins == Origin.SURFACE] != 0).all()


def test_moving_sensor_stores_points_as_if_it_stood():
    """Every stored point lies on a ray of the standing sensor, however it moved."""
    scene = Scene((WALL,), motion=EgoMotion(20.0, 0.5))
    points = simulate_scan(scene, hdl64e(360), (0,), EXACT).points[:, :3]
    still = simulate_scan(replace(scene, motion=EgoMotion()), hdl64e(360), (0,), EXACT).points
    lasers = hdl64e().lasers
    up = points[:, 2] - np.array(lasers.height_m)[rings_of(points)]
    slope = np.tan(np.array(lasers.inclination_rad))[rings_of(points)]
    lateral = 0.026
    along = np.sqrt(np.hypot(points[:, 0], points[:, 1]) ** 2 - lateral**2)
    np.testing.assert_allclose(up, along * slope, atol=2e-4)
    assert len(points) != len(still) or np.abs(points - still[:, :3]).max() > 0.1


def test_an_effect_can_be_switched_off_and_on():
    scene = Scene((WALL,), weather=Conditions(visibility_m=40))
    clear = simulate_scan(replace(scene, weather=DRY), hdl64e(90), (0,))
    off = simulate_scan(scene, hdl64e(90), (0,), {"fog": "off"})
    np.testing.assert_array_equal(off.points, clear.points)
    record = {record.name: record for record in off.effects}["fog"]
    assert (record.status, record.rays) == ("off", 0)
    on = simulate_scan(scene, hdl64e(90), (0,), {"fog": "on"})
    assert on.points.tobytes() == simulate_scan(scene, hdl64e(90), (0,)).points.tobytes()


def test_intensity_rises_with_the_root_of_the_reflectivity_and_weak_returns_have_none():
    min_power = 1e-5
    weakest, strong = 4 * min_power, 8 * min_power
    middle = np.sqrt(weakest * strong)
    power = np.float32([25 * strong, weakest, 1.0, strong, middle])
    range_m = np.sqrt(0.09 / power)
    intensity = calibrated_intensity(power, range_m, min_power)
    # The root of power * range^2 is 0.3; between the limits, half way in the logarithm, half of it.
    np.testing.assert_allclose(intensity, [0.3, 0.0, 0.3, 0.3, 0.15], atol=1e-6)
    bright = calibrated_intensity(np.float32([1.0]), np.float32([2.0]), min_power)
    np.testing.assert_allclose(bright, 0.99)


def test_no_return_and_a_single_laser():
    nowhere = Scene(pose=Pose(z_m=500.0))
    scanned = simulate_scan(nowhere, hdl64e(90), (0,))
    assert scanned.points.shape == (0, 4)
    assert len(scanned.labels) == len(scanned.origins) == 0
    lasers = Lasers((-0.1,), (0.0,), (0.2,), (0.0,), (0.0,), (1.0,))
    sensor = replace(hdl64e(90), lasers=lasers)
    assert len(simulate_scan(Scene(), sensor, (0,), EXACT).points) == 90


def test_scans_look_like_those_of_a_real_hdl64():
    """Figures of 30 real scans (KITTI, 64 beams), with room for a scene's luck."""
    figures = []
    for drive in (0, 3, 5, 9):
        points = simulate_scan(Street(0, drive, DRY).scene(40), hdl64e(), (0,)).points
        ranges = np.linalg.norm(points[:, :3], axis=1)
        near = (ranges > 1) & (ranges < 56)
        inclination = np.degrees(np.arcsin(points[near, 2] / ranges[near]))
        azimuth = np.arctan2(points[near, 1], points[near, 0])
        row = np.clip(64 * (3 - inclination) / 28, 0, 63).astype(int)
        column = np.clip(1024 * (np.pi - azimuth) / (2 * np.pi), 0, 1023).astype(int)
        hit = np.zeros((64, 1024), dtype=bool)
        hit[row, column] = True
        rows = (hit.mean(axis=1) > 0.02).sum()
        figures.append((hit.mean(), (points[:, 2] < -1.4).mean(), rows, len(points)))
    valid, ground, rows, size = np.mean(figures, axis=0)
    assert 0.70 < valid < 0.82
    assert 0.42 < ground < 0.62
    assert rows >= 61
    assert 110_000 < size < 128_000


def test_a_simulator_gives_the_scans_of_its_drive():
    simulator = Simulator(3, 5, Conditions(rain_mm_h=10), hdl64e(32), {"range_noise": "off"})
    scan = simulator.scan(7)
    scene = Street(3, 5, Conditions(rain_mm_h=10)).scene(7)
    key = (3, "effects", 5, 7)
    expected = simulate_scan(scene, hdl64e(32), key, {"range_noise": False})
    assert scan.points.tobytes() == expected.points.tobytes()
    assert scan.scene == scene
    assert Simulator(sensor="vls128").sensor.num_beams == 128
    assert doctest.testmod(module).failed == 0


def test_weather_of_another_kind_is_refused():
    with pytest.raises(ValueError, match=r"an object such as Weather\(rain_mm_h=3\), got a dict"):
        Simulator(weather={"rain_mm_h": 3})

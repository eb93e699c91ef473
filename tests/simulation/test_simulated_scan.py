from dataclasses import replace

import numpy as np
import pytest

from r3dpa.simulation import (
    HDL64E,
    DetectionLimit,
    LambertianReflection,
    Pose,
    Primitive,
    Scene,
    Semantic,
    Shape,
    Street,
    cast,
    simulate_scan,
)

DRY = (LambertianReflection(), DetectionLimit())


@pytest.fixture(scope="module")
def scan():
    return simulate_scan(Street(0, 3).scene(60), HDL64E(), (0,))


def rings_of(points):
    """Laser index by counting the falls of azimuth, as for the real scans."""
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
    return np.append(0, np.cumsum(np.diff(azimuth) < 0))


def test_types_and_ranges(scan):
    assert scan.points.dtype == np.float32
    assert scan.labels.dtype == np.uint32
    assert scan.points.shape == (len(scan.labels), 4)
    assert np.isfinite(scan.points).all()
    intensity = scan.points[:, 3]
    assert intensity.min() >= 0
    assert intensity.max() <= 0.99
    np.testing.assert_allclose(intensity * 100, np.round(intensity * 100), atol=1e-4)
    assert set(np.unique(scan.labels & 0xFFFF)) <= set(Semantic)


def test_beams_follow_one_another_and_can_be_recovered(scan):
    rings = rings_of(scan.points)
    assert rings.max() == 63
    inclination = np.arcsin(scan.points[:, 2] / np.linalg.norm(scan.points[:, :3], axis=1))
    lasers = HDL64E().lasers
    # Parallax: seen from the origin every point lies above its beam, by less than height / range.
    above = inclination - lasers.inclination_rad[rings]
    ranges = np.linalg.norm(scan.points[:, :3], axis=1)
    assert (above > 0).all()
    assert (above * ranges < 1.1 * lasers.height_m[rings]).all()


def test_parallax_changes_the_inclination_of_the_highest_beam_with_range():
    """A wall at 5 m is seen 2.4 degrees above the beam, one at 25 m by 0.5."""
    for distance_m, shift_deg in ((5, np.degrees(np.arctan(0.217 / 5))), (25, 0.497)):
        wall = Primitive(Shape.BOX, (distance_m + 1, 0, 2), (1, 30, 4), Semantic.WALL, 0.5)
        points = simulate_scan(Scene((wall,), Pose(), DRY), HDL64E(shots=720), (0,)).points
        straight = points[(rings_of(points) == 0) & (np.abs(points[:, 1]) < 0.1)]
        inclination = np.degrees(np.arctan2(straight[:, 2], straight[:, 0]))
        np.testing.assert_allclose(inclination - 1.96, shift_deg, atol=0.02)


def test_points_lie_on_the_surface_whatever_the_pose():
    """Points on the ground, brought to the world by the pose, have height 0."""
    pose = Pose(3.0, -2.0, 1.73, 0.7, 0.03, -0.02)
    points = simulate_scan(Scene((), pose, DRY), HDL64E(shots=90), (0,)).points
    x, y, z = points[:, :3].astype(float).T
    y, z = (
        np.cos(pose.roll_rad) * y - np.sin(pose.roll_rad) * z,
        np.sin(pose.roll_rad) * y + np.cos(pose.roll_rad) * z,
    )
    z = np.cos(pose.pitch_rad) * z - np.sin(pose.pitch_rad) * x
    np.testing.assert_allclose(z + pose.z_m, 0, atol=1e-4)


def test_intensity_of_a_wall_is_the_root_of_its_reflectivity():
    wall = Primitive(Shape.BOX, (11, 0, 2), (1, 30, 4), Semantic.WALL, 0.49)
    scan = simulate_scan(Scene((wall,), Pose(), DRY), HDL64E(shots=720), (0,))
    straight = (np.abs(scan.points[:, 1]) < 0.1) & (np.abs(scan.points[:, 2]) < 0.1)
    straight &= scan.points[:, 0] > 0
    assert straight.any()
    np.testing.assert_allclose(scan.points[straight, 3], 0.7, atol=0.011)


def test_labels_name_the_object():
    car = Primitive(Shape.BOX, (8, 0, 1), (2, 1, 0.8), Semantic.CAR, 0.5, 0.0, 1234)
    scan = simulate_scan(Scene((car,), Pose(), DRY), HDL64E(shots=360), (0,))
    on_car = (scan.points[:, 0] > 5) & (scan.points[:, 0] < 11) & (scan.points[:, 2] > -1.6)
    on_car &= np.abs(scan.points[:, 1]) < 2
    assert on_car.sum() > 50
    assert (scan.labels[on_car] == Semantic.CAR | 1234 << 16).all()
    assert (scan.labels[~on_car] == Semantic.ROAD).all()


class Weaken:
    stage = 6

    def __call__(self, returns, scene, generator):
        keep = generator.random(returns.power.shape) < 0.5
        return replace(returns, power=returns.power * keep)


class WeakenAgain(Weaken):
    pass


class Draw:
    """Draws, and changes nothing."""

    stage = 6

    def __call__(self, returns, scene, generator):
        generator.random(7)
        return returns


def points_after(*effects, key=(1,)):
    scene = Scene((), Pose(), (DRY[0], *effects, DRY[1]))
    return simulate_scan(scene, HDL64E(shots=360), key).points


def test_effects_are_applied_in_turn_each_with_its_own_draws():
    half = points_after(Weaken())
    assert len(half) / len(points_after()) == pytest.approx(0.5, abs=0.02)
    np.testing.assert_array_equal(half, points_after(Weaken()))
    np.testing.assert_array_equal(half, points_after(Draw(), Weaken()))
    assert not np.array_equal(half, points_after(Weaken(), key=(2,)))
    quarter = points_after(Weaken(), WeakenAgain())
    assert len(quarter) / len(points_after()) == pytest.approx(0.25, abs=0.02)


def test_an_effect_sees_the_scene_and_may_turn_the_rays():
    class Rise:
        """Moves the origin of every shot up to the height of the sensor above the road."""

        stage = 8

        def __call__(self, returns, scene, generator):
            up = np.float32([[[0.0]], [[0.0]], [[scene.pose.z_m]]])
            return replace(returns, rays=returns.rays._replace(origin=returns.rays.origin + up))

    pose = Pose(z_m=2.0)
    points = simulate_scan(Scene((), pose, (*DRY, Rise())), HDL64E(shots=90), (0,)).points
    assert len(points) > 1000
    np.testing.assert_allclose(points[:, 2], 0, atol=1e-4)


def test_scans_look_like_those_of_a_real_hdl64():
    """Figures of 30 real scans (KITTI, 64 beams), with room for a scene's luck."""
    valid, ground, rows, sizes = [], [], [], []
    for drive in (0, 2, 3, 5, 7, 9):
        points = simulate_scan(Street(0, drive).scene(40), HDL64E(), (0,)).points
        ranges = np.linalg.norm(points[:, :3], axis=1)
        near = (ranges > 1) & (ranges < 56)
        inclination = np.degrees(np.arcsin(points[near, 2] / ranges[near]))
        azimuth = np.arctan2(points[near, 1], points[near, 0])
        row = np.clip(64 * (3 - inclination) / 28, 0, 63).astype(int)
        column = np.clip(1024 * (np.pi - azimuth) / (2 * np.pi), 0, 1023).astype(int)
        hit = np.zeros((64, 1024), dtype=bool)
        hit[row, column] = True
        valid.append(hit.mean())
        rows.append((hit.mean(axis=1) > 0.02).sum())
        ground.append((points[:, 2] < -1.4).mean())
        sizes.append(len(points))
    assert 0.70 < np.mean(valid) < 0.83
    assert 0.42 < np.mean(ground) < 0.62
    assert min(rows) >= 59
    assert 110_000 < np.mean(sizes) < 131_000


def test_cast_alone_keeps_everything_the_limit_drops():
    scene = Scene()
    bare = np.isfinite(cast(scene, HDL64E(shots=90).rays).range_m).sum()
    kept = len(simulate_scan(Scene(effects=DRY), HDL64E(shots=90), (0,)).points)
    assert 0 < kept < bare

"""Scans of a flat road inside a round wall: every count is known by hand."""

import math
from dataclasses import fields

import numpy as np
import pytest
import torch
from sweeps import organised_turn

from lidarsim.realism import measures
from lidarsim.scan_files import read_scan
from lidarsim.scan_statistics import ScanStatistics, scan_statistics
from r3dpa.data.scans import find_scans
from r3dpa.geometry import LidarSensor, SphericalProjection, points_of, range_image

SHOTS = 2000
HEIGHT_M = 1.73
WALL_M = 28.1  # just behind a ground ring; the next beam meets it more than 0.2 m up
INCLINATION = np.radians(np.linspace(2.0, -24.8, 64))
ON_WALL = HEIGHT_M / np.tan(-INCLINATION.clip(max=-1e-3)) > WALL_M


def road_and_wall() -> np.ndarray:
    """Ranges (64, SHOTS) of a level road and a wall 28.1 m around the sensor."""
    to_road = HEIGHT_M / np.sin(-INCLINATION.clip(max=-1e-3))
    range_m = np.where(ON_WALL, WALL_M / np.cos(INCLINATION), to_road)
    return np.repeat(range_m[:, None], SHOTS, axis=1)


def scan_of(range_m: np.ndarray, intensity: float = 0.5) -> np.ndarray:
    """Points ring after ring; shots of range 0 have no return."""
    azimuth = (np.arange(SHOTS) + 0.5) * 2 * np.pi / SHOTS
    level = np.cos(INCLINATION)[:, None]
    up = np.broadcast_to(np.sin(INCLINATION)[:, None], range_m.shape)
    direction = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], axis=-1)
    points = (range_m[..., None] * direction)[range_m > 0]
    return np.column_stack([points, np.full(len(points), intensity)]).astype(np.float32)


def statistics_of(range_m: np.ndarray, intensity: float = 0.5) -> ScanStatistics:
    return scan_statistics(scan_of(range_m, intensity))


def feature(name: str, statistics: ScanStatistics) -> np.ndarray:
    return measures(statistics)[name].values


def value(name: str, statistics: ScanStatistics) -> float:
    return measures(statistics)[name].summary


def same(a: ScanStatistics, b: ScanStatistics) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))


@pytest.fixture(scope="module")
def whole() -> ScanStatistics:
    return statistics_of(road_and_wall())


def test_a_whole_scan_has_no_dropout(whole):
    assert whole.num_beam_scans == whole.num_ground_scans == 1
    assert whole.shots == pytest.approx(SHOTS)
    assert feature("dropout by beam", whole) == pytest.approx(0, abs=1e-4)
    assert whole.drop_runs.sum() == 0
    assert whole.num_returns == 64 * SHOTS


def test_fewer_rings_are_no_beams():
    range_m = road_and_wall()
    range_m[::2] = 0
    statistics = statistics_of(range_m)
    assert (statistics.num_ring_scans, statistics.num_beam_scans) == (1, 0)
    assert statistics.beam_returns.sum() == 0


def test_a_tenth_dropped_at_random_keeps_nine_tenths():
    generator = np.random.default_rng(0)
    range_m = road_and_wall()
    range_m[generator.random(range_m.shape) < 0.1] = 0
    statistics = statistics_of(range_m)
    dropout = feature("dropout by beam", statistics)
    assert dropout == pytest.approx(0.1, abs=0.03)  # 4 sd of 2000 shots
    keep_rates = [m for m in measures(statistics).values() if m.name.startswith("keep rate")]
    assert len(keep_rates) == 5
    for measure in keep_rates:
        assert measure.summary == pytest.approx(0.9, abs=0.006)
    # Runs of independent losses are geometric: 0.9 of them are of a single shot.
    assert statistics.drop_runs[1] / statistics.drop_runs.sum() == pytest.approx(0.9, abs=0.01)


def test_half_steps_of_the_encoder_are_no_lost_shots():
    """The real HDL-64E gives steps of 0.18 degrees and now and then one of 0.09."""
    steps = np.tile([2.0, 2.0, 2.0, 2.0, 1.0], SHOTS // 5)
    azimuth = 2 * np.pi * steps.cumsum() / steps.sum()
    azimuth -= azimuth[0] / 2
    ring = np.stack([10 * np.cos(azimuth), 10 * np.sin(azimuth)], axis=1)
    z = 10 * np.tan(INCLINATION)
    points = np.concatenate([np.column_stack([ring, np.full(SHOTS, height)]) for height in z])
    statistics = scan_statistics(np.pad(points, ((0, 0), (0, 1))).astype(np.float32))
    assert statistics.shots == pytest.approx(SHOTS, rel=1e-3)
    assert statistics.drop_runs.sum() == 0


def test_a_lost_sector_is_one_run_per_ring():
    range_m = road_and_wall()
    range_m[:, 100:110] = 0
    statistics = statistics_of(range_m)
    assert statistics.drop_runs.nonzero()[0].tolist() == [10]
    assert statistics.drop_runs[10] == 64
    assert feature("dropout by beam", statistics) == pytest.approx(10 / SHOTS, abs=1e-4)


def test_range_noise_is_measured_on_road_and_wall():
    noise = np.random.default_rng(1).normal(0, 0.02, (64, SHOTS))
    statistics = statistics_of(road_and_wall() + noise)
    measured = feature("range residual sd by beam", statistics)
    # The outer beams have no upright places (no beam beyond), but the last one has ground.
    assert np.isfinite(measured[1:]).all()
    assert measured[1:] == pytest.approx(20, rel=0.15)  # 4 standard errors of a beam
    assert np.nanmean(measured) == pytest.approx(20, rel=0.02)


def test_bias_of_one_beam_shows_against_its_neighbours():
    range_m = road_and_wall()
    range_m[3] += 0.03
    bias_mm = feature("range bias by beam", statistics_of(range_m))
    assert bias_mm[2:5] == pytest.approx([-15, 30, -15], abs=1)


def test_ground_plane_residual_is_the_roughness_of_the_road():
    points = scan_of(road_and_wall())
    generator = np.random.default_rng(2)
    slope = 0.02 * points[:, 0]
    points[:, 2] += slope + generator.normal(0, 0.03, len(points))
    statistics = scan_statistics(points)
    assert value("ground plane residual", statistics) == pytest.approx(30, rel=0.03)


def test_ground_rings_lie_where_the_beams_meet_the_road(whole):
    distance = HEIGHT_M / np.tan(-INCLINATION[~ON_WALL])
    measured = whole.ground_distance_m / whole.ground_returns.clip(1)
    on_road = np.flatnonzero(~ON_WALL)
    assert measured[on_road] == pytest.approx(distance, abs=1e-3)
    assert value("last ground ring", whole) == pytest.approx(distance[0], abs=0.5)
    spacing = feature("ground ring spacing", whole)
    near = distance[:-1] < 25
    assert spacing[on_road[:-1][near]] == pytest.approx(-np.diff(distance)[near], abs=1e-3)


def test_last_ring_needs_a_tenth_of_the_azimuth():
    last = np.flatnonzero(~ON_WALL)[0]
    distance = HEIGHT_M / np.tan(-INCLINATION[last : last + 2])
    for share, expected in ((0.2, distance[0]), (0.05, distance[1])):
        range_m = road_and_wall()
        range_m[last, round(share * SHOTS) :] = 0
        assert value("last ground ring", statistics_of(range_m)) == pytest.approx(expected, abs=0.5)


def test_incidence_on_a_wall_is_the_inclination_and_on_the_road_its_complement(whole):
    ground, upright = whole.keep_by_incidence[..., 1]
    assert upright[0] > 0
    assert upright[1:].sum() == 0  # all wall beams are within 4 degrees of the horizon
    angles = 90 - np.degrees(-INCLINATION[~ON_WALL])
    assert ground.nonzero()[0].tolist() == sorted({int(angle // 5) for angle in angles})


def test_mixed_pixels_lie_between_two_surfaces():
    range_m = np.full((64, SHOTS), 10.0)
    range_m[:, SHOTS // 2 :] = 14.0
    range_m[:, SHOTS // 2] = 12.0  # off both sides
    statistics = statistics_of(range_m)
    assert value("mixed pixels", statistics) == pytest.approx(1 / SHOTS)
    assert value("jumps > 0.5 m to the next", statistics) == pytest.approx(3 / SHOTS)


def test_intensity_by_range_and_incidence():
    statistics = statistics_of(road_and_wall(), intensity=0.37)
    medians = feature("median intensity by range", statistics)
    assert np.nanmax(np.abs(medians - 0.37)) < 0.006  # a step of 0.01 counts as an interval
    assert statistics.intensity_by_incidence.sum(axis=(0, 1)).nonzero()[0].tolist() == [37]
    assert value("saturated share", statistics) == 0
    assert value("saturated share", statistics_of(road_and_wall(), intensity=0.99)) == 1


def test_dummies_and_far_points_are_no_returns(whole):
    more = np.array([[100, 0, 0, 0.5], [0, 0, 0, 0]], dtype=np.float32)
    points = np.concatenate([scan_of(road_and_wall()), more])
    assert same(scan_statistics(points), whole)


def test_pooling_adds_what_scans_contribute(whole):
    near, far = whole, statistics_of(2 * road_and_wall())
    assert same(near + ScanStatistics(), near)
    both = near + far
    assert both.num_scans == 2
    means = [value("range W1", s) for s in (near, far, both)]
    assert means[2] == pytest.approx((means[0] + means[1]) / 2)


def test_counts_by_cell_and_sector(whole):
    cells = np.unique(np.floor(scan_of(road_and_wall())[:, :2]), axis=0)
    shares = feature("occupied cells by sector", whole)
    assert shares.mean() == pytest.approx(len(cells) / (math.pi * 50**2))
    assert shares.reshape(4, 4) == pytest.approx(np.tile(shares[:4], (4, 1)))  # quarter turns
    assert whole.bev_counts.sum() == whole.num_returns
    # The wall is hit up to 2 degrees above the sensor.
    top = whole.height_counts.nonzero()[0][-1] * 0.05 - 3
    assert top == pytest.approx(WALL_M * math.tan(math.radians(2)), abs=0.05)


def test_a_generated_scene_gives_all_but_the_rings():
    projection = SphericalProjection(LidarSensor())
    points = torch.from_numpy(scan_of(road_and_wall())[:, :3])
    scene = points_of(range_image(points, projection)[0], projection).numpy()
    statistics = scan_statistics(np.pad(scene, ((0, 0), (0, 1))))
    assert statistics.num_ring_scans == statistics.num_intensity_scans == 0
    assert statistics.num_ground_scans == 1
    assert statistics.num_returns == len(scene)


@pytest.mark.parametrize("num_points", [0, 1, 3])
def test_hardly_any_point(num_points):
    statistics = scan_statistics(np.tile(np.float32([10, 1, 0, 0.1]), (num_points, 1)))
    assert statistics.num_returns == num_points
    assert statistics.num_ground_scans == 0


def test_points_without_intensity_are_refused():
    with pytest.raises(ValueError, match=r"\(P, 4\).*\(5, 3\)"):
        scan_statistics(np.zeros((5, 3), np.float32))


def test_one_odd_intensity_is_cut_and_many_are_refused():
    points = np.column_stack([organised_turn().reshape(-1, 3), np.full(4000, 0.5, np.float32)])
    points[5, 3] = 1.01  # a file may hold one of 1000 such values
    assert scan_statistics(points).num_intensity_scans == 1
    points[:9, 3] = 181
    with pytest.raises(ValueError, match=r"in \[0, 1\], got 0\.5 to 181; divide by"):
        scan_statistics(points)


@pytest.mark.data
def test_real_scans_show_the_known_sensor(real_scans_dir):
    scans = find_scans(real_scans_dir)[::10]
    total = sum((scan_statistics(read_scan(scan.path)) for scan in scans), ScanStatistics())
    assert total.num_beam_scans == total.num_ground_scans == len(scans)
    assert 2100 < total.shots / len(scans) < 2200
    # Datasheet: accuracy better than 2 cm.
    assert 5 < value("range residual sd by beam", total) < 20

import dataclasses

import numpy as np
import pytest
import yaml

from lidarsim import Lasers, Scene, hdl64e, load_sensor, simulate_scan


def test_two_blocks_with_the_beams_of_kitti():
    lasers = hdl64e().lasers
    degrees = np.degrees(lasers.inclination_rad)
    np.testing.assert_allclose(degrees[[0, 31, 32, 63]], [1.94, -8.71, -9.03, -25.0], atol=0.005)
    steps = -np.diff(degrees)
    assert (steps > 0).all()
    # Standard deviation of 31 normal draws: within 3 standard errors (13 % each).
    for block, mean, deviation in ((steps[:31], 0.3435, 0.045), (steps[32:], 0.5152, 0.070)):
        assert block.mean() == pytest.approx(mean, abs=5e-4)
        assert block.std() == pytest.approx(deviation, rel=0.4)
    upper, lower = lasers.height_m[:32], lasers.height_m[32:]
    assert (min(upper), max(upper), min(lower), max(lower)) == (0.198, 0.209, 0.116, 0.126)
    assert set(np.abs(lasers.lateral_m)) == {0.026}
    assert lasers.lateral_m[0] < 0 < lasers.lateral_m[1]
    offset = np.degrees(lasers.azimuth_offset_rad)
    assert (offset.min() >= -8.5) & (offset.max() <= 9.9)
    assert len(np.unique(np.round(offset / 6.1))) == 4


def test_rays_are_unit_start_at_their_laser_and_step_around():
    sensor = hdl64e(shots=100)
    origin, direction = sensor.rays
    assert origin.shape == direction.shape == (3, 64, 100)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=0), 1, atol=1e-6)
    np.testing.assert_allclose(np.hypot(origin[0], origin[1]), 0.026, atol=1e-6)
    inclination = np.arcsin(direction[2])
    expected = np.broadcast_to(np.array(sensor.lasers.inclination_rad)[:, None], (64, 100))
    np.testing.assert_allclose(inclination, expected, atol=1e-6)
    # The optical centre lies sideways of the beam, not along it.
    across = origin[0] * direction[0] + origin[1] * direction[1]
    np.testing.assert_allclose(across, 0, atol=1e-7)
    azimuth = np.unwrap(np.arctan2(direction[1], direction[0]), axis=1)
    np.testing.assert_allclose(np.diff(azimuth, axis=1), np.radians(3.6), atol=2e-6)
    assert (azimuth[:, 0] >= 0).all()
    assert (azimuth[:, 0] < np.radians(3.6) + 1e-6).all()


def test_shots_are_fired_as_the_head_turns():
    """Lasers that share a heading of the head fire together, whatever their azimuth offset."""
    sensor = hdl64e()
    time_s = sensor.time_s
    assert time_s.shape == (64, 2083)
    step_s = 0.1 / 2083
    assert -0.05 <= time_s.min() < -0.05 + step_s
    assert 0.05 - step_s < time_s.max() <= 0.05
    _, direction = sensor.rays
    azimuth = np.arctan2(direction[1], direction[0])
    head = azimuth - np.array(sensor.lasers.azimuth_offset_rad)[:, None]
    head = (head + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(time_s, head / (2 * np.pi) * 0.1, atol=1e-7)


def test_presets_have_the_beams_of_their_datasheets():
    for sensor, num, top, bottom in (
        (load_sensor("hdl32e"), 32, 10.67, -30.67),
        (load_sensor("vls128"), 128, 15, -25),
    ):
        degrees = np.degrees(sensor.lasers.inclination_rad)
        assert len(degrees) == sensor.num_beams == num
        np.testing.assert_allclose(degrees[[0, -1]], [top, bottom])
        scan = simulate_scan(Scene(), dataclasses.replace(sensor, shots=32), (0,))
        assert len(scan.points) > 100
    around_horizon = np.abs(degrees) < 4.5
    np.testing.assert_allclose(np.diff(degrees[around_horizon]), -0.11, atol=1e-6)
    assert load_sensor("vls128", shots=64) == dataclasses.replace(load_sensor("vls128"), shots=64)


def calibration(*vertical):
    fixed = {"vert_offset_correction": 0.2, "horiz_offset_correction": -0.026}
    lasers = [
        {"laser_id": number, "vert_correction": up, "rot_correction": 0.01 * number} | fixed
        for number, up in enumerate(vertical)
    ]
    return yaml.safe_dump({"distance_resolution": 0.002, "num_lasers": 3, "lasers": lasers})


def test_a_calibration_file_replaces_the_beam_table(tmp_path):
    path = tmp_path / "unit.yaml"
    path.write_text(calibration(-0.3, 0.03, -0.1))
    sensor = load_sensor(str(path), shots=100)
    assert sensor.lasers.inclination_rad == (0.03, -0.1, -0.3)
    assert sensor.lasers.azimuth_offset_rad == (0.01, 0.02, 0.0)
    height_m = 0.2 / np.cos([0.03, -0.1, -0.3])  # in the file, across the beam
    assert sensor.lasers.height_m == pytest.approx(height_m)
    assert sensor.lasers.lateral_m == (-0.026, -0.026, -0.026)
    assert sensor.rays.origin.shape == (3, 3, 100)


def test_bad_calibrations_are_named(tmp_path):
    path = tmp_path / "unit.yaml"
    for content in ("lasers: 3", "{", "lasers: [{rot_correction: 1}]"):
        path.write_text(content)
        with pytest.raises(ValueError, match=r"unit\.yaml"):
            load_sensor(str(path))
    path.write_text(calibration(0.1, 0.1, 0.1))
    with pytest.raises(ValueError, match=r"unit\.yaml: inclination_rad of the lasers must fall"):
        load_sensor(str(path))
    with pytest.raises(
        ValueError, match=r"unknown sensor 'hdl65e' \(did you mean 'hdl64e'\?\); choose"
    ):
        load_sensor("hdl65e")


def test_impossible_sensors_are_refused():
    sensor = hdl64e()
    wrong = {"shots": 7, "mount_height_m": 0.0, "min_power": float("nan"), "divergence_rad": -1.0}
    for name, value in (wrong | {"return_mode": "last", "max_range_m": 1.0}).items():
        with pytest.raises(ValueError, match=name):
            dataclasses.replace(sensor, **{name: value})
    with pytest.raises(ValueError, match="columns of one length"):
        Lasers((0.1,), (0.0, 0.0), (0.0,), (0.0,), (0.0,), (1.0,))
    with pytest.raises(ValueError, match="intensity_gain"):
        dataclasses.replace(sensor.lasers, intensity_gain=(0.0,) * 64)

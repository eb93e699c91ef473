"""Sensors estimated from scans, against presets, factory angles and real scans."""

from pathlib import Path

import numpy as np
import pytest
from sweeps import organised_turn

from lidarsim import Simulator, load_sensor
from lidarsim.clouds import PointCloud
from lidarsim.sensors import estimate
from lidarsim.sensors.beams import fit_beams

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
SENSORS = SHARED / "other_sensors"
KITTI = SHARED / "real_scans" / "kitti_object_vis" / "velodyne"


def real(path):
    marks = [pytest.mark.data, pytest.mark.skipif(not path.exists(), reason=f"no {path}")]
    return pytest.param(path, marks=marks, id=path.stem)


def scans_of(name, num, **changes):
    simulator = Simulator(3, sensor=load_sensor(name, **changes))
    return [simulator.scan(7 * number).points for number in range(num)]


@pytest.fixture(scope="module")
def vlp16_scans():
    return scans_of("vlp16", 3)


def largest_difference_deg(estimated, columns):
    lasers = estimated.sensor.lasers
    return np.degrees(np.abs(np.subtract(getattr(lasers, columns[0]), columns[1])).max())


@pytest.mark.parametrize(("name", "shots"), [("hdl64e", 1000), ("hdl32e", 1085), ("os1_128", 512)])
def test_a_few_scans_of_a_preset_give_the_preset(name, shots):
    """Those of most points with half their columns."""
    truth = load_sensor(name, shots=shots)
    estimated = estimate(scans_of(name, 4, shots=shots))
    sensor, lasers = estimated.sensor, truth.lasers
    assert sensor.shots == truth.shots
    assert sensor.num_beams == truth.num_beams
    assert largest_difference_deg(estimated, ("inclination_rad", lasers.inclination_rad)) < 0.02
    np.testing.assert_allclose(sensor.lasers.height_m, lasers.height_m, atol=2e-3)
    np.testing.assert_allclose(sensor.lasers.lateral_m, lasers.lateral_m, atol=1e-3)
    # Without organised arrays, the offset is known but for whole columns.
    step = 2 * np.pi / truth.shots
    offset = np.subtract(sensor.lasers.azimuth_offset_rad, lasers.azimuth_offset_rad)
    assert np.degrees(np.abs((offset + step / 2) % step - step / 2).max()) < 0.02
    assert estimated.mount.height_m == pytest.approx(truth.mount_height_m, abs=0.05)
    assert min(estimated.confidence.values()) > 0.5
    assert estimated.blind_sectors_deg == ()
    assert estimated.full_intensity == 1


def test_a_ring_column_serves_shuffled_points_numbered_from_below(vlp16_scans):
    generator = np.random.default_rng(0)
    truth = load_sensor("vlp16")
    clouds = []
    for rows in vlp16_scans:
        degrees = np.degrees(np.arctan2(rows[:, 2], np.hypot(rows[:, 0], rows[:, 1])))
        ring = np.rint((degrees + 15) / 2).astype(np.uint16)
        order = generator.permutation(len(rows))
        clouds.append(PointCloud.of(rows[order], ring=ring[order]))
    estimated = estimate(clouds)
    assert estimated.beams_by == "a stored ring"
    assert estimated.sensor.shots == truth.shots
    inclination_rad = truth.lasers.inclination_rad
    assert largest_difference_deg(estimated, ("inclination_rad", inclination_rad)) < 0.02


def test_scans_that_lack_beams_are_combined_by_inclination(vlp16_scans):
    rows = vlp16_scans[0]
    degrees = np.degrees(np.arctan2(rows[:, 2], np.hypot(rows[:, 0], rows[:, 1])))
    lacking = rows[np.abs(degrees - 5) > 0.5]
    estimated = estimate([lacking, *vlp16_scans[1:]])
    assert estimated.sensor.num_beams == 16
    inclination_rad = load_sensor("vlp16").lasers.inclination_rad
    assert largest_difference_deg(estimated, ("inclination_rad", inclination_rad)) < 0.02
    assert "1 of 3 scans show fewer than 16 beams" in estimated.notes


def test_shuffled_points_without_ring_show_their_beams(vlp16_scans):
    generator = np.random.default_rng(0)
    estimated = estimate([generator.permutation(rows) for rows in vlp16_scans])
    truth = load_sensor("vlp16")
    assert estimated.beams_by == "the inclination"
    assert estimated.sensor.shots == truth.shots
    inclination_rad = truth.lasers.inclination_rad
    assert largest_difference_deg(estimated, ("inclination_rad", inclination_rad)) < 0.02


def test_noise_and_drops_are_withstood(vlp16_scans):
    """Five centimetres of noise along the ray, 2 mm along each axis, a third of the points lost."""
    generator = np.random.default_rng(1)
    truth = load_sensor("vlp16")
    noisy = []
    for rows in vlp16_scans:
        left = rows[generator.random(len(rows)) > 1 / 3].copy()
        range_m = np.linalg.norm(left[:, :3], axis=1)
        left[:, :3] *= (1 + generator.normal(0, 0.05, len(left)) / range_m)[:, None]
        left[:, :3] += generator.normal(0, 0.002, (len(left), 3))
        noisy.append(left)
    estimated = estimate(noisy)
    assert estimated.sensor.shots == truth.shots
    inclination_rad = truth.lasers.inclination_rad
    assert largest_difference_deg(estimated, ("inclination_rad", inclination_rad)) < 0.02
    assert estimated.dropped_share == pytest.approx(1 / 3, abs=0.05)


@pytest.mark.parametrize("name", [None, "scan.npy", "scan.npz"])
def test_organised_arrays_give_offsets_from_the_column_and_the_direction(name, tmp_path):
    columns, distance_m = 360, 20.0
    inclination = np.radians([4.0, 1.0, -3.0, -6.0])
    offset = np.radians([-5.0, 5.0, -2.0, 2.0])
    azimuth = offset[:, None] - 2 * np.pi * np.arange(columns) / columns
    away = distance_m + 3 * np.cos(5 * azimuth)
    xyz = np.stack(
        [away * np.cos(azimuth), away * np.sin(azimuth), away * np.tan(inclination)[:, None]], -1
    )
    xyz[1, 10:20] = 0
    scan = xyz if name is None else tmp_path / name
    if name == "scan.npy":
        np.save(scan, xyz)
    elif name == "scan.npz":
        np.savez(scan, cloud=xyz)
    estimated = estimate([scan])
    assert estimated.direction == "clockwise"
    assert estimated.sensor.shots == columns
    lasers = estimated.sensor.lasers
    np.testing.assert_allclose(lasers.azimuth_offset_rad, offset, atol=1e-6)
    np.testing.assert_allclose(lasers.inclination_rad, inclination, atol=1e-6)


def test_a_saved_estimate_is_a_sensor_to_simulate(vlp16_scans, tmp_path):
    estimated = estimate(vlp16_scans)
    estimated.save(tmp_path / "mine.yaml")
    loaded = load_sensor(tmp_path / "mine.yaml")
    np.testing.assert_allclose(
        loaded.lasers.inclination_rad, estimated.sensor.lasers.inclination_rad, atol=1e-7
    )
    assert loaded.shots == estimated.sensor.shots
    assert loaded.mount_height_m == estimated.sensor.mount_height_m


def test_what_is_odd_about_scans_is_said(vlp16_scans):
    rows = vlp16_scans[0]
    sector = rows[np.abs(np.arctan2(rows[:, 1], rows[:, 0])) < 1]
    cut = estimate([sector])
    assert cut.sensor.shots == load_sensor("vlp16").shots
    assert any("of 360 degrees" in note for note in cut.notes)
    assert cut.blind_sectors_deg

    twice = np.repeat(rows, 2, axis=0)
    twice[1::2, :3] *= 1.05
    dual = estimate([twice])
    assert dual.sensor.return_mode == "dual"
    assert any("second returns" in note for note in dual.notes)

    vehicle = rows.copy()
    vehicle[:, 2] += 1.73
    shifted = estimate([vehicle])
    assert any("frame of a vehicle" in note for note in shifted.notes)
    assert shifted.mount.height_m == pytest.approx(1.73, abs=0.05)


def test_scans_compensated_for_motion_are_said_to_be(vlp16_scans):
    rows = vlp16_scans[0].copy()
    turn = np.arctan2(rows[:, 1], rows[:, 0]) / (2 * np.pi)
    rows[:, 0] += turn  # 10 m/s
    rows[:, 2] += 0.1 * turn
    smeared = estimate([rows])
    assert smeared.sensor.num_beams == 16
    assert any("as in scans compensated for motion" in note for note in smeared.notes)


def test_unknown_fields_of_packed_rows_do_no_harm(vlp16_scans, tmp_path):
    names = ["x", "y", "z", "_", "intensity", "echo", "near_ir"]
    packed = np.zeros(
        len(vlp16_scans[0]),
        np.dtype({"names": names, "formats": ["<f4"] * 4 + ["<u2", "u1", "<u2"]}),
    )
    for name, column in zip("xyz", vlp16_scans[0].T[:3], strict=True):
        packed[name] = column
    np.save(tmp_path / "packed.npy", packed)
    assert estimate(tmp_path / "packed.npy").sensor.num_beams == 16


def test_shots_without_a_return_at_the_origin_are_left_out(vlp16_scans, tmp_path):
    scans = []
    for number, rows in enumerate(vlp16_scans):
        is_lost = np.random.default_rng(number).random(len(rows)) < 0.2
        scans.append(rows * ~is_lost[:, None])
        np.save(tmp_path / f"{number}.npy", scans[-1])
    for source in (scans, tmp_path):
        estimated = estimate(source)
        assert (estimated.sensor.num_beams, estimated.beams_by) == (16, "the order")
        assert estimated.sensor.shots == load_sensor("vlp16").shots
        assert estimated.sensor.min_range_m > 0.1


def test_range_limits_are_measured_from_the_sensor():
    """Not from the origin of a vehicle, 2 m below it."""
    turn = organised_turn()
    one, above = (estimate([points]).sensor for points in (turn, turn + np.float32([0, 0, 2])))
    limits = [(sensor.min_range_m, sensor.max_range_m) for sensor in (one, above)]
    assert limits[0] == pytest.approx(limits[1], abs=0.1)


def test_columns_of_scans_are_as_many():
    with pytest.raises(ValueError, match="the scans have 250 and 500 columns: give scans of one"):
        estimate([organised_turn(), organised_turn()[:, ::2]])


def test_one_odd_intensity_does_not_change_the_full_scale():
    points = np.column_stack([organised_turn().reshape(-1, 3), np.full(4000, 0.5, np.float32)])
    points[5, 3] = 1.01
    assert estimate([PointCloud.of(points)]).full_intensity == 1


def test_scans_that_show_no_spinning_sensor_are_refused(vlp16_scans):
    rows, generator = vlp16_scans[0], np.random.default_rng(2)
    with pytest.raises(ValueError, match="10 of at least 16 points"):
        estimate([rows[:10]])
    with pytest.raises(ValueError, match="all of its 100 points are 0"):
        estimate([np.zeros((100, 4), np.float32)])
    with pytest.raises(ValueError, match="no metres: divide"):
        estimate([rows * np.float32([1000, 1000, 1000, 1])])
    with pytest.raises(ValueError, match=r"shows 32 beams, .* 16: give scans of one sensor"):
        estimate([*vlp16_scans, scans_of("hdl32e", 1)[0]])
    down = rows * np.float32([1, -1, -1, 1])
    with pytest.raises(ValueError, match="above the sensor: turn the points so that z points up"):
        estimate([down])
    camera = np.stack([-rows[:, 1], -rows[:, 2], rows[:, 0], rows[:, 3]], axis=1)
    with pytest.raises(ValueError, match="flattest along y: turn the points so that z points up"):
        estimate([camera])
    # Directions anywhere in a cone, as of a non-repetitive scanner.
    spread = generator.uniform(-0.5, 0.5, (20000, 2))
    away = generator.uniform(3, 40, 20000)
    cone = np.stack([away, away * spread[:, 0], away * spread[:, 1]], axis=1)
    with pytest.raises(ValueError, match=r"solid-state or non-repetitive.*r3dpa data weather"):
        estimate([cone])


def test_a_beam_that_sees_one_distance_has_the_centre_of_the_others():
    generator = np.random.default_rng(0)
    beam = np.repeat(np.arange(3), 200)
    distance_m = generator.uniform(4, 40, 600)
    distance_m[beam == 1] = 20
    z_m = 0.2 + np.tan([0.05, 0.0, -0.05])[beam] * distance_m
    fit = fit_beams(beam, distance_m, z_m)
    np.testing.assert_allclose(fit.height_m, 0.2, atol=1e-9)
    np.testing.assert_allclose(fit.inclination, [0.05, 0.0, -0.05], atol=1e-9)
    assert fit.is_sure_height.tolist() == [True, False, True]


@pytest.mark.parametrize(
    "path", [real(SENSORS / "hdl32e"), real(SENSORS / "nuscenes/scan.pcd.bin")]
)
def test_real_hdl32e(path):
    if path.is_dir():
        pytest.importorskip("pypcd4")
    estimated = estimate(path)
    degrees = np.degrees(estimated.sensor.lasers.inclination_rad)
    np.testing.assert_allclose(degrees, np.linspace(10.67, -30.67, 32), atol=0.01)
    # 46.08 us between firings: 1085 columns at 20 turns a second. The scans of the folder are 400
    # degrees long, with a step of 0.18 degrees.
    nominal = 2000 if path.is_dir() else 1085
    assert estimated.sensor.shots == pytest.approx(nominal, rel=0.005)
    assert any("400 degrees long" in note for note in estimated.notes) == path.is_dir()
    assert estimated.direction == "clockwise"


@pytest.mark.parametrize(
    "path", [real(SENSORS / f"ouster/{n}_0.npz") for n in ("os1_128", "os2_128", "os1_32")]
)
def test_real_ouster_against_the_angles_of_the_factory(path):
    estimated = estimate([path])
    lasers = estimated.sensor.lasers
    with np.load(path) as arrays:
        altitude_deg, azimuth_deg = arrays["beam_altitude_deg"], arrays["beam_azimuth_deg"]
    assert estimated.sensor.shots == 1024
    assert estimated.direction == "clockwise"
    np.testing.assert_allclose(np.degrees(lasers.inclination_rad), altitude_deg, atol=1e-4)
    # The factory counts azimuths clockwise; the mean of the estimated ones is zero.
    offset = np.degrees(lasers.azimuth_offset_rad) + azimuth_deg
    np.testing.assert_allclose(offset, offset.mean(), atol=1e-3)


@pytest.mark.parametrize("path", [real(KITTI)])
def test_real_hdl64e_has_the_optical_centres_of_the_preset(path):
    estimated = estimate(path)
    lasers, preset = estimated.sensor.lasers, load_sensor("hdl64e").lasers
    np.testing.assert_allclose(lasers.height_m, preset.height_m, atol=2e-3)
    assert np.degrees(lasers.inclination_rad[0]) == pytest.approx(1.94, abs=0.02)
    assert np.degrees(lasers.inclination_rad[-1]) == pytest.approx(-25.0, abs=0.02)

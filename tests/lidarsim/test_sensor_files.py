"""Presets, and sensors in YAML files."""

import dataclasses
import hashlib
from importlib.resources import files

import numpy as np
import pytest
import yaml

from lidarsim import LidarSensor, Simulator, load_sensor
from lidarsim.sensors import PRESETS, SensorFile, read_sensor, write_sensor

# Of the laser tables as they were computed before they became files.
DIGESTS = {"hdl32e": "c0134b0844499427", "vls128": "447e61c6918173c5"}


def digest_of(sensor):
    return hashlib.sha256(repr(dataclasses.astuple(sensor.lasers)).encode()).hexdigest()[:16]


@pytest.mark.parametrize("name", DIGESTS)
def test_sensors_that_were_computed_have_not_changed(name):
    assert digest_of(load_sensor(name)) == DIGESTS[name]


@pytest.mark.parametrize("name", PRESETS)
def test_presets_name_their_source_and_can_be_simulated(name):
    title, source, sensor = read_sensor(name)
    assert title
    assert len(source) > 20
    few = dataclasses.replace(sensor, shots=32)
    assert Simulator(1, sensor=few).scan(0).points.shape[1] == 4


def test_files_of_other_licences_keep_their_notice():
    for name, holder in (("pandar64", "NVIDIA"), ("waymo_top", "NVIDIA"), ("os1_128", "Ouster")):
        file = files("lidarsim.sensors") / "presets" / f"{name}.yaml"
        first = file.read_text().splitlines()[0]
        assert first.startswith("# Copyright (c)")
        assert holder in first


def test_a_sensor_that_does_not_turn_is_refused_with_the_reason():
    with pytest.raises(ValueError, match="120 degrees and does not turn"):
        load_sensor("at128")


def test_a_written_sensor_is_read_again(tmp_path):
    sensor = load_sensor("os1_32", shots=512, mount_height_m=2.1)
    write_sensor(tmp_path / "mine.yaml", SensorFile("mine", "a test", sensor), {"scans": 3})
    name, source, read = read_sensor(tmp_path / "mine.yaml")
    assert (name, source) == ("mine", "a test")
    assert read == sensor
    assert Simulator(sensor=str(tmp_path / "mine.yaml")).sensor == sensor


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lasers": {"inclination_deg": [1, 0], "hight_m": [0, 0]}}, "unknown column 'hight_m'"),
        ({"sensor": {"shot": 3}}, "unknown setting 'shot'"),
        ({"beams": 3}, "unknown section 'beams'"),
        ({"lasers": {"height_m": [0, 0]}}, "inclination_rad"),
        ({"lasers": {"inclination_deg": [0, 1]}}, "must fall from beam to beam"),
        ({"sensor": {"shots": 3}}, "shots must be at least 8"),
        ({"sensor": {"shots": 1800.5}}, "shots must be a whole number"),
        ({"sensor": {"min_range_m": "near"}}, "could not convert"),
    ],
)
def test_wrong_files_say_what_is_wrong(tmp_path, change, message):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({"lasers": {"inclination_deg": [1.0, 0.0]}} | change))
    with pytest.raises(ValueError, match=rf"mine\.yaml: .*{message}"):
        load_sensor(path)


def test_heights_of_velodyne_pointcloud_are_measured_across_the_beam(tmp_path):
    """There a point is at ``d cos v - offset sin v`` and ``d sin v + offset cos v``."""
    laser = {"vert_correction": -0.42, "vert_offset_correction": 0.15}
    (tmp_path / "a.yaml").write_text(yaml.safe_dump({"lasers": [laser]}))
    distance_m = 0.15 * np.tan(-0.42)  # on the axis
    height_m = distance_m * np.sin(-0.42) + 0.15 * np.cos(-0.42)
    assert load_sensor(tmp_path / "a.yaml").lasers.height_m[0] == pytest.approx(height_m)


def test_the_range_image_of_a_preset_has_a_row_for_each_beam():
    view = LidarSensor.of("vlp32c", columns=1024)
    assert (view.beams, view.columns) == (32, 1024)
    degrees = np.degrees(load_sensor("vlp32c").lasers.inclination_rad)
    assert view.inclination_min_deg < degrees[-1] < degrees[0] < view.inclination_max_deg
    assert (view.range_min_m, view.range_max_m) == (1.0, 200.0)

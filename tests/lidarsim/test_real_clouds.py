"""Readers on files of real sensors, which are not part of the repository."""

from pathlib import Path

import numpy as np
import pytest

from lidarsim.clouds import WRITERS, packed, read_cloud, write_cloud
from lidarsim.rings import rings_of
from lidarsim.scan_files import read_scan
from lidarsim.survey import describe_scan
from lidarsim.weather import Weather, recorded_scan
from r3dpa.data import find_scans

SENSORS = Path(__file__).resolve().parents[3] / "shared" / "data" / "other_sensors"
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not SENSORS.is_dir(), reason=f"no scans of other sensors in {SENSORS}"),
]
# Beams and columns of each file.
FILES = {
    "hdl32e/1.pcd": (32, []),
    "nuscenes/scan.pcd.bin": (32, []),
    "ouster/os1_32_0.npz": (32, ["range_mm", "signal"]),
    "ouster/os1_128_0.npz": (128, ["range_mm", "signal"]),
    "ouster/os2_128_0.npz": (128, ["range_mm", "signal"]),
}


@pytest.fixture(params=FILES)
def path(request):
    return SENSORS / request.param


def test_points_intensities_and_beams(path):
    name = path.relative_to(SENSORS).as_posix()
    if path.suffix == ".pcd":
        pytest.importorskip("pypcd4")
    beams, further = FILES[name]
    cloud = read_cloud(path)
    cloud.check_metres()
    assert list(cloud.columns) == further
    assert rings_of(recorded_scan(cloud)).num_rings == beams
    assert "note:" not in describe_scan(cloud)
    points = read_scan(path)
    np.testing.assert_array_equal(points[:, :3], cloud.points)
    assert 0.02 < points[:, 3].mean() < 0.5
    assert points[:, 3].max() <= 1


def test_organised_arrays_are_points_with_their_beam():
    path = SENSORS / "ouster/os1_32_0.npz"
    with np.load(path) as arrays:
        row, column = arrays["xyz"].any(axis=2).nonzero()
        cloud = read_cloud(path)
        np.testing.assert_array_equal(cloud.points, arrays["xyz"][row, column])
        np.testing.assert_array_equal(cloud.ring, row)
        np.testing.assert_array_equal(cloud.intensity, arrays["reflectivity"][row, column])
        range_mm = np.linalg.norm(cloud.points, axis=1) * 1000
        assert np.abs(cloud.columns["range_mm"] / range_mm - 1).max() < 0.02


def test_a_scan_in_fog_is_written_in_its_format(path, tmp_path):
    cloud = read_cloud(path)
    foggy = Weather(visibility_m=30).apply(cloud)
    out = tmp_path / path.name
    write_cloud(out, foggy)
    again = read_cloud(out)
    assert 0 < len(again) < len(cloud)
    assert again.table.tobytes() == foggy.table.tobytes()
    if "range_mm" in cloud.columns:
        range_mm = np.linalg.norm(again.points, axis=1) * 1000
        assert np.abs(again.columns["range_mm"] / range_mm - 1).max() < 0.02
    assert packed(path, Weather().apply(cloud)) == path.read_bytes()


@pytest.mark.parametrize("suffix", WRITERS)
def test_points_and_intensities_survive_every_format(path, tmp_path, suffix):
    if "la" in suffix:
        pytest.importorskip("laspy")
    if suffix == ".laz":
        pytest.importorskip("lazrs")
    cloud, out = read_cloud(path), tmp_path / f"a{suffix}"
    write_cloud(out, cloud)
    again = read_cloud(out)
    atol = 1e-4 if "la" in suffix else 0
    np.testing.assert_allclose(again.points, cloud.points, rtol=0, atol=atol)
    np.testing.assert_allclose(again.intensity_shares(), cloud.intensity_shares(), atol=1e-5)
    if suffix not in (".bin", ".npy"):
        np.testing.assert_array_equal(again.ring, cloud.ring)


def test_folders_of_other_formats_are_data_sets():
    assert len(find_scans(SENSORS / "hdl32e")) == 7
    assert find_scans(SENSORS / "ouster")[0].name == "ouster/os1_128_0"
    (scan,) = find_scans(SENSORS / "nuscenes")
    assert scan.path.name == "scan.pcd.bin"

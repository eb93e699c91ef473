"""One row per beam: any sensor, shuffled points, real scans where they are present."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from lidarsim import Simulator, load_sensor
from lidarsim.clouds import read_cloud
from lidarsim.sensors import estimate
from r3dpa.geometry import (
    BeamProjection,
    LidarSensor,
    RangeCodec,
    ScanGeometry,
    in_range,
    range_image,
    share_kept,
    unproject,
)

DATA = Path(__file__).parents[3] / "shared/data"


def real(pattern, *values):
    absent = pytest.mark.skipif(not list(DATA.glob(pattern)), reason=f"no {pattern}")
    return pytest.param(pattern, *values, marks=[pytest.mark.data, absent])


@pytest.fixture(scope="module", params=["hdl64e", "hdl32e", "vlp32c", "pandar64", "os1_128"])
def known(request):
    """Sensor, its projection with a column per shot, and a simulated scan in random order."""
    sensor = load_sensor(request.param)
    points = Simulator(seed=3, sensor=request.param).scan(0).points[:, :3]
    order = np.random.default_rng(0).permutation(len(points))
    return sensor, BeamProjection.of(sensor), torch.from_numpy(points[order])


def test_no_point_of_a_known_sensor_is_lost(known):
    _, projection, points = known
    assert share_kept(points, projection) == 1.0


def test_points_come_back_where_they_were(known):
    sensor, projection, points = known
    range_m, _ = range_image(points, projection)
    row, column = projection.pixel_of(points)
    back = unproject(range_m, projection)[row, column]
    inside = in_range(points, projection.sensor)
    angle = (back - points).norm(dim=1)[inside] / points.norm(dim=1)[inside]
    # A point is off its beam by noise of its range, and of the head's motion, alone.
    assert angle.quantile(0.99) < math.pi / sensor.shots
    assert (range_m[range_m > 0] > 0).all()


def test_pixels_are_those_of_the_beams():
    lidar = load_sensor("hdl64e")
    projection = BeamProjection.of(lidar)
    distance_m = 10.0 + torch.arange(64)[:, None].double() / 10
    image = distance_m.expand(64, lidar.shots)
    points = unproject(image, projection)
    torch.testing.assert_close(points.norm(dim=-1), image)
    row, column = projection.pixel_of(points.reshape(-1, 3))
    assert (row.view(64, -1) == torch.arange(64)[:, None]).all()
    assert (column.view(64, -1) == torch.arange(lidar.shots)).all()


def test_points_that_share_a_column_move_apart():
    lidar = load_sensor("vlp16", shots=360)
    projection = BeamProjection.of(lidar)
    azimuth = torch.tensor([10.4, 10.5, 10.6, 12.5, 200.5]).deg2rad()
    points = 5 * torch.stack([azimuth.cos(), azimuth.sin(), torch.zeros(5)], dim=1)
    points[:, 2] = 5 * math.tan(math.radians(1.0))
    row, column = projection.pixel_of(points)
    assert (row == row[0]).all()
    assert len(column.unique()) == 5
    plain = torch.tensor([169, 169, 169, 167, 339])
    assert (column - plain).abs().max() <= 1
    batch = torch.stack([points, points.flip(0)])
    torch.testing.assert_close(projection.pixel_of(batch)[1], torch.stack([column, column.flip(0)]))
    far = torch.cat([points, torch.full((1, 3), torch.nan)])
    torch.testing.assert_close(projection.pixel_of(far)[1][:5], column)


def test_further_rows_stay_empty_below():
    projection = BeamProjection.of("vlp16", columns=1024, rows=32)
    assert projection.sensor == LidarSensor(32, 1024, 16.0, -48.0, 0.5, 100.0)
    points = torch.from_numpy(Simulator(sensor="vlp16").scan(0).points[:, :3])
    range_m, _ = range_image(points, projection)
    assert (range_m[16:] < 0).all()
    assert BeamProjection.for_networks("vlp16") == BeamProjection.of("vlp16", 1024)


def test_geometry_of_a_checkpoint_keeps_the_beams():
    projection = BeamProjection.of("os0_32", 1024)
    codec = RangeCodec("log2").reaching(projection.sensor.range_max_m)
    geometry = ScanGeometry(projection, codec, (8, 64))
    assert ScanGeometry.from_dict(geometry.to_dict()) == geometry


def test_codec_reaches_the_range_of_the_sensor():
    assert RangeCodec("log2").reaching(56.0) == RangeCodec("log2")
    codec = RangeCodec("log2").reaching(200.0)
    far = torch.tensor([[199.0]])
    torch.testing.assert_close(codec.to_range(codec.encode(far)), far, rtol=1e-4, atol=0)
    assert RangeCodec("linear").reaching(80.0).scale == 80.0
    assert RangeCodec("log2", scale=6.0).reaching(200.0).scale == 6.0  # as given


# Without a calibration of their own: each is estimated from the files themselves.
@pytest.mark.parametrize(
    ("pattern", "least"),
    [
        real("other_sensors/ouster/os1_128_*.npz", 1.0),
        real("other_sensors/ouster/os2_128_0.npz", 1.0),
        real("other_sensors/ouster/os1_32_0.npz", 1.0),
        real("other_sensors/nuscenes/scan.pcd.bin", 0.999),
        real("real_scans/kitti_object_vis/velodyne/*.bin", 0.9995),
    ],
)
def test_real_scans_keep_their_points(pattern, least):
    files = sorted(DATA.glob(pattern))
    projection = BeamProjection.of(estimate(files).sensor)
    for file in files:
        points = read_cloud(file, with_labels=False).points.astype(np.float32)
        assert share_kept(torch.from_numpy(points), projection) >= least


@pytest.mark.parametrize("pattern", [real("other_sensors/nuscenes/scan.pcd.bin")])
def test_rows_are_the_stored_rings(pattern):
    (file,) = DATA.glob(pattern)
    cloud = read_cloud(file, with_labels=False)
    points = torch.from_numpy(cloud.points.astype(np.float32))
    seen = points[:, :2].norm(dim=1) > 0.1
    row, _ = BeamProjection.of(estimate([file]).sensor).pixel_of(points[seen])
    assert (row.numpy() == 31 - cloud.ring[seen.numpy()]).all()

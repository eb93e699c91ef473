"""Bags written by rosbags: scans come back, and what cannot be read is named."""

from types import SimpleNamespace

import numpy as np
import pytest

from lidarsim.cloud_formats import ScanError
from lidarsim.clouds import read_cloud
from lidarsim.clouds_bag import _table_of, read_bag
from lidarsim.conversion import convert

LAYOUT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2"],
        "offsets": [0, 4, 8, 16, 20],
        "itemsize": 24,
    }
)
KINDS = {"x": 7, "y": 7, "z": 7, "intensity": 7, "ring": 4}  # numbers of the message


def scan(seed, num_points=64):
    table = np.zeros(num_points, LAYOUT)
    generator = np.random.default_rng(seed)
    for axis in "xyz":
        table[axis] = generator.uniform(2, 30, num_points)
    table["intensity"] = generator.uniform(0, 1, num_points)
    table["ring"] = np.arange(num_points) % 4
    return table


@pytest.fixture
def write_mcap(tmp_path):
    """``write_mcap({topic: [table, ...]})``: folder of a recording of these scans."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    cloud_type, field_type, header_type, time_type = (
        store.types[name]
        for name in (
            "sensor_msgs/msg/PointCloud2",
            "sensor_msgs/msg/PointField",
            "std_msgs/msg/Header",
            "builtin_interfaces/msg/Time",
        )
    )

    def message(table):
        fields = [
            field_type(name=name, offset=LAYOUT.fields[name][1], datatype=number, count=1)
            for name, number in KINDS.items()
        ]
        return cloud_type(
            header=header_type(stamp=time_type(sec=0, nanosec=0), frame_id="lidar"),
            height=1,
            width=len(table),
            fields=fields,
            is_bigendian=False,
            point_step=table.dtype.itemsize,
            row_step=table.nbytes,
            data=np.frombuffer(table.tobytes(), np.uint8),
            is_dense=False,
        )

    def write(topics):
        path = tmp_path / "drive"
        kind = rosbag2.StoragePlugin.MCAP
        with rosbag2.Writer(path, version=8, storage_plugin=kind) as writer:
            for topic, tables in topics.items():
                connection = writer.add_connection(topic, cloud_type.__msgtype__, typestore=store)
                for number, table in enumerate(tables):
                    data = store.serialize_cdr(message(table), cloud_type.__msgtype__)
                    writer.write(connection, number, data)
        return path

    return write


def test_scans_of_a_recording_become_files(write_mcap, tmp_path):
    tables = [scan(0), scan(1)]
    tables[1]["x"][5] = np.nan  # no return
    folder = write_mcap({"/points": tables})
    for number, source in enumerate((folder, *folder.glob("*.mcap"))):
        line = convert(source, tmp_path / f"scans{number}", to="npz")
        assert line.startswith("2 scans written")
        cloud = read_cloud(tmp_path / f"scans{number}" / "000001.npz")
        rest = np.delete(tables[1], 5)
        np.testing.assert_array_equal(cloud.points[:, 1], rest["y"])
        np.testing.assert_array_equal(cloud.ring, rest["ring"])
        np.testing.assert_array_equal(cloud.intensity, rest["intensity"])


def test_several_topics_are_listed(write_mcap):
    folder = write_mcap({"/front": [scan(0)], "/top": [scan(1)]})
    with pytest.raises(ScanError, match="choose --topic from /front, /top"):
        next(read_bag(folder))
    with pytest.raises(ScanError, match="unknown topic '/side'; choose --topic from /front, /top"):
        next(read_bag(folder, "/side"))
    assert len(list(read_bag(folder, "/top"))) == 1


def test_a_damaged_bag_is_named(tmp_path):
    pytest.importorskip("rosbags")
    path = tmp_path / "drive.mcap"
    path.write_bytes(b"\x89MCAP0\r\nnothing")
    with pytest.raises(ScanError, match=r"drive\.mcap: is damaged or no bag"):
        next(read_bag(path))


def test_rows_of_an_image_may_be_padded():
    table = scan(2, 6)
    lines = np.zeros((2, 3 * 24 + 8), np.uint8)
    lines[:, :72] = np.frombuffer(table.tobytes(), np.uint8).reshape(2, 72)
    fields = [
        SimpleNamespace(name=name, offset=LAYOUT.fields[name][1], datatype=number, count=1)
        for name, number in KINDS.items()
    ]
    message = SimpleNamespace(
        fields=fields, is_bigendian=False, point_step=24, row_step=80, height=2, width=3,
        data=lines.ravel(),
    )  # fmt: skip
    assert _table_of(message).tolist() == table.tolist()

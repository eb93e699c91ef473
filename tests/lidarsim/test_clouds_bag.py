"""Bags written by rosbags: scans come back, and what cannot be read is named."""

import numpy as np
import pytest

from lidarsim.cloud_formats import ScanError
from lidarsim.clouds import read_cloud
from lidarsim.clouds_bag import read_bag
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
    """``write_mcap({topic: [table, ...]})``: folder of a recording of these scans.

    Each is an image of ``height`` rows, with ``padding`` bytes after each of them.
    """
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

    def message(table, height, padding):
        fields = [
            field_type(name=name, offset=LAYOUT.fields[name][1], datatype=number, count=1)
            for name, number in KINDS.items()
        ]
        rows = table.view(np.uint8).reshape(height, -1)
        data = np.pad(rows, ((0, 0), (0, padding)))
        return cloud_type(
            header=header_type(stamp=time_type(sec=0, nanosec=0), frame_id="lidar"),
            height=height,
            width=len(table) // height,
            fields=fields,
            is_bigendian=False,
            point_step=table.dtype.itemsize,
            row_step=data.shape[1],
            data=data.ravel(),
            is_dense=False,
        )

    def write(topics, height=1, padding=0):
        path = tmp_path / "drive"
        kind = rosbag2.StoragePlugin.MCAP
        with rosbag2.Writer(path, version=8, storage_plugin=kind) as writer:
            for topic, tables in topics.items():
                connection = writer.add_connection(topic, cloud_type.__msgtype__, typestore=store)
                for number, table in enumerate(tables):
                    data = store.serialize_cdr(
                        message(table, height, padding), cloud_type.__msgtype__
                    )
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


def test_rows_of_an_image_may_be_padded(write_mcap):
    table = scan(2, 6)
    ((_, cloud),) = read_bag(write_mcap({"/points": [table]}, height=2, padding=8))
    np.testing.assert_array_equal(cloud.points[:, 1], table["y"])
    np.testing.assert_array_equal(cloud.ring, table["ring"])

"""Bags written by rosbags: scans come back, and what cannot be read is named."""

import numpy as np
import pytest

from lidarsim.cloud_formats import ScanError
from lidarsim.clouds import read_cloud
from lidarsim.clouds_bag import read_bag
from lidarsim.conversion import convert

LAYOUT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "points"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<u4"],
        "offsets": [0, 4, 8, 16, 20, 24],
        "itemsize": 28,
    }
)
CLOUD = "sensor_msgs/msg/PointCloud2"
KINDS = {"x": 7, "y": 7, "z": 7, "intensity": 7, "ring": 4, "points": 6}  # numbers of the message


def scan(seed, num_points=64):
    table = np.zeros(num_points, LAYOUT)
    generator = np.random.default_rng(seed)
    for axis in "xyz":
        table[axis] = generator.uniform(2, 30, num_points)
    table["intensity"] = generator.uniform(0, 1, num_points)
    table["ring"] = np.arange(num_points) % 4
    table["points"] = np.arange(num_points)
    return table


def message(store, table, height, padding):
    """Message of a scan, in the types of one version of ROS.

    It is an image of ``height`` rows, with ``padding`` bytes after each of them.
    """
    types, stamp_type = store.types, "builtin_interfaces/msg/Time"
    header = {"stamp": types[stamp_type](sec=0, nanosec=0), "frame_id": "lidar"}
    if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__:  # ROS 1
        header["seq"] = 0
    fields = [
        types["sensor_msgs/msg/PointField"](
            name=name, offset=LAYOUT.fields[name][1], datatype=number, count=1
        )
        for name, number in KINDS.items()
    ]
    rows = table.view(np.uint8).reshape(height, -1)
    data = np.pad(rows, ((0, 0), (0, padding)))
    return types[CLOUD](
        header=types["std_msgs/msg/Header"](**header),
        height=height,
        width=len(table) // height,
        fields=fields,
        is_bigendian=False,
        point_step=table.dtype.itemsize,
        row_step=data.shape[1],
        data=data.ravel(),
        is_dense=False,
    )


def write_recording(folder, suffix, topics, height=1, padding=0):
    """Write scans as ``{topic: [table, ...]}``: a file of ROS 1, or a folder of ROS 2."""
    typesys = pytest.importorskip("rosbags.typesys")
    from rosbags import rosbag1, rosbag2

    if suffix == ".bag":
        path = folder / "drive.bag"
        store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
        writer, serialize = rosbag1.Writer(path), store.serialize_ros1
    else:
        path = folder / "drive"
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        kind = {".mcap": "MCAP", ".db3": "SQLITE3"}[suffix]
        plugin = rosbag2.StoragePlugin[kind]
        writer = rosbag2.Writer(path, version=8, storage_plugin=plugin)
        serialize = store.serialize_cdr
    with writer:
        for topic, tables in topics.items():
            connection = writer.add_connection(topic, CLOUD, typestore=store)
            for number, table in enumerate(tables):
                cloud = message(store, table, height, padding)
                writer.write(connection, number, serialize(cloud, CLOUD))
    return path


@pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])
def test_scans_of_a_recording_become_files(suffix, tmp_path):
    tables = [scan(0), scan(1)]
    tables[1]["x"][5] = np.nan  # no return
    tables[1]["intensity"][7] = np.nan
    recording = write_recording(tmp_path, suffix, {"/points": tables})
    for number, source in enumerate((recording, *recording.glob(f"*{suffix}"))):
        line = convert(source, tmp_path / f"scans{number}", to="npz")
        assert line.startswith("2 scans written")
        cloud = read_cloud(tmp_path / f"scans{number}" / "000001.npz")
        rest = np.delete(tables[1], [5, 7])
        np.testing.assert_array_equal(cloud.points, np.stack([rest[axis] for axis in "xyz"], 1))
        np.testing.assert_array_equal(cloud.ring, rest["ring"])
        np.testing.assert_array_equal(cloud.intensity, rest["intensity"])


@pytest.mark.parametrize("suffix", [".bag", ".db3"])
def test_several_topics_are_listed(suffix, tmp_path):
    recording = write_recording(tmp_path, suffix, {"/front": [scan(0)], "/top": [scan(1)]})
    with pytest.raises(ScanError, match="choose --topic from /front, /top"):
        next(read_bag(recording))
    with pytest.raises(ScanError, match="unknown topic '/side'; choose --topic from /front, /top"):
        next(read_bag(recording, "/side"))
    assert len(list(read_bag(recording, "/top"))) == 1


@pytest.mark.parametrize("name", ["drive.bag", "drive.mcap", "metadata.yaml"])
def test_a_damaged_bag_is_named(name, tmp_path):
    pytest.importorskip("rosbags")
    path = tmp_path / name
    path.write_bytes(b"nothing")
    with pytest.raises(ScanError, match=r": is damaged or no bag"):
        next(read_bag(path if path.suffix != ".yaml" else tmp_path))


def test_a_database_without_its_metadata_is_named(tmp_path):
    pytest.importorskip("rosbags")
    path = tmp_path / "drive_0.db3"
    path.write_bytes(b"SQLite format 3\0")
    with pytest.raises(ScanError, match=r"drive_0\.db3: needs metadata\.yaml .*ros2 bag reindex"):
        next(read_bag(path))


def test_a_missing_bag_is_named(tmp_path):
    with pytest.raises(ScanError, match=r"none\.bag: is no folder and no file"):
        convert(tmp_path / "none.bag", tmp_path / "scans", to="bin")


def test_rows_of_an_image_may_be_padded(tmp_path):
    table = scan(2, 6)
    recording = write_recording(tmp_path, ".mcap", {"/points": [table]}, height=2, padding=8)
    ((_, cloud),) = read_bag(recording)
    np.testing.assert_array_equal(cloud.points[:, 1], table["y"])
    np.testing.assert_array_equal(cloud.columns["points"], table["points"])
    np.testing.assert_array_equal(cloud.ring, table["ring"])

"""Scans of ROS bags (``.bag``, ``.db3``) and MCAP files by the package rosbags.

Only messages of type ``sensor_msgs/PointCloud2`` are read, one scan each.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.cloud_formats import ScanError, Table, table_of
from lidarsim.clouds import PointCloud, known_columns, suffix_of

#: Suffixes of bags.
BAGS = (".bag", ".db3", ".mcap")
_METADATA = "metadata.yaml"  # beside the files of a ROS 2 recording
_TYPE = "sensor_msgs/msg/PointCloud2"
# Numbers of sensor_msgs/PointField.
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def is_bag(path: Path) -> bool:
    """Whether a file, or the folder of a ROS 2 recording, holds messages."""
    is_file = path.is_file() and suffix_of(path) in BAGS
    return is_file or (path / _METADATA).is_file()


def read_bag(path: Path, topic: str | None = None) -> Iterator[tuple[str, PointCloud]]:
    """Name and points of each scan, in the order of recording, without points that are not finite.

    Args:
        path: Bag of ROS 1, or a file or folder of ROS 2.
        topic: Topic of the scans; needed if several hold some.

    Raises:
        ScanError: If the file is damaged, or its scans have no or several topics.
    """
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ScanError(f"{path}: bags need rosbags: pip install 'r3dpa[bag]'") from error
    source = path.parent if path.suffix == ".db3" else path
    if path.suffix == ".db3" and not (source / _METADATA).is_file():
        raise ScanError(f"{path}: needs {_METADATA} beside it, which `ros2 bag reindex` writes")
    try:
        with AnyReader([source], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            known = sorted({c.topic for c in reader.connections if c.msgtype == _TYPE})
            if topic is None and len(known) == 1:
                topic = known[0]
            if topic not in known:
                raise ScanError(_no_topic(path, topic, known))
            connections = [c for c in reader.connections if c.topic == topic]
            messages = reader.messages(connections=connections)
            for number, (connection, _, data) in enumerate(messages):
                message = reader.deserialize(data, connection.msgtype)
                yield f"{number:06d}", _cloud_of(path, number, message)
    except AnyReaderError as error:
        raise ScanError(f"{path}: is damaged or no bag ({error})") from error


def _no_topic(path: Path, topic: str | None, known: list[str]) -> str:
    if not known:
        return f"{path}: holds no messages of type {_TYPE}, which scans have"
    wanted = "several topics hold scans" if topic is None else f"unknown topic {topic!r}"
    return f"{path}: {wanted}; choose --topic from {', '.join(known)}"


def _cloud_of(path: Path, number: int, message: Any) -> PointCloud:
    """Point cloud of a message."""
    try:
        table = _table_of(message)
    except (KeyError, TypeError, ValueError) as error:
        raise ScanError(f"{path}: scan {number} is damaged ({error})") from error
    names = known_columns(f"{path}: scan {number}", table)
    is_finite = np.all([np.isfinite(table[name]) for name in names.values()], axis=0)
    return PointCloud(table[is_finite], names)


def _table_of(message: Any) -> Table:
    """Rows ``(P,)`` of all single-valued fields, without padding between rows of the image."""
    fields = [field for field in message.fields if field.count == 1]
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": [order + _DTYPES[field.datatype] for field in fields],
            "offsets": [field.offset for field in fields],
            "itemsize": message.point_step,
        }
    )
    lines = np.asarray(message.data, np.uint8).reshape(message.height, message.row_step)
    used = np.ascontiguousarray(lines[:, : message.width * message.point_step])
    table = used.view(dtype).reshape(-1)
    return table_of({name: table[name] for name in dtype.names or ()}, len(table))

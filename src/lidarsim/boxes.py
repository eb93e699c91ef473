"""3-D boxes of the objects of a simulated scan, as KITTI's label files hold them."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from lidarsim.scan import SimulatedScan
from lidarsim.scene import Primitive, Semantic

KITTI_TYPES = {
    Semantic.CAR: "Car",
    Semantic.TRUCK: "Truck",
    Semantic.BUS: "Bus",
    Semantic.CARAVAN: "Caravan",
    Semantic.TRAILER: "Trailer",
    Semantic.PERSON: "Pedestrian",
    Semantic.RIDER: "Cyclist",
    Semantic.MOTORCYCLE: "Motorcycle",
    Semantic.BICYCLE: "Bicycle",
}
_CORNERS = np.array(list(itertools.product((-1, 1), repeat=3)), dtype=np.float64)


def kitti_label(scan: SimulatedScan, sensor_to_world: NDArray[np.float64]) -> str:
    """Boxes of the objects that a scan shows, a line of KITTI's label format for each.

    ::

        type truncated occluded alpha  bbox (4)  height width length  x y z  rotation_y

    The frame belongs to a camera at the sensor that looks ahead: x right, y down, z forward. The
    place is the middle of the lower face, in the middle of the sweep. There is no picture: the
    occlusion is 3 (unknown) and the picture's box -1.

    Args:
        scan: Simulated scan; its scene has the solids of the objects.
        sensor_to_world: ``(3, 4)`` pose of the sensor frame, metres.
    """
    labels = set(np.unique(scan.labels).tolist())
    parts = defaultdict(list)
    for primitive in (*scan.scene.primitives, *scan.scene.unseen):
        label = int(primitive.semantic) | primitive.instance << 16
        if primitive.instance and primitive.semantic in KITTI_TYPES and label in labels:
            parts[label].append(primitive)
    return "".join(f"{_line(parts[label], sensor_to_world)}\n" for label in sorted(parts))


def _line(parts: list[Primitive], sensor_to_world: NDArray[np.float64]) -> str:
    yaw = parts[0].yaw_rad  # all parts of a vehicle or a person look the same way
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0]])
    turn = np.vstack([turn, [0, 0, 1]])
    corners = np.concatenate(
        [np.array(part.centre) @ turn + _CORNERS * np.array(part.half_size) for part in parts]
    )
    low, high = corners.min(axis=0), corners.max(axis=0)
    length, width, height = high - low
    bottom = turn @ np.array([*(low + high)[:2] / 2, low[2]])
    rotation, place = sensor_to_world[:, :3], sensor_to_world[:, 3]
    x, y, z = (bottom - place) @ rotation
    ahead = turn[:, 0] @ rotation  # of the object, in the sensor frame
    # Both angles lie in [-pi, pi].
    rotation_y = math.remainder(-math.atan2(ahead[1], ahead[0]) - math.pi / 2, math.tau)
    alpha = math.remainder(rotation_y - math.atan2(-y, x), math.tau)
    numbers = (height, width, length, -y, -z, x, rotation_y)
    kind = KITTI_TYPES[parts[0].semantic]
    return f"{kind} 0.00 3 {alpha:.2f} -1 -1 -1 -1 {' '.join(f'{v:.2f}' for v in numbers)}"

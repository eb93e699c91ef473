"""3-D boxes of the objects of a simulated scan, as KITTI's label files hold them."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from lidarsim.scan import SimulatedScan
from lidarsim.scene import EgoMotion, Primitive, Semantic

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
_RIDDEN = (Semantic.BICYCLE, Semantic.MOTORCYCLE)
_SEARCHES = 3


def kitti_label(scan: SimulatedScan, sensor_to_world: NDArray[np.float64]) -> str:
    """Boxes of the objects that a scan shows, a line of KITTI's label format for each.

    ::

        type truncated occluded alpha  bbox (4)  height width length  x y z  rotation_y

    The frame belongs to a camera at the sensor that looks ahead: x right, y down, z forward. The
    place is the middle of the lower face, seen from the sensor when it looks there: as in the
    points, objects and sensor move during the sweep. Behind the sensor, where its turn begins and
    ends, points of an object may lie a sweep's way apart; the box holds some of them. A cyclist's
    box holds the bicycle too. There is no picture: the occlusion is 3 (unknown) and the picture's
    box -1.

    Args:
        scan: Simulated scan; its scene has the solids of the objects.
        sensor_to_world: ``(3, 4)`` pose of the sensor frame in the middle of the sweep, metres.
    """
    labels = set(np.unique(scan.labels).tolist())
    solids = [
        solid
        for solid in (*scan.scene.primitives, *scan.scene.unseen)
        if solid.instance and solid.semantic in KITTI_TYPES
    ]
    riders = {solid.instance for solid in solids if solid.semantic == Semantic.RIDER}
    parts, shown = defaultdict(list), set()
    for solid in solids:
        is_ridden = solid.semantic in _RIDDEN and solid.instance in riders
        kind = Semantic.RIDER if is_ridden else solid.semantic
        parts[solid.instance, kind].append(solid)
        if int(solid.semantic) | solid.instance << 16 in labels:
            shown.add((solid.instance, kind))
    return "".join(
        f"{KITTI_TYPES[kind]} {_numbers(parts[instance, kind], scan, sensor_to_world)}\n"
        for instance, kind in sorted(shown)
    )


def _turned(angle: float) -> NDArray[np.float64]:
    """Rotation ``(3, 3)`` about the vertical axis."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def _numbers(
    parts: list[Primitive], scan: SimulatedScan, sensor_to_world: NDArray[np.float64]
) -> str:
    yaw = parts[0].yaw_rad  # all parts of a vehicle or a person look the same way
    turn = _turned(yaw)
    corners = np.concatenate(
        [np.array(part.centre) @ turn + _CORNERS * np.array(part.half_size) for part in parts]
    )
    low, high = corners.min(axis=0), corners.max(axis=0)
    length, width, height = high - low
    bottom = turn @ np.array([*(low + high)[:2] / 2, low[2]])
    moves = {effect.name for effect in scan.effects if effect.status == "ran"}
    motion = scan.scene.motion if "rolling_shutter" in moves else EgoMotion()
    velocity_m_s = parts[0].velocity_m_s if "moving_actors" in moves else (0.0, 0.0)
    velocity = np.array([*velocity_m_s, 0.0])
    time_s = 0.0
    for _ in range(_SEARCHES):  # where the object is depends on when the sensor looks there
        ahead_m, aside_m, heading = motion.moved(time_s)
        rotation = sensor_to_world[:, :3] @ _turned(heading)
        place = sensor_to_world @ (ahead_m, aside_m, 0, 1)
        x, y, z = (bottom + velocity * time_s - place) @ rotation
        time_s = math.atan2(y, x) / math.tau / scan.sensor.spin_hz
    ahead = turn[:, 0] @ rotation  # of the object, in the sensor frame
    # Both angles lie in [-pi, pi].
    rotation_y = math.remainder(-math.atan2(ahead[1], ahead[0]) - math.pi / 2, math.tau)
    alpha = math.remainder(rotation_y - math.atan2(-y, x), math.tau)
    numbers = (height, width, length, -y, -z, x, rotation_y)
    return f"0.00 3 {alpha:.2f} -1 -1 -1 -1 {' '.join(f'{v:.2f}' for v in numbers)}"

"""3-D boxes of the objects of simulated scans, and the names of their classes."""

from collections import defaultdict
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from lidarsim import Semantic, Simulator, simulate
from lidarsim.boxes import KITTI_TYPES, kitti_label
from lidarsim.drive_files import velodyne_to_world
from lidarsim.scene import Pose, Primitive, Scene, Shape
from lidarsim.sensors import hdl64e
from lidarsim.street import Street


def boxes_of(text):
    """Type, size (length, width, height), and place and yaw in the sensor frame, of each line."""
    for line in text.splitlines():
        kind, *numbers = line.split()
        height, width, length, right, down, ahead, rotation_y = map(float, numbers[7:])
        place = np.array([ahead, -right, -down])
        yield kind, np.array([length, width, height]), place, -rotation_y - np.pi / 2


def test_the_line_of_a_car_is_known():
    """A car of 4 x 2 x 1.5 m, 10 m ahead of a sensor that looks north, 1.7 m above its wheels."""
    heading = np.pi / 2
    car = Primitive(Shape.BOX, (5, 30, 0.75), (2, 1, 0.75), Semantic.CAR, 0.3, heading, instance=7)
    pose = Pose(x_m=5, y_m=20, z_m=1.7, heading_rad=heading)
    scan = Simulator().scan(0)
    labels = np.array([26 | 7 << 16], dtype=np.uint32)
    scan = replace(scan, scene=Scene((car,), pose), labels=labels)
    (line,) = kitti_label(scan, velodyne_to_world(pose)).splitlines()
    expected = "Car 0.00 3 -1.57 -1 -1 -1 -1 1.50 2.00 4.00 0.00 1.70 10.00 -1.57"
    assert line.replace("-0.00", "0.00") == expected
    unseen = replace(scan, labels=np.zeros(1, dtype=np.uint32))
    assert kitti_label(unseen, velodyne_to_world(pose)) == ""


def test_points_of_an_object_lie_in_its_box():
    """Also of those that move, seen from a sensor that moves."""
    off = dict.fromkeys(("range_noise", "mixed_pixels", "glass", "polished_metal"), "off")
    scan = Simulator(seed=0, drive=2, effects=off).scan(40)
    moving = {e.name for e in scan.effects if e.status == "ran"}
    assert {"rolling_shutter", "moving_actors"} <= moving
    text = kitti_label(scan, velodyne_to_world(scan.scene.pose))
    of_object = np.isin(scan.labels & 0xFFFF, [int(semantic) for semantic in KITTI_TYPES])
    instances = np.unique(scan.labels[of_object] >> 16)
    boxes = list(boxes_of(text))
    assert len(boxes) == len(instances) > 5
    assert {"Pedestrian", "Cyclist", "Car"} <= {kind for kind, *_ in boxes}
    for instance, (kind, size, place, yaw) in zip(instances, boxes, strict=True):
        shown = of_object & (scan.labels >> 16 == instance)
        semantics = np.unique(scan.labels[shown] & 0xFFFF)
        assert kind in {KITTI_TYPES[Semantic(int(semantic))] for semantic in semantics}
        cosine, sine = np.cos(yaw), np.sin(yaw)
        away = scan.points[shown, :3] - place
        along = away[:, 0] * cosine + away[:, 1] * sine
        across = away[:, 1] * cosine - away[:, 0] * sine
        inside = np.abs(along) < size[0] / 2 + 0.15
        inside &= np.abs(across) < size[1] / 2 + 0.15
        inside &= (away[:, 2] > -0.15) & (away[:, 2] < size[2] + 0.15)
        is_behind = abs(np.arctan2(place[1], place[0])) > 2.9
        assert is_behind or inside.mean() > 0.99


@pytest.fixture(scope="module")
def data_set(tmp_path_factory):
    out = tmp_path_factory.mktemp("boxes")
    simulate(out, 1, drives=["0002"])
    return out


def test_a_box_does_not_depend_on_the_distance():
    """Wheels, mirrors and roofs are built near the sensor only, but belong to the object."""
    street, sizes = Street(seed=0, drive=0), defaultdict(set)
    for number in range(0, 60, 10):
        scene = street.scene(number)
        standing = {
            int(solid.semantic) | solid.instance << 16
            for solid in (*scene.primitives, *scene.unseen)
            if solid.instance and solid.semantic in KITTI_TYPES and not any(solid.velocity_m_s)
        }
        labels = sorted(standing)
        labels_of_scan = np.array(labels, np.uint32)
        scan = SimpleNamespace(scene=scene, labels=labels_of_scan, effects=(), sensor=hdl64e())
        boxes = boxes_of(kitti_label(scan, velodyne_to_world(scene.pose)))
        for label, (_, size, _, _) in zip(labels, boxes, strict=True):
            sizes[label].add(tuple(size))
    assert len(sizes) > 5
    assert all(len(each) == 1 for each in sizes.values())


def test_a_data_set_names_its_classes(data_set):
    names = yaml.safe_load((data_set / "classes.yaml").read_text())
    assert names == {int(semantic): semantic.name.lower() for semantic in Semantic}


def test_a_data_set_has_boxes_of_each_scan(data_set):
    (boxes,) = data_set.rglob("boxes/*.txt")
    assert boxes.stem == "0000000000"
    assert all(kind in KITTI_TYPES.values() for kind, *_ in boxes_of(boxes.read_text()))

from __future__ import annotations

import numpy as np
import pytest

from r3dpa.data import ScanError, read_scan, write_bin
from r3dpa.data.labels import CLASS_NAMES, read_labels
from r3dpa.simulation import Semantic

# Camera axes: x right, y down, z forward; the camera 0.3 m ahead of the sensor and 0.1 m below.
CALIB = "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.1 1 0 0 -0.3\n"
BOX = "Car 0 0 0 0 0 1 1 {height} {width} {length} {x} {y} {z} {turn}\n"


def kitti_scan(folder, points, boxes, calib=CALIB):
    scan = folder / "velodyne" / "000007.bin"
    write_bin(scan, np.asarray(points, dtype=np.float32))
    for kind, text in (("label_2", boxes), ("calib", calib)):
        (folder / kind).mkdir(exist_ok=True)
        (folder / kind / "000007.txt").write_text(text)
    return scan


def labels_of(scan):
    return read_labels(scan, read_scan(scan))


def test_names_are_those_of_the_simulator():
    unnamed = (Semantic.UNLABELED, Semantic.EGO_VEHICLE)
    assert {s.value: s.name.lower() for s in Semantic if s not in unnamed}.items() <= (
        CLASS_NAMES.items()
    )


def test_labels_of_the_simulator_come_as_they_are(tmp_path):
    scan = tmp_path / "velodyne_points" / "data" / "0.bin"
    write_bin(scan, np.ones((2, 4)))
    labels = np.array([26 | 3 << 16, 0xFFFFFFFF], dtype="<u4")
    (tmp_path / "velodyne_points" / "labels").mkdir()
    (tmp_path / "velodyne_points" / "labels" / "0.label").write_bytes(labels.tobytes())
    assert labels_of(scan).tolist() == [26 | 3 << 16, 0xFFFFFFFF]


def test_semantic_kitti_becomes_kitti_360(tmp_path):
    scan = tmp_path / "velodyne" / "000001.bin"
    write_bin(scan, np.ones((5, 4)))
    path = tmp_path / "labels" / "000001.label"
    path.parent.mkdir()
    # A car, one that moves, a trunk, a lane marking, an outlier.
    path.write_bytes(np.array([10 | 5 << 16, 252, 71, 60, 1], dtype="<u4").tobytes())
    labels = labels_of(scan)
    assert (labels >> 16).tolist() == [5, 0, 0, 0, 0]
    names = [CLASS_NAMES.get(label) for label in (labels & 0xFFFF).tolist()]
    assert names == ["car", "car", "vegetation", "road", None]

    path.write_bytes(np.array([10, 10, 10, 10, 12], dtype="<u4").tobytes())
    with pytest.raises(ScanError, match=r"000001\.label holds \[12\], which are no classes"):
        labels_of(scan)
    path.write_bytes(bytes(12))
    with pytest.raises(ScanError, match=r"000001\.label holds 3 labels, but its scan 5 points"):
        labels_of(scan)


def test_points_in_a_box_of_the_camera_frame(tmp_path):
    # A car 4 m long, 2 m wide, 1.5 m high, its bottom 1.6 m below the camera, 10 m ahead of it and
    # 3 m to the right: in the sensor frame its middle is (10.3, -3, -0.95).
    middle = np.array([10.3, -3.0, -0.95])
    offsets = np.zeros((6, 3))
    offsets[:3, 0] = [0.9, 1.9, 2.1]  # along x
    offsets[3:5, 1] = [0.9, 1.9]  # along y
    offsets[5, 2] = 0.8  # above
    points = np.column_stack([middle + offsets, np.zeros(6)])
    box = {"height": 1.5, "width": 2.0, "length": 4.0, "x": 3.0, "y": 1.6, "z": 10.0}
    # rotation_y is 0 for a car that faces the camera's right, -pi / 2 for one that drives ahead.
    across = labels_of(kitti_scan(tmp_path, points, BOX.format(**box, turn=0)))
    car = 26 | 1 << 16
    assert across.tolist() == [car, 0, 0, car, car, 0]
    dont_care = "DontCare -1 -1 -10 0 0 0 0 -1 -1 -1 -1000 -1000 -1000 -10\n\n"
    ahead = labels_of(kitti_scan(tmp_path, points, dont_care + BOX.format(**box, turn=-np.pi / 2)))
    car = 26 | 3 << 16  # objects are numbered by line
    assert ahead.tolist() == [car, car, 0, car, 0, 0]


def test_a_box_turns_as_kitti_draws_it(tmp_path):
    """Against the published corners: R_y(turn) of (+-l/2, 0 or -h, +-w/2), plus the place."""
    turn, place, size = 0.4, np.array([3.0, 1.6, 10.0]), np.array([4.0, 1.5, 2.0])
    rotation = np.array(
        [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    )
    corners = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / 2.0
    camera = [
        (rotation @ (scale * corner * size - (0, 0.75, 0)) + place)
        for corner in corners
        for scale in (0.99, 1.01)
    ]
    points = [(z + 0.3, -x, -y - 0.1, 0) for x, y, z in camera]
    box = BOX.format(height=1.5, width=2.0, length=4.0, x=3.0, y=1.6, z=10.0, turn=turn)
    assert (labels_of(kitti_scan(tmp_path, points, box)) > 0).tolist() == [True, False] * 8


@pytest.mark.parametrize(
    ("boxes", "calib", "message"),
    [
        ("Car 0 0 0 1 1 1 1 1 1 1\n", CALIB, r"label_2/000007\.txt, line 1: is no box of KITTI"),
        ("Boat" + BOX[3:].format(height=1, width=1, length=1, x=1, y=1, z=1, turn=1), CALIB, "Boa"),
        ("", "R0_rect: 1 0 0\n", r"calib/000007\.txt: needs R0_rect of 9"),
        ("", "P2: 1 0 0\n", r"calib/000007\.txt: needs R0_rect of 9"),
    ],
)
def test_a_damaged_file_of_boxes_is_named(tmp_path, boxes, calib, message):
    with pytest.raises(ScanError, match=message):
        labels_of(kitti_scan(tmp_path, np.ones((1, 4)), boxes, calib))


def test_a_scan_without_labels_says_where_they_were_looked_for(tmp_path):
    scan = tmp_path / "a.bin"
    write_bin(scan, np.ones((1, 4)))
    with pytest.raises(ScanError, match=r"a\.bin has no labels: looked for labels/a\.label"):
        labels_of(scan)
    scan = kitti_scan(tmp_path, np.ones((1, 4)), "")
    (tmp_path / "calib" / "000007.txt").unlink()
    with pytest.raises(ScanError, match=r"calib/000007\.txt: cannot be read"):
        labels_of(scan)


def test_every_box_of_the_real_scans_holds_points(real_scans_dir):
    counts = []
    for scan in sorted((real_scans_dir / "kitti_object_vis" / "velodyne").glob("*.bin")):
        labels = labels_of(scan)
        counts += np.unique(labels[labels > 0], return_counts=True)[1].tolist()
    assert len(counts) == 6
    assert (min(counts), max(counts)) == (9, 1351)  # as counted when the scans were collected

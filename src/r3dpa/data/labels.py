"""Labels of the points of a scan from three sources, as classes of KITTI-360.

=====================================  ================================================
scan                                   labels
=====================================  ================================================
``velodyne_points/data/F.bin``         ``velodyne_points/labels/F.label`` of KITTI-360,
                                       as ``r3dpa simulate`` writes them
``velodyne/F.bin``                     ``labels/F.label`` of SemanticKITTI
``velodyne/F.bin``                     3D boxes ``label_2/F.txt`` with ``calib/F.txt``
                                       of the KITTI object benchmark
=====================================  ================================================
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from r3dpa.data.scans import ScanError, read_beside, read_bytes

_NAMES = {
    6: "ground,road,sidewalk,parking,rail track,building,wall,fence,guard rail,bridge,tunnel",
    17: "pole,polegroup,traffic light,sign,vegetation,terrain",
    24: "person,rider,car,truck,bus,caravan,trailer,train,motorcycle,bicycle,garage,gate,stop",
    37: "smallpole,lamp,trash bin,vending machine,box,unknown construction,unknown vehicle",
    44: "unknown object",
}
#: Names by KITTI-360 class id; every other id counts as unlabelled.
CLASS_NAMES = {
    first + place: name
    for first, names in _NAMES.items()
    for place, name in enumerate(names.split(","))
}
_ID = {name: number for number, name in CLASS_NAMES.items()}
# Ids of SemanticKITTI; those from 252 on are of things that move.
_SEMANTIC_NAMES = """10 252 car; 11 bicycle; 13 257 bus; 15 motorcycle; 16 256 train; 18 258 truck;
20 259 unknown vehicle; 30 254 person; 31 32 253 255 rider; 40 60 road; 44 parking; 48 sidewalk;
49 ground; 50 building; 51 fence; 52 unknown construction; 70 71 vegetation; 72 terrain; 80 pole;
81 sign; 99 unknown object"""
_SEMANTIC_KITTI = {0: 0, 1: 0} | {
    int(word): _ID[" ".join(w for w in entry.split() if not w.isdigit())]
    for entry in _SEMANTIC_NAMES.split(";")
    for word in entry.split()
    if word.isdigit()
}
_KITTI_BOXES = {
    "Car": _ID["car"],
    "Van": _ID["car"],  # as in KITTI-360
    "Truck": _ID["truck"],
    "Pedestrian": _ID["person"],
    "Person_sitting": _ID["person"],
    "Cyclist": _ID["rider"],
    "Tram": _ID["train"],
    "Misc": _ID["unknown object"],
}


def read_labels(scan: str | Path, points: NDArray[np.float32]) -> NDArray[np.int64]:
    """Class and object of each point of a scan, from the files beside it; boxes label few points.

    Args:
        scan: The ``.bin`` file, in one of the layouts above.
        points: ``(P, 4)`` its points x, y, z in metres and intensity.

    Returns:
        ``(P,)`` KITTI-360 class in the lower 16 bits, see :data:`CLASS_NAMES`, 0 without a label;
        number of the object in the upper, 0 for none.

    Raises:
        ScanError: If there are no labels, or a file is damaged or of another scan.
    """
    scan = Path(scan)
    simulated = read_beside(scan, "labels")
    if simulated is not None:
        return simulated.astype(np.int64)
    root = scan.parents[1] if len(scan.parents) > 1 else scan.parent
    own, boxes = root / "labels" / f"{scan.stem}.label", root / "label_2" / f"{scan.stem}.txt"
    if scan.parent.name == "velodyne" and own.exists():
        return _semantic_kitti(own, len(points))
    if scan.parent.name == "velodyne" and boxes.exists():
        return _in_boxes(boxes, root / "calib" / f"{scan.stem}.txt", points)
    raise ScanError(
        f"{scan} has no labels: looked for labels/{scan.stem}.label beside its folder (of "
        "velodyne_points/data as KITTI-360 and `r3dpa simulate` have them, or of velodyne as "
        f"SemanticKITTI), and for label_2/{scan.stem}.txt with calib/ beside velodyne (KITTI boxes)"
    )


def _semantic_kitti(path: Path, num_points: int) -> NDArray[np.int64]:
    data = read_bytes(path)
    if len(data) != 4 * num_points:
        raise ScanError(f"{path} holds {len(data) / 4:g} labels, but its scan {num_points} points")
    labels = np.frombuffer(data, dtype="<u4").astype(np.int64)
    table = np.full(1 << 16, -1)
    table[list(_SEMANTIC_KITTI)] = list(_SEMANTIC_KITTI.values())
    classes = table[labels & 0xFFFF]
    if (classes < 0).any():
        unknown = sorted(set((labels[classes < 0] & 0xFFFF).tolist()))
        raise ScanError(f"{path} holds {unknown[:5]}, which are no classes of SemanticKITTI")
    return classes | labels >> 16 << 16


def _in_boxes(path: Path, calib: Path, points: NDArray[np.float32]) -> NDArray[np.int64]:
    """Labels of the points in the boxes of the KITTI object benchmark, objects numbered from 1."""
    # A box stands in the frame of the rectified camera (x right, y down, z forward): its place is
    # the middle of its bottom, and rotation_y turns it about y.
    to_camera = _camera_of(calib)
    places = np.column_stack([points[:, :3], np.ones(len(points))]) @ to_camera.T
    labels = np.zeros(len(points), dtype=np.int64)
    for number, line in enumerate(_text(path).splitlines(), start=1):
        kind, *numbers = line.split() or ["DontCare"]
        if kind == "DontCare":
            continue
        try:
            height, width, length, *place, turn = map(float, numbers[7:14])
            label = _KITTI_BOXES[kind]
            x, y, z = (places - place).T
        except (KeyError, ValueError) as error:
            raise ScanError(
                f"{path}, line {number}: is no box of KITTI, as 'Car' and 14 or 15 numbers: "
                f"{line[:80]!r}"
            ) from error
        along = np.cos(turn) * x - np.sin(turn) * z
        across = np.sin(turn) * x + np.cos(turn) * z
        inside = (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2)
        labels[inside & (y <= 0) & (y >= -height)] = label | number << 16
    return labels


def _camera_of(path: Path) -> NDArray[np.float64]:
    """Matrix ``(3, 4)`` from points ``(x, y, z, 1)`` of the scan to the rectified camera."""
    entries = dict(line.split(":", 1) for line in _text(path).splitlines() if ":" in line)
    try:
        rectify = np.array(entries["R0_rect"].split(), dtype=np.float64).reshape(3, 3)
        return rectify @ np.array(entries["Tr_velo_to_cam"].split(), np.float64).reshape(3, 4)
    except (KeyError, ValueError) as error:
        raise ScanError(
            f"{path}: needs R0_rect of 9 and Tr_velo_to_cam of 12 numbers, as the calib files of "
            f"the KITTI object benchmark have them ({error})"
        ) from error


def _text(path: Path) -> str:
    return read_bytes(path).decode("utf-8", errors="replace")

"""Labels of scans as classes of KITTI-360, from the files beside them.

Letters: P points.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from lidarsim.cloud_formats import ScanError, read_bytes
from lidarsim.scan_files import read_beside
from r3dpa.io import atomic_path

#: Names by KITTI-360 class id; every other id counts as unlabelled.
CLASS_NAMES = {
    6: "ground",
    7: "road",
    8: "sidewalk",
    9: "parking",
    10: "rail track",
    11: "building",
    12: "wall",
    13: "fence",
    14: "guard rail",
    15: "bridge",
    16: "tunnel",
    17: "pole",
    18: "polegroup",
    19: "traffic light",
    20: "sign",
    21: "vegetation",
    22: "terrain",
    24: "person",
    25: "rider",
    26: "car",
    27: "truck",
    28: "bus",
    29: "caravan",
    30: "trailer",
    31: "train",
    32: "motorcycle",
    33: "bicycle",
    34: "garage",
    35: "gate",
    36: "stop",
    37: "smallpole",
    38: "lamp",
    39: "trash bin",
    40: "vending machine",
    41: "box",
    42: "unknown construction",
    43: "unknown vehicle",
    44: "unknown object",
}
# Ids of SemanticKITTI by class; those from 252 on are of things that move.
_SEMANTIC_KITTI_IDS = {
    "car": (10, 252),
    "bicycle": (11,),
    "bus": (13, 257),
    "motorcycle": (15,),
    "train": (16, 256),
    "truck": (18, 258),
    "unknown vehicle": (20, 259),
    "person": (30, 254),
    "rider": (31, 32, 253, 255),
    "road": (40, 60),
    "parking": (44,),
    "sidewalk": (48,),
    "ground": (49,),
    "building": (50,),
    "fence": (51,),
    "unknown construction": (52,),
    "vegetation": (70, 71),
    "terrain": (72,),
    "pole": (80,),
    "sign": (81,),
    "unknown object": (99,),
}
# KITTI-360 class by id of SemanticKITTI, whose 0 is unlabelled and 1 an outlier.
_ID_OF = {name: number for number, name in CLASS_NAMES.items()}
_SEMANTIC_KITTI = {0: 0, 1: 0} | {
    number: _ID_OF[name] for name, numbers in _SEMANTIC_KITTI_IDS.items() for number in numbers
}


def read_labels(scan: str | Path, num_points: int) -> NDArray[np.int64]:
    """Class and object of each of the P points of a ``.bin`` scan, from the file beside it.

    ``velodyne_points/labels/F.label`` of KITTI-360, as ``r3dpa data simulate`` writes them, for
    ``velodyne_points/data/F.bin``; ``labels/F.label`` of SemanticKITTI for ``velodyne/F.bin``.

    Returns:
        ``(P,)`` KITTI-360 class in the lower 16 bits, see :data:`CLASS_NAMES`, 0 without a label;
        number of the object in the upper, 0 for none.
    """
    labels = find_labels(scan, num_points)
    if labels is None:
        raise ScanError(
            f"{scan} has no labels: looked for labels/{Path(scan).stem}.label beside its folder, "
            "velodyne_points/data as KITTI-360 and `r3dpa data simulate` have it, or velodyne as "
            "SemanticKITTI"
        )
    return labels


def find_labels(scan: str | Path, num_points: int) -> NDArray[np.int64] | None:
    """Labels ``(P,)`` as of :func:`read_labels`; None for a scan without a label file."""
    scan = Path(scan)
    simulated = read_beside(scan, "labels")
    if simulated is not None:
        return simulated.astype(np.int64)
    path = scan.absolute().parent.parent / "labels" / f"{scan.stem}.label"
    if scan.parent.name == "velodyne" and path.exists():
        return _semantic_kitti(path, num_points)
    return None


def write_labels(path: str | Path, labels: Tensor) -> None:
    """Write the KITTI-360 classes ``(P,)`` of points as the uint32 of a ``.label`` file; atomic."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(labels.numpy().astype("<u4").tobytes())


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

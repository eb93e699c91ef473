"""Labels of scans as classes of KITTI-360, from the files beside them.

Letters: P points.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from lidarsim.cloud_formats import ScanError
from lidarsim.clouds import PointCloud, labels_beside
from lidarsim.weather import ADDED_CLASS
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
_LAST_OF_KITTI_360 = max(CLASS_NAMES)


def read_labels(scan: str | Path, num_points: int) -> NDArray[np.int64]:
    """Class and object of each of the P points of a scan, from the ``.label`` file beside it.

    The file lies in the folder of the scan, in ``labels`` there, or in ``labels`` beside the
    folder, as `r3dpa data simulate` and `r3dpa sample` write it. Classes of SemanticKITTI become
    classes of KITTI-360: labels beside a folder ``velodyne`` have them, and elsewhere labels whose
    ids all are of SemanticKITTI and some are not of KITTI-360. Points that weather or a fault has
    added keep :data:`lidarsim.weather.ADDED_CLASS` and above.

    Returns:
        ``(P,)`` KITTI-360 class in the lower 16 bits, see :data:`CLASS_NAMES`, 0 without a label;
        number of the object in the upper, 0 for none.

    Raises:
        ScanError: If there is no such file, it has another number of labels, or it holds ids that
            SemanticKITTI does not have.
    """
    labels = find_labels(scan, num_points)
    if labels is None:
        scan = Path(scan)
        raise ScanError(
            f"{scan} has no labels: looked for {scan.stem}.label in its folder, and in folders "
            "labels there and beside it, as KITTI-360, SemanticKITTI and `r3dpa data simulate` "
            "have them"
        )
    return labels


def find_labels(scan: str | Path, num_points: int) -> NDArray[np.int64] | None:
    """Labels ``(P,)`` as of :func:`read_labels`; None for a scan without a label file."""
    scan = Path(scan)
    labels, path = labels_beside(scan, num_points)
    return None if labels is None else _kitti_360(labels, scan, path)


def labels_of_cloud(cloud: PointCloud) -> NDArray[np.int64] | None:
    """Labels ``(P,)`` as of :func:`read_labels` of a scan that was read; None without labels."""
    if cloud.labels is None:
        return None
    if cloud.file is None:
        return cloud.labels.astype(np.int64)
    return _kitti_360(cloud.labels, cloud.file.path, cloud.file.label_path)


def classes_as_of_cloud(classes: NDArray[np.int64], cloud: PointCloud) -> NDArray[np.int64]:
    """KITTI-360 classes ``(P,)`` by the ids that the labels of a cloud have; 0 for unknown ones."""
    file = cloud.file
    if file is None or cloud.labels is None:
        return classes
    if not _is_semantic_kitti(cloud.labels.astype(np.int64), file.path, file.label_path):
        return classes
    table = np.zeros(1 << 16, np.int64)
    for name, numbers in _SEMANTIC_KITTI_IDS.items():
        table[_ID_OF[name]] = numbers[0]
    return table[classes]


def write_labels(path: str | Path, labels: Tensor) -> None:
    """Write the KITTI-360 classes ``(P,)`` of points as the uint32 of a ``.label`` file; atomic."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(labels.numpy().astype("<u4").tobytes())


def _kitti_360(labels: NDArray[np.uint32], scan: Path, path: Path | None) -> NDArray[np.int64]:
    """Labels in the file ``path`` of a scan, with the classes of KITTI-360."""
    numbers = labels.astype(np.int64)
    if not _is_semantic_kitti(numbers, scan, path):
        return numbers
    table = np.full(1 << 16, -1)
    table[ADDED_CLASS:] = np.arange(ADDED_CLASS, 1 << 16)
    table[list(_SEMANTIC_KITTI)] = list(_SEMANTIC_KITTI.values())
    classes = table[numbers & 0xFFFF]
    if (classes < 0).any():
        unknown = sorted(set((numbers[classes < 0] & 0xFFFF).tolist()))
        raise ScanError(f"{path} holds {unknown[:5]}, which are no classes of SemanticKITTI")
    return classes | numbers >> 16 << 16


def _is_semantic_kitti(labels: NDArray[np.int64], scan: Path, path: Path | None) -> bool:
    """Whether labels are of SemanticKITTI, by the place of their file or else by their ids."""
    folder = scan.absolute().parent
    is_its_place = path is not None and path.parent == folder.parent / "labels"
    if folder.name == "velodyne" and is_its_place:
        return True
    # Scans that were converted or changed may have their labels elsewhere.
    ids = np.flatnonzero(np.bincount(labels & 0xFFFF))
    ids = ids[ids < ADDED_CLASS]
    are_its_ids = np.isin(ids, list(_SEMANTIC_KITTI)).all()
    return bool(are_its_ids and (ids > _LAST_OF_KITTI_360).any())

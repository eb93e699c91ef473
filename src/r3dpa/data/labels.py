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


def read_labels(scan: str | Path, num_points: int) -> NDArray[np.int64]:
    """Class and object of each of the P points of a ``.bin`` scan, from the file beside it.

    ``velodyne_points/labels/F.label`` of KITTI-360, as ``r3dpa data simulate`` writes them, for
    ``velodyne_points/data/F.bin``; ``labels/F.label`` of SemanticKITTI for ``velodyne/F.bin``.

    Returns:
        ``(P,)`` KITTI-360 class in the lower 16 bits, see :data:`CLASS_NAMES`, 0 without a label;
        number of the object in the upper, 0 for none.
    """
    scan = Path(scan)
    simulated = read_beside(scan, "labels")
    if simulated is not None:
        return simulated.astype(np.int64)
    path = scan.absolute().parents[1] / "labels" / f"{scan.stem}.label"
    if scan.parent.name == "velodyne" and path.exists():
        return _semantic_kitti(path, num_points)
    raise ScanError(
        f"{scan} has no labels: looked for labels/{scan.stem}.label beside its folder, "
        "velodyne_points/data as KITTI-360 and `r3dpa data simulate` have it, or velodyne as "
        "SemanticKITTI"
    )


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

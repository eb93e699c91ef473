"""Labels of scans as classes of KITTI-360, and the mean feature of each class.

Letters: P points, K values before the linear step, N = h * w cells, D feature width, C classes.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from operator import add
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from r3dpa.data.feature_grids import Extractor
from r3dpa.data.scans import Scan, ScanError, read_beside, read_bytes, read_scan
from r3dpa.geometry import Projection, in_range, projection_to_dict
from r3dpa.io import UNPICKLING_ERRORS, atomic_path, first_line

_CARD = "r3dpa_objects"
_VERSION = 1
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


@dataclass(frozen=True)
class ObjectClass:
    """Statistics of one class, a name of :data:`CLASS_NAMES`.

    ``num_cells`` are the feature-grid cells that hold a point of it, ``spread`` the mean of
    ``1 - cosine`` between the feature and those of the cells, in [0, 2].
    """

    name: str
    num_scans: int
    num_cells: int
    num_points: int
    spread: float


@dataclass(frozen=True)
class ObjectLibrary:
    """Mean features ``(C, D)`` float32 of different classes, to guide a generator towards them.

    ``extractor`` (its name and settings) and ``projection`` are plain values; ``grid_size`` (h, w).
    """

    features: Tensor
    classes: tuple[ObjectClass, ...]
    extractor: dict[str, Any]
    projection: dict[str, Any]
    grid_size: tuple[int, int]

    def __post_init__(self) -> None:
        shape, names = tuple(self.features.shape), self.names
        if shape[:-1] != (len(names),) or len(set(names)) < len(names):
            given = f"{shape} for {', '.join(names)}"
            raise ValueError(f"needs features (C, D) of different classes, got {given}")
        if not self.features.isfinite().all():
            raise ValueError("holds NaN or infinite features")

    @property
    def names(self) -> tuple[str, ...]:
        """Class names."""
        return tuple(entry.name for entry in self.classes)

    @property
    def source(self) -> str:
        """Name of the feature source."""
        return str(self.extractor["name"])

    def feature(self, name: str) -> Tensor:
        """Mean feature ``(D,)`` of a class; ``ValueError`` lists the known ones."""
        if name not in self.names:
            known = ", ".join(self.names)
            raise ValueError(f"there is no {name!r} among the objects; there are {known}")
        return self.features[self.names.index(name)]

    def check_source(self, source: str | None, dim: int) -> None:
        """Raise ``ValueError`` where a network was aligned with another source or width."""
        own = self.features.shape[1]
        if source != self.source or dim != own:
            raise ValueError(
                f"the objects have features of {self.source!r} of width {own}, but the network is "
                f"aligned with those of {source!r} of width {dim}: make them again with `r3dpa "
                "objects --ckpt` for its checkpoint"
            )

    def save(self, path: str | Path) -> None:
        """Write a ``.safetensors`` file, atomically."""
        card = {
            "version": _VERSION,
            "classes": [asdict(entry) for entry in self.classes],
            "extractor": self.extractor,
            "projection": self.projection,
            "grid_size": list(self.grid_size),
        }
        with atomic_path(path) as temporary:
            tensors = {"features": self.features.cpu().contiguous()}
            save_file(tensors, temporary, metadata={_CARD: json.dumps(card)})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what :meth:`save` wrote; ``ValueError`` names a missing or damaged file."""
        try:
            with safe_open(path, framework="pt") as file:
                card = json.loads(file.metadata()[_CARD])
                features = file.get_tensor("features").float()
            if card["version"] != _VERSION:
                raise ValueError(f"is of version {card['version']}, this is {_VERSION}")
            classes = tuple(ObjectClass(**entry) for entry in card["classes"])
            rows, columns = card["grid_size"]
            _ = card["extractor"]["name"]
            return cls(features, classes, card["extractor"], card["projection"], (rows, columns))
        except (*UNPICKLING_ERRORS, SafetensorError) as error:
            raise ValueError(
                f"{path} holds no objects ({first_line(error)}): give the file that `r3dpa "
                "objects` wrote"
            ) from error


@torch.no_grad()  # not inference mode: a target of guidance takes part in a backward pass
def object_library(
    scans: Iterable[Scan],
    extractor: Extractor,
    projection: Projection,
    grid_size: tuple[int, int] = (8, 64),
) -> ObjectLibrary:
    """Mean feature of each class, by id, over the cells of labelled scans.

    In a cell, the features of the class's own points are averaged; the means are weighted with the
    share of the cell's points that are of the class::

        feature = sum_cells share * mean / sum_cells share

    so that a cell full of an object counts once, however many points it holds, and the rim of an
    object, where its features depend on what is behind it, counts little.

    Source: R3DPA (ICRA 2026) averages the points of the class in a single scan.

    ``grid_size`` are the rows and columns (h, w) of the cells. ``ScanError`` if a scan or its
    labels cannot be used; ``ValueError`` if no class is shown, or a feature is not finite.
    """
    cell_rows, cell_columns = projection.sensor.cell_size(grid_size)
    lift = getattr(extractor, "lift", torch.nn.Identity())
    # By class: features and directions, weighted; weight; numbers of scans, cells and points.
    found: dict[str, tuple[Any, ...]] = {}
    for scan in scans:
        whole = torch.from_numpy(read_scan(scan.path, projection.sensor))
        labels = torch.from_numpy(read_labels(scan.path, len(whole))) & 0xFFFF
        values = extractor.point_features([extractor.prepare(whole)])[0]
        points = whole[:, :3]
        row, column = projection.pixel_of(points)
        cell = row // cell_rows * grid_size[1] + column // cell_columns
        kept = in_range(points, projection.sensor)
        totals = torch.bincount(cell[kept], minlength=grid_size[0] * grid_size[1])
        for name, number in _ID.items():
            own = (kept & (labels == number)).nonzero()[:, 0]
            if len(own) == 0:
                continue
            cells, counts = cell[own].unique(return_counts=True)
            order = own[cell[own].argsort(stable=True)].to(values.device)
            first = (counts.cumsum(0) - counts).to(values.device)
            lifted = lift(F.embedding_bag(order, values.float(), first, mode="mean")).double().cpu()
            if not lifted.isfinite().all():
                raise ValueError(
                    f"{scan.path}: extractor {extractor.name} gave NaN or infinite features; leave "
                    "this scan out"
                )
            shares = counts / totals[cells].double()
            directions = shares @ F.normalize(lifted, dim=1)
            part = shares @ lifted, directions, shares.sum().item(), 1, len(cells), len(own)
            found[name] = tuple(map(add, found[name], part)) if name in found else part
    if not found:
        raise ValueError("the scans have no labelled point within range: give more scans")
    features, results = [], []
    for name in (name for name in _ID if name in found):
        total, directions, weight, num_scans, num_cells, num_points = found[name]
        mean = total / weight
        cosine = (F.normalize(mean, dim=0) @ directions / weight).item()
        features.append(mean.float())
        results.append(ObjectClass(name, num_scans, num_cells, num_points, max(0.0, 1 - cosine)))
    return ObjectLibrary(
        torch.stack(features),
        tuple(results),
        json.loads(json.dumps({"name": extractor.name, "settings": extractor.settings})),
        projection_to_dict(projection),
        (grid_size[0], grid_size[1]),
    )

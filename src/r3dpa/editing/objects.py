"""The mean feature of each labelled class of scans.

Letters: K values before the linear step, N = h * w cells, D feature width, C classes.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from operator import add
from pathlib import Path
from typing import Any, Self

import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from lidarsim.scan_files import read_scan
from r3dpa.data.feature_grids import Extractor
from r3dpa.data.labels import CLASS_NAMES, read_labels
from r3dpa.data.scans import Scan
from r3dpa.geometry import Projection, in_range, projection_to_dict
from r3dpa.io import UNPICKLING_ERRORS, atomic_path, first_line

_CARD = "r3dpa_objects"
_VERSION = 1


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
        for number, name in CLASS_NAMES.items():
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
    for name in (name for name in CLASS_NAMES.values() if name in found):
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

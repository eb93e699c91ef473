"""What objects look like to a feature extractor: one mean feature per class, from labelled scans.

Letters: P points, K values before the linear step, N = h * w cells, D feature width, C classes.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from r3dpa.data.feature_grids import Extractor
from r3dpa.data.labels import CLASS_NAMES, read_labels
from r3dpa.data.scans import Scan, read_scan
from r3dpa.geometry import Projection, in_range, projection_to_dict
from r3dpa.io import UNPICKLING_ERRORS, atomic_path, first_line

__all__ = ["ObjectClass", "ObjectLibrary", "object_library"]

_CARD = "r3dpa_objects"
_VERSION = 1


@dataclass(frozen=True)
class ObjectClass:
    """What the feature of one class was made from.

    Args:
        name: Of the class, one of :data:`r3dpa.data.labels.CLASS_NAMES`.
        num_scans: Scans that show it.
        num_cells: Cells of the feature grids that hold a point of it.
        num_points: Points within the range limits.
        spread: Mean of ``1 - cosine`` between the feature and those of the cells, in [0, 2].
    """

    name: str
    num_scans: int
    num_cells: int
    num_points: int
    spread: float


@dataclass(frozen=True)
class ObjectLibrary:
    """Mean features of classes, to guide a generator towards them.

    Args:
        features: ``(C, D)`` float32.
        classes: What each row was made from.
        extractor: ``name`` and ``settings`` of what made the features.
        projection: That of the range images, as plain values.
        grid_size: Rows and columns (h, w) of the cells.

    Raises:
        ValueError: If the rows and the classes do not fit each other, a class is named twice, or a
            feature is not finite.
    """

    features: Tensor
    classes: tuple[ObjectClass, ...]
    extractor: dict[str, Any]
    projection: dict[str, Any]
    grid_size: tuple[int, int]

    def __post_init__(self) -> None:
        """Check that the parts fit together."""
        names = self.names
        if self.features.shape[:-1] != (len(names),) or len(set(names)) < len(names):
            raise ValueError(
                f"needs features (C, D) of different classes, got {tuple(self.features.shape)} for "
                f"{', '.join(names)}"
            )
        if not self.features.isfinite().all():
            raise ValueError("holds NaN or infinite features")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the classes."""
        return tuple(entry.name for entry in self.classes)

    @property
    def source(self) -> str:
        """Name of the feature source."""
        return str(self.extractor["name"])

    def feature(self, name: str) -> Tensor:
        """Mean feature ``(D,)`` of a class.

        Raises:
            ValueError: If the library has no such class; lists those that it has.
        """
        if name not in self.names:
            raise ValueError(
                f"there is no {name!r} among the objects; there are {', '.join(self.names)}"
            )
        return self.features[self.names.index(name)]

    def check_source(self, source: str | None, dim: int) -> None:
        """Refuse features that a network was not aligned with.

        Args:
            source: Feature source that the checkpoint records, None for none.
            dim: Width of its projected features.

        Raises:
            ValueError: If one differs; names both values.
        """
        own = self.features.shape[1]
        if source != self.source or dim != own:
            raise ValueError(
                f"the objects have features of {self.source!r} of width {own}, but the network is "
                f"aligned with those of {source!r} of width {dim}: make them again with `r3dpa "
                f"objects --source {source} --dim {dim}`"
            )

    def save(self, path: str | Path) -> None:
        """Write everything to one ``.safetensors`` file, atomically.

        Raises:
            OSError: If the file cannot be written.
        """
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
        """Read what :meth:`save` wrote.

        Raises:
            ValueError: If the file is missing, damaged or of something else; it is named.
        """
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


@dataclass
class _Sums:
    """What is added up over the cells of one class, each weighted by the class's share of it.

    Args:
        dim: Width D of the features.
    """

    dim: int
    features: Tensor = field(init=False)
    directions: Tensor = field(init=False)
    weight: float = 0.0
    num_scans: int = 0
    num_cells: int = 0
    num_points: int = 0

    def __post_init__(self) -> None:
        """Start from nothing."""
        self.features = torch.zeros(self.dim, dtype=torch.float64)
        self.directions = torch.zeros(self.dim, dtype=torch.float64)

    def add(self, cells: Tensor, counts: Tensor, shares: Tensor) -> None:
        """Cells ``(M, D)`` float64 of one scan, points of the class and its share ``(M,)``."""
        self.features += shares @ cells
        self.directions += shares @ F.normalize(cells, dim=1)
        self.weight += shares.sum().item()
        self.num_scans += 1
        self.num_cells += len(cells)
        self.num_points += int(counts.sum())

    def result(self, name: str) -> tuple[Tensor, ObjectClass]:
        """Feature ``(D,)`` of the class and what it was made from."""
        mean = self.features / self.weight
        cosine = (F.normalize(mean, dim=0) @ self.directions / self.weight).item()
        counts = self.num_scans, self.num_cells, self.num_points
        return mean.float(), ObjectClass(name, *counts, max(0.0, 1 - cosine))


@torch.no_grad()  # not inference mode: a target of guidance takes part in a backward pass
def object_library(
    scans: Iterable[Scan],
    extractor: Extractor,
    projection: Projection,
    grid_size: tuple[int, int] = (8, 64),
    classes: Sequence[str] | None = None,
) -> ObjectLibrary:
    """Mean feature of each class over the cells of labelled scans.

    In a cell, the features of the class's own points are averaged. Of these means, each counts by
    the share of the cell's points that are of the class::

        feature = sum_cells share * mean / sum_cells share

    so that a cell full of an object counts once whether it holds ten points or a hundred, and the
    rim of an object, where its features know of what stands behind, counts little.

    Source: R3DPA (ICRA 2026) averages the points of the class in a single scan.

    Args:
        scans: Scans with labels, see :func:`r3dpa.data.labels.read_labels`.
        extractor: Frozen network, run where its tensors are.
        projection: That of the range images.
        grid_size: Rows and columns (h, w) of the cells.
        classes: Names of the classes; all that the scans show where None.

    Returns:
        The library, its classes in the order given, or by id.

    Raises:
        ScanError: If a scan or its labels cannot be used; names the file.
        ValueError: If a class is unknown, named twice or not in the scans, there is nothing
            labelled, the grid does not divide the range image, or a feature is not finite.
    """
    cell_rows, cell_columns = projection.sensor.cell_size(grid_size)
    wanted = _wanted(classes)
    lift = getattr(extractor, "lift", torch.nn.Identity())
    sums: dict[str, _Sums] = {}
    shown: set[int] = set()
    for scan in scans:
        points, labels, values = _features(scan, extractor, projection)
        row, column = projection.pixel_of(points)
        cell = row // cell_rows * grid_size[1] + column // cell_columns
        kept = in_range(points, projection.sensor)
        shown.update((labels[kept] & 0xFFFF).unique().tolist())
        totals = torch.bincount(cell[kept], minlength=grid_size[0] * grid_size[1])
        for name, number in wanted.items():
            own = (kept & (labels & 0xFFFF == number)).nonzero()[:, 0]
            if len(own) == 0:
                continue
            cells, counts, means = _means(own, cell[own], values)
            lifted = lift(means).double().cpu()
            if not lifted.isfinite().all():
                raise ValueError(
                    f"{scan.path}: extractor {extractor.name} gave NaN or infinite features; leave "
                    "this scan out"
                )
            counted = sums.setdefault(name, _Sums(extractor.dim))
            counted.add(lifted, counts, counts / totals[cells].double())
    missing = [name for name in wanted if name not in sums]
    if not sums or (classes is not None and missing):
        found = ", ".join(name for number, name in CLASS_NAMES.items() if number in shown)
        raise ValueError(
            f"the scans have no labelled point of {', '.join(missing)} within range; they show "
            f"{found or 'no class at all'}. Give more scans or other classes"
        )
    results = [sums[name].result(name) for name in wanted if name in sums]
    return ObjectLibrary(
        torch.stack([feature for feature, _ in results]),
        tuple(entry for _, entry in results),
        json.loads(json.dumps({"name": extractor.name, "settings": extractor.settings})),
        projection_to_dict(projection),
        (grid_size[0], grid_size[1]),
    )


def _wanted(classes: Sequence[str] | None) -> dict[str, int]:
    """Ids of classes by name."""
    ids = {name: number for number, name in CLASS_NAMES.items()}
    if classes is None:
        return ids
    if not classes or len(set(classes)) < len(classes):
        raise ValueError(f"classes must be different names, at least one, got {list(classes)}")
    if unknown := [name for name in classes if name not in ids]:
        raise ValueError(f"there is no class {', '.join(unknown)}; there are {', '.join(ids)}")
    return {name: ids[name] for name in classes}


def _features(
    scan: Scan, extractor: Extractor, projection: Projection
) -> tuple[Tensor, Tensor, Tensor]:
    """Points ``(P, 3)`` and labels ``(P,)`` of a scan on the CPU, and values ``(P, K)``."""
    points = torch.from_numpy(read_scan(scan.path, projection.sensor))
    labels = torch.from_numpy(read_labels(scan.path, points.numpy()))
    values = extractor.point_features([extractor.prepare(points)])[0]
    return points[:, :3], labels, values


def _means(own: Tensor, cell: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cells ``(M,)`` that hold some points, how many each, and their mean values ``(M, K)``.

    Args:
        own: Numbers of the points, on the CPU like ``cell``.
        cell: Cell of each of them.
        values: ``(P, K)`` of all points of the scan.
    """
    cells, counts = cell.unique(return_counts=True)
    order, first = own[cell.argsort(stable=True)], counts.cumsum(0) - counts
    device = values.device
    means = F.embedding_bag(order.to(device), values.float(), first.to(device), mode="mean")
    return cells, counts, means

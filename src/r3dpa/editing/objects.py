"""The mean feature of each labelled class of scans, and which edits come near it.

Letters: K values before the linear step, N = h * w cells, D feature width, C classes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self, cast

import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from r3dpa.data.datasets import CachedImages, points_at_pixels
from r3dpa.data.feature_grids import Extractor, grid_of_points
from r3dpa.data.labels import CLASS_NAMES, read_labels
from r3dpa.data.scans import Scan
from r3dpa.editing.editor import EditResult
from r3dpa.editing.regions import token_mask
from r3dpa.geometry import (
    LidarSensor,
    Pixels,
    Projection,
    classes_of,
    in_range,
    labels_of,
    projection_to_dict,
    values_at_returns,
)
from r3dpa.io import UNPICKLING_ERRORS, atomic_path, first_line, json_values

_CARD = "r3dpa_objects"
_VERSION = 1
# A draw fills the box of an object that holds this share of the most points of a draw.
_FILLED = 1 / 3
# It is recognised if the feature source takes this share of its points in the box for the object.
_RECOGNISED = 1 / 2
_OTHER_NAMES = {"pedestrian": "person", "tree": "vegetation"}


@dataclass(frozen=True)
class ObjectClass:
    """Statistics of one class, a name of :data:`CLASS_NAMES`.

    ``num_cells`` are the feature-grid cells that hold a point of it, ``spread`` the mean of
    ``1 - cosine`` between the feature and the features of the cells, in [0, 2].
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
        """Mean feature ``(D,)`` of a class; ``pedestrian`` is a person, ``tree`` vegetation.

        Raises:
            ValueError: If the library lacks the class; the message lists the classes that it has.
        """
        return self.features[self.names.index(self._class_name(name))]

    def semantic_class(self, name: str) -> int:
        """Place of a class of the library in :data:`r3dpa.geometry.SEMANTIC_CLASSES`.

        Raises:
            ValueError: As :meth:`feature`.
        """
        name = self._class_name(name)
        labels = {each: label for label, each in CLASS_NAMES.items()}
        return int(classes_of(torch.tensor(labels[name])))

    def _class_name(self, name: str) -> str:
        name = _OTHER_NAMES.get(name, name)
        if name not in self.names:
            raise ValueError(f"unknown class {name!r}; choose from {', '.join(self.names)}")
        return name

    def check_source(self, source: str | None, dim: int) -> None:
        """Refuse a network that was aligned with another source or width.

        Raises:
            ValueError: Naming both.
        """
        width = self.features.shape[1]
        if source != self.source or dim != width:
            raise ValueError(
                f"the objects have features of {self.source!r} of width {width}, but the network "
                f"is aligned with {source!r} of width {dim}: make them again with `r3dpa data "
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
        """Read what :meth:`save` wrote.

        Raises:
            ValueError: If the file is missing or damaged.
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
                f"{path} holds no objects ({first_line(error)}): give the file that `r3dpa data "
                "objects` wrote"
            ) from error


class _ClassSums:
    """Weighted sums over the cells of one class."""

    def __init__(self, dim: int) -> None:
        self.features = torch.zeros(dim, dtype=torch.float64)
        self.directions = torch.zeros(dim, dtype=torch.float64)
        self.weight = 0.0
        self.num_scans = self.num_cells = self.num_points = 0

    def add(self, shares: Tensor, features: Tensor, num_points: int) -> None:
        """Add the cells of a scan: their shares ``(N,)`` and features ``(N, D)``, float64."""
        self.features = self.features + shares @ features
        self.directions = self.directions + shares @ F.normalize(features, dim=1)
        self.weight += shares.sum().item()
        self.num_scans += 1
        self.num_cells += len(shares)
        self.num_points += num_points

    def mean(self) -> Tensor:
        """Mean feature ``(D,)`` float64."""
        return self.features / self.weight

    def result(self, name: str) -> ObjectClass:
        """Statistics of the class."""
        cosine = (F.normalize(self.mean(), dim=0) @ self.directions / self.weight).item()
        spread = max(0.0, 1 - cosine)
        return ObjectClass(name, self.num_scans, self.num_cells, self.num_points, spread)


@torch.no_grad()  # not inference mode: a target of guidance takes part in a backward pass
def object_library(
    scans: Iterable[Scan],
    extractor: Extractor,
    projection: Projection,
    grid_size: tuple[int, int] = (8, 64),
    images: CachedImages | None = None,
) -> ObjectLibrary:
    """Mean feature of each class, by id, over the cells of labelled scans.

    In a cell, the features of the class's own points are averaged; the means are weighted with the
    share of the cell's points that are of the class::

        feature = sum_cells share * mean / sum_cells share

    so that a cell full of an object counts once, however many points it holds, and the rim of an
    object, where its features depend on what is behind it, counts little.

    Source: R3DPA (ICRA 2026) averages the points of the class in a single scan.

    Args:
        scans: Scans with labels, see :func:`r3dpa.data.labels.read_labels`.
        extractor: Feature source of the library.
        projection: Projection whose pixels the cells consist of.
        grid_size: Rows and columns (h, w) of the cells.
        images: Cached images of the scans, whose pixels are the points; default: the scan files.

    Raises:
        ScanError: If a scan or its labels cannot be used.
        ValueError: If no point has a known class, or a feature is not finite.
    """
    sums: dict[str, _ClassSums] = {}
    for scan in scans:
        points, labels = _labelled_points(scan, projection.sensor, images)
        cells = _cells_of_classes(points, labels, extractor, projection, grid_size)
        for name, shares, features, num_points in cells:
            if not features.isfinite().all():
                raise ValueError(
                    f"{scan.path}: extractor {extractor.name} gave NaN or infinite features; leave "
                    "this scan out"
                )
            sums.setdefault(name, _ClassSums(features.shape[1])).add(shares, features, num_points)
    names = [name for name in CLASS_NAMES.values() if name in sums]
    if not names:
        raise ValueError("the scans have no labelled point within range: give more scans")
    return ObjectLibrary(
        torch.stack([sums[name].mean().float() for name in names]),
        tuple(sums[name].result(name) for name in names),
        json_values({"name": extractor.name, "settings": extractor.settings}),
        projection_to_dict(projection),
        (grid_size[0], grid_size[1]),
    )


@torch.no_grad()
def most_like_first(
    edits: EditResult,
    pixel_mask: Tensor,
    feature: Tensor,
    extractor: Extractor,
    grid_size: tuple[int, int],
    inside: Callable[[Tensor], Tensor] | None = None,
    semantic_class: int | None = None,
) -> EditResult:
    """Order the draws of an inpainted part by their likeness to an object, the greatest first.

    Likeness is the mean cosine between the feature of the object and the features of the part's
    cells, which the feature source takes from the points of the draw. The ``cosine`` of the edits
    cannot replace it: it is of features that the network predicts, which guidance may raise
    without making an object. Where the object has a box, draws come first if the feature source
    takes at least half of their points in the box for the object; draws with few points in the box
    come last, since their object stands in front of it or behind.

    Args:
        edits: Draws of :meth:`SceneEditor.inpaint`.
        pixel_mask: ``(H, W)`` bool of the part.
        feature: ``(D,)`` of the object, see :meth:`ObjectLibrary.feature`.
        extractor: Feature source of the object.
        grid_size: Rows and columns (h, w) of the cells.
        inside: Which of points ``(P, 3)`` lie in the box of the object, ``(P,)`` bool, such as
            :func:`r3dpa.editing.regions.in_box3d`. Default: the part has no box.
        semantic_class: Class of the object, see :meth:`ObjectLibrary.semantic_class`; ignored
            for feature sources without classes. Default: the order ignores classes.

    Returns:
        The edits in that order, with their ``draws`` and ``likeness``, and ``points_inside`` and
        ``points_of_class`` if there is a box.
    """
    tokens, projection = token_mask(pixel_mask, grid_size), edits.projection
    classes_of_points = None
    if semantic_class is not None and getattr(extractor, "class_head", None) is not None:
        classes_of_points = cast(Any, extractor).classes
    cosines, counts, counts_of_class = [], [], []
    for scene in edits:
        points = points_at_pixels(Pixels(scene.range_m, scene.intensity), projection)
        cells = grid_of_points(extractor, points, projection, grid_size)[tokens]
        cosines.append(F.cosine_similarity(cells, feature, dim=1).mean())
        if inside is not None:
            in_box = inside(points[:, :3])
            counts.append(in_box.sum())
            if classes_of_points is not None:
                of_class = classes_of_points(points) == semantic_class
                counts_of_class.append((in_box & of_class).sum())
    likeness = torch.stack(cosines)
    edits = replace(edits, draws=torch.arange(len(edits)), likeness=likeness)
    # Groups of draws, ordered by likeness within: likeness differs by 2 at most, so that 2 more
    # lift a draw that fills the box above the others, and 4 more one that is also recognised.
    order = likeness
    if counts:
        points_inside = torch.stack(counts)
        edits = replace(edits, points_inside=points_inside)
        order = order + 2 * _fills(points_inside)
    if counts_of_class:
        points_of_class = torch.stack(counts_of_class)
        edits = replace(edits, points_of_class=points_of_class)
        recognised = points_of_class >= _RECOGNISED * points_inside
        points_recognised = torch.where(recognised, points_of_class, 0)
        order = order + 4 * (recognised & _fills(points_recognised))
    return edits[order.argsort(descending=True, stable=True)]


def _fills(counts: Tensor) -> Tensor:
    """Whether draws fill a box, by the numbers ``(B,)`` of their points in it."""
    return (counts > 0) & (counts >= _FILLED * counts.max())


def _labelled_points(
    scan: Scan, sensor: LidarSensor, images: CachedImages | None
) -> tuple[Tensor, Tensor]:
    """Points ``(P, 4)`` of a scan, and KITTI-360 class ids ``(P,)``."""
    if images is None:
        points = torch.from_numpy(scan.read(sensor))
        return points, torch.from_numpy(read_labels(scan.path, len(points))) & 0xFFFF
    pixels = images.read(scan)
    if pixels.classes is None:
        raise ValueError("the cached images have no classes: set codec.num_classes of the data")
    classes = values_at_returns(pixels.classes, pixels.range_m, images.projection)
    return points_at_pixels(pixels, images.projection), labels_of(classes)


def _cells_of_classes(
    points: Tensor,
    labels: Tensor,
    extractor: Extractor,
    projection: Projection,
    grid_size: tuple[int, int],
) -> Iterator[tuple[str, Tensor, Tensor, int]]:
    """Cells of a scan ``(P, 4)`` by class: name, shares ``(N,)``, features ``(N, D)``, points."""
    lift = getattr(extractor, "lift", torch.nn.Identity())
    values = extractor.point_features([extractor.prepare(points)])[0]
    cell = projection.sensor.cell_of(*projection.pixel_of(points[:, :3]), grid_size)
    within = in_range(points[:, :3], projection.sensor)
    totals = torch.bincount(cell[within], minlength=grid_size[0] * grid_size[1])
    for number, name in CLASS_NAMES.items():
        selected = (within & (labels == number)).nonzero()[:, 0]
        if len(selected) == 0:
            continue
        cells, counts = cell[selected].unique(return_counts=True)
        # Points cell after cell, so that a bag is a cell.
        by_cell = selected[cell[selected].argsort(stable=True)].to(values.device)
        first = (counts.cumsum(0) - counts).to(values.device)
        means = F.embedding_bag(by_cell, values.float(), first, mode="mean")
        shares = counts / totals[cells].double()
        yield name, shares, lift(means).double().cpu(), len(selected)

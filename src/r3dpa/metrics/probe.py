"""What frozen point features know of the classes of a scene: linear probe and cell statistics.

Letters: P points, F width of point features, C classes, N = h * w cells, D width of cells.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from statistics import mean, median
from typing import Any, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from r3dpa.geometry import LidarSensor, Projection, SphericalProjection, pool_cells

Labelled = tuple[Tensor, Tensor]

_MAX_ITERATIONS = 200


class PointExtractor(Protocol):
    """What a source of features must offer, see :class:`r3dpa.data.Extractor`.

    A linear last step, ``lift``, and ``needs_labels`` are optional.
    """

    name: str

    def prepare(self, points: Tensor, *labels: Tensor) -> Any:
        """Work of the CPU for one scan ``(P, 4)``."""
        ...

    def point_features(self, prepared: Sequence[Any]) -> list[Tensor]:
        """Features ``(P, F)`` of each prepared scan."""
        ...


@dataclass(frozen=True)
class ProbeScores:
    """How well classes are told apart.

    Args:
        classes: The C label values, in the order of the matrix.
        confusion: ``(C, C)`` int64 test points: rows are the true, columns the predicted class.
    """

    classes: tuple[int, ...]
    confusion: Tensor

    @property
    def iou(self) -> dict[int, float]:
        """Intersection over union by class; NaN for a class without a test point."""
        hits = self.confusion.diagonal().double()
        truth = self.confusion.sum(dim=1)
        union = (truth + self.confusion.sum(dim=0)).double() - hits
        values = torch.where(truth > 0, hits / union.clamp_min(1), torch.nan)
        return dict(zip(self.classes, values.tolist(), strict=True))

    @property
    def mean_iou(self) -> float:
        """Mean of the IoU over the classes with test points; NaN without any test point.

        A class without a test point does not count, but points that are taken for it are missed
        by their own class.
        """
        return _known_mean(self.iou.values())

    @property
    def accuracy(self) -> float:
        """Share of the test points whose class is told right; NaN without any test point."""
        total = int(self.confusion.sum())
        return int(self.confusion.diagonal().sum()) / total if total else float("nan")

    @property
    def shares(self) -> dict[int, float]:
        """Share of the test points that each class has."""
        counts = self.confusion.sum(dim=1)
        return dict(zip(self.classes, (counts / counts.sum().clamp_min(1)).tolist(), strict=True))


@dataclass(frozen=True)
class SourceProbe:
    """What one source of features gives on the test scans.

    Args:
        name: Of the source.
        scores: Of the linear probe on all labelled test points.
        train_points: Points that the probe was fitted on.
        empty_share: Mean share of empty cells.
        neighbour_cosine: Mean of :func:`neighbour_cosine` over the scans that have it.
        ms_per_scan: Median time from points to cells, milliseconds.
    """

    name: str
    scores: ProbeScores
    train_points: int
    empty_share: float
    neighbour_cosine: float
    ms_per_scan: float


def logistic_regression(
    features: Tensor, targets: Tensor, num_classes: int, ridge: float = 1e-4
) -> tuple[Tensor, Tensor]:
    """Weights of a multinomial logistic regression on standardised principal components.

    With the covariance S of the features, L-BFGS from zero (nothing is drawn at random) minimises::

        mean cross-entropy + ridge / 2 * trace(weight^T S weight)

    The penalty is the variance of the logits, so that no invertible linear map of the features
    changes the predictions. Standardised one by one, features that are nearly copies of each
    other, as those of an untrained network, would leave the solver far from the minimum and look
    worse than they are. A class without a point is never predicted.

    Args:
        features: ``(P, F)``; float64 stays, every other type is taken as float32.
        targets: ``(P,)`` int64 class indices in ``[0, num_classes)``.
        num_classes: C.
        ridge: At least 0.

    Returns:
        ``weight`` ``(F, C)`` and ``bias`` ``(C,)``: the logits are ``features @ weight + bias``.

    Raises:
        ValueError: If there is no point, or a feature is not finite.
    """
    if not len(features):
        raise ValueError("no labelled point to fit a linear probe on; give scans with labels")
    features = features.detach()
    features = features if features.dtype == torch.float64 else features.float()
    if not features.isfinite().all():
        raise ValueError("features hold NaN or infinite values; no probe can be fitted on them")
    centre = features.mean(dim=0)
    centred = features - centre
    variances, axes = torch.linalg.eigh((centred.T @ centred).double() / len(features))
    # Along the other axes there is nothing but the rounding of float32.
    kept = variances > (1e-6 * features.abs().max()).square()
    whitening = (axes[:, kept] / variances[kept].sqrt()).to(features)
    standardised = centred @ whitening
    present, dense = targets.unique(return_inverse=True)

    weight = standardised.new_zeros(standardised.shape[1], len(present), requires_grad=True)
    bias = standardised.new_zeros(len(present), requires_grad=True)
    optimizer = torch.optim.LBFGS(
        [weight, bias],
        max_iter=_MAX_ITERATIONS,
        tolerance_grad=1e-6,
        tolerance_change=1e-9,
        history_size=20,
        line_search_fn="strong_wolfe",
    )

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = F.cross_entropy(standardised @ weight + bias, dense)
        loss = loss + ridge / 2 * weight.square().sum()
        loss.backward()
        return loss

    with torch.enable_grad():
        optimizer.step(closure)
    folded = whitening @ weight.detach()
    all_weights = folded.new_zeros(features.shape[1], num_classes)
    all_weights[:, present] = folded
    all_biases = folded.new_full((num_classes,), -torch.inf)
    all_biases[present] = bias.detach() - centre @ folded
    return all_weights, all_biases


def linear_probe(
    train_features: Tensor,
    train_labels: Tensor,
    test: Iterable[Labelled],
    classes: Sequence[int],
    ridge: float = 1e-4,
) -> ProbeScores:
    """Scores of a linear classifier of frozen features: the usual test of what they know.

    Points of other labels than ``classes`` are left out of the fit and of the test.

    Source: linear probing as in ScaLR (CVPR 2024), but fitted by :func:`logistic_regression`
    instead of epochs of stochastic gradient descent, so that it has no schedule to tune.

    Args:
        train_features: ``(P, F)``.
        train_labels: ``(P,)`` int64 labels of these points.
        test: Features and labels, scan by scan; one scan is held at a time.
        classes: The C labels to tell apart.
        ridge: See :func:`logistic_regression`.

    Returns:
        The scores over all test points.

    Raises:
        ValueError: If a class is named twice, no training point has a label of ``classes``, or a
            training feature is not finite.
    """
    if len(set(classes)) < len(classes):
        raise ValueError(f"classes name a label twice: {list(classes)}")
    targets = _class_index(train_labels.to(train_features.device), classes)
    known = targets >= 0
    weight, bias = logistic_regression(train_features[known], targets[known], len(classes), ridge)
    confusion = torch.zeros(len(classes), len(classes), dtype=torch.int64)
    for features, labels in test:
        truth = _class_index(labels, classes).to(weight.device)
        known = truth >= 0
        predicted = (features[known].to(weight) @ weight + bias).argmax(dim=1)
        pairs = truth[known] * len(classes) + predicted
        confusion += torch.bincount(pairs, minlength=confusion.numel()).view_as(confusion).cpu()
    return ProbeScores(tuple(classes), confusion)


def probe_source(
    extractor: PointExtractor,
    train: Iterable[Labelled],
    test: Iterable[Labelled],
    classes: Sequence[int],
    projection: Projection | None = None,
    grid_size: tuple[int, int] = (8, 64),
    points_per_scan: int = 2000,
    seed: int = 0,
) -> SourceProbe:
    """Linear probe, cell statistics and time of one source of features.

    The probe reads the point features before the linear last step of the source, ``lift``, which
    can add nothing that a linear probe could use; the cells are lifted, as in a feature grid.

    Args:
        extractor: The source.
        train: Points ``(P, 4)`` and labels ``(P,)`` int64 of scans: class in the lower 16 bits,
            as in KITTI-360.
        test: The same of other scans; all their points count.
        classes: Classes to tell apart; points of others are left out.
        projection: Of the grid; spherical for the default sensor where None.
        grid_size: Cells ``(h, w)``.
        points_per_scan: Points of each training scan that the probe is fitted on, drawn at
            random from those of ``classes``.
        seed: Of that draw, which is the same for every source.

    Raises:
        ValueError: As :func:`linear_probe`, and if there is no scan to fit or to test on.
    """
    projection = projection or SphericalProjection(LidarSensor())
    cells = _CellStatistics(projection, grid_size)
    generator = torch.Generator().manual_seed(seed)
    parts = [_drawn(extractor, scan, classes, points_per_scan, generator) for scan in train]
    if not parts:
        raise ValueError("no scan to fit a linear probe on; give at least one")
    features, labels = (torch.cat(column) for column in zip(*parts, strict=True))

    def extracted() -> Iterator[Labelled]:
        for points, coded in test:
            yield cells.add(extractor, points, coded), _semantic(coded)

    scores = linear_probe(features, labels, extracted(), classes)
    if not cells.times_ms:
        raise ValueError("no scan to test a linear probe on; give at least one")
    return SourceProbe(
        extractor.name,
        scores,
        len(features),
        mean(cells.empty),
        _known_mean(cells.cosines),
        median(cells.times_ms),
    )


def empty_share(grid: Tensor) -> float:
    """Share of the cells ``(N, D)`` that are empty, that is, zero throughout."""
    return float((grid == 0).all(dim=1).double().mean())


def neighbour_cosine(grid: Tensor, grid_size: tuple[int, int]) -> float:
    """Mean cosine between cells that lie beside or above each other, where neither is empty.

    How smooth a grid is: near 1, neighbours look alike. Columns wrap around, rows do not. A cell
    is the mean of the features of its points and not normalised again in a feature grid; here
    only its direction counts.

    Args:
        grid: ``(N, D)`` cells row by row, zeros where a cell is empty.
        grid_size: ``(h, w)`` with product N.

    Returns:
        The mean over the pairs; NaN where there is none.

    Raises:
        ValueError: If the grid does not have ``h * w`` cells.
    """
    rows, columns = grid_size
    if len(grid) != rows * columns:
        raise ValueError(f"{len(grid)} cells do not fill a grid of {rows} x {columns}")
    cells = F.normalize(grid.double(), dim=1, eps=torch.finfo(torch.float64).tiny)
    cells = cells.unflatten(0, grid_size)
    # Two columns are neighbours once, and one column has none.
    wrapped = torch.cat([cells, cells[:, :1]], dim=1) if columns > 2 else cells
    total, pairs = 0.0, 0
    for one, other in ((wrapped[:, :-1], wrapped[:, 1:]), (cells[:-1], cells[1:])):
        both = (one != 0).any(dim=-1) & (other != 0).any(dim=-1)
        total += float((one * other).sum(dim=-1)[both].sum())
        pairs += int(both.sum())
    return total / pairs if pairs else float("nan")


@dataclass
class _CellStatistics:
    """Statistics of the grids of scans, one number a scan."""

    projection: Projection
    grid_size: tuple[int, int]
    empty: list[float] = field(default_factory=list)
    cosines: list[float] = field(default_factory=list)
    times_ms: list[float] = field(default_factory=list)

    def add(self, extractor: PointExtractor, points: Tensor, labels: Tensor) -> Tensor:
        """Point features of a scan, ``(P, F)``, whose cells are counted in."""
        start = time.perf_counter()
        features = _features(extractor, points, labels)
        xyz = points[:, :3].to(features.device)
        grid, counts = pool_cells(xyz, features, self.projection, self.grid_size)
        lift = getattr(extractor, "lift", None)
        grid = grid if lift is None else lift(grid)
        grid = (grid * (counts > 0)[:, None]).cpu()  # the copy waits for a GPU
        self.times_ms.append(1000 * (time.perf_counter() - start))
        self.empty.append(empty_share(grid))
        self.cosines.append(neighbour_cosine(grid, self.grid_size))
        return features


def _drawn(
    extractor: PointExtractor,
    scan: Labelled,
    classes: Sequence[int],
    count: int,
    generator: torch.Generator,
) -> Labelled:
    """Features and classes of up to ``count`` points of a scan, drawn among those of classes."""
    points, coded = scan
    labels = _semantic(coded)
    known = torch.nonzero(_class_index(labels, classes) >= 0)[:, 0]
    chosen = known[torch.randperm(len(known), generator=generator)[:count]]
    features = _features(extractor, points, coded)
    return features[chosen.to(features.device)], labels[chosen]


def _features(extractor: PointExtractor, points: Tensor, labels: Tensor) -> Tensor:
    needed = (labels,) if getattr(extractor, "needs_labels", False) else ()
    with torch.no_grad():
        features = extractor.point_features([extractor.prepare(points, *needed)])[0]
    if not features.isfinite().all():
        raise ValueError(f"features of {extractor.name!r} hold NaN or infinite values")
    return features


def _semantic(coded: Tensor) -> Tensor:
    return coded & 0xFFFF


def _class_index(labels: Tensor, classes: Sequence[int]) -> Tensor:
    """Place of each label in ``classes``, -1 for labels that are none of them."""
    matches = labels[:, None] == labels.new_tensor(list(classes))
    return torch.where(matches.any(dim=1), matches.int().argmax(dim=1), -1)


def _known_mean(values: Iterable[float]) -> float:
    """Mean of the values that are not NaN; NaN where there is none."""
    known = [value for value in values if not math.isnan(value)]
    return mean(known) if known else float("nan")

"""Scans against their reconstructions: ranges, edges, missing returns, classes, intensity."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torchmetrics import Metric

from r3dpa.geometry import Pixels
from r3dpa.geometry.semantics import NUM_CLASSES, SEMANTIC_CLASSES, UNKNOWN_CLASS

EDGE_M = 0.6
"""Neighbouring pixels are on two surfaces where their ranges differ by more, metres."""
_BIN_M = 1e-3  # of the histogram that the median is taken from
_NUM_BINS = 60_000
_SUMS = (
    "error_m",
    "error_at_edges_m",
    "edges",
    "returns_of_scan",
    "returns_of_reconstruction",
    "returns_of_both",
    "returns_of_either",
    "missing_of_both",
    "missing_of_either",
    "flying_of_scan",
    "flying_of_reconstruction",
)


def flying_pixels(range_m: Tensor) -> Tensor:
    """Find pixels, bool, that lie between their left and right neighbours, far from both.

    In a cloud they are rays of points between a near and a far surface, which decoders draw where
    a scan has an edge. Images are ``(..., H, W)`` metres, -1 without a return; columns wrap around.
    """
    left, right = range_m.roll(1, -1), range_m.roll(-1, -1)
    near, far = torch.minimum(left, right), torch.maximum(left, right)
    between = (range_m > near + EDGE_M) & (range_m < far - EDGE_M)
    return between & (near > 0)


def edge_pixels(range_m: Tensor) -> Tensor:
    """Find pixels with a return, bool, at least one neighbour of which is on another surface."""
    seen = range_m > 0
    edges = torch.zeros_like(seen)
    for shift, axis in ((1, -1), (-1, -1), (1, -2), (-1, -2)):
        beside = range_m.roll(shift, axis)
        apart = seen & (beside > 0) & ((range_m - beside).abs() > EDGE_M)
        if axis == -2:  # rows do not wrap around
            apart[..., 0 if shift == 1 else -1, :] = False
        edges |= apart
    return edges


class ReconstructionQuality(Metric):
    """Errors of reconstructed range images ``(B, H, W)`` in metres, -1 without a return.

    ``compute`` returns means over pixels: ``range_error_m``, ``median_error_m`` and
    ``edge_error_m`` (at :func:`edge_pixels` of the scan) where both images have a return;
    ``return_iou`` and ``missing_iou``, intersection over union of the pixels with and without one;
    ``flying``, the share of returns that are :func:`flying_pixels`, and ``flying_scans``, the same
    share of the scans themselves.

    Example:
        >>> metric = ReconstructionQuality()
        >>> scan = torch.full((1, 4, 8), 10.0)
        >>> metric.update(scan, scan + 0.5)
        >>> metric.compute()["range_error_m"]
        0.5
    """

    full_state_update = False
    histogram: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("histogram", torch.zeros(_NUM_BINS, dtype=torch.float64), "sum")
        for name in _SUMS:
            self.add_state(name, torch.zeros((), dtype=torch.float64), "sum")

    def update(self, range_m: Tensor, reconstructed_m: Tensor) -> None:
        """Add scans and their reconstructions."""
        scan, reconstruction = range_m > 0, reconstructed_m > 0
        both, edges = scan & reconstruction, edge_pixels(range_m) & reconstruction
        error = (reconstructed_m - range_m).abs()
        bins = (error[both] / _BIN_M).long().clamp(max=_NUM_BINS - 1)
        self.histogram += torch.bincount(bins, minlength=_NUM_BINS)
        sums = {
            "error_m": error[both].double(),
            "returns_of_both": both,
            "error_at_edges_m": error[edges].double(),
            "edges": edges,
            "returns_of_either": scan | reconstruction,
            "missing_of_both": ~scan & ~reconstruction,
            "missing_of_either": ~scan | ~reconstruction,
            "flying_of_reconstruction": flying_pixels(reconstructed_m),
            "returns_of_reconstruction": reconstruction,
            "flying_of_scan": flying_pixels(range_m),
            "returns_of_scan": scan,
        }
        for name, values in sums.items():
            getattr(self, name).add_(values.sum())

    def compute(self) -> dict[str, float]:
        """Return the figures by name."""

        def ratio(numerator: str, denominator: str) -> float:
            return getattr(self, numerator).item() / max(1, getattr(self, denominator).item())

        below = self.histogram.cumsum(0)
        median = int((below < below[-1] / 2).sum())
        return {
            "range_error_m": ratio("error_m", "returns_of_both"),
            "median_error_m": (median + 0.5) * _BIN_M,
            "edge_error_m": ratio("error_at_edges_m", "edges"),
            "return_iou": ratio("returns_of_both", "returns_of_either"),
            "missing_iou": ratio("missing_of_both", "missing_of_either"),
            "flying": ratio("flying_of_reconstruction", "returns_of_reconstruction"),
            "flying_scans": ratio("flying_of_scan", "returns_of_scan"),
        }


def class_confusion(classes: Tensor, reconstructed: Tensor) -> Tensor:
    """Count pixels by class: ``(C, C + 1)`` int64, rows of the scan, columns of the reconstruction.

    Args:
        classes: Numbers of :data:`r3dpa.geometry.SEMANTIC_CLASSES`; -1, without a label, does not
            count.
        reconstructed: The same of the reconstruction; -1, without a return, is the last column.
    """
    known = classes != UNKNOWN_CLASS
    columns = reconstructed[known]
    columns = torch.where(columns == UNKNOWN_CLASS, NUM_CLASSES, columns)
    pairs = classes[known] * (NUM_CLASSES + 1) + columns
    counts = torch.bincount(pairs, minlength=NUM_CLASSES * (NUM_CLASSES + 1))
    return counts.view(NUM_CLASSES, NUM_CLASSES + 1)


def class_iou(confusion: Tensor) -> Tensor:
    """Intersection over union ``(C,)`` float64 of each class; NaN for one that is in neither.

    ``hits / (hits + misses + false alarms)`` of counts of :func:`class_confusion`.
    """
    hits = confusion.diagonal().double()
    union = confusion.sum(dim=1) + confusion[:, :-1].sum(dim=0) - hits
    return hits / union  # 0 / 0 is NaN


class LabelQuality(Metric):
    """Classes and intensity of reconstructed scans, of VAEs that have them.

    ``compute`` returns ``miou``, the mean of :func:`class_iou` over the classes that occur;
    ``iou <class>`` of each of these; ``intensity_error``, the mean absolute error where both images
    have a return.

    Example:
        >>> range_m, classes = torch.full((1, 3), 10.0), torch.tensor([[0, 0, 11]])
        >>> reconstructed = Pixels(range_m, classes=torch.tensor([[0, 11, 11]]))
        >>> quality = LabelQuality()
        >>> quality.update(Pixels(range_m, classes=classes), reconstructed)
        >>> quality.compute()
        {'miou': 0.5, 'iou road': 0.5, 'iou car': 0.5}
    """

    full_state_update = False
    confusion: Tensor
    intensity_sum: Tensor
    num_intensities: Tensor

    def __init__(self) -> None:
        super().__init__()
        confusion = torch.zeros(NUM_CLASSES, NUM_CLASSES + 1, dtype=torch.int64)
        self.add_state("confusion", confusion, "sum")
        self.add_state("intensity_sum", torch.zeros((), dtype=torch.float64), "sum")
        self.add_state("num_intensities", torch.zeros((), dtype=torch.int64), "sum")

    def update(self, scans: Pixels, reconstructed: Pixels) -> None:
        """Add scans and their reconstructions, ``(..., H, W)``."""
        if scans.classes is not None and reconstructed.classes is not None:
            self.confusion += class_confusion(scans.classes, reconstructed.classes)
        if scans.intensity is not None and reconstructed.intensity is not None:
            both = (scans.range_m > 0) & (reconstructed.range_m > 0)
            error = (reconstructed.intensity - scans.intensity).abs()
            self.intensity_sum += error[both].double().sum()
            self.num_intensities += both.sum()

    def compute(self) -> dict[str, float]:
        """Return the figures by name, without channels that were not given."""
        figures = {}
        iou = class_iou(self.confusion)
        if not iou.isnan().all():
            figures["miou"] = iou.nanmean().item()
            for semantic_class, value in zip(SEMANTIC_CLASSES, iou.tolist(), strict=True):
                if not math.isnan(value):
                    figures[f"iou {semantic_class.name}"] = value
        if self.num_intensities:
            figures["intensity_error"] = (self.intensity_sum / self.num_intensities).item()
        return figures

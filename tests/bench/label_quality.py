"""Classes and intensity of reconstructed scans; used by ``reconstruction_quality.py``."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torchmetrics import Metric

from r3dpa.geometry.semantics import NUM_CLASSES, SEMANTIC_CLASSES, UNKNOWN_CLASS


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

    def update(self, scans, reconstructed) -> None:
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

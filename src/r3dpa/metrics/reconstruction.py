"""Scans against their reconstructions: ranges, edges, missing returns."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torchmetrics import Metric

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
        """Return the figures by name, NaN where nothing was compared."""

        def ratio(numerator: str, denominator: str) -> float:
            total = getattr(self, denominator).item()
            return getattr(self, numerator).item() / total if total else math.nan

        below = self.histogram.cumsum(0)
        median = int((below < below[-1] / 2).sum())
        return {
            "range_error_m": ratio("error_m", "returns_of_both"),
            "median_error_m": (median + 0.5) * _BIN_M if below[-1] else math.nan,
            "edge_error_m": ratio("error_at_edges_m", "edges"),
            "return_iou": ratio("returns_of_both", "returns_of_either"),
            "missing_iou": ratio("missing_of_both", "missing_of_either"),
            "flying": ratio("flying_of_reconstruction", "returns_of_reconstruction"),
            "flying_scans": ratio("flying_of_scan", "returns_of_scan"),
        }

"""Range images against their reconstructions: range error, edges, missing returns."""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics import Metric

EDGE_M = 0.6
"""Neighbouring pixels are on two surfaces where their ranges differ by more, metres."""
_BIN_M = 1e-3  # of the histogram that the median is taken from
_NUM_BINS = 60_000


def flying_pixels(range_m: Tensor) -> Tensor:
    """Pixels, bool, that lie between their left and right neighbours, far from both.

    In a cloud they are rays of points between a near and a far surface, which decoders draw where
    a scan has an edge. Images are ``(..., H, W)`` metres, -1 without a return; columns wrap around.
    """
    left, right = range_m.roll(1, -1), range_m.roll(-1, -1)
    near, far = torch.minimum(left, right), torch.maximum(left, right)
    between = (range_m > near + EDGE_M) & (range_m < far - EDGE_M)
    return between & (near > 0)


def edge_pixels(range_m: Tensor) -> Tensor:
    """Pixels with a return, bool, at least one neighbour of which is on another surface."""
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
    ``flying``, the share of returns that are :func:`flying_pixels`, and ``flying_scans``, that of
    the scans themselves.
    """

    full_state_update = False
    histogram: Tensor
    sums: Tensor

    def __init__(self) -> None:
        super().__init__()
        zeros = torch.zeros(11, dtype=torch.float64)
        self.add_state("histogram", torch.zeros(_NUM_BINS, dtype=torch.float64), "sum")
        self.add_state("sums", zeros, "sum")

    def update(self, range_m: Tensor, found_m: Tensor) -> None:
        """Adds scans and their reconstructions."""
        seen, found = range_m > 0, found_m > 0
        both, edges = seen & found, edge_pixels(range_m) & found
        error = (found_m - range_m).abs()
        bins = (error[both] / _BIN_M).long().clamp(max=_NUM_BINS - 1)
        self.histogram += torch.bincount(bins, minlength=_NUM_BINS)
        counts = (
            error[both].double().sum(),
            both.sum(),
            error[edges].double().sum(),
            edges.sum(),
            (seen | found).sum(),
            (~seen & ~found).sum(),
            (~seen | ~found).sum(),
            flying_pixels(found_m).sum(),
            found.sum(),
            flying_pixels(range_m).sum(),
            seen.sum(),
        )
        self.sums += torch.stack([count.double() for count in counts])

    def compute(self) -> dict[str, float]:
        """Figures by name."""
        s = self.sums.tolist()
        below = self.histogram.cumsum(0)
        median = int((below < below[-1] / 2).sum())
        return {
            "range_error_m": s[0] / max(1, s[1]),
            "median_error_m": (median + 0.5) * _BIN_M,
            "edge_error_m": s[2] / max(1, s[3]),
            "return_iou": s[1] / max(1, s[4]),
            "missing_iou": s[5] / max(1, s[6]),
            "flying": s[7] / max(1, s[8]),
            "flying_scans": s[9] / max(1, s[10]),
        }

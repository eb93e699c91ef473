"""Distances between histograms and between curves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def wasserstein_1(
    counts_a: NDArray[np.float64], counts_b: NDArray[np.float64], bin_width: float
) -> float:
    """Earth mover's distance of two normalised histograms: the area between their CDFs.

    Counts are ``(N,)`` in the same bins of equal width; the result has the unit of ``bin_width``
    and is NaN where a histogram is empty.
    """
    if counts_a.sum() == 0 or counts_b.sum() == 0:
        return float("nan")
    cdf_a, cdf_b = counts_a.cumsum() / counts_a.sum(), counts_b.cumsum() / counts_b.sum()
    return float(np.abs(cdf_a - cdf_b).sum() * bin_width)


def jensen_shannon(counts_a: NDArray[np.float64], counts_b: NDArray[np.float64]) -> float:
    """Jensen-Shannon divergence of two normalised histograms of any shape, in nats.

    ``(KL(a | m) + KL(b | m)) / 2`` with ``m = (a + b) / 2``: 0 for equal histograms, ln 2 = 0.693
    for disjoint ones, NaN if one is empty.
    """
    if counts_a.sum() == 0 or counts_b.sum() == 0:
        return float("nan")
    shares = (counts_a / counts_a.sum(), counts_b / counts_b.sum())
    middle = (shares[0] + shares[1]) / 2
    return float(sum((p[p > 0] * np.log(p[p > 0] / middle[p > 0])).sum() / 2 for p in shares))


def curve_rmse(curve_a: NDArray[np.float64], curve_b: NDArray[np.float64]) -> float:
    """Root mean square difference of two curves over the bins that are not NaN in either."""
    both = np.isfinite(curve_a) & np.isfinite(curve_b)
    return float(np.sqrt(np.mean((curve_a[both] - curve_b[both]) ** 2))) if both.any() else np.nan

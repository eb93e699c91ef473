"""Distances of two sets of scenes in one feature space. Letters: N scenes, F feature width."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from r3dpa.metrics.distances import OVER_REAL_SCANS, SIDES, SceneMetric, check_names
from r3dpa.metrics.functional import (
    Moments,
    fd_infinity,
    frechet_distance,
    frechet_of_draws,
    merge_packed,
    polynomial_mmd,
    shared_balls,
    squared_mmd_error,
)
from r3dpa.metrics.resampling import Resampling, quantile_of_t
from r3dpa.metrics.results import MetricResult

_KID_SUBSETS, _KID_SUBSET_SIZE = 100, 1000
_KID_FEWEST = 4  # scenes of a set, so that a subset of half of them has a pair
_NORMAL_95 = 1.96  # deviations of a normal distribution that hold 95 % of it, to each side
_NEIGHBORS = 5  # of the balls of precision and recall
_NOTES_OF_SHARES = {
    "precision": "",
    "recall": OVER_REAL_SCANS,
    "density": "",
    # Real scans share their neighbours, so that missed ones come in groups.
    "coverage": f"{OVER_REAL_SCANS}; up to a fifth too narrow",
}
SHARES = tuple(_NOTES_OF_SHARES)
"""Last words of the rows of :class:`PrecisionRecall`."""


class FeatureMetric(SceneMetric):
    """Moments of all features of width F in float64, and features of the scenes in the states.

    Args:
        num_features: Width F.
        label: Name of the feature space in results; in small letters, the key of its features
            where ``update`` gets features of several spaces.
        max_real: Real scans whose features stay in the states; None for all.
    """

    real_moments: Tensor
    generated_moments: Tensor

    def __init__(self, num_features: int, label: str = "", max_real: int | None = None) -> None:
        super().__init__(max_real)
        self.num_features, self.label = num_features, label
        packed = torch.zeros(1 + num_features + num_features**2, dtype=torch.float64)
        for side in SIDES:
            self.add_state(f"{side}_moments", packed, merge_packed)
        self._add_subset_states(torch.zeros(0, num_features))

    def update(
        self,
        features: Tensor | Mapping[str, Tensor],
        real: bool,
        names: Sequence[str] | None = None,
    ) -> None:
        """Add ``(N, F)`` features, or such by space.

        Raises:
            ValueError: If features are not finite or of another width, or names are not one per
                scene; none is added then.
        """
        side = "real" if real else "generated"
        if not isinstance(features, Tensor):
            features = features[self.label.lower()]
        features = features.detach()
        check_names(names, len(features))
        added = Moments.of(features, f"{side} features")
        setattr(self, f"{side}_moments", self.moments(side).merge(added).pack())
        self._append(side, features, names)

    def moments(self, side: str) -> Moments:
        """Return the moments of all scenes."""
        return Moments.unpack(getattr(self, f"{side}_moments"))

    def rows(self, side: str) -> Tensor:
        """Return features ``(n, F)`` of the scenes in the states, by the hashes of their names.

        Draws of rows then depend on the names, not on the order of the scenes.
        """
        values = self.subset(side)[1]
        return values[self._hashes(side).argsort(stable=True)].double()

    def _both(self) -> tuple[Tensor, Tensor, tuple[int, int]]:
        """Real and generated features of the scenes in the states, and counts, generated first."""
        real, generated = self.rows("real"), self.rows("generated")
        return real, generated, (len(generated), len(real))


class FrechetDistance(FeatureMetric):
    """Fréchet distance between real and generated features: FRID, FLD, FSVD, FPVD.

    Attributes:
        reference: Mean ``(F,)`` and covariance ``(F, F)`` in place of real features, as in the
            official statistics file.

    Example:
        >>> metric = FrechetDistance(num_features=2, label="FD")
        >>> square = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
        >>> metric.update(square, real=True)
        >>> metric.update(square + 3, real=False)
        >>> round(metric.compute()["FD"], 6)
        18.0
    """

    reference: tuple[Tensor, Tensor] | None = None

    def compute(self) -> dict[str, float]:
        """Return the distance.

        Raises:
            ValueError: For fewer than F + 1 samples, which ``results`` only notes.
        """
        for side in SIDES:
            count, needed = self.count(side), self.num_features + 1
            if count < needed and (side == "generated" or self.reference is None):
                raise ValueError(
                    f"{side}: {count} samples for {self.num_features} features, at least {needed} "
                    "are needed"
                )
        return super().compute()

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """Return the distance, with an interval over the generated scenes in the states."""
        real_mean, real_covariance = self._real_moments()
        rows = self.rows("generated")
        ends = None
        if resampling.num_resamples and len(rows) > 2:
            ends = resampling.interval(
                frechet_of_draws(real_mean, real_covariance, rows), len(rows)
            )
        generated = self.moments("generated")
        covariance = generated.covariance("generated features")
        value = frechet_distance(real_mean, real_covariance, generated.mean, covariance).item()
        note, width = "", self.num_features
        fewest = min(self.count(side) or math.inf for side in SIDES)
        if fewest <= width:
            note = f"{fewest} scenes for {width} features: dominated by their small number"
        return [self._row(self.label, value, interval=ends, note=note)]

    def _real_moments(self) -> tuple[Tensor, Tensor]:
        """Mean and covariance of the real features."""
        if self.reference is not None:
            return self.reference
        real = self.moments("real")
        return real.mean, real.covariance("real features")


class FrechetInfinity(FeatureMetric):
    """Fréchet distance extrapolated to infinitely many samples, see :func:`fd_infinity`."""

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """Return the extrapolated distance with the error of the fitted line."""
        real, generated, counts = self._both()
        name, needed = f"{self.label} inf", 4 * (self.num_features + 1)
        if min(counts) < needed:
            return [self._row(name, None, counts, note=f"needs {needed} scenes of both kinds")]
        value, standard_error = fd_infinity(real, generated, resampling.generator())
        error = _NORMAL_95 * standard_error
        return [self._row(name, value, counts, interval=(value - error, value + error))]


class PolynomialMMD(FeatureMetric):
    """Kernel distance (KID) of features: unbiased at any number of samples.

    Subsets have at most 1000 scenes and half of the smaller set.
    """

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """Return the mean; its interval covers the errors of the scenes and of the subsets."""
        real, generated, counts = self._both()
        name = f"{self.label} KID"
        if min(counts) < _KID_FEWEST:
            note = f"needs {_KID_FEWEST} scenes of both kinds"
            return [self._row(name, None, counts, note=note)]
        size = min(_KID_SUBSET_SIZE, min(counts) // 2)  # subsets as large as a set would all be one
        mean, std = polynomial_mmd(real, generated, resampling.generator(), _KID_SUBSETS, size)
        if not resampling.num_resamples:
            return [self._row(name, mean, counts)]
        error_of_scenes = squared_mmd_error(real, generated)
        error = math.hypot(error_of_scenes, std / _KID_SUBSETS**0.5)
        half = quantile_of_t(len(generated) - 1) * error
        return [self._row(name, mean, counts, interval=(mean - half, mean + half))]


class PrecisionRecall(FeatureMetric):
    """Precision, recall, density and coverage, see :func:`shared_balls`."""

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """Return the four shares; intervals are over the scenes of each mean, the others fixed."""
        real, generated, counts = self._both()

        def row(share: str, value: float | None, **fields: Any) -> MetricResult:
            return self._row(f"{self.label} {share}", value, counts, direction="higher", **fields)

        if min(counts) <= _NEIGHBORS:
            note = f"needs {_NEIGHBORS + 1} scenes of both kinds"
            return [row(share, None, note=note) for share in _NOTES_OF_SHARES]
        rows = []
        for share, hits in shared_balls(real, generated, _NEIGHBORS).items():
            interval = resampling.of_mean if share == "density" else resampling.of_share
            note = _NOTES_OF_SHARES[share]
            rows.append(row(share, hits.mean().item(), interval=interval(hits), note=note))
        return rows

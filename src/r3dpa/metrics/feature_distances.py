"""Distances of two sets of scenes in one feature space. Letters: N scenes, F feature width."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

import torch
from torch import Tensor
from torchmetrics import MetricCollection

from r3dpa.metrics.distances import (
    OVER_REAL_SCANS,
    SIDES,
    BaselineDistances,
    BEVHistogramDistance,
    MinimumMatchingDistance,
    RangeHistogramDistance,
    SceneMetric,
)
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
from r3dpa.metrics.scene import EvaluationScene, Protocol
from r3dpa.metrics.scene_features import SceneFeatures

_KID_SUBSETS, _KID_SUBSET_SIZE = 100, 1000
_NORMAL_95 = 1.96  # deviations of a normal distribution that hold 95 % of it, to each side
_NEIGHBORS = 5  # of the balls of precision and recall
_BATCH = 8


class FeatureMetric(SceneMetric):
    """Moments of all features of width F in float64, and the features of the scenes that are kept.

    ``label`` names the feature space in results; in small letters it is the key of its features if
    ``update`` gets those of several spaces.
    """

    real_moments: Tensor
    generated_moments: Tensor

    def __init__(self, num_features: int, label: str = "", max_real: int | None = None) -> None:
        super().__init__(max_real)
        self.num_features, self.label = num_features, label
        empty = torch.zeros(1 + num_features + num_features**2, dtype=torch.float64)
        self._add_states("moments", empty, merge_packed)
        self._add_kept(torch.zeros(0, num_features))

    def update(
        self,
        features: Tensor | Mapping[str, Tensor],
        real: bool,
        names: Sequence[str] | None = None,
    ) -> None:
        """Add ``(N, F)`` features, or such by space; NaN or another width is a ``ValueError``."""
        side = SIDES[not real]
        values = (
            features if isinstance(features, Tensor) else features[self.label.lower()]
        ).detach()
        added = Moments.of(values, f"{side} features")
        merged = Moments.unpack(getattr(self, f"{side}_moments")).merge(added)
        setattr(self, f"{side}_moments", merged.pack())
        self._keep(side, values, names)

    def moments(self, side: str) -> Moments:
        """Of all scenes."""
        return Moments.unpack(getattr(self, f"{side}_moments"))

    def rows(self, side: str) -> Tensor:
        """Features ``(n, F)`` of the kept scenes, by the hashes of their names.

        What draws some of the rows depends on the names then, not on the order of the scenes.
        """
        values = self.kept(side)[1]
        return values[self._joined(f"{side}_order")[:, 0].argsort(stable=True)].double()

    def _both(self) -> tuple[Tensor, Tensor, tuple[int, int]]:
        """Features of the kept real and generated scenes, and their numbers, generated first."""
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
        """The distance; a ``ValueError`` for fewer than F + 1 samples, unlike in ``results``."""
        for side in SIDES:
            count, needed = self.count(side), self.num_features + 1
            if count < needed and (side == "generated" or self.reference is None):
                raise ValueError(
                    f"{side}: {count} samples for {self.num_features} features, at least {needed} "
                    "are needed"
                )
        return super().compute()

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """The distance, with an interval over the generated scenes that are kept."""
        rows, width = self.rows("generated"), self.num_features
        ends = None
        if resampling.num_resamples and len(rows) > 2:
            ends = resampling.interval(frechet_of_draws(*self._real, rows), len(rows))
        fewest = min(self.count(side) or math.inf for side in SIDES)
        few = f"{fewest} scenes for {width} features: dominated by their small number"
        generated = self.moments("generated")
        covariance = generated.covariance("generated features")
        value = frechet_distance(*self._real, generated.mean, covariance).item()
        return [self._row(self.label, value, interval=ends, note=few * (fewest <= width))]

    @property
    def _real(self) -> tuple[Tensor, Tensor]:
        """Mean and covariance of the real features."""
        real = self.moments("real")
        return self.reference or (real.mean, real.covariance("real features"))


class FrechetInfinity(FeatureMetric):
    """Fréchet distance extrapolated to infinitely many samples, see :func:`fd_infinity`."""

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """The extrapolated distance with the error of the line."""
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
        """The mean; the interval has the errors of the scenes and of the subsets drawn."""
        real, generated, counts = self._both()
        name = f"{self.label} KID"
        if min(counts) < 4:
            return [self._row(name, None, counts, note="needs 4 scenes of both kinds")]
        size = min(_KID_SUBSET_SIZE, min(counts) // 2)  # subsets as large as a set would all be one
        mean, std = polynomial_mmd(real, generated, resampling.generator(), _KID_SUBSETS, size)
        if not resampling.num_resamples:
            return [self._row(name, mean, counts)]
        of_scenes = squared_mmd_error(real, generated)
        half = quantile_of_t(len(generated) - 1) * math.hypot(of_scenes, std / _KID_SUBSETS**0.5)
        return [self._row(name, mean, counts, interval=(mean - half, mean + half))]


class PrecisionRecall(FeatureMetric):
    """Precision, recall, density and coverage, see :func:`shared_balls`."""

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """The four shares; intervals are over the scenes of each mean, with the others fixed."""
        real, generated, counts = self._both()
        fields: dict[str, dict[str, Any]]
        if min(counts) <= _NEIGHBORS:
            unknown = {"value": None, "note": f"needs {_NEIGHBORS + 1} scenes of both kinds"}
            fields = dict.fromkeys(("precision", "recall", "density", "coverage"), unknown)
        else:
            fields = {}
            for name, shares in shared_balls(real, generated, _NEIGHBORS).items():
                interval = resampling.of_mean if name == "density" else resampling.of_share
                fields[name] = {"value": shares.mean().item(), "interval": interval(shares)}
            fields["recall"]["note"] = OVER_REAL_SCANS
            # Real scans share their neighbours, so that the ones that are missed come in groups.
            fields["coverage"]["note"] = f"{OVER_REAL_SCANS}; up to a fifth too narrow"
        return [
            self._row(f"{self.label} {name}", counts=counts, direction="higher", **row)
            for name, row in fields.items()
        ]


_OF_SPACE = {
    "frechet": FrechetDistance,
    "inf": FrechetInfinity,
    "kid": PolynomialMMD,
    "shares": PrecisionRecall,
}


def scene_metrics(
    protocol: Protocol,
    spaces: Mapping[str, int],
    num_groups: int = 1,
    max_rows: int | None = None,
    max_images: tuple[int | None, int | None] = (None, None),
) -> MetricCollection:
    """All metrics of scenes: ``cells``, ``ranges``, ``matching``, ``baselines``, four a space.

    ``spaces`` has the widths by name. ``update`` takes ``clouds``, ``range_m``, ``features`` by
    space, ``names`` and ``real``; see :func:`update_with`.
    """
    metrics: dict[str, SceneMetric] = {
        "cells": BEVHistogramDistance(protocol.grid, num_groups),
        "ranges": RangeHistogramDistance(protocol.sensor.range_max_m, num_groups),
        "matching": MinimumMatchingDistance(protocol, *max_images),
        "baselines": BaselineDistances(protocol, *max_images),
    }
    groups = [["cells"], ["ranges"], ["matching", "baselines"]]
    for name, width in spaces.items():
        for kind, metric in _OF_SPACE.items():
            metrics[f"{name}_{kind}"] = metric(width, name.upper(), max_rows)
        groups.append([f"{name}_{kind}" for kind in _OF_SPACE])
    return MetricCollection(dict(metrics), compute_groups=groups)


def metrics_of(metrics: MetricCollection) -> dict[str, Any]:
    """The metrics by name; those of a feature space share their states."""
    found: dict[str, Any] = dict(metrics.items(keep_base=True, copy_state=False))
    return {name: found[name] for group in metrics.compute_groups.values() for name in group}


def update_with(
    metrics: MetricCollection,
    scenes: Sequence[EvaluationScene],
    features: Mapping[str, Tensor],
    real: bool,
) -> None:
    """Adds scenes to metrics of :func:`scene_metrics`."""
    if scenes:
        metrics.update(
            clouds=[scene.points for scene in scenes],
            range_m=torch.stack([s.range_m for s in scenes if s.range_m is not None]),
            features=features,
            names=[scene.name for scene in scenes],
            real=real,
        )


def with_features(
    scenes: Iterable[EvaluationScene], spaces: Sequence[SceneFeatures]
) -> Iterator[tuple[list[EvaluationScene], dict[str, Tensor]]]:
    """Batches of scenes with their features by space, for :func:`update_with`."""
    stream = iter(scenes)
    while batch := list(islice(stream, _BATCH)):
        yield batch, {space.name: space(batch) for space in spaces}

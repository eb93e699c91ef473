"""Distances between two sets of scenes in one feature space, as rows of a table."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from r3dpa.metrics.distances import Counts, Ends, Resampling, distance_row
from r3dpa.metrics.functional import (
    Moments,
    fd_infinity,
    frechet_distance,
    polynomial_mmd,
)
from r3dpa.metrics.functional_manifold import shared_balls
from r3dpa.metrics.results import MetricResult
from r3dpa.metrics.scene_set import SceneSet

_NUM_NEIGHBORS = 5
_KID_SUBSETS, _KID_SUBSET_SIZE = 100, 1000
_NORMAL_95 = 1.96  # deviations of a normal distribution that hold 95 % of it, to each side


class FeatureSample(NamedTuple):
    """A set of scenes in one feature space.

    Attributes:
        moments: Of all scenes.
        rows: ``(n, F)`` features of those that are kept.
    """

    moments: Moments
    rows: Tensor

    @classmethod
    def of(cls, scenes: SceneSet, space: str) -> FeatureSample:
        """Features of one space."""
        return cls(scenes.moments[space], scenes.features(space).double())

    def subset(self, size: int, generator: torch.Generator) -> FeatureSample:
        """Up to ``size`` scenes, of the kept ones, and their moments alone."""
        rows = self.rows[torch.randperm(len(self.rows), generator=generator)[:size]]
        return FeatureSample(Moments.of(rows), rows)


def feature_rows(
    label: str, real: FeatureSample, generated: FeatureSample, resampling: Resampling
) -> list[MetricResult]:
    """Fréchet distance, FD-infinity, polynomial MMD (KID), precision, recall, density and coverage.

    The intervals are over the generated scenes: bootstrap for the Fréchet distance, the error of
    the line for FD-infinity, the spread of subsets for the polynomial MMD (wider than needed), and
    of the shares the bootstrap of the scenes that they are means over (real ones for recall and
    coverage), with the balls left as they are.

    Args:
        label: Of the space.
        real: At least two scenes.
        generated: At least two scenes.
        resampling: Of the intervals.
    """
    counts = (int(generated.moments.count), int(real.moments.count))
    kept = (len(generated.rows), len(real.rows))
    mean, covariance = real.moments.mean, real.moments.covariance()
    return [
        frechet_row(label, mean, covariance, generated, resampling, counts),
        _infinity(label, real.rows, generated.rows, resampling, kept),
        _polynomial(label, real.rows, generated.rows, resampling, kept),
        *_shares(label, real.rows, generated.rows, resampling, kept),
    ]


def frechet_row(
    label: str,
    mean: Tensor,
    covariance: Tensor,
    generated: FeatureSample,
    resampling: Resampling,
    counts: Counts,
) -> MetricResult:
    """Fréchet distance to real scans of which only moments are known.

    Args:
        label: Of the space.
        mean: ``(F,)`` of the real scans.
        covariance: ``(F, F)`` of the real scans.
        generated: At least two scenes.
        resampling: Of the interval.
        counts: Generated scenes and, where it is known, real scans.
    """

    def distance(moments: Moments) -> float:
        return frechet_distance(mean, covariance, moments.mean, moments.covariance()).item()

    width, fewest = len(mean), min(count for count in counts if count is not None)
    few = f"{fewest} scenes for {width} features: tells mostly how few they are"
    ends = resampling.interval(
        lambda drawn: distance(Moments.of(generated.rows[drawn])), len(generated.rows)
    )
    return distance_row(
        label,
        label,
        distance(generated.moments),
        counts,
        interval=ends,
        note=few if fewest <= width else "",
    )


def _infinity(
    label: str, real: Tensor, generated: Tensor, resampling: Resampling, counts: tuple[int, int]
) -> MetricResult:
    needed = 4 * (real.shape[1] + 1)
    name = f"{label} inf"
    if min(counts) < needed:
        return distance_row(name, label, None, counts, note=f"needs {needed} scenes of both kinds")
    found = fd_infinity(real, generated, resampling.generator())
    error = _NORMAL_95 * found.standard_error
    return distance_row(
        name, label, found.value, counts, interval=(found.value - error, found.value + error)
    )


def _polynomial(
    label: str, real: Tensor, generated: Tensor, resampling: Resampling, counts: tuple[int, int]
) -> MetricResult:
    name = f"{label} KID"
    # Subsets as large as a set would all be one.
    size = min(_KID_SUBSET_SIZE, min(counts) // 2)
    if size < 2:
        return distance_row(name, "", None, counts, note="needs 4 scenes of both kinds")
    mean, std = polynomial_mmd(real, generated, resampling.generator(), _KID_SUBSETS, size)
    ends = (mean - _NORMAL_95 * std, mean + _NORMAL_95 * std)
    return distance_row(name, "", mean, counts, interval=ends)


def _shares(
    label: str, real: Tensor, generated: Tensor, resampling: Resampling, counts: tuple[int, int]
) -> list[MetricResult]:
    def row(name: str, value: float | None, ends: Ends | None, note: str = "") -> MetricResult:
        return MetricResult(
            f"{label} {name}",
            value,
            interval=ends,
            direction="higher",
            num_samples=counts[0],
            num_references=counts[1],
            note=note,
        )

    if min(counts) <= _NUM_NEIGHBORS:
        note = f"needs {_NUM_NEIGHBORS + 1} scenes of both kinds"
        names = ("precision", "recall", "density", "coverage")
        return [row(name, None, None, note) for name in names]

    def mean(name: str, by_scene: Tensor) -> MetricResult:
        values = by_scene.double()
        ends = resampling.interval(lambda drawn: values[drawn].mean().item(), len(values))
        return row(name, values.mean().item(), ends)

    balls = shared_balls(real, generated, _NUM_NEIGHBORS)
    return [
        mean("precision", balls.precise),
        mean("recall", balls.recalled),
        mean("density", balls.density),
        mean("coverage", balls.covered),
    ]

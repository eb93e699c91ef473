"""All metrics of scenes as one collection, and batches of scenes for it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

import torch
from torch import Tensor
from torchmetrics import MetricCollection

from r3dpa.metrics.distances import (
    BaselineDistances,
    BEVHistogramDistance,
    MinimumMatchingDistance,
    RangeHistogramDistance,
    SceneMetric,
)
from r3dpa.metrics.feature_distances import (
    FrechetDistance,
    FrechetInfinity,
    PolynomialMMD,
    PrecisionRecall,
)
from r3dpa.metrics.scene import EvaluationScene, Protocol
from r3dpa.metrics.scene_features import SceneFeatures

_METRICS_OF_SPACE = {
    "frechet": FrechetDistance,
    "inf": FrechetInfinity,
    "kid": PolynomialMMD,
    "shares": PrecisionRecall,
}
_BATCH = 8  # scenes whose features are computed together


def scene_metrics(
    protocol: Protocol,
    spaces: Mapping[str, int],
    num_groups: int = 1,
    max_rows: int | None = None,
    max_images: tuple[int | None, int | None] = (None, None),
) -> MetricCollection:
    """Return all metrics: ``cells``, ``ranges``, ``matching``, ``baselines``, four per space.

    The metrics of a feature space are ``<space>_frechet``, ``_inf``, ``_kid`` and ``_shares``.

    Args:
        protocol: Preparation of the scenes.
        spaces: Widths of the feature spaces by name.
        num_groups: Groups of generated scenes that intervals of histograms leave out.
        max_rows: Real scans whose features stay in the states; None for all.
        max_images: Real and generated scenes whose images stay in the states; None for all.

    Returns:
        Metrics whose ``update`` takes ``clouds``, ``range_m``, ``features`` by space, ``names``
        and ``real``; see :func:`update_with`.
    """
    metrics: dict[str, SceneMetric] = {
        "cells": BEVHistogramDistance(protocol.grid, num_groups),
        "ranges": RangeHistogramDistance(protocol.sensor.range_max_m, num_groups),
        "matching": MinimumMatchingDistance(protocol, *max_images),
        "baselines": BaselineDistances(protocol, *max_images),
    }
    groups = [["cells"], ["ranges"], ["matching", "baselines"]]
    for space, width in spaces.items():
        names = [f"{space}_{kind}" for kind in _METRICS_OF_SPACE]
        for name, metric in zip(names, _METRICS_OF_SPACE.values(), strict=True):
            metrics[name] = metric(width, space.upper(), max_rows)
        groups.append(names)
    return MetricCollection(dict(metrics), compute_groups=groups)


def metrics_by_name(metrics: MetricCollection) -> dict[str, Any]:
    """Return the metrics by name; metrics of one feature space share their states."""
    by_name: dict[str, Any] = dict(metrics.items(keep_base=True, copy_state=False))
    return {name: by_name[name] for group in metrics.compute_groups.values() for name in group}


def update_with(
    metrics: MetricCollection,
    scenes: Sequence[EvaluationScene],
    features: Mapping[str, Tensor],
    real: bool,
) -> None:
    """Add scenes to metrics of :func:`scene_metrics`."""
    if scenes:
        metrics.update(
            clouds=[scene.points for scene in scenes],
            range_m=torch.stack([s.range_m for s in scenes if s.range_m is not None]),
            features=features,
            names=[scene.name for scene in scenes],
            real=real,
        )


def batches_with_features(
    scenes: Iterable[EvaluationScene], spaces: Sequence[SceneFeatures]
) -> Iterator[tuple[list[EvaluationScene], dict[str, Tensor]]]:
    """Yield batches of scenes with their features by space, for :func:`update_with`."""
    stream = iter(scenes)
    while batch := list(islice(stream, _BATCH)):
        yield batch, {space.name: space(batch) for space in spaces}

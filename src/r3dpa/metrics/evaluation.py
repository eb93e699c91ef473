"""Distances of generated scenes from real ones, with intervals, floors and a verdict."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import torch

from r3dpa.feature_names import FREE_SPACES, SPACES
from r3dpa.io import source_commit
from r3dpa.metrics.collection import (
    batches_with_features,
    metrics_by_name,
    scene_metrics,
    update_with,
)
from r3dpa.metrics.distances import RANGE_BIN_M
from r3dpa.metrics.feature_distances import SHARES
from r3dpa.metrics.floors import add_floor, measure_floors, verdict, warn_of_other_sensor
from r3dpa.metrics.functional_bev import Matching
from r3dpa.metrics.official_statistics import OfficialSplit, OfficialStatistics
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.resampling import Resampling
from r3dpa.metrics.results import Evaluation, MetricResult
from r3dpa.metrics.scene import DEFAULT, EvaluationScene, Protocol, usable_scenes
from r3dpa.metrics.scene_features import SceneFeatures, feature_spaces, scene_features

AnyReference = ReferenceStatistics | OfficialStatistics

_GROUPS = 16  # of histograms, which their intervals leave out in turn
_SHOWN_MATCHES = 3  # best and worst, in the figure
_SKIP_BAD = ". --skip_bad leaves such scenes out, and lists them (`r3dpa test`: --scorer.skip_bad)"
#: Metric of the collection that gives a row without a feature space.
_METRIC_OF_ROW = {
    "JSD": "cells",
    "TV": "cells",
    "W1 range": "ranges",
    "MMD": "matching",
    "CD 3D": "matching",
    "JSD points": "baselines",
    "MMD kernel": "baselines",
    "MMD 0.5 m": "baselines",
}
#: The same for the second word of a row of a feature space; all others are shares.
_METRIC_OF_WORD = {"": "frechet", "inf": "inf", "KID": "kid"}


class TooFewScenesError(ValueError):
    """Fewer than two scenes are left that can be compared."""


class Comparison(NamedTuple):
    """An evaluation, and the data of its figures."""

    evaluation: Evaluation
    figures: dict[str, Any] | None  # for r3dpa.viz.evaluation.save_figures; None without real scans


class Measured(NamedTuple):
    """Metrics filled with generated and real scenes, and their rows."""

    metrics: dict[str, Any]  # of scene_metrics, by name
    rows: list[MetricResult]
    matching: Matching | None  # None without a real side
    names: list[str]  # of the scenes that were used
    bad: list[str]  # name and fault of each scene that was left out
    has_more: bool  # whether there are more scenes than the protocol counts


def evaluate(
    scenes: Iterable[EvaluationScene],
    reference: AnyReference,
    spaces: Sequence[SceneFeatures],
    *,
    label: str,
    source: str = "",
    made_with: Mapping[str, Any] | None = None,
    allow_few: bool = False,
    skip_bad: bool = False,
    baseline_metrics: bool = False,
    resampling: Resampling | None = None,
) -> Comparison:
    """Compare generated scenes with real ones under the protocol of the reference.

    The floor of a distance is the distance between the halves of the reference, with as many scenes
    as are evaluated, or as many as a half keeps; for precision and its relatives the note of the
    row has what the halves reach. Official statistics give no floors, and do not name their
    weights: ``spaces`` must use the same ones.

    Args:
        scenes: Read once; the first ``num_samples`` of the protocol count.
        reference: Complete statistics of the real scans.
        spaces: Feature spaces, each one of the reference.
        label: Name of the generator or run.
        source: Origin of the scenes.
        made_with: Provenance for JSON: ``solver``, ``steps``, ``seed`` and anything else.
        allow_few: Accept fewer scenes than features.
        skip_bad: Leave out scenes that are empty, hold NaN or have another size, and list them.
        baseline_metrics: Also JSD and MMD as R2DM, R2Flow and LiDM define them.
        resampling: Seed, and cost of the intervals.
    """
    resampling = resampling or Resampling()
    measured = measure(scenes, reference, spaces, resampling, allow_few, skip_bad, baseline_metrics)
    floors: dict[str, MetricResult] = {}
    if isinstance(reference, ReferenceStatistics):
        floors = measure_floors(
            reference,
            [space.name for space in spaces],
            list(measured.metrics),
            len(measured.names),
            len(measured.metrics["matching"].subset("generated")[0]),
            resampling,
        )
    provenance = {"source": source, **_provenance(made_with or {})}
    extra = provenance["extra"] | _remarks(measured, reference, floors, resampling)
    about = provenance | {
        "backbones": {space.label: dict(space.card) for space in spaces},
        "protocol": asdict(reference.protocol),
        "reference": reference.describe(),
        "commit": source_commit(),
        "extra": extra,
    }
    rows = tuple(add_floor(row, floors) for row in measured.rows)
    figures = None
    if isinstance(reference, ReferenceStatistics) and measured.matching:
        figures = _figure_data(measured, measured.matching, reference)
    return Comparison(Evaluation(label, rows, about), figures)


def measure(
    scenes: Iterable[EvaluationScene],
    reference: AnyReference,
    spaces: Sequence[SceneFeatures],
    resampling: Resampling,
    allow_few: bool = False,
    skip_bad: bool = False,
    baseline_metrics: bool = False,
) -> Measured:
    """Compute all metrics of scenes against a reference; arguments as of :func:`evaluate`."""
    reference.check(spaces)
    protocol = reference.protocol
    collection = scene_metrics(
        protocol,
        {space.name: space.dim for space in spaces},
        num_groups=_GROUPS,
        max_images=(None, protocol.num_mmd_samples),
    )
    bad: list[str] = []
    stream, names = iter(scenes), []
    usable = usable_scenes(stream, protocol, bad if skip_bad else None, _SKIP_BAD)
    for batch, features in batches_with_features(islice(usable, protocol.num_samples), spaces):
        update_with(collection, batch, features, real=False)
        names += [scene.name for scene in batch]
    try:
        has_more = next(stream, None) is not None
    except ValueError:  # a bad scene beyond the samples, which does not count
        has_more = True
    check_counts(len(names), reference, spaces, allow_few, bad)

    reference.fill(collection, spaces)
    metrics = metrics_by_name(collection)
    if not baseline_metrics:
        del metrics["baselines"]
    matching = None
    rows: list[MetricResult] = []
    for name, metric in metrics.items():
        if not metric.has_reference:
            continue
        if name == "matching":
            matching = metric.matching()
            rows += metric.results(resampling, matching)
        else:
            rows += metric.results(resampling)
    return Measured(metrics, rows, matching, names, bad, has_more)


def scene_distance(
    name: str,
    real: Iterable[Sequence[Any]],
    generated: Iterable[Sequence[Any]],
    protocol: Protocol = DEFAULT,
    ckpt: str | Path | None = None,
    device: str = "cpu",
) -> float:
    """Compute one metric between two sets of scenes, without a reference file.

    Args:
        name: As in the tables: ``JSD``, ``TV``, ``MMD``, ``CD 3D``, ``W1 range``; ``JSD points``,
            ``MMD kernel`` and ``MMD 0.5 m`` of the baselines; a feature space, such as ``FWID``,
            for its Fréchet distance, or ``FWID KID``, ``FWID precision``, ...
        real: Scenes as ``(name, points)``, points ``(P, 3)`` a tensor or array of metres, or what
            :func:`r3dpa.data.samples.read_samples` gives.
        generated: The same.
        protocol: Preparation of the scenes.
        ckpt: Official weights of the feature space.
        device: Device of its network.

    Raises:
        ValueError: If the metric is unknown, there are no scenes, it needs more, or they are not of
            this form.

    Example:
        >>> cloud = torch.tensor([[10.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
        >>> scene_distance("JSD", [("real", cloud)], [("a", cloud), ("b", cloud)])
        0.0
    """
    space, _, word = name.partition(" ")
    if name in _METRIC_OF_ROW:
        spaces, metric_name = [], _METRIC_OF_ROW[name]
    else:
        if space.lower() not in SPACES:
            raise ValueError(
                f"unknown metric {name!r}; choose from {', '.join(_METRIC_OF_ROW)}, or a feature "
                f"space: {', '.join(map(str.upper, SPACES))}"
            )
        label = space.upper()
        known = [label, *(f"{label} {further}" for further in ("inf", "KID", *SHARES))]
        if name not in known:
            raise ValueError(f"unknown metric {name!r}; choose from {', '.join(known)}")
        spaces = [scene_features(space.lower(), ckpt, protocol, device)]
        metric_name = f"{space.lower()}_{_METRIC_OF_WORD.get(word, 'shares')}"
    limits = (protocol.num_mmd_references, protocol.num_mmd_samples)
    collection = scene_metrics(protocol, {s.name: s.dim for s in spaces}, max_images=limits)
    for scenes, is_real in ((real, True), (generated, False)):
        num_scenes = 0
        for batch, features in batches_with_features(
            usable_scenes(_named_scenes(scenes), protocol), spaces
        ):
            update_with(collection, batch, features, is_real)
            num_scenes += len(batch)
        if not num_scenes:
            raise ValueError(f"there are no {'real' if is_real else 'generated'} scenes to compare")
    metric = metrics_by_name(collection)[metric_name]
    rows = {row.name: row for row in metric.results(Resampling(num_resamples=0))}
    value = rows[name].value
    if value is None:
        raise ValueError(f"{name}: {rows[name].note}")
    return value


def _named_scenes(scenes: Iterable[Any]) -> Iterator[EvaluationScene]:
    """Scenes of tuples; refuses files and bare clouds, which an iteration would take apart."""
    for scene in scenes:
        if not isinstance(scene, tuple) or len(scene) < 2:
            raise ValueError(
                "scenes must be tuples (name, points), such as r3dpa.data.read_samples gives, got "
                f"{type(scene).__name__}"
            )
        yield EvaluationScene(*scene)


def check_counts(
    num_scenes: int,
    reference: AnyReference,
    spaces: Sequence[SceneFeatures],
    allow_few: bool,
    bad: Sequence[str] = (),
) -> None:
    """Refuse a comparison of too few scenes.

    Raises:
        TooFewScenesError: Below two scenes.
        ValueError: Without ``allow_few``, if scenes or scans are not more than the features.
    """
    if num_scenes < 2:
        given = "1 generated scene" if num_scenes == 1 else "no generated scenes"
        left_out = f"; {len(bad)} cannot be used, the first is {bad[0]}" if bad else ""
        raise TooFewScenesError(f"{given}, a comparison needs at least 2{left_out}")
    counts = {"generated scenes": num_scenes, "real scans": len(reference.names) or math.inf}
    few = [
        f"{count} {what} for the {space.dim} features of {space.label}"
        for space in spaces
        for what, count in counts.items()
        if count <= space.dim
    ]
    if few and not allow_few:
        raise ValueError(
            f"{'; '.join(few)}: the covariance would be singular, and the distance dominated by "
            "sample size; give more, choose a smaller space, or allow it with --allow_few "
            "(`r3dpa test`: --scorer.allow_few true)"
        )


def load_reference(path: Path, split: OfficialSplit | None = None) -> AnyReference:
    """Load a complete reference, official if it is ``.npy``; only that one has a ``split``."""
    if path.suffix == ".npy":
        return OfficialStatistics.load(path, split)
    if split is not None:
        raise ValueError(f"{path}: is no official file; the split {split} does not apply to it")
    statistics = ReferenceStatistics.load(path)
    statistics.check()
    return statistics


def reference_spaces(
    statistics: AnyReference,
    names: Sequence[str] | None,
    ckpt: Mapping[str, Any] | None,
    device: str,
    protocol: str | None = None,
) -> list[SceneFeatures]:
    """Return the feature spaces of a comparison.

    Args:
        statistics: The reference.
        names: Spaces; default: all of the reference that need no weights, or have them.
        ckpt: Official weights by space.
        device: Device of the networks.
        protocol: Expected protocol of the reference; None for any.
    """
    given = statistics.protocol.name
    if protocol not in (None, given):
        raise ValueError(
            f"the reference is of the protocol {given}, not {protocol}: compute another one "
            f"with `r3dpa data reference --protocol {protocol}`, or name no protocol"
        )
    if names is None:
        names = [name for name in statistics.spaces if name in (*FREE_SPACES, *(ckpt or {}))]
    spaces = feature_spaces(names, ckpt, statistics.protocol, device)
    statistics.check(spaces)
    return spaces


def _provenance(made_with: Mapping[str, Any]) -> dict[str, Any]:
    """Provenance in the keys of an evaluation; all others are ``extra``."""
    extra = dict(made_with)
    keys = ("solver", "steps", "seed", "precision", "feature_source")
    return {key: extra.pop(key, None) for key in keys} | {"extra": extra}


def _remarks(
    measured: Measured,
    reference: AnyReference,
    floors: Mapping[str, MetricResult],
    resampling: Resampling,
) -> dict[str, Any]:
    """Collect what qualifies the numbers: counts, verdict, warning, rows and scenes left out."""
    remarks: dict[str, Any] = {}
    num_scenes, wanted = len(measured.names), reference.protocol.num_samples
    if measured.has_more:
        remarks["scenes"] = f"only the first {num_scenes} were used, as many as the protocol counts"
    elif num_scenes < wanted:
        remarks["scenes"] = f"{num_scenes}, where the protocol asks for {wanted}"
    if isinstance(reference, ReferenceStatistics):
        remarks["verdict"] = verdict(measured.rows, floors, num_scenes)
    else:
        remarks["left_out"] = reference.left_out
    remarks["resampling"] = asdict(resampling)
    if warning := warn_of_other_sensor(measured.metrics["matching"]):
        remarks["warning"] = warning
    if measured.bad:
        remarks["bad_samples"] = measured.bad
    return remarks


def _figure_data(
    measured: Measured, matching: Matching, reference: ReferenceStatistics
) -> dict[str, Any]:
    """Data of the figures; ``matching`` is of the real scans whose images are in the states."""
    cells, ranges = measured.metrics["cells"], measured.metrics["ranges"]
    places, samples = measured.metrics["matching"].subset("generated")
    _, scans = measured.metrics["matching"].subset("real")
    halves = [metrics_by_name(half) for half in reference.halves]
    scan_names: list[str] = []
    for index, half in enumerate(halves):
        names = reference.names_of_half(index)
        places_of_half, _ = half["matching"].subset("real")
        scan_names += [names[place] for place in places_of_half]
    matches = []
    for index in matching.squared_normalised.argsort().tolist():
        nearest = int(matching.nearest[index])
        pair = f"{measured.names[places[nearest]]} and {scan_names[index]}"
        title = f"{pair}: {matching.squared_normalised[index]:.3g}"
        matches.append((title, samples[nearest].numpy(), scans[index].numpy()))
    grid, num_bins = reference.protocol.grid, len(ranges.real_bins)
    halves_with_scans = [half["ranges"] for half in halves if half["ranges"].count("real")]
    return {
        "cells": (
            cells.generated_bins.sum(dim=0).view(grid.side, grid.side).numpy(),
            cells.real_bins.view(grid.side, grid.side).numpy(),
        ),
        "half_m": grid.half_m,
        "edges_m": (torch.arange(num_bins + 1).double() * RANGE_BIN_M).numpy(),
        "ranges": (ranges.generated_bins.sum(dim=0).numpy(), ranges.real_bins.numpy()),
        "halves": torch.stack([half.real_bins for half in halves_with_scans]).numpy(),
        "best": matches[:_SHOWN_MATCHES],
        "worst": matches[::-1][:_SHOWN_MATCHES],
        "sensor": reference.protocol.sensor,
    }

"""Distances of generated scenes from real ones, with intervals, floors and a verdict."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import torch

from r3dpa.io import source_commit
from r3dpa.metrics.distances import RANGE_BIN_M, MinimumMatchingDistance
from r3dpa.metrics.feature_distances import metrics_of, scene_metrics, update_with, with_features
from r3dpa.metrics.functional_bev import Matching
from r3dpa.metrics.official_statistics import OfficialSplit, OfficialStatistics
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.resampling import Resampling
from r3dpa.metrics.results import Evaluation, MetricResult
from r3dpa.metrics.scene import DEFAULT, EvaluationScene, Protocol, usable_scenes
from r3dpa.metrics.scene_features import FREE_SPACES, SceneFeatures, feature_spaces, scene_features

AnyReference = ReferenceStatistics | OfficialStatistics

_GROUPS = 16  # of histograms, which their intervals leave out in turn
_UNBIASED = (" inf", " KID")  # distances whose mean does not depend on how many scenes there are
_SHOWN_MATCHES = 3
_SHARES = ("precision", "recall")
_NEAR, _POOR = 1.5, 0.5  # times the floor; times the share that real scans reach
_ALIKE = 0.6  # ratio of the numbers of returns below which scenes are of another sensor
_ROWS = {"JSD": "cells", "TV": "cells", "W1 range": "ranges"}
_ROWS |= {"MMD": "matching", "CD 3D": "matching"}
_ROWS |= dict.fromkeys(("JSD points", "MMD kernel", "MMD 0.5 m"), "baselines")
_KINDS = {"": "frechet", "inf": "inf", "KID": "kid"}  # of a feature space; others are shares
_SKIP_BAD = ". --skip_bad leaves such scenes out, and lists them (`r3dpa test`: --scorer.skip_bad)"


class TooFewScenesError(ValueError):
    """Fewer than two scenes are left that can be compared."""


class Comparison(NamedTuple):
    """An evaluation, and the data of its figures."""

    evaluation: Evaluation
    figures: dict[str, Any] | None  # for r3dpa.viz.evaluation.save_figures; None without real scans


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

    The floor of a distance is that between the halves of the reference, with as many scenes as are
    evaluated, or as many as a half keeps; for precision and its relatives the note of the row has
    what the halves reach. Official statistics give no floors, and do not name their weights: those
    of ``spaces`` must be the same.

    Args:
        scenes: Read once; the first ``num_samples`` of the protocol count.
        reference: Complete statistics of the real scans.
        spaces: Feature spaces, each one of the reference.
        label: Of the generator or run.
        source: Origin of the scenes.
        made_with: Provenance for JSON: ``solver``, ``steps``, ``seed`` and anything else.
        allow_few: Accept fewer scenes than features.
        skip_bad: Leave out scenes that are empty, hold NaN or have another size, and list them.
        baseline_metrics: Also JSD and MMD as R2DM, R2Flow and LiDM define them.
        resampling: Seed, and cost of the intervals.
    """
    resampling = resampling or Resampling()
    reference.check(spaces)
    protocol = reference.protocol
    metrics = scene_metrics(
        protocol,
        {space.name: space.dim for space in spaces},
        num_groups=_GROUPS,
        max_images=(None, protocol.num_mmd_samples),
    )
    bad: list[str] | None = [] if skip_bad else None
    stream, names = iter(scenes), []
    counted = islice(usable_scenes(stream, protocol, bad, _SKIP_BAD), protocol.num_samples)
    for batch, features in with_features(counted, spaces):
        update_with(metrics, batch, features, real=False)
        names += [scene.name for scene in batch]
    more = next(stream, None) is not None
    check_counts(len(names), reference, spaces, allow_few, bad or ())

    reference.fill(metrics, spaces)
    by_name = metrics_of(metrics)
    if not baseline_metrics:
        by_name.pop("baselines")
    match = by_name["matching"]
    known = match.matching() if match.has_reference else None
    rows: list[MetricResult] = []
    for metric in by_name.values():
        if metric is match and known:
            rows += match.results(resampling, known)
        elif metric.has_reference:
            rows += metric.results(resampling)

    extra = dict(made_with or {})
    keys = ("solver", "steps", "seed", "precision", "feature_source")
    about = {key: extra.pop(key, None) for key in keys}
    if more:
        extra["scenes"] = f"only the first {len(names)} were used, as many as the protocol counts"
    elif len(names) < protocol.num_samples:
        extra["scenes"] = f"{len(names)}, where the protocol asks for {protocol.num_samples}"
    floors: dict[str, MetricResult] = {}
    if isinstance(reference, ReferenceStatistics):
        num_images = len(match.kept("generated")[0])
        key = tuple(by_name), len(names), num_images, resampling
        if key not in reference.floors:
            reference.floors[key] = _floors(reference, spaces, *key)
        floors = reference.floors[key]
        extra["verdict"] = _verdict(rows, floors)
    else:
        extra["left_out"] = reference.left_out
    extra["resampling"] = dict(vars(resampling))
    if warning := _other_sensor(match):
        extra["warning"] = warning
    if bad:
        extra["bad_samples"] = bad
    about |= {
        "backbones": {space.label: dict(space.card) for space in spaces},
        "protocol": asdict(protocol),
        "reference": reference.describe(),
        "commit": source_commit(),
        "source": source,
        "extra": extra,
    }
    evaluation = Evaluation(label, tuple(_with_floor(row, floors) for row in rows), about)
    figures = None
    if isinstance(reference, ReferenceStatistics) and known:
        figures = _figures(by_name, reference, known, names)
    return Comparison(evaluation, figures)


def scene_distance(
    name: str,
    real: Iterable[Sequence[Any]],
    generated: Iterable[Sequence[Any]],
    protocol: Protocol = DEFAULT,
    ckpt: str | Path | None = None,
    device: str = "cpu",
) -> float:
    """One metric between two sets of scenes, without a reference file, intervals and floors.

    Args:
        name: As in the tables: ``JSD``, ``TV``, ``MMD``, ``CD 3D``, ``W1 range``; those of the
            baselines, ``JSD points``, ``MMD kernel`` and ``MMD 0.5 m``; a feature space, such as
            ``FWID``, for its Fréchet distance, or ``FWID KID``, ``FWID precision``, ...
        real: Scenes as ``(name, points)``, or what :func:`r3dpa.data.samples.read_samples` gives.
        generated: The same.
        protocol: Preparation of the scenes.
        ckpt: Official weights of the feature space.
        device: Of its network.

    Example:
        >>> cloud = torch.tensor([[10.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
        >>> scene_distance("JSD", [("real", cloud)], [("made", cloud), ("again", cloud)])
        0.0
    """
    space, _, kind = name.partition(" ")
    spaces = [] if name in _ROWS else [scene_features(space.lower(), ckpt, protocol, device)]
    limits = (protocol.num_mmd_references, protocol.num_mmd_samples)
    metrics = scene_metrics(protocol, {s.name: s.dim for s in spaces}, max_images=limits)
    for scenes, is_real in ((real, True), (generated, False)):
        usable = usable_scenes((EvaluationScene(*scene) for scene in scenes), protocol)
        for batch, features in with_features(usable, spaces):
            update_with(metrics, batch, features, is_real)
    metric = metrics_of(metrics)[_ROWS.get(name) or f"{space.lower()}_{_KINDS.get(kind, 'shares')}"]
    rows = {row.name: row for row in metric.results(Resampling(num_resamples=0))}
    if name not in rows:
        raise ValueError(f"there is no metric {name!r}; of {space} there are {', '.join(rows)}")
    value = rows[name].value
    if value is None:
        raise ValueError(f"{name}: {rows[name].note}")
    return value


def check_counts(
    num_scenes: int,
    reference: AnyReference,
    spaces: Sequence[SceneFeatures],
    allow_few: bool,
    bad: Sequence[str] = (),
) -> None:
    """A ``TooFewScenesError`` below two scenes, a ``ValueError`` below the number of features."""
    if num_scenes < 2:
        left_out = f" {len(bad)} cannot be used, the first is {bad[0]}" if bad else ""
        raise TooFewScenesError(
            f"{num_scenes} generated scenes; a comparison needs at least 2.{left_out}"
        )
    counts = {"generated scenes": num_scenes, "real scans": len(reference.names) or math.inf}
    few = [
        f"{count} {what} for the {space.dim} features of {space.label}"
        for space in spaces
        for what, count in counts.items()
        if count <= space.dim
    ]
    if few and not allow_few:
        raise ValueError(
            f"{'; '.join(few)}: the covariance would be singular, and the distance tell mostly how "
            "few there are. Give more, choose a smaller space, or allow it with --allow_few "
            "(`r3dpa test`: --scorer.allow_few true)"
        )


def load_reference(path: Path, split: OfficialSplit | None = None) -> AnyReference:
    """Complete reference, official if it is ``.npy``; ``split`` is of the official file alone."""
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
    """Feature spaces of a comparison; default: those of the reference that have what they need."""
    given = statistics.protocol.name
    if protocol not in (None, given):
        raise ValueError(
            f"the reference is of the protocol {given}, not {protocol}: compute another one "
            f"with `r3dpa data reference --protocol {protocol}`, or ask for no protocol"
        )
    if names is None:
        names = [name for name in statistics.spaces if name in (*FREE_SPACES, *(ckpt or {}))]
    spaces = feature_spaces(names, ckpt, statistics.protocol, device)
    statistics.check(spaces)
    return spaces


def _floors(
    reference: ReferenceStatistics,
    spaces: Sequence[SceneFeatures],
    metric_names: Sequence[str],
    num_samples: int,
    num_images: int,
    resampling: Resampling,
) -> dict[str, MetricResult]:
    """Rows of the first half of the reference as if it were generated, against the second."""
    if min(len(reference.names_of_half(index)) for index in (0, 1)) < 2:
        return {}
    names = [space.name for space in spaces]
    metrics = reference.metrics(names, max_images=(None, num_images))
    held, other, own = map(metrics_of, (*reference.halves, metrics))
    for name, metric in own.items():
        metric.adopt_real(other[name])
    places, images = held["matching"].kept("real")
    of_first = reference.names_of_half(0)
    own["matching"].update(images, real=False, names=[of_first[place] for place in places])
    if num_samples <= len(images):
        chosen = images[held["matching"].lowest("real", num_samples)]
        own["cells"].update(own["matching"].clouds(chosen), real=False)
        own["ranges"].update(chosen, real=False)
    else:  # only sums are left of the others
        for name in ("cells", "ranges"):
            own[name].generated_bins[0] = held[name].real_bins
            own[name].generated_count = held[name].real_count.clone()
    for name in names:
        rows = held[f"{name}_frechet"].rows("real")
        chosen = torch.randperm(len(rows), generator=resampling.generator())[:num_samples]
        own[f"{name}_frechet"].update(rows[chosen], real=False)
    without = replace(resampling, num_resamples=0)
    filled = metrics_of(metrics)
    found = [row for name in metric_names for row in filled[name].results(without)]
    return {row.name: row for row in found}


def _verdict(rows: Sequence[MetricResult], floors: Mapping[str, MetricResult]) -> str:
    """Distances near their floor, and whether the scenes are realistic, in one line."""
    near, far, poor = [], [], []
    for row in rows:
        floor = floors.get(row.name)
        if floor is None or floor.value is None or row.value is None:
            continue
        if row.direction == "lower":
            if row.value <= _NEAR * max(floor.value, 0.0) + row.half_width:
                near.append(row.name)
            elif floor.value > 0:
                far.append((row.value / floor.value, row.name))
        elif row.name.endswith(_SHARES) and row.value < _POOR * floor.value:
            poor.append(f"{row.name} {row.value:.2g} (real scans {floor.value:.2g})")
    worst = ", ".join(f"{name} ({ratio:.3g} x)" for ratio, name in sorted(far, reverse=True)[:3])
    parts = [f"near the floor in {', '.join(near)}"] if near else []
    parts += [f"above it in {len(far)} distances, most in {worst}"] if far else []
    if not parts:
        return "no floors to compare with"
    if poor:
        return f"not realistic: {', '.join(poor)}" + (f", though {parts[0]}" if near else "")
    return "; ".join(parts)


def _other_sensor(match: MinimumMatchingDistance) -> str:
    """A warning if scenes and real scans differ in their number of returns by much."""
    if not match.count("real"):
        return ""
    images = (match.kept(side)[1] for side in ("generated", "real"))
    made, real = (int((range_m > 0).sum(dim=(1, 2)).median()) for range_m in images)
    if _ALIKE <= made / max(real, 1) <= 1 / _ALIKE:
        return ""
    return (
        f"{made:,} returns in a scene (median), but {real:,} in a real scan: scenes of another "
        "sensor need a reference for it, `r3dpa data reference --data` with a YAML of that sensor"
    )


def _with_floor(row: MetricResult, floors: Mapping[str, MetricResult]) -> MetricResult:
    floor = floors.get(row.name)
    if floor is None or floor.value is None or row.value is None:
        return row
    counts = f"{floor.num_samples} and {floor.num_references} scans"
    if row.direction == "higher":
        text = f"real scans reach {floor.value:.3g} ({counts})"
        return replace(row, note="; ".join(filter(None, [row.note, text])))
    text = f"floor of {counts}"
    if not row.name.endswith(_UNBIASED) and floor.num_samples != row.num_samples:
        fewer = (floor.num_samples or 0) < (row.num_samples or 0)
        text += f", rather {'high' if fewer else 'low'}: the value is of {row.num_samples} scenes"
    return replace(row, floor=max(floor.value, 0.0), note="; ".join(filter(None, [row.note, text])))


def _figures(
    metrics: Mapping[str, Any],
    reference: ReferenceStatistics,
    matching: Matching,
    names: Sequence[str],
) -> dict[str, Any]:
    """Data of the figures; ``matching`` is of the real scans that are kept."""
    grid, ranges, match = reference.protocol.grid, metrics["ranges"], metrics["matching"]
    halves = [metrics_of(half) for half in reference.halves]
    cells = [metrics["cells"].generated_bins.sum(dim=0), metrics["cells"].real_bins]
    (places, samples), (_, scans) = match.kept("generated"), match.kept("real")
    of_scans = [
        reference.names_of_half(index)[place]
        for index, half in enumerate(halves)
        for place in half["matching"].kept("real")[0]
    ]
    pairs = []
    for index in matching.squared_normalised.argsort().tolist():
        nearest = int(matching.nearest[index])
        pair = f"{names[places[nearest]]} and {of_scans[index]}"
        title = f"{pair}: {matching.squared_normalised[index]:.3g}"
        pairs.append((title, samples[nearest].numpy(), scans[index].numpy()))
    counted = [half["ranges"] for half in halves if half["ranges"].count("real")]
    return {
        "cells": tuple(part.view(grid.side, grid.side).numpy() for part in cells),
        "half_m": grid.half_m,
        "edges_m": (torch.arange(len(ranges.real_bins) + 1).double() * RANGE_BIN_M).numpy(),
        "ranges": (ranges.generated_bins.sum(dim=0).numpy(), ranges.real_bins.numpy()),
        "halves": torch.stack([half.real_bins for half in counted]).numpy(),
        "best": pairs[:_SHOWN_MATCHES],
        "worst": pairs[::-1][:_SHOWN_MATCHES],
        "sensor": reference.protocol.sensor,
    }

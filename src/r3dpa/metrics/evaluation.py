"""How near generated scenes are to real ones: all metrics with intervals, floors and a verdict."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, cast

import torch
from torchmetrics import MetricCollection

from r3dpa.io import usable_device
from r3dpa.metrics.bootstrap import Resampling
from r3dpa.metrics.distances import RANGE_BIN_M, MinimumMatchingDistance
from r3dpa.metrics.feature_distances import (
    FeatureMetric,
    metrics_of,
    scene_metrics,
    update_with,
    with_features,
)
from r3dpa.metrics.functional_bev import Matching
from r3dpa.metrics.protocol import Protocol
from r3dpa.metrics.reference import ReferenceStatistics, check_spaces
from r3dpa.metrics.results import About, Evaluation, MetricResult
from r3dpa.metrics.scene import EvaluationScene, usable_scenes
from r3dpa.metrics.scene_features import SceneFeatures, scene_features

_GROUPS = 16  # of the bootstrap of histograms
_BATCH = 8
_UNBIASED = (" inf", " KID")  # distances whose mean does not depend on how many scenes there are
_SHOWN_MATCHES = 3
_SHARES = ("precision", "recall")
_NEAR, _POOR = 1.5, 0.5  # times the floor; times the share that real scans reach
_ALIKE = 0.6  # ratio of the numbers of returns below which scenes are of another sensor
#: How a caller in Python sets an option that allows something.
PYTHON_OPTION = "{}=True"


class TooFewScenesError(ValueError):
    """Fewer than two scenes are left that can be compared."""


@dataclass(frozen=True)
class Comparison:
    """An evaluation, and the data that its figures are drawn from.

    Args:
        evaluation: All numbers.
        metrics: Of :func:`scene_metrics`, with the real and the generated scenes.
        reference: Real scans.
        matching: Of the real scans whose images are kept to the generated scenes.
        names: Of all generated scenes.
    """

    evaluation: Evaluation
    metrics: MetricCollection
    reference: ReferenceStatistics
    matching: Matching
    names: list[str]

    def figure_data(self) -> dict[str, Any]:
        """Arguments of :func:`r3dpa.viz.evaluation.save_figures`."""
        metrics: dict[str, Any] = metrics_of(self.metrics)
        protocol, ranges = self.reference.protocol, metrics["ranges"]
        cells = [metrics["cells"].generated_bins.sum(dim=0), metrics["cells"].real_bins]
        halves: list[Any] = [metrics_of(half)["ranges"] for half in self.reference.halves]
        order = self.matching.squared_normalised.argsort().tolist()
        return {
            "cells": tuple(part.view(protocol.grid.shape).numpy() for part in cells),
            "limits_m": (protocol.grid.x_m, protocol.grid.y_m),
            "edges_m": (torch.arange(len(ranges.real_bins) + 1).double() * RANGE_BIN_M).numpy(),
            "ranges": (ranges.generated_bins.sum(dim=0).numpy(), ranges.real_bins.numpy()),
            "halves": torch.stack([h.real_bins for h in halves if h.count("real")]).numpy(),
            "best": [self._pair(index) for index in order[:_SHOWN_MATCHES]],
            "worst": [self._pair(index) for index in order[::-1][:_SHOWN_MATCHES]],
            "sensor": protocol.sensor,
        }

    def _pair(self, index: int) -> tuple[str, Any, Any]:
        """Title and range images of a real scan and the sample that is nearest to it."""
        metric = cast(MinimumMatchingDistance, metrics_of(self.metrics)["matching"])
        (places, samples), (_, scans) = metric.kept("generated"), metric.kept("real")
        nearest = int(self.matching.nearest[index])
        pair = f"{self.names[places[nearest]]} and {self.reference.kept_images[index]}"
        title = f"{pair}: {self.matching.squared_normalised[index]:.3g}"
        return title, samples[nearest].numpy(), scans[index].numpy()


def evaluate(
    scenes: Iterable[EvaluationScene],
    reference: ReferenceStatistics,
    spaces: Sequence[SceneFeatures],
    *,
    label: str,
    source: str = "",
    made_with: Mapping[str, Any] | None = None,
    commit: str | None = None,
    allow_few: bool = False,
    skip_bad: bool = False,
    option: str = PYTHON_OPTION,
    batch_size: int = _BATCH,
    resampling: Resampling | None = None,
) -> Comparison:
    """Compare generated scenes with real ones under the protocol of the reference.

    Real and generated scenes take one way, :func:`r3dpa.metrics.scene.through_sensor`. The same
    scenes in the same order give the same numbers.

    The floor of a distance is that between the halves of the reference: other drives where there
    are several. It is taken at as many scenes as are evaluated, or at as many as a half keeps; the
    note of the row says so where these are fewer. Precision and its relatives are no distances:
    what the halves reach is in their notes.

    Args:
        scenes: Read once; the first ``num_samples`` of the protocol count.
        reference: Complete statistics of the real scans.
        spaces: Feature spaces, each one of the reference.
        label: Of the generator or run.
        source: Where the scenes come from.
        made_with: What is known of their making: ``solver``, ``steps``, ``seed``, ``precision``,
            ``feature_source``; anything else JSON can hold is kept, too.
        commit: Version of the code.
        allow_few: Accept fewer scenes than features.
        skip_bad: Leave out scenes that are empty, hold NaN or have another size; the result lists
            them as ``bad_samples`` of ``extra``.
        option: How the caller sets ``allow_few`` and ``skip_bad``, for messages.
        batch_size: Scenes per pass of a network.
        resampling: Seed, and cost of the intervals.

    Raises:
        TooFewScenesError: If there are fewer than two scenes.
        ValueError: If the reference is not complete or lacks a space, or there are, without
            ``allow_few``, not more scenes than features; without ``skip_bad``, if a scene is empty,
            holds NaN or has another size: it is named.
    """
    resampling = resampling or Resampling()
    reference.check_complete()
    check_spaces(reference.spaces, spaces)
    protocol = reference.protocol
    metrics = empty_metrics(protocol, spaces)
    bad: list[str] | None = [] if skip_bad else None
    names, more = gather(metrics, scenes, spaces, protocol, batch_size, bad, option)
    counts = {"generated scenes": len(names), "real scans": reference.count()}
    check_counts(counts, spaces, allow_few, option, bad or ())
    reference.fill(metrics)

    by_name = metrics_of(metrics)
    match = cast(MinimumMatchingDistance, by_name["matching"])
    known = match.matching()
    rows: list[MetricResult] = []
    for metric in by_name.values():
        rows += match.results(resampling, known) if metric is match else metric.results(resampling)
    floors = floors_of(reference, spaces, len(names), len(match.kept("generated")[0]), resampling)
    about = about_generated(len(names), more, spaces, reference, made_with, commit, source)
    extra = about["extra"] | {"verdict": verdict(rows, floors), "bootstrap": vars(resampling)}
    if warning := _other_sensor(match):
        extra["warning"] = warning
    if bad:
        extra["bad_samples"] = bad
    about["extra"] = extra
    evaluation = Evaluation(label, tuple(_with_floor(row, floors) for row in rows), about)
    return Comparison(evaluation, metrics, reference, known[0], names)


def empty_metrics(protocol: Protocol, spaces: Sequence[SceneFeatures]) -> MetricCollection:
    """Metrics of an evaluation under a protocol."""
    return scene_metrics(
        protocol,
        {space.name: (space.label, space.dim) for space in spaces},
        num_groups=_GROUPS,
        max_rows=(None, protocol.num_samples),
        max_images=(None, protocol.num_mmd_samples),
    )


def gather(
    metrics: MetricCollection,
    scenes: Iterable[EvaluationScene],
    spaces: Sequence[SceneFeatures],
    protocol: Protocol,
    batch_size: int = _BATCH,
    bad: list[str] | None = None,
    option: str = PYTHON_OPTION,
) -> tuple[list[str], bool]:
    """Updates metrics with generated scenes."""
    stream, names = iter(scenes), []
    advice = f". {option.format('skip_bad')} leaves such scenes out, and lists them"
    counted = islice(usable_scenes(stream, protocol, bad, advice), protocol.num_samples)
    for batch, features in with_features(counted, spaces, batch_size):
        update_with(metrics, batch, features, real=False)
        names += [scene.name for scene in batch]
    return names, next(stream, None) is not None


def check_counts(
    counts: Mapping[str, int],
    spaces: Sequence[SceneFeatures],
    allow_few: bool,
    option: str = PYTHON_OPTION,
    bad: Sequence[str] = (),
) -> None:
    """Refuses fewer than two scenes and, unless allowed, fewer than features.

    Raises:
        TooFewScenesError: If there are fewer than two generated scenes.
        ValueError: Naming the kinds and the spaces.
    """
    num_samples = counts["generated scenes"]
    if num_samples < 2:
        left_out = f" {len(bad)} cannot be used, the first is {bad[0]}" if bad else ""
        raise TooFewScenesError(
            f"{num_samples} generated scenes; a comparison needs at least 2.{left_out}"
        )
    few = [
        f"{count} {what} for the {space.dim} features of {space.label}"
        for space in spaces
        for what, count in counts.items()
        if count <= space.dim
    ]
    if few and not allow_few:
        raise ValueError(
            f"{'; '.join(few)}: the covariance would be singular, and the distance tell mostly how "
            "few there are. Give more, choose a smaller space, or allow it with "
            + option.format("allow_few")
        )


def about_generated(
    count: int,
    more: bool,
    spaces: Sequence[SceneFeatures],
    reference: Any,
    made_with: Mapping[str, Any] | None,
    commit: str | None,
    source: str,
) -> About:
    """Where the numbers of an evaluation come from."""
    extra, protocol = dict(made_with or {}), reference.protocol
    known = {
        key: extra.pop(key, None)
        for key in ("solver", "steps", "seed", "precision", "feature_source")
    }
    if more:
        extra["scenes"] = f"only the first {count} were used, as many as the protocol counts"
    elif count < protocol.num_samples:
        extra["scenes"] = f"{count}, where the protocol asks for {protocol.num_samples}"
    about: Any = {
        "backbones": {space.label: dict(space.card) for space in spaces},
        "protocol": protocol.to_dict(),
        "reference": reference.describe(),
        **known,
        "commit": commit,
        "published": False,
        "source": source,
        "extra": extra,
    }
    return cast(About, about)


def floors_of(
    reference: ReferenceStatistics,
    spaces: Sequence[SceneFeatures],
    num_samples: int,
    num_images: int,
    resampling: Resampling,
) -> dict[str, MetricResult]:
    """Rows of the first half of the reference as if it were generated, against the second."""
    if min(reference.count(0), reference.count(1)) < 2:
        return {}
    without = replace(resampling, num_resamples=0)
    held: dict[str, Any] = metrics_of(reference.halves[0])
    names = [space.name for space in spaces]
    metrics = reference.metrics(names, max_images=(None, num_images))
    reference.fill(metrics, 1)
    own: dict[str, Any] = metrics_of(metrics)
    places, images = held["matching"].kept("real")
    of_first = [reference.names_of_half(0)[place] for place in places]
    own["matching"].update(images, real=False, names=of_first)
    if num_samples <= len(images):
        chosen = images[held["matching"].lowest("real", num_samples)]
        own["cells"].update(own["matching"].clouds(chosen), real=False)
        own["ranges"].update(chosen, real=False)
    else:  # only sums are left of the others
        for name in ("cells", "ranges"):
            own[name].generated_bins[0] = held[name].real_bins
            own[name].generated_count = held[name].real_count.clone()
    for name in names:
        rows = cast(FeatureMetric, held[f"{name}_frechet"]).rows("real")
        chosen = torch.randperm(len(rows), generator=resampling.generator())[:num_samples]
        own[f"{name}_frechet"].update(rows[chosen], real=False)
    rows_by_name: dict[str, MetricResult] = {}
    for metric in metrics_of(metrics).values():
        rows_by_name |= {row.name: row for row in metric.results(without)}
    return rows_by_name


def verdict(rows: Sequence[MetricResult], floors: Mapping[str, MetricResult]) -> str:
    """One line: which distances are near their floor, and whether the scenes are realistic."""
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
    """A warning where scenes and real scans differ in their number of returns by much."""
    made, real = (
        int((match.kept(side)[1] > 0).sum(dim=(1, 2)).median()) for side in ("generated", "real")
    )
    if _ALIKE <= made / max(real, 1) <= 1 / _ALIKE:
        return ""
    return (
        f"{made:,} returns in a scene (median), but {real:,} in a real scan: scenes of another "
        "sensor need a reference for it, `r3dpa reference --data` with a YAML of that sensor"
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
    note = "; ".join(filter(None, [row.note, text]))
    return replace(row, floor=max(floor.value, 0.0), note=note)


def feature_spaces(
    names: Sequence[str],
    ckpt: Mapping[str, Any] | None,
    protocol: Protocol,
    device: str,
) -> list[SceneFeatures]:
    """Feature spaces by name.

    Raises:
        ValueError: If a name occurs twice, a file belongs to none of them, or as
            :func:`scene_features`.
    """
    if len(set(names)) < len(names):
        raise ValueError(f"spaces must be different names, got {', '.join(names)}")
    unused = [name for name in ckpt or {} if name not in names]
    if unused:
        raise ValueError(
            f"--ckpt.{unused[0]}: {unused[0]} is not among the spaces ({', '.join(names)}); add it "
            f"to them, or leave its file out (`r3dpa test`: --scorer.ckpt.{unused[0]})"
        )
    device = usable_device(device)
    return [scene_features(name, (ckpt or {}).get(name), protocol, device) for name in names]

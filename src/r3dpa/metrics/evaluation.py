"""How near generated scenes are to real ones: all metrics with intervals and floors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any, NamedTuple

from r3dpa.metrics.distances import Resampling, histogram_rows, matching_rows
from r3dpa.metrics.feature_distances import FeatureSample, feature_rows
from r3dpa.metrics.functional_bev import Matching
from r3dpa.metrics.protocol import Protocol
from r3dpa.metrics.reference import ReferenceStatistics, check_spaces
from r3dpa.metrics.results import About, Evaluation, MetricResult
from r3dpa.metrics.scene import EvaluationScene
from r3dpa.metrics.scene_features import SceneFeatures
from r3dpa.metrics.scene_set import SceneSet, add_scenes, usable_scenes

_GROUPS = 16  # of the bootstrap of histograms
_BATCH = 8
_UNBIASED = (" inf", " KID")  # distances whose mean does not depend on how many scenes there are
_RESAMPLING = Resampling()
#: How a caller in Python sets an option that allows something.
PYTHON_OPTION = "{}=True"


class TooFewScenesError(ValueError):
    """Not two scenes are left that can be compared."""


class Comparison(NamedTuple):
    """An evaluation, and what its figures are drawn from.

    Attributes:
        evaluation: All numbers.
        samples: Generated scenes.
        references: Real scans.
        matching: Of the real scans whose images are kept to the generated scenes.
    """

    evaluation: Evaluation
    samples: SceneSet
    references: SceneSet
    matching: Matching


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
    resampling: Resampling = _RESAMPLING,
) -> Comparison:
    """Compare generated scenes with real ones under the protocol of the reference.

    Real and generated scenes take one way, :func:`r3dpa.metrics.scene.through_sensor`. The same
    scenes in the same order give the same numbers.

    The floor of a distance is that between the halves of the reference: other drives where there
    are several. It is taken at as many scenes as are evaluated, or at as many as a half keeps; but
    JSD, TV and W1, of which only sums are kept, over all scans of both halves. Fewer scenes than
    are evaluated raise a floor and more lower it, and the note of the row then says so.
    Precision and its relatives are no distances: what the halves reach is in their notes.

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
    reference.check_complete()
    check_spaces(reference.spaces, spaces)
    protocol = reference.protocol
    bad: list[str] | None = [] if skip_bad else None
    samples, more = gather(scenes, spaces, protocol, batch_size, bad, option)
    references = reference.whole
    counts = {"generated scenes": samples.count, "real scans": references.count}
    check_counts(counts, spaces, allow_few, option, bad or ())

    rows = histogram_rows(references, samples, resampling)
    matched, matching = matching_rows(references, samples, resampling)
    rows += matched
    for space in spaces:
        real, generated = (FeatureSample.of(part, space.name) for part in (references, samples))
        rows += feature_rows(space.label, real, generated, resampling)
    floors = _floors(reference, spaces, samples, resampling)
    about = about_generated(samples.count, more, spaces, reference, made_with, commit, source)
    about["extra"] |= {"bootstrap": vars(resampling)} | ({"bad_samples": bad} if bad else {})
    evaluation = Evaluation(label, tuple(_with_floor(row, floors) for row in rows), about)
    return Comparison(evaluation, samples, references, matching)


def about_generated(
    count: int,
    more: bool,
    spaces: Sequence[SceneFeatures],
    reference: Any,
    made_with: Mapping[str, Any] | None,
    commit: str | None,
    source: str,
) -> About:
    """Where the numbers come from.

    Args:
        count: Scenes compared.
        more: Whether there were more of them than the protocol counts.
        spaces: Feature spaces.
        reference: What has their ``protocol`` and can ``describe`` itself.
        made_with: As for :func:`evaluate`.
        commit: As for :func:`evaluate`.
        source: As for :func:`evaluate`.
    """
    told, protocol = dict(made_with or {}), reference.protocol
    return {
        "backbones": {space.label: dict(space.card) for space in spaces},
        "protocol": protocol.to_dict(),
        "reference": reference.describe(),
        "solver": told.pop("solver", None),
        "steps": told.pop("steps", None),
        "seed": told.pop("seed", None),
        "precision": told.pop("precision", None),
        "feature_source": told.pop("feature_source", None),
        "commit": commit,
        "published": False,
        "source": source,
        "extra": told | _counted(count, more, protocol),
    }


def gather(
    scenes: Iterable[EvaluationScene],
    spaces: Sequence[SceneFeatures],
    protocol: Protocol,
    batch_size: int = _BATCH,
    bad: list[str] | None = None,
    option: str = PYTHON_OPTION,
) -> tuple[SceneSet, bool]:
    """Statistics of generated scenes, and whether there were more than the protocol counts.

    Args:
        scenes: Read once; the first usable ones count, as many as the protocol says.
        spaces: Feature spaces.
        protocol: How scenes are prepared.
        batch_size: Scenes per pass of a network.
        bad: Takes the messages of scenes that cannot be used. Where None, the first one stops.
        option: How the caller sets ``skip_bad``, for that message.
    """
    widths = {space.name: space.dim for space in spaces}
    samples = SceneSet(protocol, widths, protocol.num_samples, protocol.num_mmd_samples, _GROUPS)
    stream = iter(scenes)
    advice = f". {option.format('skip_bad')} leaves such scenes out, and lists them"
    counted = islice(usable_scenes(stream, protocol, bad, advice), protocol.num_samples)
    for batch, features in add_scenes(counted, spaces, batch_size):
        samples.add(batch, features)
    return samples, next(stream, None) is not None


def check_counts(
    counts: Mapping[str, int],
    spaces: Sequence[SceneFeatures],
    allow_few: bool,
    option: str = PYTHON_OPTION,
    bad: Sequence[str] = (),
) -> None:
    """Refuses fewer than two scenes and, unless allowed, fewer than features.

    Args:
        counts: How many there are of each kind; ``generated scenes`` among them.
        spaces: Feature spaces.
        allow_few: Accept fewer scenes than features.
        option: How the caller sets ``allow_few``, for the message.
        bad: Messages of generated scenes that were left out.

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


def _floors(
    reference: ReferenceStatistics,
    spaces: Sequence[SceneFeatures],
    samples: SceneSet,
    resampling: Resampling,
) -> dict[str, MetricResult]:
    """Rows of the first half of the reference as if it were generated, against the second.

    Of it, as many scans as there are samples are used where it keeps so many.
    """
    first, second = reference.halves
    if min(first.count, second.count) < 2:
        return {}
    without = replace(resampling, num_resamples=0)
    rows = histogram_rows(second, first, without)
    # The nearest of more samples is nearer, so that MMD falls with their number.
    rows += matching_rows(second, first.with_images(len(samples.images)), without)[0]
    for space in spaces:
        real, held_out = (FeatureSample.of(part, space.name) for part in (second, first))
        same_size = held_out.subset(samples.count, resampling.generator())
        rows += feature_rows(space.label, real, same_size, without)
    return {row.name: row for row in rows}


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


def _counted(count: int, more: bool, protocol: Protocol) -> dict[str, Any]:
    """What differs from the number of scenes that the protocol asks for."""
    if more:
        return {"scenes": f"only the first {count} were used, as many as the protocol counts"}
    if count < protocol.num_samples:
        return {"scenes": f"{count}, where the protocol asks for {protocol.num_samples}"}
    return {}

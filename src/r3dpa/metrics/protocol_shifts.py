"""Shift of the metrics of fixed samples by each choice in which published protocols differ."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any, Literal, NamedTuple

from torch import Tensor

from r3dpa.geometry import LidarSensor, Projection, RingProjection, SphericalProjection, range_image
from r3dpa.io import text_table
from r3dpa.metrics.evaluation import evaluate
from r3dpa.metrics.reference import ReferenceStatistics, cards_of
from r3dpa.metrics.results import Evaluation
from r3dpa.metrics.scene import PUBLISHED, EvaluationScene, Protocol
from r3dpa.metrics.scene_features import SceneFeatures

Split = Literal["all", "train", "val"]


class Choice(NamedTuple):
    """One choice of a protocol, all others as in R3DPA's, and who made it.

    ``projection`` is that of the real scans, None that of the protocol; ``share`` is of the samples
    that count, and ``split`` of the real scans.
    """

    factor: str
    choice: str
    source: str
    protocol: Protocol
    projection: Projection | None = None
    split: Split = "all"
    share: float = 1.0


def choices(sensor: LidarSensor) -> list[Choice]:
    """Choices that papers state or their code shows, for a sensor's field of view; R3DPA's first.

    Source: ``evaluate.py`` and paper of R3DPA; data and metrics of R2DM and R2Flow; LiDM.
    """
    base = replace(PUBLISHED, sensor=replace(sensor, range_min_m=1.0, range_max_m=56.0))

    def within(least: float, most: float) -> Protocol:
        return replace(base, sensor=replace(sensor, range_min_m=least, range_max_m=most))

    hiding = SphericalProjection(base.sensor, legacy_hiding=True)
    rings = RingProjection(base.sensor, (0.0,) * sensor.beams, legacy_rows=True)
    theirs = "R2DM, R2Flow"
    return [
        Choice("", "corners, 1-56 m, train and val", "R3DPA", base),
        Choice("pixel", "centre", "r3dpa", replace(base, unprojection="centre")),
        Choice("range", "0.5-63 m", f"{theirs}: metrics", within(0.5, 63.0)),
        Choice("range", "1.45-80 m", f"{theirs}: data", within(1.45, 80.0)),
        Choice("projection", "points out of range hide others", theirs, base, hiding),
        Choice("projection", "a row per ring of the scan", theirs, base, rings),
        Choice("samples", "a half", "-", base, share=0.5),
        Choice("samples", "a fifth: 2,000 for 10,000", "LiDM", base, share=0.2),
        Choice("reference", "val alone", "R3DPA", base, split="val"),
        Choice("reference", "train alone", "-", base, split="train"),
    ]


class ProtocolShifts(NamedTuple):
    """Choices and the evaluation of the same samples under each."""

    choices: list[Choice]
    evaluations: list[Evaluation]

    def entries(self) -> list[dict[str, Any]]:
        """Value, shift from the first choice, and 95 % interval of each metric by choice."""
        base = {row.name: row for row in self.evaluations[0].rows}
        found = []
        for choice, evaluation in zip(self.choices, self.evaluations, strict=True):
            metrics = {}
            for row in evaluation.rows:
                own, first = row.value, base[row.name]
                if row.direction == "lower" and own is not None and first.value is not None:
                    low, high = first.interval or (first.value, first.value)
                    metrics[row.name] = {
                        "value": own,
                        "interval": row.interval,
                        "shift": own - first.value,
                        "beyond_interval": not low <= own <= high,
                    }
            entry = {"factor": choice.factor, "choice": choice.choice, "source": choice.source}
            counts = [(row.num_samples, row.num_references) for row in evaluation.rows[:1]]
            found.append(entry | {"counts": counts[0], "metrics": metrics})
        return found

    def __str__(self) -> str:
        first, *others = self.entries()
        names = list(first["metrics"])
        lines = []
        for name in names:
            own = first["metrics"][name]
            low, high = own["interval"] or (own["value"], own["value"])
            cells = [name, f"{own['value']:.3g} [{low:.3g}, {high:.3g}]"]
            for entry in others:
                shifted = entry["metrics"].get(name)
                mark = "*" if shifted and shifted["beyond_interval"] else ""
                cells.append(f"{shifted['shift']:+.2g}{mark}" if shifted else "-")
            lines.append(cells)
        rows = [list(row) for row in zip(*lines, strict=True)]
        heads = [f"{e['factor']}: {e['choice']} ({e['source']})".lstrip(": ") for e in others]
        labels = ["", f"{first['choice']} ({first['source']})", *heads]
        table = [[label, *row] for label, row in zip(labels[1:], rows[1:], strict=True)]
        note = "shift of the value; * outside the 95 % interval of the first row"
        return f"{text_table(table, ['', *names])}\n{note}"


def protocol_shifts(
    samples: Callable[[Protocol], Iterable[EvaluationScene]],
    scans: Mapping[Split, Sequence[str]],
    points: Callable[[str], Tensor],
    spaces: Callable[[Protocol], Sequence[SceneFeatures]],
    sensor: LidarSensor,
    about: dict[str, Any],
) -> ProtocolShifts:
    """Evaluates samples under each of :func:`choices`; a split of fewer than 2 scans is left out.

    Args:
        samples: Scenes for a protocol, the same ones each time.
        scans: Names of the real scans by split.
        points: Points ``(P, 3)`` or ``(P, 4)`` of a scan.
        spaces: Feature spaces for a protocol.
        sensor: Image size and field of view.
        about: Card of the references.
    """
    kept = [choice for choice in choices(sensor) if len(scans[choice.split]) > 1]
    references: dict[Any, ReferenceStatistics] = {}
    evaluations: list[Evaluation] = []
    for choice in kept:
        protocol, found = choice.protocol, spaces(choice.protocol)
        key = (protocol, choice.projection, choice.split)
        if key not in references:
            names = scans[choice.split]
            reference = ReferenceStatistics(protocol, cards_of(found), names, about)
            reference.update((_seen(name, points(name), choice) for name in names), found)
            references[key] = reference
        total = evaluations[0].rows[0].num_samples if evaluations else None
        limit = None if total is None else max(2, round(choice.share * total))
        scenes = islice(samples(protocol), limit)
        options: dict[str, Any] = {"allow_few": True, "skip_bad": True, "baseline_metrics": True}
        compared = evaluate(scenes, references[key], found, label=choice.choice, **options)
        evaluations.append(compared.evaluation)
    return ProtocolShifts(kept, evaluations)


def _seen(name: str, points: Tensor, choice: Choice) -> EvaluationScene:
    if choice.projection is None:
        return EvaluationScene(name, points)
    return EvaluationScene(name, None, range_image(points[:, :3], choice.projection)[0])

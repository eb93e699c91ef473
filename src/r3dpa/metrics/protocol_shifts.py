"""Shift of the metrics of fixed samples by each choice in which published protocols differ."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any, Literal, NamedTuple

from torch import Tensor

from r3dpa.geometry import Projection, RingProjection, SphericalProjection, range_image
from r3dpa.io import text_table
from r3dpa.metrics.evaluation import evaluate
from r3dpa.metrics.reference import ReferenceStatistics, cards_of
from r3dpa.metrics.results import Evaluation
from r3dpa.metrics.scene import EvaluationScene, Protocol
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


def choices(base: Protocol) -> list[Choice]:
    """Choices that papers state or their code shows, one at a time changed from R3DPA's, ``base``.

    Source: ``evaluate.py`` and paper of R3DPA; data and metrics of R2DM and R2Flow; LiDM.
    """

    def within(least: float, most: float) -> Protocol:
        return replace(base, sensor=replace(base.sensor, range_min_m=least, range_max_m=most))

    base = within(1.0, 56.0)
    hiding = SphericalProjection(base.sensor, legacy_hiding=True)
    rings = RingProjection(base.sensor, (0.0,) * base.sensor.beams, legacy_rows=True)
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
        """Value, 95 % interval and shift from the first choice of each metric, by choice."""
        rows = [row for row in self.evaluations[0].rows if row.direction == "lower"]
        base, found = {row.name: (row.value, row.interval) for row in rows}, []
        for choice, evaluation in zip(self.choices, self.evaluations, strict=True):
            metrics = {}
            for row in evaluation.rows:
                value, (unshifted, interval) = row.value, base.get(row.name, (None, None))
                if value is not None and unshifted is not None and interval:
                    metrics[row.name] = {
                        "value": value,
                        "interval": row.interval,
                        "shift": value - unshifted,
                        "beyond_interval": not interval[0] <= value <= interval[1],
                    }
            count = evaluation.rows[0]
            entry = {
                "factor": choice.factor,
                "choice": choice.choice,
                "source": choice.source,
                "samples": count.num_samples,
                "scans": count.num_references,
                "metrics": metrics,
            }
            found.append(entry)
        return found

    def __str__(self) -> str:
        rows = []
        names = list(self.entries()[0]["metrics"])
        for entry in self.entries():
            cells = ["{factor}: {choice} ({source})".format(**entry).removeprefix(": ")]
            for name in names:
                cell = entry["metrics"].get(name)
                if cell is None:
                    cells.append("-")
                elif not entry["factor"]:
                    cells.append("{:.3g} [{:.3g}, {:.3g}]".format(cell["value"], *cell["interval"]))
                else:
                    cells.append(f"{cell['shift']:+.2g}{'*' * cell['beyond_interval']}")
            rows.append(cells)
        note = "below the first row: shift of the value; * outside the first row's 95 % interval"
        return f"{text_table(rows, ['', *names])}\n{note}"


def protocol_shifts(
    samples: Callable[[Protocol], Iterable[EvaluationScene]],
    scans: Mapping[Split, Sequence[str]],
    points: Callable[[str], Tensor],
    spaces: Callable[[Protocol], Sequence[SceneFeatures]],
    base: Protocol,
    about: dict[str, Any],
) -> ProtocolShifts:
    """Evaluates samples under each of :func:`choices`; a split of fewer than 2 scans is left out.

    Args:
        samples: Scenes for a protocol, the same ones each time.
        scans: Names of the real scans by split.
        points: Points ``(P, 3)`` or ``(P, 4)`` of a scan.
        spaces: Feature spaces for a protocol.
        base: Protocol of R3DPA, with image size and field of view of the sensor.
        about: Card of the references.
    """
    kept = [choice for choice in choices(base) if len(scans[choice.split]) > 1]
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

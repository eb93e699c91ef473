"""Tables of an ablation: means over seeds, the paper's numbers beside them, and its orders."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from statistics import fmean, stdev
from typing import Literal

from scipy.stats import t as student

from r3dpa.ablation.curves import curves_of
from r3dpa.ablation.plan import Plan, Stage, Table
from r3dpa.ablation.runner import evaluation_of
from r3dpa.atomic import atomic_path
from r3dpa.metrics.result_table import EvaluationTable
from r3dpa.metrics.results import About, Evaluation, MetricResult
from r3dpa.metrics.scene_features import SPACES

__all__ = ["OrderResult", "mean_of_seeds", "order_results", "write_table"]

_DISTANCES = ("JSD", "MMD", *(space.upper() for space in SPACES))
_LEVEL = 0.95
_POINTS = 100  # at most, of a curve in the JSON file

Results = Mapping[str, Mapping[int, Evaluation]]
"""Evaluations by row and seed; a failed one is missing."""


@dataclass(frozen=True)
class OrderResult:
    """What became of one order of the paper, in one metric.

    Args:
        first: Row that the paper has as better, or as alike.
        second: The other row.
        claim: What the paper says.
        metric: Name of the metric.
        verdicts: For each seed that both rows have: is ``first`` ``better``, ``worse``, or can it
            not be told (``tie``)?
        change: Mean over the seeds of the relative difference of ``first`` to ``second``.
    """

    first: str
    second: str
    claim: Literal["better", "alike"]
    metric: str
    verdicts: tuple[Literal["better", "tie", "worse"], ...]
    change: float

    @property
    def holds(self) -> Literal["yes", "no", "unclear"]:
        """Whether all seeds agree with the claim, or all disagree.

        *Alike* is what is not better, or worse, in all seeds.
        """
        same = len(set(self.verdicts)) == 1 and self.verdicts[0] != "tie"
        if self.claim == "alike":
            return "no" if same else "yes"
        if not same:
            return "unclear"
        return "yes" if self.verdicts[0] == "better" else "no"


def mean_of_seeds(label: str, evaluations: Sequence[Evaluation]) -> Evaluation:
    """One evaluation of several that differ in their seed alone.

    The interval of a value is Student's, of the mean over the seeds; that of a single seed stays
    the one of its scenes. A metric without a value in one of them has none.

    Args:
        label: Of the row.
        evaluations: At least one.
    """
    first = evaluations[0]
    if len(evaluations) == 1:
        return replace(first, label=label)
    rows = []
    for row in first.rows:
        found = [other for e in evaluations if (other := e.row(row.name)) is not None]
        values = [other.value for other in found if other.value is not None]
        if len(values) < len(evaluations):
            rows.append(replace(row, value=None, interval=None, note="not in every seed"))
            continue
        mean, num = fmean(values), len(values)
        half = student.ppf((1 + _LEVEL) / 2, num - 1) * stdev(values) / math.sqrt(num)
        rows.append(replace(row, value=mean, interval=(mean - half, mean + half), note=""))
    seeds = {"seeds": len(evaluations), "of each seed": [e.about["source"] for e in evaluations]}
    about: About = {**first.about, "seed": None, "extra": {**first.about["extra"], **seeds}}
    return Evaluation(label, tuple(rows), about)


def order_results(table: Table, results: Results, metrics: Sequence[str]) -> list[OrderResult]:
    """What became of the orders of the paper, as far as there are results."""
    found = []
    claims: tuple[tuple[Literal["better", "alike"], tuple[tuple[str, str], ...]], ...]
    claims = (("better", table.better), ("alike", table.alike))
    for claim, pairs in claims:
        for first, second in pairs:
            ours, theirs = results.get(first, {}), results.get(second, {})
            for metric in metrics:
                both = [
                    (a, b)
                    for seed in sorted(ours.keys() & theirs.keys())
                    if (a := ours[seed].row(metric)) and (b := theirs[seed].row(metric))
                ]
                if both:
                    changes = [_change(a, b) for a, b in both]
                    verdicts = tuple(_verdict(a, b) for a, b in both)
                    found.append(
                        OrderResult(first, second, claim, metric, verdicts, fmean(changes))
                    )
    return found


def _verdict(ours: MetricResult, theirs: MetricResult) -> Literal["better", "tie", "worse"]:
    """Told by the intervals of the scenes; the floor is the same for both and says nothing here."""
    ours, theirs = replace(ours, floor=None), replace(theirs, floor=None)
    if ours.ties_with(theirs):
        return "tie"
    assert ours.value is not None
    assert theirs.value is not None
    return "better" if (ours.value < theirs.value) == (ours.direction == "lower") else "worse"


def _change(ours: MetricResult, theirs: MetricResult) -> float:
    assert ours.value is not None
    assert theirs.value is not None
    return (ours.value - theirs.value) / abs(theirs.value) if theirs.value else 0.0


def write_table(
    plan: Plan, table: Table, out: Path, failed: Mapping[str, str]
) -> tuple[str, Results]:
    """Writes ``<out>/<table>.md``, ``.tex``, ``.csv`` and ``.json`` of what is there.

    The distances are in the first two; the CSV has every metric, and the JSON every seed, the
    training curves, the orders of the paper and the failures.

    Args:
        plan: The plan that was run.
        table: One of its tables.
        out: Folder of the ablation.
        failed: Why processes failed, by name.

    Returns:
        The table for the terminal, and the evaluations by row and seed.
    """
    results: dict[str, dict[int, Evaluation]] = {}
    for row in table.rows:
        results[row.key] = {}
        for seed in plan.seeds:
            stage = row.tested(seed)
            path = evaluation_of(out, stage)
            if f"test of {stage.name}" not in failed and path.is_file():
                results[row.key][seed] = Evaluation.load(path)
    own = [
        mean_of_seeds(row.label, list(results[row.key].values()))
        for row in table.rows
        if results[row.key]
    ]
    lost = [
        f"{row.label}, seed {seed}: no result"
        for row in table.rows
        for seed in plan.seeds
        if seed not in results[row.key]
    ]
    if not own:
        return f"{table.name}: {table.caption}\n\nno row has a result", results
    distances = [
        replace(e, rows=tuple(row for row in e.rows if row.name in _DISTANCES)) for e in own
    ]
    shown = EvaluationTable((*_published(table), *distances))
    metrics = [name for name in shown.metrics if any(e.row(name) for e in distances)]
    orders = order_results(table, results, metrics)
    head = (
        f"{table.caption} Scale {plan.scale.name}: {plan.scale.about} Seeds "
        f"{', '.join(map(str, plan.seeds))}."
    )
    if len(plan.seeds) > 1:
        head += " Intervals are Student's, of the mean over the seeds."
    told = [*_told(table, orders), *lost]
    with atomic_path(out / f"{table.name}.md") as temporary:
        listed = "\n".join(f"- {line}" for line in told)
        text = f"# {table.name}\n\n{head}\n\n{shown.markdown()}\n{listed}\n"
        temporary.write_text(text, encoding="utf-8")
    with atomic_path(out / f"{table.name}.tex") as temporary:
        temporary.write_text(f"% {' '.join(head.split())}\n{shown.latex()}", encoding="utf-8")
    EvaluationTable(tuple(own)).save(out / f"{table.name}.csv")
    _save_json(plan, table, out, results, orders, failed)
    return "\n".join([f"{table.name}: {head}", "", str(shown), *told]), results


def _told(table: Table, orders: Sequence[OrderResult]) -> list[str]:
    """Each order of the paper in a line."""
    labels = {row.key: row.label for row in table.rows}
    lines: dict[tuple[str, str, str], list[str]] = {}
    for order in orders:
        counts = ", ".join(
            f"{verdict} {order.verdicts.count(verdict)}"
            for verdict in ("better", "tie", "worse")
            if verdict in order.verdicts
        )
        lines.setdefault((order.first, order.second, order.claim), []).append(
            f"{order.metric} {order.holds} ({100 * order.change:+.0f} %; seeds: {counts})"
        )
    words = {"better": "better than", "alike": "like"}
    return [
        f"Paper: {labels[first]} {words[claim]} {labels[second]}. Here: {'; '.join(found)}"
        for (first, second, claim), found in lines.items()
    ]


def _save_json(
    plan: Plan,
    table: Table,
    out: Path,
    results: Results,
    orders: Sequence[OrderResult],
    failed: Mapping[str, str],
) -> None:
    stored = {
        "table": table.name,
        "caption": table.caption,
        "scale": plan.scale.name,
        "about": plan.scale.about,
        "rows": [
            {
                "key": row.key,
                "label": row.label,
                "published": row.published,
                "stages": {
                    str(seed): [stage.name for stage in stages]
                    for seed, stages in row.stages.items()
                },
                "values": {
                    str(seed): {r.name: r.value for r in e.rows}
                    for seed, e in results[row.key].items()
                },
            }
            for row in table.rows
        ],
        "orders": [
            {
                "first": order.first,
                "second": order.second,
                "claim": order.claim,
                "metric": order.metric,
                "verdicts": list(order.verdicts),
                "change": order.change,
                "holds": order.holds,
            }
            for order in orders
        ],
        "curves": {
            stage.name: _thinned(out, stage)
            for row in table.rows
            for stages in row.stages.values()
            for stage in stages
        },
        "failed": dict(failed),
    }
    with atomic_path(out / f"{table.name}.json") as temporary:
        temporary.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")


def _thinned(out: Path, stage: Stage) -> dict[str, list[list[float]]]:
    """Steps and values of each loss of a stage: running means of up to 100 neighbouring parts."""
    found = {}
    for name, curve in curves_of(out, stage).items():
        if name.startswith(("train/", "val/")):
            size = math.ceil(len(curve) / _POINTS)
            points = list(curve.items())
            parts = [points[start : start + size] for start in range(0, len(points), size)]
            found[name] = [
                [fmean(step for step, _ in part) for part in parts],
                [float(f"{fmean(value for _, value in part):.5g}") for part in parts],
            ]
    return found


def _published(table: Table) -> list[Evaluation]:
    """The rows as the paper printed them; KITTI-360, other networks and other data than here."""
    content = files("r3dpa.metrics").joinpath("published.json").read_text(encoding="utf-8")
    scales = json.loads(content)["scales"]
    found = []
    for row in table.rows:
        values = tuple(
            MetricResult(name, float(f"{printed}e{scales[name]}"), scale=scales[name])
            for name, printed in row.published.items()
        )
        about: About = {
            "backbones": {},
            "protocol": {"name": "published"},
            "reference": "KITTI-360, train-val",
            "solver": None,
            "steps": None,
            "seed": None,
            "precision": None,
            "commit": None,
            "feature_source": None,
            "published": True,
            "source": f"R3DPA (ICRA 2026), {table.name.replace('_', ' ')}",
            "extra": {},
        }
        if values:
            found.append(Evaluation(row.label, values, about))
    return found

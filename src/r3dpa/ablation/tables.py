"""Tables of an ablation: means over seeds, published numbers, and the orders of the paper."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, Literal

import torch
from scipy.stats import t as student

from r3dpa import viz
from r3dpa.ablation.plan import Plan, Stage, Table
from r3dpa.ablation.run import commit_of, evaluation_of, stage_folder
from r3dpa.io import atomic_path, command, machine, versions
from r3dpa.metrics.result_table import EvaluationTable
from r3dpa.metrics.results import About, Evaluation, MetricResult, published_scales
from r3dpa.metrics.scene_features import SPACES

__all__ = ["OrderResult", "Results", "curves_of", "mean_of_seeds", "order_results", "write_table"]

_DISTANCES = ("JSD", "MMD", *(space.upper() for space in SPACES))
_LEVEL = 0.95
_ALIKE = 0.05
_POINTS = 100  # at most, of a curve in the JSON file

Results = Mapping[str, Mapping[int, Evaluation]]
"""Evaluations by row and seed; a failed one is missing."""


@dataclass(frozen=True)
class OrderResult:
    """Result for one order of the paper in one metric.

    Args:
        first: Row that the claim is about.
        second: The row that it is compared with.
        claim: Claim of the paper: by its numbers in this metric if it printed both.
        metric: Name of the metric.
        change: Relative difference of ``first`` to ``second``, the mean over the seeds.
        interval: Its 95 % interval: Student's of the differences seed by seed, or with a single
            seed that of the scenes, without the noise of training.
        direction: Which values are better.
    """

    first: str
    second: str
    claim: Literal["better", "worse", "alike"]
    metric: str
    change: float
    interval: tuple[float, float]
    direction: Literal["lower", "higher"] = "lower"

    @property
    def holds(self) -> Literal["yes", "no", "unclear"]:
        """Whether the interval lies wholly inside or outside the claim.

        *Alike* means a difference of at most 5 %, a few times that of such rows in the paper.
        """
        low, high = self.interval
        if self.claim == "alike":
            if max(-low, high) <= _ALIKE:
                return "yes"
            return "no" if low > _ALIKE or high < -_ALIKE else "unclear"
        if low <= 0 <= high:
            return "unclear"
        better = (high < 0) == (self.direction == "lower")
        return "yes" if better == (self.claim == "better") else "no"


def mean_of_seeds(label: str, evaluations: Sequence[Evaluation]) -> Evaluation:
    """One evaluation of several, at least one, that differ in their seed alone.

    Intervals are Student's, of the mean over the seeds; a single seed keeps those of its scenes. A
    metric without a value in one seed has none.
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
        mean, half = fmean(values), _students(values)
        notes = dict.fromkeys(other.note for other in found if other.note)
        rows.append(
            replace(row, value=mean, interval=(mean - half, mean + half), note="; ".join(notes))
        )
    extra = {
        **first.about["extra"],
        "bad_samples": [name for e in evaluations for name in e.bad_samples],
        "seeds": len(evaluations),
        "of each seed": [e.about["source"] for e in evaluations],
    }
    about: About = {**first.about, "seed": None, "extra": extra}
    return Evaluation(label, tuple(rows), about)


def order_results(table: Table, results: Results, metrics: Sequence[str]) -> list[OrderResult]:
    """Orders of the paper for which there are results."""
    rows = {row.key: row for row in table.rows}
    claims = [("better", pair) for pair in table.better] + [("alike", pair) for pair in table.alike]
    found = []
    for claim, (first, second) in claims:
        ours, theirs = results.get(first, {}), results.get(second, {})
        for metric in metrics:
            both = [
                (a, b)
                for seed in sorted(ours.keys() & theirs.keys())
                if (a := ours[seed].row(metric)) and (b := theirs[seed].row(metric))
            ]
            both = [(a, b) for a, b in both if a.value is not None and b.value]
            if both:
                direction = both[0][0].direction
                printed = [rows[key].published.get(metric) for key in (first, second)]
                found.append(
                    OrderResult(
                        first,
                        second,
                        _claim(claim, printed, direction),
                        metric,
                        *_difference(both),
                        direction,
                    )
                )
    return found


def _claim(
    general: str, printed: Sequence[float | None], direction: str
) -> Literal["better", "worse", "alike"]:
    """The claim in a metric: the printed numbers may be the reverse of the general claim."""
    if general == "alike":
        return "alike"
    first, second = printed
    if first is None or second is None or first == second:
        return "better"
    return "better" if (first < second) == (direction == "lower") else "worse"


def _difference(
    both: Sequence[tuple[MetricResult, MetricResult]],
) -> tuple[float, tuple[float, float]]:
    """Mean relative difference, and the ends of its interval."""
    changes = []
    for a, b in both:
        assert a.value is not None
        assert b.value is not None
        changes.append((a.value - b.value) / abs(b.value))
        half = math.hypot(a.half_width, b.half_width) / abs(b.value)
    if len(changes) > 1:
        half = _students(changes)
    mean = fmean(changes)
    return mean, (mean - half, mean + half)


def _students(values: Sequence[float]) -> float:
    """Half the width of Student's interval of a mean."""
    num = len(values)
    return float(student.ppf((1 + _LEVEL) / 2, num - 1)) * stdev(values) / math.sqrt(num)


def write_table(
    plan: Plan, table: Table, out: Path, failed: Mapping[str, str]
) -> tuple[str, Results]:
    """Writes ``<out>/<table>.md``, ``.tex``, ``.csv`` and ``.json`` from the existing results.

    The first two have the distances, the CSV every metric, and the JSON every seed, the training
    curves, the orders of the paper and the failures.

    Args:
        plan: The plan that was run.
        table: One of its tables.
        out: Folder of the ablation.
        failed: Reasons of failures by name of the job.

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
        mean_of_seeds(_counted(row.label, found, plan), list(found.values()))
        for row in table.rows
        if (found := results[row.key])
    ]
    lost = [
        f"{row.label}, seed {seed}: no result"
        for row in table.rows
        for seed in plan.seeds
        if seed not in results[row.key]
    ]
    if not own:
        for suffix in ("md", "tex", "csv", "json"):  # of another run, they would look like its own
            (out / f"{table.name}.{suffix}").unlink(missing_ok=True)
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
        head += (
            " Intervals are Student's, of the mean over the seeds, which share scans and prior; "
            "those of orders are of the differences seed by seed."
        )
    else:
        head += " Intervals are those of the scenes: another training differs by more."
    commits = _commits(out, table, results)
    told = [*_told(table, orders), *lost]
    if len(commits) > 1:
        told.append(f"trained or tested by different commits: {', '.join(commits)}")
    with atomic_path(out / f"{table.name}.md") as temporary:
        listed = "\n".join(f"- {line}" for line in told)
        text = f"# {table.name}\n\n{head}\n\n{shown.markdown()}\n{listed}\n"
        temporary.write_text(text, encoding="utf-8")
    with atomic_path(out / f"{table.name}.tex") as temporary:
        temporary.write_text(f"% {' '.join(head.split())}\n{shown.latex()}", encoding="utf-8")
    EvaluationTable(tuple(own)).save(out / f"{table.name}.csv")
    about = {"command": command(), "machine": machine(), "versions": versions(torch)}
    about["commits"] = commits
    _save_json(plan, table, out, results, orders, failed, about)
    return "\n".join([f"{table.name}: {head}", "", str(shown), *told]), results


def _counted(label: str, found: Mapping[int, Evaluation], plan: Plan) -> str:
    """Label of a row, with the number of its seeds where some are missing."""
    num, total = len(found), len(plan.seeds)
    return label if num == total else f"{label} ({num} of {total} seeds)"


def _commits(out: Path, table: Table, results: Results) -> list[str]:
    """Commits of the code that trained and tested the rows, shortened."""
    found: dict[str, None] = {}
    for row in table.rows:
        for seed, evaluation in results[row.key].items():
            trained = [commit_of(out, stage) for stage in row.stages[seed]]
            for commit in (*trained, evaluation.about["commit"]):
                found[commit[:10] if commit else "unknown"] = None
    return list(found)


def _told(table: Table, orders: Sequence[OrderResult]) -> list[str]:
    """Each order of the paper in a line."""
    labels = {row.key: row.label for row in table.rows}
    lines: dict[tuple[str, str, bool], list[str]] = {}
    for order in orders:
        low, high = (100 * end for end in order.interval)
        reverse = " (worse there)" if order.claim == "worse" else ""
        lines.setdefault((order.first, order.second, order.claim == "alike"), []).append(
            f"{order.metric}{reverse} {order.holds}, {100 * order.change:+.0f} % "
            f"[{low:+.0f}, {high:+.0f}]"
        )
    return [
        f"Paper: {labels[first]} {'like' if alike else 'better than'} {labels[second]}. "
        f"Here: {'; '.join(found)}"
        for (first, second, alike), found in lines.items()
    ]


def _save_json(
    plan: Plan,
    table: Table,
    out: Path,
    results: Results,
    orders: Sequence[OrderResult],
    failed: Mapping[str, str],
    about: Mapping[str, Any],
) -> None:
    rows = []
    for row in table.rows:
        found = {str(seed): evaluation.rows for seed, evaluation in results[row.key].items()}
        entry = {
            "key": row.key,
            "label": row.label,
            "published": row.published,
            "stages": {str(seed): [s.name for s in chain] for seed, chain in row.stages.items()},
            "values": {seed: {r.name: r.value for r in rs} for seed, rs in found.items()},
            "intervals": {seed: {r.name: r.interval for r in rs} for seed, rs in found.items()},
        }
        rows.append(entry)
    fields = ("first", "second", "claim", "metric", "change", "interval", "holds")
    chains = [chain for row in table.rows for chain in row.stages.values()]
    stored = {
        "table": table.name,
        "caption": table.caption,
        "scale": plan.scale.name,
        "about": plan.scale.about,
        **about,
        "rows": rows,
        "orders": [{field: getattr(order, field) for field in fields} for order in orders],
        "curves": {stage.name: _thinned(out, stage) for chain in chains for stage in chain},
        "failed": dict(failed),
    }
    with atomic_path(out / f"{table.name}.json") as temporary:
        temporary.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")


def curves_of(out: Path, stage: Stage) -> dict[str, dict[int, float]]:
    """Logged values of a stage by quantity and step; a resumed run overwrites repeated steps."""
    found: dict[str, dict[int, float]] = {}
    paths = stage_folder(out, stage).glob("version_*/metrics.csv")
    for path in sorted(paths, key=lambda path: path.stat().st_mtime):
        for name, (steps, values) in viz.read_metrics(path).items():
            known = found.setdefault(name, {})
            known.update(zip(map(int, steps), map(float, values), strict=True))
    return {name: dict(sorted(values.items())) for name, values in found.items()}


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
    scales = published_scales()
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

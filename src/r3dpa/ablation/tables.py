"""Tables of an ablation: means over seeds, published numbers, and the orders of the paper."""

from __future__ import annotations

import hashlib
import json
import math
import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, Literal, NamedTuple

import torch
from scipy.stats import t as student

from r3dpa import viz
from r3dpa.ablation.plan import Plan, Stage, Table
from r3dpa.ablation.runs import mark_of
from r3dpa.io import command, machine, versions
from r3dpa.metrics.results import (
    Evaluation,
    EvaluationTable,
    published_evaluation,
    save_csv,
    save_text,
)
from r3dpa.metrics.scene_features import SPACES

_DISTANCES = ("JSD", "MMD", *(space.upper() for space in SPACES))
_LEVEL = 0.95
_ALIKE = 0.05  # a few times the differences of such rows in the paper
_POINTS = 100  # at most, of a curve in the JSON file

Results = Mapping[str, Mapping[int, Evaluation]]
"""Evaluations by row and seed; a failed one is missing."""


class Order(NamedTuple):
    """Result for one order of the paper in one metric.

    ``claim`` (better, worse, alike) is by the paper's numbers in this metric if it printed both.
    ``change`` is the relative difference of ``first`` to ``second``, the mean over the seeds, with
    its 95 % interval: Student's of the differences seed by seed, or with a single seed that of the
    scenes, without the noise of training. ``holds`` (yes, no, unclear) tells whether the interval
    lies inside or outside the claim; *alike* means a difference of at most 5 %.
    """

    first: str
    second: str
    claim: str
    metric: str
    change: float
    interval: tuple[float, float]
    holds: str


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
        notes = "; ".join(dict.fromkeys(other.note for other in found if other.note))
        rows.append(replace(row, value=mean, interval=(mean - half, mean + half), note=notes))
    bad = [name for e in evaluations for name in e.bad_samples]
    extra = first.about["extra"] | {"bad_samples": bad, "seeds": len(evaluations)}
    return Evaluation(label, tuple(rows), first.about | {"seed": None, "extra": extra})


def _students(values: Sequence[float]) -> float:
    """Half the width of Student's interval of a mean."""
    num = len(values)
    return float(student.ppf((1 + _LEVEL) / 2, num - 1)) * stdev(values) / math.sqrt(num)


def order_results(table: Table, results: Results, metrics: Sequence[str]) -> list[Order]:
    """Orders of the paper for which there are results."""
    printed = {row.key: row.published for row in table.rows}
    found = []
    for (claim, first, second), metric in product(table.orders, metrics):
        ours, theirs = results.get(first, {}), results.get(second, {})
        changes, half, lower = [], 0.0, True
        for seed in sorted(ours.keys() & theirs.keys()):
            a, b = ours[seed].row(metric), theirs[seed].row(metric)
            if a and b and a.value is not None and b.value:
                changes.append((a.value - b.value) / abs(b.value))
                half = math.hypot(a.half_width, b.half_width) / abs(b.value)
                lower = a.direction == "lower"
        if not changes:
            continue
        half = _students(changes) if len(changes) > 1 else half
        low, high = fmean(changes) - half, fmean(changes) + half
        x, y = printed[first].get(metric), printed[second].get(metric)
        if claim == "better" and x is not None and y is not None and x != y and (x < y) != lower:
            claim = "worse"  # the printed numbers are the reverse of the general claim
        if claim == "alike":
            inside, outside = max(-low, high) <= _ALIKE, low > _ALIKE or high < -_ALIKE
        else:
            ends = (low, high) if lower == (claim == "better") else (-high, -low)
            inside, outside = ends[1] < 0, ends[0] > 0
        holds = "yes" if inside else "no" if outside else "unclear"
        found.append(Order(first, second, claim, metric, fmean(changes), (low, high), holds))
    return found


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
    results: dict[str, dict[int, Evaluation]] = {row.key: {} for row in table.rows}
    means, lost, commits = [], [], dict[str, None]()
    for row in table.rows:
        for seed, chain in row.stages.items():
            path = chain[-1].evaluation(out)
            if f"test of {chain[-1].name}" in failed or not path.is_file():
                lost.append(f"{row.label}, seed {seed}: no result")
                continue
            results[row.key][seed] = found = Evaluation.load(path)
            by = [*(commit_of(out, stage) for stage in chain), found.about["commit"]]
            commits |= dict.fromkeys(commit[:10] if commit else "unknown" for commit in by)
        if num := len(results[row.key]):
            few = "" if num == len(plan.seeds) else f" ({num} of {len(plan.seeds)} seeds)"
            means.append(mean_of_seeds(row.label + few, list(results[row.key].values())))
    if not means:
        for suffix in ("md", "tex", "csv", "json"):  # of another run, they would look like its own
            (out / f"{table.name}.{suffix}").unlink(missing_ok=True)
        return f"{table.name}: {table.caption}\n\nno row has a result", results
    distances = [evaluation.only(_DISTANCES) for evaluation in means]
    shown = EvaluationTable((*_published(table), *distances))
    orders = order_results(
        table, results, [name for name in shown.columns if any(e.row(name) for e in distances)]
    )
    intervals = "those of the scenes: another training differs by more."
    if len(plan.seeds) > 1:
        intervals = (
            "Student's, of the mean over the seeds, which share scans and prior; those of orders "
            "are of the differences seed by seed."
        )
    head = (
        f"{table.caption} Scale {plan.scale}: {plan.about} Seeds "
        f"{', '.join(map(str, plan.seeds))}. Intervals are {intervals}"
    )
    notes = [*_described(table, orders), *lost]
    if len(commits) > 1:
        notes.append(f"trained or tested by different commits: {', '.join(commits)}")
    listed = "\n".join(f"- {line}" for line in notes)
    save_text(out / f"{table.name}.md", f"# {table.name}\n\n{head}\n\n{shown}\n{listed}\n")
    save_text(out / f"{table.name}.tex", f"% {' '.join(head.split())}\n{shown.latex()}")
    save_csv(means, out / f"{table.name}.csv")
    stages = [stage for row in table.rows for chain in row.stages.values() for stage in chain]
    stored = {
        "table": table.name,
        "caption": table.caption,
        "scale": plan.scale,
        "about": plan.about,
        "command": command(),
        "machine": machine(),
        "versions": versions(torch),
        "commits": list(commits),
        "rows": [
            {
                "key": row.key,
                "label": row.label,
                "published": row.published,
                "stages": {seed: [s.name for s in chain] for seed, chain in row.stages.items()},
                "values": _by_seed(results[row.key], "value"),
                "intervals": _by_seed(results[row.key], "interval"),
            }
            for row in table.rows
        ],
        "orders": [order._asdict() for order in orders],
        "curves": {stage.name: _thinned(out, stage) for stage in stages},
        "failed": dict(failed),
    }
    save_text(out / f"{table.name}.json", json.dumps(stored, indent=1) + "\n")
    return "\n".join([f"{table.name}: {head}", "", str(shown), *notes]), results


def _by_seed(found: Mapping[int, Evaluation], key: str) -> dict[int, dict[str, Any]]:
    return {seed: {row.name: getattr(row, key) for row in e.rows} for seed, e in found.items()}


def commit_of(out: Path, stage: Stage) -> str | None:
    """Commit of the code that trained a stage, if known."""
    return mark_of(stage.folder(out) / "fit").get("commit")


def _described(table: Table, orders: Sequence[Order]) -> list[str]:
    """Each order of the paper in a line."""
    labels = {row.key: row.label for row in table.rows}
    lines: dict[str, list[str]] = {}
    for order in orders:
        relation = "like" if order.claim == "alike" else "better than"
        claim = f"{labels[order.first]} {relation} {labels[order.second]}"
        low, high = (100 * end for end in order.interval)
        reverse = " (worse there)" if order.claim == "worse" else ""
        lines.setdefault(claim, []).append(
            f"{order.metric}{reverse} {order.holds}, {100 * order.change:+.0f} % "
            f"[{low:+.0f}, {high:+.0f}]"
        )
    return [f"Paper: {claim}. Here: {'; '.join(found)}" for claim, found in lines.items()]


def _published(table: Table) -> list[Evaluation]:
    """The rows as the paper printed them; KITTI-360, other networks and other data than here."""
    source = f"R3DPA (ICRA 2026), {table.name.replace('_', ' ')}"
    return [
        published_evaluation(row.label, row.published, "KITTI-360, train-val", source)
        for row in table.rows
        if row.published
    ]


def curves_of(out: Path, stage: Stage) -> dict[str, dict[int, float]]:
    """Logged values of a stage by quantity and step; a resumed run overwrites repeated steps."""
    found: dict[str, dict[int, float]] = {}
    paths = stage.folder(out).glob("version_*/metrics.csv")
    for path in sorted(paths, key=lambda path: path.stat().st_mtime):
        for name, (steps, values) in viz.read_metrics(path).items():
            known = found.setdefault(name, {})
            known.update(zip(map(int, steps), map(float, values), strict=True))
    return {name: dict(sorted(values.items())) for name, values in found.items()}


def _thinned(out: Path, stage: Stage) -> dict[str, list[list[float]]]:
    """Steps and values of each loss of a stage: means of up to 100 parts."""
    found = {}
    for name, curve in curves_of(out, stage).items():
        if name.startswith(("train/", "val/")):
            size = math.ceil(len(curve) / _POINTS)
            points = list(curve.items())
            parts = [points[start : start + size] for start in range(0, len(points), size)]
            means = [[fmean(values) for values in zip(*part, strict=True)] for part in parts]
            found[name] = [[step for step, _ in means], [float(f"{v:.5g}") for _, v in means]]
    return found


def log_rows(
    plan: Plan, table: Table, results: Results, out: Path, mode: Literal["offline", "online"]
) -> None:
    """Logs a wandb run for each row and seed: group, configuration, curves, pictures, metrics.

    A run that was logged before is not logged again; with other numbers it replaces the offline run
    of the same row and seed. Offline runs are in ``<out>/wandb``, for ``wandb sync``.
    """
    import wandb  # takes seconds

    for row in table.rows:
        for seed, evaluation in results[row.key].items():
            stages = row.stages[seed]
            values = {r.name.replace(" ", "_"): r.value for r in evaluation.rows}
            summary = {name: value for name, value in values.items() if value is not None}
            content = json.dumps([[stage.name for stage in stages], summary])
            of_row = f"{table.name}-{row.key}-{seed}"
            run_id = f"{of_row}-{hashlib.sha256(content.encode()).hexdigest()[:8]}"
            if any((out / "wandb").glob(f"*run-*-{run_id}")):
                continue
            for stale in (out / "wandb").glob(f"offline-run-*-{of_row}-????????"):
                shutil.rmtree(stale)
            config = {
                "table": table.name,
                "row": row.key,
                "label": row.label,
                "scale": plan.scale,
                "seed": seed,
                "commands": {s.name: shlex.join(["r3dpa", "fit", *s.words]) for s in stages},
                "stages": {stage.name: stage.config for stage in stages},
                "commits": [commit_of(out, stage) for stage in stages],
            }
            with wandb.init(
                project="r3dpa",
                group=f"{table.name} {plan.scale}",
                job_type="row",
                name=f"{row.label}, seed {seed}",
                id=run_id,
                dir=out,
                mode=mode,
                config=config,
                settings=wandb.Settings(silent=True, console="off"),
            ) as run:
                for stage in stages:
                    prefix = stage.experiment
                    run.define_metric(f"{prefix}/*", step_metric=f"{prefix}/step")
                    for name, curve in curves_of(out, stage).items():
                        for step, value in curve.items():
                            run.log({f"{prefix}/step": step, f"{prefix}/{name}": value})
                for path in sorted(stages[-1].evaluation(out).parent.rglob("*.png")):
                    run.log({f"samples/{path.stem}": wandb.Image(str(path))})
                run.summary.update(summary)

"""Tables of an ablation: means over seeds, published numbers, and the orders of the paper."""

from __future__ import annotations

import hashlib
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from statistics import fmean, stdev
from typing import Any, Literal, NamedTuple

import torch

from r3dpa import viz
from r3dpa.ablation.plan import Plan, PlannedStage, Row, Table
from r3dpa.io import command, machine, versions, write_text
from r3dpa.metrics.resampling import Ends, quantile_of_t
from r3dpa.metrics.results import (
    DISTANCES,
    Evaluation,
    EvaluationTable,
    published_evaluation,
    save_csv,
)

_ALIKE = 0.05  # share; a few times the differences of such rows in the paper
_SUFFIXES = (".md", ".tex", ".csv", ".json")
# The paper compares with all real scans, but in MMD with validation scans alone.
_REFERENCE = "KITTI-360, train-val (MMD: val-only)"

Results = Mapping[str, Mapping[int, Evaluation]]
"""Evaluations by row and seed; a failed one is missing."""


class Order(NamedTuple):
    """Result for one order of the paper: ``claim`` (better, worse, alike) of two rows in a metric.

    ``change`` and ``interval`` come from :func:`relative_change`. ``holds`` is yes if the
    interval lies inside the claim, no if outside, else unclear.
    """

    first: str
    second: str
    claim: str
    metric: str
    change: float
    interval: tuple[float, float]
    holds: str


def mean_of_seeds(label: str, evaluations: Sequence[Evaluation]) -> Evaluation:
    """Average evaluations, at least one, that differ in their seed alone.

    Intervals are Student's, of the mean over the seeds; a single seed keeps the intervals over its
    scenes. A metric without a value in one seed has none.
    """
    first = evaluations[0]
    if len(evaluations) == 1:
        return replace(first, label=label)
    rows = []
    for row in first.rows:
        of_seeds = [e.row(row.name) for e in evaluations]
        values = [r.value for r in of_seeds if r is not None and r.value is not None]
        if len(values) < len(evaluations):
            rows.append(replace(row, value=None, interval=None, note="not in every seed"))
            continue
        mean, half = fmean(values), _half_width(values)
        notes = dict.fromkeys(r.note for r in of_seeds if r is not None and r.note)
        interval = (mean - half, mean + half)
        rows.append(replace(row, value=mean, interval=interval, note="; ".join(notes)))
    bad = [name for e in evaluations for name in e.bad_samples]
    extra = first.about["extra"] | {"bad_samples": bad, "seeds": len(evaluations)}
    for remark in ("verdict", "warning"):  # of the scenes of one seed
        extra.pop(remark, None)
    return Evaluation(label, tuple(rows), first.about | {"seed": None, "extra": extra})


def relative_change(
    ours: Mapping[int, Evaluation], theirs: Mapping[int, Evaluation], metric: str
) -> tuple[float, Ends] | None:
    """Return the difference of two trainings relative to the second, and its 95 % interval.

    The mean over the seeds that both have, with Student's interval of the differences seed by seed.
    A side that is one run, with a single seed or as released weights, has the interval over its
    scenes, without the noise of training. None without a value.
    """
    changes, pairs, scale = [], [], 1.0
    for seed in ours.keys() & theirs.keys():
        a, b = ours[seed].row(metric), theirs[seed].row(metric)
        if a and b and a.value is not None and b.value:
            scale = abs(b.value)
            changes.append((a.value - b.value) / scale)
            pairs.append((a, b))
    if not changes:
        return None
    sides = list(zip(*pairs, strict=True))
    one_run = [rows[0] for rows in sides if len({row.value for row in rows}) == 1]
    half = math.hypot(*(row.half_width for row in one_run)) / scale
    if len(one_run) < len(sides):
        half = math.hypot(half, _half_width(changes))
    mean = fmean(changes)
    return mean, (mean - half, mean + half)


def _different_runs(row: Row, evaluations: Mapping[int, Evaluation]) -> list[Evaluation]:
    """Evaluations of the trainings of a row: released weights are the same with every seed."""
    by_run = {row.stages[seed][-1].name: each for seed, each in evaluations.items()}
    return list(by_run.values())


def _half_width(values: Sequence[float]) -> float:
    """Half the width of Student's 95 % interval of a mean."""
    num = len(values)
    return quantile_of_t(num - 1) * stdev(values) / math.sqrt(num)


def order_results(table: Table, results: Results, metrics: Mapping[str, bool]) -> list[Order]:
    """Orders for which there are results; ``metrics`` is True where lower values are better.

    Where the paper printed the reverse of its claim for a metric, the printed numbers count.
    """
    printed = {row.key: row.published for row in table.rows}
    orders = []
    for (claim, first, second), (metric, lower) in product(table.orders, metrics.items()):
        change = relative_change(results[first], results[second], metric)
        if change is None:
            continue
        mean, (low, high) = change
        x, y = printed[first].get(metric), printed[second].get(metric)
        if claim == "better" and x is not None and y is not None and x != y and (x < y) != lower:
            claim = "worse"
        if claim == "alike":
            inside = max(-low, high) <= _ALIKE
            outside = low > _ALIKE or high < -_ALIKE
        else:
            falls = lower == (claim == "better")  # whether the claim is a smaller value
            inside = high < 0 if falls else low > 0
            outside = low > 0 if falls else high < 0
        holds = "yes" if inside else "no" if outside else "unclear"
        orders.append(Order(first, second, claim, metric, mean, (low, high), holds))
    return orders


def write_table(plan: Plan, table: Table, failed: Mapping[str, str]) -> tuple[str, Results]:
    """Write ``<table>.md``, ``.tex``, ``.csv`` and ``.json`` from the existing results.

    The first two have the distances, the CSV every metric, and the JSON every seed, the orders of
    the paper and the reasons of failures by name of the job.

    Returns:
        The table for the terminal, and the evaluations by row and seed.
    """
    results, missing = _read_results(table, failed)
    means = [
        mean_of_seeds(row.label, _different_runs(row, results[row.key]))
        for row in table.rows
        if results[row.key]
    ]
    file = plan.out / table.name
    if not means:
        for suffix in _SUFFIXES:  # files of an earlier run would look like results of this one
            file.with_suffix(suffix).unlink(missing_ok=True)
        return f"{table.name}: {table.caption}\n\nno row has a result", results
    distances = [evaluation.only(DISTANCES) for evaluation in means]
    shown = EvaluationTable((*_published(table), *distances))
    measured = {row.name: row.direction == "lower" for e in distances for row in e.rows}
    orders = order_results(table, results, measured)
    head = _head(plan, table)
    notes = [*_describe(table, orders), *missing]
    listed = "\n".join(f"- {line}" for line in notes)
    write_text(file.with_suffix(".md"), f"# {table.name}\n\n{head}\n\n{shown}\n{listed}\n")
    write_text(file.with_suffix(".tex"), f"% {' '.join(head.split())}\n{shown.latex()}")
    save_csv(means, file.with_suffix(".csv"))
    content = _record(plan, table, results, orders, failed)
    write_text(file.with_suffix(".json"), json.dumps(content, indent=1) + "\n")
    return "\n".join([f"{table.name}: {head}", "", str(shown), *notes]), results


def _read_results(
    table: Table, failed: Mapping[str, str]
) -> tuple[dict[str, dict[int, Evaluation]], list[str]]:
    """Evaluations by row and seed, and a line for each missing one."""
    results: dict[str, dict[int, Evaluation]] = {row.key: {} for row in table.rows}
    missing = []
    for row in table.rows:
        for seed, chain in row.stages.items():
            tested = chain[-1]
            if f"test of {tested.name}" in failed or not tested.evaluation.is_file():
                missing.append(f"{row.label}, seed {seed}: no result")
                continue
            evaluation = Evaluation.load(tested.evaluation)
            step = evaluation.about["extra"].get("step")
            if tested.config and step not in (None, tested.config["trainer"]["max_steps"]):
                missing.append(
                    f"{row.label}, seed {seed}: {tested.evaluation} is of step {step}, not the last"
                )
            else:
                results[row.key][seed] = evaluation
    return results, missing


def _published(table: Table) -> list[Evaluation]:
    """Numbers of the paper, which come from other networks and other data than here."""
    source = f"R3DPA (ICRA 2026), {table.name.replace('_', ' ')}"
    return [
        published_evaluation(row.label, row.published, _REFERENCE, source)
        for row in table.rows
        if row.published
    ]


def _head(plan: Plan, table: Table) -> str:
    intervals = "over the scenes: another training differs by more."
    if len(plan.seeds) > 1:
        intervals = (
            "Student's, of the mean over the seeds, which share scans and prior; for orders, of "
            "the differences seed by seed."
        )
    seeds = ", ".join(map(str, plan.seeds))
    return (
        f"{table.caption} Scale {plan.scale}: {plan.about} Seeds {seeds}. Intervals are {intervals}"
    )


def _describe(table: Table, orders: Sequence[Order]) -> list[str]:
    """A line for each order of the paper, with what became of it in each metric."""
    labels = {row.key: row.label for row in table.rows}
    lines: dict[str, list[str]] = {}
    for order in orders:
        relation = "like" if order.claim == "alike" else "better than"
        claim = f"{labels[order.first]} {relation} {labels[order.second]}"
        low, high = (100 * end for end in order.interval)
        reverse = " (worse there)" if order.claim == "worse" else ""
        lines.setdefault(claim, []).append(
            f"{order.metric}{reverse} {_answer(order)}, {100 * order.change:+.0f} % "
            f"[{low:+.0f}, {high:+.0f}]"
        )
    return [f"Paper: {claim}. Here: {'; '.join(results)}" for claim, results in lines.items()]


def _answer(order: Order) -> str:
    """Yes or no, or the largest difference that an interval with both inside leaves."""
    if order.holds != "unclear":
        return order.holds
    low, high = order.interval
    return f"no difference above {100 * max(-low, high):.0f} %"


def _record(
    plan: Plan, table: Table, results: Results, orders: Sequence[Order], failed: Mapping[str, str]
) -> dict[str, Any]:
    rows = []
    for row in table.rows:
        by_seed = results[row.key].items()
        record = row._asdict() | {
            "stages": {seed: [s.name for s in chain] for seed, chain in row.stages.items()},
            "values": {seed: {r.name: r.value for r in e.rows} for seed, e in by_seed},
            "intervals": {seed: {r.name: r.interval for r in e.rows} for seed, e in by_seed},
        }
        rows.append(record)
    return {
        "table": table.name,
        "caption": table.caption,
        "scale": plan.scale,
        "about": plan.about,
        "command": command(),
        "machine": machine(),
        "versions": versions(torch),
        "rows": rows,
        "orders": [order._asdict() for order in orders],
        "failed": dict(failed),
    }


def log_rows(
    plan: Plan, table: Table, results: Results, mode: Literal["offline", "online"]
) -> None:
    """Log a wandb run for each row and seed: group, configuration, curves, pictures, metrics.

    A run that was logged before with the same numbers is not logged again. Offline runs are in
    ``<out>/wandb``, for ``wandb sync``.
    """
    for row in table.rows:
        for seed, evaluation in results[row.key].items():
            stages = row.stages[seed]
            summary = {
                result.name.replace(" ", "_"): result.value
                for result in evaluation.rows
                if result.value is not None
            }
            content = json.dumps([[stage.name for stage in stages], summary]).encode()
            run_id = f"{table.name}-{row.key}-{seed}-{hashlib.sha256(content).hexdigest()[:8]}"
            if not any((plan.out / "wandb").glob(f"*run-*-{run_id}")):
                _log_row(plan, table, row, seed, summary, run_id, mode)


def _log_row(
    plan: Plan,
    table: Table,
    row: Row,
    seed: int,
    summary: Mapping[str, float],
    run_id: str,
    mode: Literal["offline", "online"],
) -> None:
    import wandb  # takes seconds

    stages: list[PlannedStage] = row.stages[seed]
    config = {
        "scale": plan.scale,
        "seed": seed,
        "commands": {s.name: shlex.join(["r3dpa", "fit", *s.words]) for s in stages},
        "stages": {stage.name: stage.config for stage in stages},
    }
    with wandb.init(
        project="r3dpa",
        group=f"{table.name} {plan.scale}",
        job_type="row",
        name=f"{row.label}, seed {seed}",
        id=run_id,
        dir=plan.out,
        mode=mode,
        config=config,
        settings=wandb.Settings(silent=True, console="off"),
    ) as run:
        for stage in stages:
            prefix = stage.words[0]
            run.define_metric(f"{prefix}/*", step_metric=f"{prefix}/step")
            for name, (steps, values) in viz.read_curves(stage.folder).items():
                for step, value in zip(steps, values, strict=True):
                    run.log({f"{prefix}/step": step, f"{prefix}/{name}": value})
        for path in sorted(stages[-1].evaluation.parent.rglob("*.png")):
            run.log({f"samples/{path.stem}": wandb.Image(str(path))})
        run.summary.update(dict(summary))

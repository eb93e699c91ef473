"""Tables of an ablation: means over seeds, published numbers, and the orders of the paper."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, Literal, NamedTuple

import torch

from r3dpa import viz
from r3dpa.ablation.plan import Plan, Table
from r3dpa.io import command, machine, versions, write_text
from r3dpa.metrics.results import (
    Evaluation,
    EvaluationTable,
    published_evaluation,
    save_csv,
)
from r3dpa.metrics.scene_features import SPACES
from r3dpa.metrics.seeds import mean_of_seeds, relative_change

_DISTANCES = ("JSD", "MMD", *(space.upper() for space in SPACES))
_ALIKE = 0.05  # share; a few times the differences of such rows in the paper

Results = Mapping[str, Mapping[int, Evaluation]]
"""Evaluations by row and seed; a failed one is missing."""


class Order(NamedTuple):
    """Result for one order of the paper: ``claim`` (better, worse, alike) of two rows in a metric.

    ``change`` and ``interval`` are those of :func:`relative_change`. ``holds`` is yes if the
    interval lies inside the claim, no if outside, else unclear.
    """

    first: str
    second: str
    claim: str
    metric: str
    change: float
    interval: tuple[float, float]
    holds: str


def order_results(table: Table, results: Results, metrics: Mapping[str, bool]) -> list[Order]:
    """Orders for which there are results; ``metrics`` is True where lower values are better.

    The paper's numbers of a metric, if it printed both, go before its general claim.
    """
    printed = {row.key: row.published for row in table.rows}
    found = []
    for (claim, first, second), (metric, lower) in product(table.orders, metrics.items()):
        if (change := relative_change(results[first], results[second], metric)) is None:
            continue
        mean, (low, high) = change
        x, y = printed[first].get(metric), printed[second].get(metric)
        if claim == "better" and x is not None and y is not None and x != y and (x < y) != lower:
            claim = "worse"
        if claim == "alike":
            inside, outside = max(-low, high) <= _ALIKE, low > _ALIKE or high < -_ALIKE
        else:
            ends = (low, high) if lower == (claim == "better") else (-high, -low)
            inside, outside = ends[1] < 0, ends[0] > 0
        holds = "yes" if inside else "no" if outside else "unclear"
        found.append(Order(first, second, claim, metric, mean, (low, high), holds))
    return found


def write_table(plan: Plan, table: Table, failed: Mapping[str, str]) -> tuple[str, Results]:
    """Writes ``<table>.md``, ``.tex``, ``.csv`` and ``.json`` from the existing results.

    The first two have the distances, the CSV every metric, and the JSON every seed, the orders of
    the paper and the reasons of failures by name of the job. Returns the table for the terminal,
    and the evaluations by row and seed.
    """
    results: dict[str, dict[int, Evaluation]] = {row.key: {} for row in table.rows}
    means, lost = [], []
    for row in table.rows:
        for seed, chain in row.stages.items():
            path = chain[-1].evaluation
            if f"test of {chain[-1].name}" in failed or not path.is_file():
                lost.append(f"{row.label}, seed {seed}: no result")
                continue
            found = Evaluation.load(path)
            step = found.about["extra"].get("step")
            config = chain[-1].config
            if config and step is not None and step != config["trainer"]["max_steps"]:
                lost.append(f"{row.label}, seed {seed}: {path} is of step {step}, not the last")
            else:
                results[row.key][seed] = found
        if results[row.key]:
            means.append(mean_of_seeds(row.label, list(results[row.key].values())))
    file = plan.out / table.name
    if not means:
        for suffix in (".md", ".tex", ".csv", ".json"):  # of another run, they would look like own
            file.with_suffix(suffix).unlink(missing_ok=True)
        return f"{table.name}: {table.caption}\n\nno row has a result", results
    distances = [evaluation.only(_DISTANCES) for evaluation in means]
    source = "KITTI-360, train-val", f"R3DPA (ICRA 2026), {table.name.replace('_', ' ')}"
    published = [  # other networks and other data than here
        published_evaluation(r.label, r.published, *source) for r in table.rows if r.published
    ]
    shown = EvaluationTable((*published, *distances))
    measured = {row.name: row.direction == "lower" for e in distances for row in e.rows}
    orders = order_results(table, results, measured)
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
    listed = "\n".join(f"- {line}" for line in notes)
    write_text(file.with_suffix(".md"), f"# {table.name}\n\n{head}\n\n{shown}\n{listed}\n")
    write_text(file.with_suffix(".tex"), f"% {' '.join(head.split())}\n{shown.latex()}")
    save_csv(means, file.with_suffix(".csv"))
    stored = {
        "table": table.name,
        "caption": table.caption,
        "scale": plan.scale,
        "about": plan.about,
        "command": command(),
        "machine": machine(),
        "versions": versions(torch),
        "rows": [
            row._asdict()
            | {
                "stages": {seed: [s.name for s in chain] for seed, chain in row.stages.items()},
                "values": _by_seed(results[row.key], "value"),
                "intervals": _by_seed(results[row.key], "interval"),
            }
            for row in table.rows
        ],
        "orders": [order._asdict() for order in orders],
        "failed": dict(failed),
    }
    write_text(file.with_suffix(".json"), json.dumps(stored, indent=1) + "\n")
    return "\n".join([f"{table.name}: {head}", "", str(shown), *notes]), results


def _by_seed(found: Mapping[int, Evaluation], key: str) -> dict[int, dict[str, Any]]:
    return {seed: {row.name: getattr(row, key) for row in e.rows} for seed, e in found.items()}


def _described(table: Table, orders: Sequence[Order]) -> list[str]:
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


def log_rows(
    plan: Plan, table: Table, results: Results, mode: Literal["offline", "online"]
) -> None:
    """Logs a wandb run for each row and seed: group, configuration, curves, pictures, metrics.

    A run that was logged before with the same numbers is not logged again. Offline runs are in
    ``<out>/wandb``, for ``wandb sync``.
    """
    import wandb  # takes seconds

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
            if any((plan.out / "wandb").glob(f"*run-*-{run_id}")):
                continue
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
                    for name, curve in viz.read_curves(stage.folder).items():
                        for step, value in zip(*curve, strict=True):
                            run.log({f"{prefix}/step": step, f"{prefix}/{name}": value})
                for path in sorted(stages[-1].evaluation.parent.rglob("*.png")):
                    run.log({f"samples/{path.stem}": wandb.Image(str(path))})
                run.summary.update(summary)

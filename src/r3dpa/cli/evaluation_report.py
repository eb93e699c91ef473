"""An evaluation as text, tables and figures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch

from r3dpa import viz
from r3dpa.metrics.evaluation import Comparison
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.result_table import EvaluationTable
from r3dpa.metrics.results import Evaluation, published_evaluations
from r3dpa.metrics.scene_features import SPACES
from r3dpa.metrics.scene_set import RANGE_BIN_M
from r3dpa.viz import evaluation as figures

__all__ = ["report", "save_reports"]

_SHOWN_MATCHES = 3


def report(evaluation: Evaluation, statistics: ReferenceStatistics) -> str:
    """All numbers of an evaluation, and below those that the paper has, beside the published."""
    text, table = str(evaluation), _beside_published(evaluation, statistics)
    return text if table is None else f"{text}\n\n{table}"


def save_reports(comparison: Comparison, statistics: ReferenceStatistics, out: Path) -> None:
    """Writes numbers, tables and figures of a comparison to a folder.

    ``evaluation.json`` and ``metrics.csv`` hold all rows; ``table.md`` and ``table.tex`` the
    distances beside the published ones; ``birds_eye.png``, ``ranges.png`` and ``matches.png`` are
    drawn from the sets themselves.

    Args:
        comparison: Result of :func:`evaluate_scenes`.
        statistics: Its reference.
        out: Folder; files of these names are replaced.
    """
    evaluation = comparison.evaluation
    evaluation.save(out / "evaluation.json")
    EvaluationTable((evaluation,)).save(out / "metrics.csv")
    table = _beside_published(evaluation, statistics) or EvaluationTable((evaluation,))
    table.save(out / "table.md")
    table.save(out / "table.tex")
    _draw(comparison, statistics, out)


def _beside_published(
    evaluation: Evaluation, statistics: ReferenceStatistics
) -> EvaluationTable | None:
    """Distances without relatives of theirs, below the published rows that have some of them."""
    split: Literal["val-only", "train-val"] = (
        "val-only" if statistics.about.get("split") == "val" else "train-val"
    )
    heads = {space.upper() for space in SPACES} | {"JSD", "MMD"}
    own = replace(evaluation, rows=tuple(r for r in evaluation.rows if r.name in heads))
    names = {row.name for row in own.rows}
    others = [
        replace(other, rows=tuple(row for row in other.rows if row.name in names))
        for other in published_evaluations(split)
    ]
    others = [other for other in others if other.rows]
    return EvaluationTable((*others, own)) if others else None


def _draw(comparison: Comparison, statistics: ReferenceStatistics, out: Path) -> None:
    samples, references, matching = comparison[1:]
    setting = statistics.protocol
    grid, sensor = setting.grid, setting.sensor
    both = (samples, references)
    made, real = (part.cells.sum(dim=0).view(grid.shape).numpy() for part in both)
    viz.save(figures.bev_histograms(made, real, grid.x_m, grid.y_m), out / "birds_eye.png")
    edges_m = torch.arange(references.ranges.shape[1] + 1).double() * RANGE_BIN_M
    halves = [part.ranges[0] for part in statistics.halves if part.count]
    made, real = (part.ranges.sum(dim=0).numpy() for part in both)
    ranges = figures.range_histogram(edges_m.numpy(), made, real, torch.stack(halves).numpy())
    viz.save(ranges, out / "ranges.png")

    shown, scans = samples.images.items(), references.images.items()
    order = matching.squared_normalised.argsort().tolist()

    def pair(index: int) -> figures.MatchedPair:
        name, _, sample_m = shown[int(matching.nearest[index])]
        scan, _, reference_m = scans[index]
        title = f"{name} and {scan}: {matching.squared_normalised[index]:.3g}"
        return figures.MatchedPair(title, sample_m.numpy(), reference_m.numpy())

    best = [pair(index) for index in order[:_SHOWN_MATCHES]]
    worst = [pair(index) for index in order[::-1][:_SHOWN_MATCHES]]
    viz.save(figures.matches_figure(best, worst, sensor), out / "matches.png")

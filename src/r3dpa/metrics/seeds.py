"""Evaluations of the same training with several seeds: means, and differences in pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import fmean, stdev

from r3dpa.metrics.resampling import Ends, quantile_of_t
from r3dpa.metrics.results import Evaluation


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


def relative_change(
    ours: Mapping[int, Evaluation], theirs: Mapping[int, Evaluation], metric: str
) -> tuple[float, Ends] | None:
    """Difference of two trainings in a metric over the value of the second, and its 95 % interval.

    The mean over the seeds that both have, with Student's interval of the differences seed by seed;
    with a single seed that of the scenes, without the noise of training. None without a value.
    """
    changes, half = [], 0.0
    for seed in ours.keys() & theirs.keys():
        a, b = ours[seed].row(metric), theirs[seed].row(metric)
        if a and b and a.value is not None and b.value:
            changes.append((a.value - b.value) / abs(b.value))
            half = math.hypot(a.half_width, b.half_width) / abs(b.value)
    if not changes:
        return None
    mean, half = fmean(changes), _students(changes) if len(changes) > 1 else half
    return mean, (mean - half, mean + half)


def _students(values: Sequence[float]) -> float:
    """Half the width of Student's 95 % interval of a mean."""
    num = len(values)
    return quantile_of_t(num - 1) * stdev(values) / math.sqrt(num)

"""Evaluations of one training with several seeds: means, and differences paired by seed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import fmean, stdev

from r3dpa.metrics.resampling import Ends, quantile_of_t
from r3dpa.metrics.results import Evaluation


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
    return Evaluation(label, tuple(rows), first.about | {"seed": None, "extra": extra})


def relative_change(
    ours: Mapping[int, Evaluation], theirs: Mapping[int, Evaluation], metric: str
) -> tuple[float, Ends] | None:
    """Return the difference of two trainings relative to the second, and its 95 % interval.

    The mean over the seeds that both have, with Student's interval of the differences seed by seed;
    with a single seed the interval over the scenes, without the noise of training. None without a
    value.
    """
    changes, half = [], 0.0
    for seed in ours.keys() & theirs.keys():
        a, b = ours[seed].row(metric), theirs[seed].row(metric)
        if a and b and a.value is not None and b.value:
            changes.append((a.value - b.value) / abs(b.value))
            half = math.hypot(a.half_width, b.half_width) / abs(b.value)
    if not changes:
        return None
    mean = fmean(changes)
    if len(changes) > 1:
        half = _half_width(changes)
    return mean, (mean - half, mean + half)


def _half_width(values: Sequence[float]) -> float:
    """Half the width of Student's 95 % interval of a mean."""
    num = len(values)
    return quantile_of_t(num - 1) * stdev(values) / math.sqrt(num)

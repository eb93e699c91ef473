"""Floors of an evaluation: the distances that real scans have from real scans, and the verdict.

The floor of a metric is its value between the halves of the reference, see
:class:`~r3dpa.metrics.reference.ReferenceStatistics`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from r3dpa.metrics.collection import metrics_by_name
from r3dpa.metrics.distances import MinimumMatchingDistance
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.resampling import Resampling
from r3dpa.metrics.results import MetricResult

Floors = Mapping[str, MetricResult]

#: A distance is near its floor up to this multiple of it, plus half the width of its interval:
#: the floors of two random splits of the same scans differ by about as much.
NEAR_FLOOR = 1.5
#: Scenes whose precision or recall is below this part of what real scans reach are not realistic,
#: however small their distances are.
POOR_SHARE = 0.5
#: With fewer scenes, or fewer scans in a half of the reference, values and floors are mostly the
#: bias of small samples, which both have. Range images with 3 m of noise are near the floor in 6 or
#: 7 of 8 distances with 4 to 16 scenes, in 2 to 5 with 32, in 1 with 128.
FEWEST_SCENES = 32
#: Ratio of the medians of the numbers of returns, below which (or above the inverse of which)
#: scenes and scans probably come from different sensors.
SAME_SENSOR_RATIO = 0.6
#: Distances whose mean does not depend on how many scenes there are.
_UNBIASED = (" inf", " KID")
_SHARES = ("precision", "recall")


def measure_floors(
    reference: ReferenceStatistics,
    spaces: Sequence[str],
    metric_names: Sequence[str],
    num_samples: int,
    num_images: int,
    resampling: Resampling,
) -> dict[str, MetricResult]:
    """Compare the first half of the reference, as if it were generated, with the second.

    Args:
        reference: Complete statistics; computed floors are kept in its ``floors``.
        spaces: Names of the feature spaces.
        metric_names: Metrics of :func:`~r3dpa.metrics.collection.scene_metrics` to compute.
        num_samples: Scenes of the evaluation; as many scans of the first half are used, or as many
            as it keeps.
        num_images: The same for the metrics of range images.
        resampling: Its seed draws the scans.

    Returns:
        Rows by name, without intervals; empty where a half has fewer than two scans.
    """
    if min(reference.sizes_of_halves) < 2:
        return {}
    key = (tuple(metric_names), num_samples, num_images, resampling)
    if key in reference.floors:
        return reference.floors[key]
    collection = reference.metrics(spaces, max_images=(None, num_images))
    metrics = metrics_by_name(collection)
    first, second = map(metrics_by_name, reference.halves)
    for name, metric in metrics.items():
        metric.adopt_real(second[name])

    names = reference.names_of_half(0)
    places, images = first["matching"].subset("real")
    metrics["matching"].update(images, real=False, names=[names[place] for place in places])
    if num_samples <= len(images):
        chosen = images[first["matching"].lowest("real", num_samples)]
        metrics["cells"].update(metrics["matching"].points_of_images(chosen), real=False)
        metrics["ranges"].update(chosen, real=False)
    else:  # the sums over all scans of the half are all that is left of the others
        for name in ("cells", "ranges"):
            metrics[name].generated_bins[0] = first[name].real_bins
            metrics[name].generated_count = first[name].real_count.clone()
    for space in spaces:
        rows = first[f"{space}_frechet"].rows("real")
        chosen = torch.randperm(len(rows), generator=resampling.generator())[:num_samples]
        metrics[f"{space}_frechet"].update(rows[chosen], real=False)

    without_intervals = replace(resampling, num_resamples=0)
    metrics = metrics_by_name(collection)  # shares the states within each feature space
    rows = [row for name in metric_names for row in metrics[name].results(without_intervals)]
    reference.floors[key] = {row.name: row for row in rows}
    return reference.floors[key]


def add_floor(row: MetricResult, floors: Floors) -> MetricResult:
    """Return the row with its floor, and with a note on the scans that the floor is of.

    Rows of which higher values are better have no floor; their note says what real scans reach.
    """
    floor = floors.get(row.name)
    if floor is None or floor.value is None or row.value is None:
        return row
    counts = f"{floor.num_samples} and {floor.num_references} scans"
    if row.direction == "higher":
        return _add_note(row, f"real scans reach {floor.value:.3g} ({counts})")
    note = f"floor of {counts}"
    if not row.name.endswith(_UNBIASED) and floor.num_samples != row.num_samples:
        tendency = "high" if (floor.num_samples or 0) < (row.num_samples or 0) else "low"
        note += f", rather {tendency}: the value is of {row.num_samples} scenes"
    return _add_note(replace(row, floor=max(floor.value, 0.0)), note)


def _add_note(row: MetricResult, note: str) -> MetricResult:
    return replace(row, note=f"{row.note}; {note}" if row.note else note)


def verdict(rows: Sequence[MetricResult], floors: Floors, num_scenes: int) -> str:
    """Say in one line which distances are near their floor, and whether scenes are realistic.

    Args:
        rows: Results of the evaluation.
        floors: Results of :func:`measure_floors`.
        num_scenes: Generated scenes.
    """
    if not floors:
        return "no floors to compare with"
    num_scans = min(
        count
        for floor in floors.values()
        for count in (floor.num_samples, floor.num_references)
        if count is not None
    )
    if min(num_scenes, num_scans) < FEWEST_SCENES:
        return (
            f"too few to tell: {num_scenes} scenes, floors between {num_scans} scans; "
            f"give at least {FEWEST_SCENES} scenes and a reference of {2 * FEWEST_SCENES} scans"
        )
    near, far, poor = [], [], []
    for row in rows:
        floor = floors.get(row.name)
        if floor is None or floor.value is None or row.value is None:
            continue
        if row.direction == "lower":
            if row.value <= NEAR_FLOOR * max(floor.value, 0.0) + row.half_width:
                near.append(row.name)
            else:  # unbiased estimates between scans may be below 0
                ratio = row.value / floor.value if floor.value > 0 else math.inf
                far.append((ratio, row.name))
        elif row.name.endswith(_SHARES) and row.value < POOR_SHARE * floor.value:
            poor.append(f"{row.name} {row.value:.2g} (real scans {floor.value:.2g})")
    near_text = f"near the floor in {', '.join(near)}"
    if poor:
        text = f"not realistic: {', '.join(poor)}"
        return f"{text}, though {near_text}" if near else text
    parts = [near_text] if near else []
    if far:
        worst = [
            f"{name} ({ratio:.3g} x)" if ratio < math.inf else f"{name} (floor 0)"
            for ratio, name in sorted(far, reverse=True)[:3]
        ]
        plural = "" if len(far) == 1 else "s"
        parts.append(f"above it in {len(far)} distance{plural}, most in {', '.join(worst)}")
    return "; ".join(parts) or "no floors to compare with"


def warn_of_other_sensor(matching: MinimumMatchingDistance) -> str:
    """Return a warning if scenes and real scans differ by much in their number of returns."""
    if not matching.count("real"):
        return ""
    medians = []
    for side in ("generated", "real"):
        range_m = matching.subset(side)[1]
        medians.append(int((range_m > 0).sum(dim=(1, 2)).median()))
    generated, real = medians
    if SAME_SENSOR_RATIO <= generated / max(real, 1) <= 1 / SAME_SENSOR_RATIO:
        return ""
    return (
        f"{generated:,} returns in a scene (median), but {real:,} in a real scan: scenes of "
        "another sensor need a reference for it, `r3dpa data reference --data` with a YAML of that "
        "sensor"
    )

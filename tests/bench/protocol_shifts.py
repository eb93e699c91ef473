"""Shift of the metrics of fixed samples by each choice in which published protocols differ.

    python tests/bench/protocol_shifts.py SAMPLES DATA notebooks/results/protocols_cpu.json

Published numbers of one generator differ by paper, and so do their protocols: pixel centre, range
cut, projection, number of samples, split of the real scans. One choice at a time is changed from
the protocol of R3DPA, and the samples are evaluated again. Writes the table as JSON and, beside it,
as Markdown.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import torch

from r3dpa.cli.features import read_data
from r3dpa.data.samples import read_samples
from r3dpa.data.scans import evenly
from r3dpa.geometry import Projection, RingProjection, SphericalProjection, range_image
from r3dpa.io import command, machine, source_commit, text_table, versions, write_text
from r3dpa.metrics.evaluation import feature_spaces, measure
from r3dpa.metrics.reference import ReferenceStatistics, cards_of
from r3dpa.metrics.resampling import Resampling
from r3dpa.metrics.scene import PROTOCOLS, EvaluationScene, Protocol


class Choice(NamedTuple):
    """One choice of a protocol, all others as in R3DPA's, and who made it."""

    factor: str
    choice: str
    source: str
    protocol: Protocol
    projection: Projection | None = None  # of the real scans; None for the protocol's
    split: str = "all"  # of the real scans
    share: float = 1.0  # of the samples that count


def choices(base):
    """Choices that papers state or their code shows, one at a time changed from R3DPA's.

    Source: ``evaluate.py`` and paper of R3DPA; data and metrics of R2DM and R2Flow; LiDM.
    """

    def within(least, most):
        return replace(base, sensor=replace(base.sensor, range_min_m=least, range_max_m=most))

    base = within(1.0, 56.0)
    hiding = SphericalProjection(base.sensor, legacy_hiding=True)
    rings = RingProjection(base.sensor, (0.0,) * base.sensor.beams, legacy_rows=True)
    return [
        Choice("", "corners, 1-56 m, train and val", "R3DPA", base),
        Choice("pixel", "centre", "r3dpa", replace(base, unprojection="centre")),
        Choice("range", "0.5-63 m", "R2DM, R2Flow: metrics", within(0.5, 63.0)),
        Choice("range", "1.45-80 m", "R2DM, R2Flow: data", within(1.45, 80.0)),
        Choice("projection", "points out of range hide others", "R2DM, R2Flow", base, hiding),
        Choice("projection", "a row per ring of the scan", "R2DM, R2Flow", base, rings),
        Choice("samples", "a half", "-", base, share=0.5),
        Choice("samples", "a fifth: 2,000 for 10,000", "LiDM", base, share=0.2),
        Choice("reference", "val alone", "R3DPA", base, split="val"),
        Choice("reference", "train alone", "-", base, split="train"),
    ]


def measure_choices(samples, module, scans, spaces=("fgeo",)):
    """Value, 95 % interval and shift of each metric, by choice; ``scans`` are lists by split.

    A split of fewer than two scans is left out.
    """
    entries, references, unchanged, num_samples = [], {}, {}, None
    for choice in choices(replace(PROTOCOLS["published"], sensor=module.sensor)):
        if len(scans[choice.split]) < 2:
            continue
        protocol = choice.protocol
        networks = feature_spaces(spaces, None, protocol, "cpu")
        key = (protocol, choice.projection, choice.split)
        if key not in references:
            names = [scan.name for scan in scans[choice.split]]
            references[key] = ReferenceStatistics(protocol, cards_of(networks), names, {})
            real = (real_scene(module, scan, choice.projection) for scan in scans[choice.split])
            references[key].update(real, networks)
        limit = None if num_samples is None else max(2, round(choice.share * num_samples))
        files = read_samples(samples, protocol.sensor, protocol.unprojection, skip_bad=True)
        scenes = (EvaluationScene(*sample) for sample in islice(files, limit))
        options = {"allow_few": True, "skip_bad": True, "baseline_metrics": True}
        measured = measure(scenes, references[key], networks, Resampling(), **options)
        metrics = {}
        for row in measured.rows:
            if row.value is None:
                continue
            if not choice.factor and row.interval and row.direction == "lower":
                unchanged[row.name] = row
            if row.name in unchanged:
                base = unchanged[row.name]
                metrics[row.name] = {
                    "value": row.value,
                    "interval": row.interval,
                    "shift": row.value - base.value,
                    "beyond_interval": not base.interval[0] <= row.value <= base.interval[1],
                }
        num_samples = num_samples or len(measured.names)
        entry = {"factor": choice.factor, "choice": choice.choice, "source": choice.source}
        counts = {"samples": len(measured.names), "scans": len(references[key].names)}
        entries.append(entry | counts | {"metrics": metrics})
    return entries


def real_scene(module, scan, projection):
    points = module.points(scan)
    if projection is None:
        return EvaluationScene(scan.name, points)
    return EvaluationScene(scan.name, None, range_image(points[:, :3], projection)[0])


def markdown(entries):
    """Table of the entries: values of the first, shifts of the others."""
    names = list(entries[0]["metrics"])
    rows = []
    for entry in entries:
        cells = [": ".join(filter(None, (entry["factor"], entry["choice"]))), entry["source"]]
        for name in names:
            metric = entry["metrics"].get(name)
            if metric is None:
                cells.append("-")
            elif not entry["factor"]:
                low, high = metric["interval"]
                cells.append(f"{metric['value']:.3g} [{low:.3g}, {high:.3g}]")
            else:
                cells.append(f"{metric['shift']:+.2g}{'*' if metric['beyond_interval'] else ''}")
        rows.append(cells)
    table = text_table(rows, ["", "chosen by", *names], "ll" + "r" * len(names), "pipe")
    counts = f"{entries[0]['samples']} samples and {entries[0]['scans']} real scans"
    note = "Below the first row: shift of the value; * beyond the first row's 95 % interval."
    return f"{table}\n\nOf {counts}. {note}\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("samples", type=Path, help="as for r3dpa evaluate")
    parser.add_argument("data", type=Path, help="folder of real scans, or a data YAML")
    parser.add_argument("out", type=Path, help="JSON file")
    parser.add_argument("--limit", type=int, help="maximum real scans per split, evenly spaced")
    arguments = parser.parse_args()
    module = read_data(arguments.data)
    train, val = (evenly(part, arguments.limit) for part in module.limited_split())
    scans = {"all": sorted(train + val), "train": train, "val": val}
    entries = measure_choices(arguments.samples, module, scans)
    card = {"command": command(), "machine": machine(), "commit": source_commit()}
    card |= {"samples": str(arguments.samples), "data": str(arguments.data)}
    content = card | {"versions": versions(torch), "choices": entries}
    write_text(arguments.out, json.dumps(content, indent=1, allow_nan=False) + "\n")
    write_text(arguments.out.with_suffix(".md"), markdown(entries))


if __name__ == "__main__":
    main()

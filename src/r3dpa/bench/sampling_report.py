"""Files, tables, pictures and sentences of ``r3dpa bench sampling``."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from r3dpa import viz
from r3dpa.bench.error_budget import Reference
from r3dpa.bench.front import Row, duration, quality_levels, save_quality_levels, sentences
from r3dpa.bench.hardware import Peak
from r3dpa.bench.timing import Controlled
from r3dpa.checkpoints.networks import format_table
from r3dpa.io import atomic_path, one_line
from r3dpa.viz.pareto import (
    ParetoPlot,
    ParetoPoint,
    discretisation_figure,
    pareto_figure,
    pareto_page,
)

__all__ = ["EVALUATIONS", "Found", "write_report"]

#: NFE of the rows, where there is time for all; the picture shows the least time of each.
EVALUATIONS = (2, 4, 8, 16, 32, 64, 128, 256)

_TITLES = {
    "mixture": "exact velocity of 128 Gaussians in 64 dimensions",
    "model": "trained model",
}


@dataclass(frozen=True)
class Found:
    """All figures of one problem.

    Args:
        rows: All ways to sample.
        reference: The converged solution.
        unsure: Labels of the rows whose error the reference cannot tell.
        front: Indices of the rows that each further second buys something with.
        told: One sentence for each step between them.
        timing: Times of the rows, by label.
        peak: Of the device, in the fastest precision of the rows.
        flop: Of one evaluation, and of everything else of a scene.
        floors: Distances of data from data, by name.
        model: Distances of the converged solution from data, by name.
        against_converged: Distances of rows minus those of the converged solution, by label.
        main: Distance between distributions that is drawn; None where none is known.
    """

    rows: tuple[Row, ...]
    reference: Reference
    unsure: tuple[str, ...]
    front: tuple[int, ...]
    told: tuple[str, ...]
    timing: Controlled
    peak: Peak
    flop: tuple[float, float]
    floors: dict[str, float]
    model: dict[str, float]
    against_converged: dict[str, dict[str, Any]]
    main: str | None


def write_report(
    out: Path, found: Mapping[str, Found], facts: dict[str, Any], published: dict[str, float]
) -> str:
    """All files, and the text of the summary."""
    content = facts | {"problems": {name: _record(part) for name, part in found.items()}}
    with atomic_path(out / "sampling.json") as temporary:
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    _write_rows(out / "sampling.csv", found)
    shown = found.get("model", found["mixture"])
    plots = [plot for name, part in found.items() for plot in _plots(name, part, published)]
    plots = plots[::-1] if "model" in found else plots
    first = "model" if "model" in found else "mixture"
    main, *others = _plots(first, shown, published)
    viz.save(pareto_figure(main), out / "pareto.png")
    for plot in others:
        name = re.sub(r"\W+", "_", plot.value_name.lower()).strip("_")
        viz.save(pareto_figure(plot), out / f"pareto_{name}.png")
    with atomic_path(out / "pareto.html") as temporary:
        ordered = [main, *others, *(plot for plot in plots if plot not in (main, *others))]
        temporary.write_text(pareto_page(ordered), encoding="utf-8")
    panels = {_TITLES[name]: _error_points(part) for name, part in found.items()}
    unsure = {_TITLES[name]: part.reference.self_error for name, part in found.items()}
    viz.save(discretisation_figure(panels, unsure), out / "discretisation.png")
    tail = []
    if "model" in found:
        levels = quality_levels(shown.rows)
        where = facts["machine"]["gpu"] or facts["machine"]["cpu"]
        save_quality_levels(levels, f"{where}, {one_line(facts['model'])}", out / "quality.json")
        tail += [
            f"quality {level}: {choice['solver']}, {choice['steps']} steps, shift "
            f"{choice['shift']:g} (error {choice['error']:.3g}, {choice['seconds_share']:.0%} of "
            "the time of best)"
            for level, choice in levels.items()
        ]
    else:
        tail.append("no checkpoint was given: all figures are of the mixture, none of a model")
    tail += [f"{name}: {one_line(values)}" for name, values in facts.items()]
    with atomic_path(out / "summary.md") as temporary:
        temporary.write_text(_markdown(found, tail), encoding="utf-8")
    tail.append(f"files: {', '.join(sorted(path.name for path in out.iterdir()))}")
    return "\n\n".join([*(_text(name, part) for name, part in found.items()), "\n".join(tail)])


def _record(found: Found) -> dict[str, Any]:
    """Plain values, without samples."""
    return {
        "rows": [asdict(row) for row in found.rows],
        "reference": {
            "solver": "heun",
            "steps": found.reference.steps,
            "nfe": found.reference.solved.nfe,
            "samples": len(found.reference.solved.latents),
            "self_error": found.reference.self_error,
            "certified": not found.unsure,
            "not_converged": list(found.unsure),
        },
        "budget": _budget(found),
        "front": [found.rows[index].label for index in found.front],
        "sentences": list(found.told),
        "timing": {
            "dropped_share": found.timing.dropped,
            "a_a": asdict(found.timing.repeat),
            "sound": found.timing.sound,
            "seconds": {label: asdict(taken) for label, taken in found.timing.series.items()},
        },
        "peak": asdict(found.peak),
        "flop": {"evaluation": found.flop[0], "rest": found.flop[1]},
        "against_converged": found.against_converged,
    }


def _budget(found: Found) -> dict[str, Any]:
    """The four terms of the error, each by itself."""
    known = [row for row in found.rows if row.discretisation is not None]
    least = min(known, key=lambda row: row.discretisation or 0.0)
    return {
        "floor": found.floors,
        "model": found.model,
        "discretisation": {"least": least.discretisation, "row": least.label},
        "precision": {
            row.label: row.precision_error for row in found.rows if row.precision_error is not None
        },
    }


def _write_rows(path: Path, found: Mapping[str, Found]) -> None:
    records = []
    for name, part in found.items():
        for row in part.rows:
            record = {"problem": name} | asdict(row)
            metrics = record.pop("metrics")
            for key in ("error_interval", "seconds_interval"):
                ends = record.pop(key) or (None, None)
                record |= {f"{key}_low": ends[0], f"{key}_high": ends[1]}
            records.append(record | metrics)
    keys = list(dict.fromkeys(key for record in records for key in record))
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, keys)
        writer.writeheader()
        writer.writerows(records)


def _plots(name: str, found: Found, published: Mapping[str, float]) -> list[ParetoPlot]:
    """Error against time and, where data tell it, distance against time."""
    limits = {
        nfe: (nfe * found.flop[0] + found.flop[1]) / found.peak.flop_s
        for nfe in sorted({row.nfe for row in found.rows if row.nfe in EVALUATIONS})
    }
    levels = {}
    bf16 = [row.precision_error for row in found.rows if row.precision == "bf16"]
    if bf16 and bf16[0]:
        levels["bf16 against fp32"] = bf16[0]
    indices = [index for index, row in enumerate(found.rows) if row.error]
    plots = [
        ParetoPlot(
            f"What accuracy costs in time: {_TITLES[name]}",
            "RMSE of the latents from the converged solution",
            tuple(_error_points(found)),
            tuple(indices.index(index) for index in found.front if index in indices),
            levels,
            limits,
            found.peak.flop_s,
            found.told,
        )
    ]
    if found.main is not None:
        plots.append(_distance_plot(name, found, found.main, limits, published))
    return plots


def _distance_plot(
    name: str,
    found: Found,
    main: str,
    limits: Mapping[int, float],
    published: Mapping[str, float],
) -> ParetoPlot:
    """One distance against time; steps below the floor count as ties."""
    rows = [row for row in found.rows if row.metrics.get(main, 0.0) > 0]
    values = [row.metrics[main] for row in rows]
    floor = found.floors.get(main, 0.0)
    chain: list[int] = []
    for index in sorted(range(len(rows)), key=lambda index: rows[index].seconds):
        if not chain or values[index] < values[chain[-1]]:
            chain.append(index)
    told = sentences([rows[i] for i in chain], [values[i] for i in chain], main, floor=floor)
    levels = {"floor (data against data)": floor, "converged model": found.model[main]}
    if main in published:
        levels["published"] = published[main]
    points = []
    for row, value in zip(rows, values, strict=True):
        apart = found.against_converged[row.label].get(main)
        low, high = value, value
        if apart is not None:  # paired by scene, so that the converged model stands still
            low, high = (found.model[main] + apart[end] for end in ("low", "high"))
        points.append(_point(row, value, min(max(low, 1e-9), value), max(high, value)))
    return ParetoPlot(
        f"Distance from data against time: {_TITLES[name]}",
        main,
        tuple(points),
        tuple(chain),
        {key: value for key, value in levels.items() if value > 0},
        limits,
        found.peak.flop_s,
        tuple(told),
        "least distance so far",
    )


def _error_points(found: Found) -> list[ParetoPoint]:
    points = []
    for row in found.rows:
        if row.error and row.error_interval is not None:
            points.append(_point(row, row.error, *row.error_interval))
    return points


def _point(row: Row, value: float, low: float, high: float) -> ParetoPoint:
    details = {
        "steps": str(row.steps),
        "precision": row.precision + (", compiled" if row.compiled else ""),
        "batch": str(row.batch),
        "end to end": duration(row.end_to_end),
        "GFLOP": f"{row.flop / 1e9:.3g}",
        "share of the peak": f"{row.peak_share:.1%}",
    }
    if row.range_rmse_m is not None and row.mask_iou is not None:
        details["range RMSE"] = f"{row.range_rmse_m:.3g} m"
        details["IoU of returns"] = f"{row.mask_iou:.3f}"
    if row.converged is False:
        details["reference"] = "not converged enough"
    if row.suspect:
        details["suspect"] = row.suspect
    details |= {name: f"{number:.3g}" for name, number in row.metrics.items()}
    return ParetoPoint(
        row.label, row.name, row.nfe, row.seconds, value, low, high,
        row.precision == "bf16", details,
    )  # fmt: skip


def _table(found: Found) -> str:
    rows = []
    for row in found.rows:
        optional = (row.error, row.precision_error, row.range_rmse_m, row.mask_iou)
        cells = ["-" if value is None else f"{value:.3g}" for value in optional]
        if row.converged is False:
            cells[0] += " ?"
        distance = row.metrics.get(found.main or "")
        rows.append(
            [
                row.label,
                str(row.nfe),
                *cells,
                "-" if distance is None else f"{distance:.3g}",
                duration(row.seconds) + ("" if row.quiet else " ~"),
                duration(row.end_to_end),
                f"{row.flop / 1e9:.3g}",
                f"{row.flop_s / 1e12:.3g}",
                f"{row.peak_share:.1%}",
                "-" if row.memory_bytes is None else f"{row.memory_bytes / 2**30:.2f}",
            ]
        )
    header = ["row", "NFE", "error", "precision", "range m", "IoU", found.main or "distance"]
    header += ["device s", "end to end", "GFLOP", "TFLOP/s", "of peak", "GPU GiB"]
    return format_table(header, rows)


def _notes(name: str, found: Found) -> list[str]:
    """What a reader must know of the table."""
    reference, timing = found.reference, found.timing
    state = "certified"
    if found.unsure:
        state = f"not converged for {len(found.unsure)} rows (marked ?): {', '.join(found.unsure)}"
    repeat = timing.repeat
    lines = [
        f"{_TITLES[name]}: reference Heun-{reference.steps}, "
        f"{len(reference.solved.latents)} samples, {reference.self_error:.3g} from half its steps: "
        f"{state}",
        f"timing: {timing.dropped:.0%} of the measurements dropped by rule; first row over itself "
        f"{repeat.value:.3f} ({repeat.low:.3f}..{repeat.high:.3f})"
        + ("" if timing.sound else ": the machine was too busy, claim nothing"),
        f"peak {found.peak.flop_s / 1e12:.3g} TFLOP/s ({found.peak.source}); "
        f"{found.flop[0] / 1e9:.3g} GFLOP an evaluation, {found.flop[1] / 1e9:.3g} the rest",
    ]
    if not all(row.quiet for row in found.rows):
        lines.append("~: more than half of the rounds were disturbed, and all of them count")
    for key in found.floors:
        lines.append(
            f"{key}: floor {found.floors[key]:.3g}, converged {found.model.get(key, 0.0):.3g}"
        )
    return lines


def _text(name: str, found: Found) -> str:
    told = ["what each further second buys", *found.told]
    return "\n".join([_table(found), *_notes(name, found), *told])


def _markdown(found: Mapping[str, Found], lines: Sequence[str]) -> str:
    parts = ["# What accuracy costs in time", "", "![Pareto front](pareto.png)", ""]
    for name, part in found.items():
        parts += [f"## {_TITLES[name]}", "", "What each further second buys:", ""]
        parts += [f"- {sentence}" for sentence in part.told]
        parts += ["", "```", _table(part), *_notes(name, part), "```", ""]
    return "\n".join([*parts, *(f"- {line}" for line in lines if line), ""])

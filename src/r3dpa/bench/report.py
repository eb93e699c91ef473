"""Files, table, pictures and advice of ``r3dpa bench sampling``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from r3dpa import viz
from r3dpa.bench.measure import Comparison
from r3dpa.bench.rows import Row, front_of, quality_levels, sentences
from r3dpa.io import atomic_path, one_line, text_table

#: NFE of the rows where there is time for all.
EVALUATIONS = (2, 4, 8, 16, 32, 64, 128, 256)

_TITLES = {
    "mixture": "exact velocity of 128 Gaussians in 64 dimensions",
    "model": "trained model",
}


class Finding(NamedTuple):
    """All figures of one problem.

    ``steps`` are the Heun steps of the converged solution and ``self_error`` its RMSE from that of
    half the steps; ``flop`` is that of one evaluation, and of everything else of a scene.
    """

    rows: Sequence[Row]
    steps: int
    samples: int
    self_error: float
    timing: Comparison
    peak_flop_s: float
    flop: tuple[float, float]


def write_report(out: Path, found: Mapping[str, Finding], facts: dict[str, Any]) -> str:
    """Writes all files; returns the text of the summary."""
    content = facts | {"problems": {name: _record(part) for name, part in found.items()}}
    _write(out / "sampling.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    name = "model" if "model" in found else "mixture"
    viz.save(_picture(name, found[name]), out / "pareto.png")
    panels = {_TITLES[key]: _points(part.rows) for key, part in found.items()}
    unsure = {_TITLES[key]: part.self_error for key, part in found.items()}
    viz.save(viz.discretisation_figure(panels, unsure), out / "discretisation.png")
    tail = ["no checkpoint was given: all figures are of the mixture, none of a model"]
    if "model" in found:
        levels = quality_levels(found[name].rows)
        where = f"{facts['machine']['gpu'] or facts['machine']['cpu']}, {one_line(facts['model'])}"
        table = {"levels": levels, "measured_on": where}
        _write(out / "quality.json", json.dumps(table, indent=2, allow_nan=False) + "\n")
        tail = [
            f"quality {level}: {choice['solver']}, {choice['steps']} steps, shift "
            f"{choice['shift']:g} (error {choice['error']:.3g}, {choice['seconds_share']:.0%} of "
            "the time of best)"
            for level, choice in levels.items()
        ]
    tail += [f"{key}: {one_line(values)}" for key, values in facts.items()]
    lines = ["# What accuracy costs in time", "", "![Pareto front](pareto.png)", ""]
    for key, part in found.items():
        steps = sentences(front_of(part.rows, part.timing.tolerance))
        lines += [f"## {_TITLES[key]}", "", "What each further second buys:", ""]
        lines += [*(f"- {sentence}" for sentence in steps), "", "```", _table(part), *_notes(part)]
        lines += ["```", ""]
    _write(out / "summary.md", "\n".join([*lines, *(f"- {line}" for line in tail), ""]))
    files = sorted(path.name for path in out.iterdir() if path.is_file())
    return "\n".join([*lines[4:], *tail, f"files: {', '.join(files)}"])


def _write(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _record(found: Finding) -> dict[str, Any]:
    """Plain values, without samples."""
    front = front_of(found.rows, found.timing.tolerance)
    unsure = [row.label for row in found.rows if not row.converged]
    return {
        "rows": [row.record() for row in found.rows],
        "reference": {
            "solver": "heun",
            "steps": found.steps,
            "samples": found.samples,
            "self_error": found.self_error,
            "certified": not unsure,
            "not_converged": unsure,
        },
        "front": [row.label for row in front],
        "sentences": sentences(front),
        "timing": {
            "a_a": asdict(found.timing.repeat),
            "sound": found.timing.sound,
        },
        "peak_flop_s": found.peak_flop_s,
        "flop": {"evaluation": found.flop[0], "rest": found.flop[1]},
    }


def _picture(name: str, found: Finding) -> Figure:
    """Error against time."""
    front = front_of(found.rows, found.timing.tolerance)
    bf16 = [row for row in found.rows if row.way.precision == "bf16" and row.precision_error]
    return viz.pareto_figure(
        f"What accuracy costs in time: {_TITLES[name]}",
        "RMSE of the latents from the converged solution",
        _points(found.rows),
        _points(front),
        {"bf16 against fp32": bf16[0].precision_error or 0.0} if bf16 else {},
        sentences(front),
    )


def _points(rows: Sequence[Row]) -> list[viz.ParetoPoint]:
    return [
        viz.ParetoPoint(
            row.label,
            row.way.name,
            row.way.nfe,
            row.seconds,
            row.error,
            row.interval,
            filled=row.way.precision == "bf16",
        )
        for row in rows
        if row.error > 0
    ]


#: Column of the table, key of the row, factor and format.
_COLUMNS = (
    ("NFE", "nfe", 1, "d"),
    ("error", "error", 1, ".3g"),
    ("precision", "precision_error", 1, ".3g"),
    ("range m", "range_rmse_m", 1, ".3g"),
    ("IoU", "mask_iou", 1, ".3g"),
    ("device ms", "seconds", 1e3, ".4g"),
    ("end to end ms", "end_to_end", 1e3, ".4g"),
    ("GFLOP", "flop", 1e-9, ".3g"),
    ("TFLOP/s", "flop_s", 1e-12, ".3g"),
    ("of peak", "peak_share", 1, ".1%"),
    ("GPU GiB", "memory_bytes", 2**-30, ".2f"),
)


def _table(found: Finding) -> str:
    """All rows."""
    lines = []
    for row in found.rows:
        values = row.record()
        cells = [
            "-" if values[key] is None else format(values[key] * factor, style)
            for _, key, factor, style in _COLUMNS
        ]
        lines.append([row.label + ("" if row.converged else " ?"), *cells])
    return text_table(lines, ["row", *(column[0] for column in _COLUMNS)])


def _notes(found: Finding) -> list[str]:
    """Conditions of the measurement that a reader of the table needs."""
    return [
        f"error: RMSE from Heun-{found.steps} of {found.samples} samples, itself "
        f"{found.self_error:.3g} from half its steps; ?: error too small for that reference",
        f"timing: first row over itself {found.timing.repeat}"
        + ("" if found.timing.sound else ": the machine was too busy, claim nothing"),
        f"peak {found.peak_flop_s / 1e12:.3g} TFLOP/s; "
        f"{found.flop[0] / 1e9:.3g} GFLOP an evaluation, {found.flop[1] / 1e9:.3g} the rest",
    ]

"""Table, picture and files of ``r3dpa bench sampling``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from r3dpa import viz
from r3dpa.io import one_line, text_table, write_text

_TITLES = {"mixture": "exact velocity of 128 Gaussians in 64 dimensions", "model": "trained model"}
#: Column of the table, key of the row, factor and format.
_COLUMNS = (
    ("NFE", "nfe", 1, "d"),
    ("error", "error", 1, ".3g"),
    ("precision", "precision_error", 1, ".3g"),
    ("range m", "range_rmse_m", 1, ".3g"),
    ("IoU", "mask_iou", 1, ".3g"),
    ("ms per scene", "seconds", 1e3, ".4g"),
    ("GFLOP", "flop", 1e-9, ".3g"),
    ("TFLOP/s", "flop_s", 1e-12, ".3g"),
)

Row = Mapping[str, Any]


def pareto_front(rows: Sequence[Row]) -> list[str]:
    """Labels of the rows with a smaller error than every faster one, from the fastest on."""
    front: list[Row] = []
    for row in sorted(rows, key=lambda row: (row["seconds"], row["error"])):
        if not front or row["error"] < front[-1]["error"]:
            front.append(row)
    return [row["label"] for row in front]


def write_report(
    out: Path, problems: Mapping[str, Mapping[str, Any]], facts: dict[str, Any]
) -> str:
    """Write ``sampling.json``, ``summary.md`` and ``pareto.png``; return the text of the summary.

    Args:
        out: Folder of the files.
        problems: Figures by problem, see :func:`r3dpa.bench.sampling.run_problem`.
        facts: What was measured, and where.
    """
    content = json.dumps(facts | {"problems": problems}, indent=1, allow_nan=False)
    write_text(out / "sampling.json", f"{content}\n")
    last = list(problems)[-1]
    viz.save(_picture(_TITLES[last], problems[last]), out / "pareto.png")
    lines = []
    for name, problem in problems.items():
        lines += [f"## {_TITLES[name]}", "", "```", _table(problem), *_notes(problem), "```", ""]
    lines += [f"- {name}: {one_line(values)}" for name, values in facts.items()]
    text = "\n".join(lines)
    head = "# What accuracy costs in time\n\n![Pareto front](pareto.png)\n\n"
    write_text(out / "summary.md", f"{head}{text}\n")
    return f"{text}\nfiles: {', '.join(sorted(p.name for p in out.iterdir() if p.is_file()))}"


def _picture(title: str, problem: Mapping[str, Any]) -> Figure:
    points = {
        row["label"]: viz.ParetoPoint(
            row["label"],
            row["name"],
            row["seconds"],
            row["error"],
            row["error_interval"],
            filled=row["precision"] == "bf16",
        )
        for row in problem["rows"]
        if row["error"] > 0
    }
    bf16 = [row["precision_error"] for row in problem["rows"] if row["precision_error"]]
    return viz.pareto_figure(
        f"What accuracy costs in time: {title}",
        "RMSE of the latents from the converged solution",
        list(points.values()),
        [points[label] for label in problem["front"] if label in points],
        {"bf16 against fp32": bf16[0]} if bf16 else {},
    )


def _table(problem: Mapping[str, Any]) -> str:
    lines = []
    for row in problem["rows"]:
        in_front = " *" if row["label"] in problem["front"] else ""
        unsure = "" if row["converged"] else " ?"
        cells = [
            "-" if row[key] is None else format(row[key] * factor, style)
            for _, key, factor, style in _COLUMNS
        ]
        lines.append([f"{row['label']}{in_front}{unsure}", *cells])
    return text_table(lines, ["row", *(column[0] for column in _COLUMNS)])


def _notes(problem: Mapping[str, Any]) -> list[str]:
    reference, timing, flop = (problem[name] for name in ("reference", "timing", "flop"))
    again = "{value:.3f} ({low:.3f}..{high:.3f})".format(**timing["a_a"])
    busy = "" if timing["sound"] else ": the machine was too busy, claim nothing"
    return [
        "*: Pareto front, no row is both faster and more exact",
        f"error: RMSE from Heun-{reference['steps']} of {reference['samples']} samples, itself "
        f"{reference['self_error']:.3g} from half its steps; ?: too small for that reference",
        f"timing: first row over itself {again}{busy}",
        f"{flop['evaluation'] / 1e9:.3g} GFLOP per evaluation, {flop['rest'] / 1e9:.3g} the rest",
    ]

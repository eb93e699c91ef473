"""Results of evaluations: numbers with intervals and floors, and their tables.

Values are stored as computed; a power of ten applies to the printed column only: JSD = 0.0567 is
stored, and 5.67 is printed below 10^-2.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, Self

from tabulate import LATEX_ESCAPE_RULES

from r3dpa.io import text_table, write_text
from r3dpa.metrics.resampling import Ends

Direction = Literal["lower", "higher"]
Split = Literal["train-val", "val-only"]
Mark = Literal["", "best", "second", "tie"]

_PUBLISHED: Any = json.loads(files(__package__).joinpath("published.json").read_text("utf-8"))
#: Power of ten of the printed column of each metric of the paper.
PUBLISHED_SCALES: dict[str, int] = _PUBLISHED["scales"]
_SHOWN_BAD = 20  # samples left out that are printed
# How often they hold: notebooks/results/interval_coverage.json.
_INTERVAL = (
    "95 % interval (measured to hold in 90 to 99 %) over draws of as many generated scenes "
    "against the same real scans"
)
_FLOOR = "real vs. real (floor)"
_DISTANCES = (*PUBLISHED_SCALES, "FWID", "FGEO")
#: Provenance of an evaluation, by default unknown.
_ABOUT: dict[str, Any] = {
    "backbones": {},  # card of each feature network
    "protocol": {},
    "reference": "",  # split, count and hash of the names of the real scans
    "solver": None,
    "steps": None,
    "seed": None,
    "precision": None,
    "commit": None,
    "feature_source": None,  # features that the generator was aligned to
    "published": False,
    "source": "",  # files of the samples, or line of the publication
    "extra": {},  # anything else, such as "bad_samples": those left out, each with the reason
}
_MARKDOWN: dict[Mark, str] = {"": "{}", "best": "**{}**", "second": "_{}_", "tie": "= {}"}
_LATEX_ESCAPES = str.maketrans(LATEX_ESCAPE_RULES)
_LATEX: dict[Mark, str] = {
    "": "{}",
    "best": r"\textbf{{{}}}",
    "second": r"\underline{{{}}}",
    "tie": "{}$^{{=}}$",
}


@dataclass(frozen=True)
class MetricResult:
    """One number of an evaluation.

    The 95 % interval is the spread of the value over draws of this many generated scenes, compared
    with the same real scans, unless the note names another. It is not corrected for the bias of few
    scenes, except for extrapolated values, and too wide where the value is mostly such a bias.
    """

    name: str  #: of the metric, as in the head of a column
    value: float | None  #: in ``unit``; None if unknown, with the reason in ``note``
    interval: Ends | None = None
    floor: float | None = None  #: value of real scans against real scans
    direction: Direction = "lower"  #: which values are better
    unit: str = ""
    scale: int = 0  #: power of ten of the printed column
    num_samples: int | None = None  #: generated scans that were used
    num_references: int | None = None  #: real scans that were used
    note: str = ""

    def __post_init__(self) -> None:
        numbers = [self.value or 0.0, self.floor or 0.0, *(self.interval or ())]
        if not all(map(math.isfinite, numbers)) or numbers[2:] != sorted(numbers[2:]):
            raise ValueError(f"{self}: give finite numbers, the lower end of the interval first")
        if self.interval is not None:  # a list, in JSON
            object.__setattr__(self, "interval", tuple(self.interval))

    @property
    def half_width(self) -> float:
        """Half the width of the interval; 0 without one."""
        return 0.0 if self.interval is None else (self.interval[1] - self.interval[0]) / 2

    @property
    def badness(self) -> float:
        """The value with a sign that makes smaller ones better; infinite if it is None."""
        if self.value is None:
            return math.inf
        return self.value if self.direction == "lower" else -self.value

    def ties_with(self, other: MetricResult) -> bool:
        """Whether two values differ by no more than their floors or their intervals.

        The half widths of independent values add in squares, and unknown ones count as 0::

            |a - b| <= max(floor_a, floor_b, sqrt(half_width_a^2 + half_width_b^2))
        """
        intervals = math.hypot(self.half_width, other.half_width)
        allowed = max(intervals, self.floor or 0.0, other.floor or 0.0)
        return abs(self.badness - other.badness) <= allowed

    def printed(self, number: float | None) -> str:
        """A number of this metric in its column: two decimals, more if it is small."""
        if number is None:
            return "-"
        number /= 10.0**self.scale
        return f"{number:.2g}" if 0 < abs(number) < 0.1 else f"{number:.2f}"

    @property
    def printed_interval(self) -> str:
        """``[low, high]``; empty without an interval."""
        return ", ".join(map(self.printed, self.interval)).join("[]") if self.interval else ""


@dataclass(frozen=True)
class Evaluation:
    """All numbers of one set of samples against one reference; ``str`` gives them as a table.

    ``about`` is the provenance, with the keys of ``_ABOUT`` and values that JSON can hold; those
    left out get its defaults.
    """

    label: str
    rows: tuple[MetricResult, ...]
    about: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        about = json.loads(json.dumps(_ABOUT | self.about, allow_nan=False))
        object.__setattr__(self, "rows", tuple(self.rows))
        object.__setattr__(self, "about", about)

    @property
    def published(self) -> bool:
        """Whether the numbers come from a publication."""
        return self.about["published"]

    @property
    def name(self) -> str:
        """Label in tables."""
        return " ".join(self.label.split()) + " (published)" * self.published

    @property
    def bad_samples(self) -> list[str]:
        """Name and reason of each sample that was left out."""
        return self.about["extra"].get("bad_samples", [])

    def row(self, name: str) -> MetricResult | None:
        """Result of a metric; None without such a row or without a value."""
        return next((r for r in self.rows if r.name == name and r.value is not None), None)

    def only(self, names: Sequence[str]) -> Self:
        """The evaluation with the rows of these metrics alone."""
        return replace(self, rows=tuple(row for row in self.rows if row.name in names))

    def __str__(self) -> str:
        heads = ("metric", "value", "interval", "floor", "better", "samples", "references", "note")
        table = text_table(map(_cells, self.rows), heads, align="lrrrlrrl")
        extra = dict(self.about["extra"])
        head = [f"{key}: {extra.pop(key)}" for key in ("verdict", "warning") if extra.get(key)]
        bad = extra.pop("bad_samples", [])
        about = {**self.about, "protocol": self.about["protocol"].get("name"), **extra}
        lines = [
            f"{key}: {value}"
            for key, value in about.items()
            if isinstance(value, str | int | float) and not isinstance(value, bool)
        ]
        if bad:
            lines.append(f"samples that cannot be used and are left out: {len(bad)}")
        if len(bad) > _SHOWN_BAD:
            bad = [*bad[:_SHOWN_BAD], f"and {len(bad) - _SHOWN_BAD} more"]
        if any(row.interval for row in self.rows):
            lines.insert(0, f"interval: {_INTERVAL}, unless noted; too wide near the floor")
        return "\n".join([self.label, *head, "", table, "", *lines, *bad])

    def save(self, path: str | Path) -> None:
        """Writes the evaluation as JSON."""
        write_text(path, json.dumps(asdict(self), indent=2, ensure_ascii=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads what ``save`` wrote; a ``ValueError`` names the file and the fault."""
        try:
            stored = json.loads(Path(path).read_text(encoding="utf-8"))
            stored["rows"] = tuple(MetricResult(**row) for row in stored["rows"])
            return cls(**stored)
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            raise ValueError(f"{path} holds no evaluation: {error}") from error


@dataclass(frozen=True)
class EvaluationTable:
    """Evaluations as lines, metrics as columns; ``str`` gives the table for a terminal.

    The best and the second best value are marked where intervals and floors separate them from all
    that follow; tied values have an equals sign instead. A column with fewer than two values to
    rank has no marks, and published numbers, which have no intervals, are not ranked.

    Args:
        evaluations: At least one; published ones are printed first.
    """

    evaluations: Sequence[Evaluation]

    def __post_init__(self) -> None:
        ordered = sorted(self.evaluations, key=lambda evaluation: not evaluation.published)
        object.__setattr__(self, "evaluations", tuple(ordered))

    @cached_property
    def columns(self) -> dict[str, list[MetricResult | None]]:
        """Results of each metric that has a value, one per evaluation; those of the paper first."""
        given = [row.name for e in self.evaluations for row in e.rows]
        names = dict.fromkeys((*PUBLISHED_SCALES, *given))
        columns = {name: [e.row(name) for e in self.evaluations] for name in names}
        return {name: column for name, column in columns.items() if any(column)}

    def marks(self, metric: str) -> list[Mark]:
        """Mark of each evaluation in a column."""
        marks: list[Mark] = [""] * len(self.evaluations)
        left = {
            index: result
            for index, result in enumerate(self.columns[metric])
            if result is not None and not self.evaluations[index].published
        }
        places: tuple[Mark, ...] = ("best", "second") if len(left) > 1 else ()
        for place in places:
            best = min(left.values(), key=lambda result: result.badness)
            tied = [index for index, result in left.items() if result.ties_with(best)]
            if len(tied) > 1:
                return ["tie" if index in tied else mark for index, mark in enumerate(marks)]
            marks[tied[0]] = place
            del left[tied[0]]
        return marks

    def __str__(self) -> str:
        def cell(result: MetricResult, mark: Mark) -> str:
            value = _MARKDOWN[mark].format(result.printed(result.value))
            return f"{value} {result.printed_interval}".strip()

        heads = []
        for result in map(_first, self.columns.values()):
            scale = f"1e{result.scale}" * bool(result.scale)
            kind = ", ".join(filter(None, [scale, result.unit, result.direction]))
            heads.append(f"{result.name} ({kind})")
        table = text_table(self._lines(cell), ["", *heads], "l" + "r" * len(heads), "pipe")
        marks = "**best**, _second_, = tie: no further apart than the floor or the intervals"
        interval = f"[low, high]: {_INTERVAL} (MMD: real scans drawn, generated scenes fixed)"
        below = [f"- {text}" for text in (marks, interval, *self.notes)]
        return "\n".join([table, "", *below]) + "\n"

    def latex(self) -> str:
        r"""The table as a ``tabular`` of the package booktabs: best bold, second underlined.

        Intervals, which would make it too wide for a page, are left out; notes are comments.
        """
        arrows = {"lower": r"$\downarrow$", "higher": r"$\uparrow$"}
        heads = []
        for result in map(_first, self.columns.values()):
            scale = rf"$\times 10^{{{result.scale}}}$" * bool(result.scale)
            name = result.name.translate(_LATEX_ESCAPES)
            heads.append(f"{name} {arrows[result.direction]} {scale}{result.unit}")
        found = self._lines(lambda result, mark: _LATEX[mark].format(result.printed(result.value)))
        lines = [[first.translate(_LATEX_ESCAPES), *cells] for first, *cells in found]
        table = text_table(lines, ["Method", *heads], "l" + "r" * len(heads), "latex_raw")
        for rule in ("toprule", "midrule", "bottomrule"):
            table = table.replace(r"\hline", f"\\{rule}", 1)
        return "\n".join([*(f"% {' '.join(note.split())}" for note in self.notes), table, ""])

    @property
    def notes(self) -> list[str]:
        """Differences between the evaluations, samples left out, reasons of absent values."""
        own = [e for e in self.evaluations if not e.published]
        published = {e.about["reference"]: None for e in self.evaluations if e.published}
        notes = [f"published: against {name}, not ranked" for name in published]
        notes += [
            f"not the same {key}: {', '.join(e.label for e in own)}"
            for key in ("protocol", "reference", "backbones")
            if any(e.about[key] != own[0].about[key] for e in own[1:])
        ]
        counts: dict[str, list[str]] = {}
        for e in self.evaluations:
            numbers = sorted({row.num_samples for row in e.rows if row.num_samples})
            text = " or ".join(f"{number:,}" for number in numbers) or "an unknown number"
            counts.setdefault(text, []).append(e.name)
        if len(counts) > 1:
            listed = "; ".join(f"{text} of {', '.join(names)}" for text, names in counts.items())
            notes.append(f"not the same number of scenes: {listed}")
        for e in own:
            if e.bad_samples:
                left_out = f"samples that cannot be used and are left out: {len(e.bad_samples)}"
                notes.append(f"{e.name}: {left_out}")
            notes += [f"{e.name}, {row.name}: {row.note}" for row in e.rows if row.value is None]
        return notes

    def _lines(self, cell: Callable[[MetricResult, Mark], str]) -> list[list[str]]:
        """Lines of cells: the published evaluations, the others, the floors."""
        cells = []
        for metric, column in self.columns.items():
            known = sorted(r.floor for r in column if r is not None and r.floor is not None)
            floors = dict.fromkeys(map(_first(column).printed, known[:1] + known[-1:]))
            marked = zip(column, self.marks(metric), strict=True)
            texts = [cell(result, mark) if result else "-" for result, mark in marked]
            cells.append([*texts, " to ".join(floors) or "-"])
        names = [e.name.replace("|", "/") for e in self.evaluations]
        lines = [list(line) for line in zip([*names, _FLOOR], *cells, strict=True)]
        return lines if any(text != "-" for text in lines[-1][1:]) else lines[:-1]


def report(evaluation: Evaluation, split: str | None, earlier: Sequence[Evaluation] = ()) -> str:
    """All numbers of an evaluation, and its distances beside earlier or the published ones."""
    return f"{evaluation}\n\n{_comparison(evaluation, split, earlier)}"


def save_reports(
    evaluation: Evaluation, split: str | None, out: Path, earlier: Sequence[Evaluation] = ()
) -> None:
    """Writes ``evaluation.json`` and ``metrics.csv`` (all rows), ``table.md`` and ``table.tex``.

    The latter two have the distances beside earlier or the published ones.
    """
    evaluation.save(out / "evaluation.json")
    save_csv((evaluation,), out / "metrics.csv")
    table = _comparison(evaluation, split, earlier)
    write_text(out / "table.md", str(table))
    write_text(out / "table.tex", table.latex())


def save_csv(evaluations: Iterable[Evaluation], path: Path) -> None:
    """Writes every row of every evaluation as a line, with values as they were computed."""
    keys = [key.name for key in fields(MetricResult) if key.name not in ("name", "interval")]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["label", "published", "metric", "low", "high", *keys])
    for e in evaluations:
        for row in e.rows:
            ends = row.interval or (None, None)
            values = [getattr(row, key) for key in keys]
            writer.writerow([e.label, e.published, row.name, *ends, *values])
    write_text(path, text.getvalue())


def _comparison(
    evaluation: Evaluation, split: str | None, earlier: Sequence[Evaluation]
) -> EvaluationTable:
    if earlier:
        return EvaluationTable([one.only(_DISTANCES) for one in (*earlier, evaluation)])
    own = evaluation.only(_DISTANCES)
    names = [row.name for row in own.rows]
    published = published_evaluations("val-only" if split == "val" else "train-val")
    others = [other.only(names) for other in published]
    return EvaluationTable((*(other for other in others if other.rows), own))


def published_evaluations(split: Split) -> tuple[Evaluation, ...]:
    """Rows of the main table of the paper, without intervals and floors.

    MMD was computed against validation scans alone and belongs to ``"val-only"``.

    Source: R3DPA (ICRA 2026), table of unconditional generation on KITTI-360.
    """
    return tuple(
        published_evaluation(
            method["label"],
            method[split],
            f"KITTI-360, {split}",
            _PUBLISHED["source"],
            dict.fromkeys(method[split], (method["num_samples"], None))
            | {"MMD": _PUBLISHED["counts_of_mmd"]},
            solver=method["solver"],
            steps=method["steps"],
        )
        for method in _PUBLISHED["methods"]
    )


def published_evaluation(
    label: str,
    printed: Mapping[str, float],
    reference: str,
    source: str,
    counts: Mapping[str, tuple[int | None, int | None]] | None = None,
    **about: Any,
) -> Evaluation:
    """Evaluation of numbers as the paper printed them, with counts of scenes by metric."""
    rows = []
    for name, number in printed.items():
        value = float(f"{number}e{PUBLISHED_SCALES[name]}")  # decimal shift, free of rounding
        scale, (samples, real) = PUBLISHED_SCALES[name], (counts or {}).get(name, (None, None))
        row = MetricResult(name, value, scale=scale, num_samples=samples, num_references=real)
        rows.append(row)
    about |= {"protocol": {"name": "published"}, "reference": reference, "source": source}
    return Evaluation(label, tuple(rows), about | {"published": True})


def _cells(row: MetricResult) -> tuple[str, ...]:
    counts = ["-" if n is None else f"{n:,}" for n in (row.num_samples, row.num_references)]
    scale, unit = f" x1e{row.scale}" * bool(row.scale), f" ({row.unit})" * bool(row.unit)
    return (
        f"{row.name}{scale}{unit}",
        row.printed(row.value),
        row.printed_interval or "-",
        row.printed(row.floor),
        row.direction,
        *counts,
        row.note,
    )


def _first(column: Sequence[MetricResult | None]) -> MetricResult:
    return next(filter(None, column))

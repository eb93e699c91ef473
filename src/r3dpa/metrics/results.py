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

from r3dpa.feature_names import SPACES
from r3dpa.io import text_table, write_text
from r3dpa.metrics.resampling import Ends

Direction = Literal["lower", "higher"]
Split = Literal["train-val", "val-only"]
Mark = Literal["", "best", "second", "tie"]

_PUBLISHED: Any = json.loads(files(__package__).joinpath("published.json").read_text("utf-8"))
#: Data set of the published numbers, as ``about["dataset"]`` of a reference names it.
PUBLISHED_DATASET = "KITTI-360"
#: Power of ten of the printed column of each metric of the paper.
PUBLISHED_SCALES: dict[str, int] = _PUBLISHED["scales"]
_SHOWN_BAD = 20  # samples left out that are printed
# Measured in notebooks/results/interval_coverage.json.
_INTERVAL = (
    "95 % interval (measured to hold in 90 to 99 %) over draws of as many generated scenes "
    "against the same real scans; of a mean over trainings, over these"
)
_FLOOR = "real vs. real (floor)"
#: Of references that were computed before they named their data set.
_UNKNOWN_DATASET = (
    "- published numbers left out: the reference does not say whether it is of KITTI-360; "
    "compute it again with `r3dpa data reference`\n"
)
#: Distances of the main tables, the ones in the paper first.
DISTANCES = tuple(dict.fromkeys([*PUBLISHED_SCALES, *(space.upper() for space in SPACES)]))
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
    "feature_source": None,  # features that the generator was aligned with
    "published": False,
    "source": "",  # files of the samples, or line of the publication
    "extra": {},  # anything else, such as "bad_samples": names and faults of samples left out
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

    The 95 % interval is the spread of the value over draws of as many generated scenes, compared
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
        numbers = [self.value or 0.0, self.floor or 0.0]
        if self.interval is not None:
            low, high = self.interval
            numbers += [low, high]
            if low > high:
                raise ValueError(f"{self}: give the lower end of the interval first")
            object.__setattr__(self, "interval", (low, high))  # a list, in JSON
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"{self}: give finite numbers")

    @property
    def half_width(self) -> float:
        """Half the width of the interval; 0 without one."""
        return 0.0 if self.interval is None else (self.interval[1] - self.interval[0]) / 2

    @property
    def sort_key(self) -> float:
        """Value with the sign that makes smaller ones better; infinite if it is None."""
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
        return abs(self.sort_key - other.sort_key) <= allowed

    def printed(self, number: float | None) -> str:
        """Format a number of this metric for its column: two decimals, more if it is small."""
        if number is None:
            return "-"
        number /= 10.0**self.scale
        return f"{number:.2g}" if 0 < abs(number) < 0.1 else f"{number:.2f}"

    @property
    def printed_interval(self) -> str:
        """``[low, high]``; empty without an interval."""
        if self.interval is None:
            return ""
        low, high = self.interval
        return f"[{self.printed(low)}, {self.printed(high)}]"


@dataclass(frozen=True)
class Evaluation:
    """All numbers of one set of samples against one reference; ``str`` gives them as a table.

    ``about`` is the provenance, with the keys and default values of ``_ABOUT``. Values must be such
    as JSON can hold.
    """

    label: str
    rows: tuple[MetricResult, ...]
    about: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        as_json = json.dumps(_ABOUT | self.about, allow_nan=False)
        about = json.loads(as_json)  # equal to what a saved evaluation loads
        object.__setattr__(self, "rows", tuple(self.rows))
        object.__setattr__(self, "about", about)

    @property
    def published(self) -> bool:
        """Whether the numbers come from a publication."""
        return self.about["published"]

    @property
    def name(self) -> str:
        """Label in tables."""
        label = " ".join(self.label.split())
        return f"{label} (published)" if self.published else label

    @property
    def bad_samples(self) -> list[str]:
        """Name and fault of each sample that was left out."""
        return self.about["extra"].get("bad_samples", [])

    def row(self, name: str) -> MetricResult | None:
        """Return the result of a metric; None without such a row or without a value."""
        for row in self.rows:
            if row.name == name and row.value is not None:
                return row
        return None

    def only(self, names: Sequence[str]) -> Self:
        """Return the evaluation with the rows of these metrics alone."""
        return replace(self, rows=tuple(row for row in self.rows if row.name in names))

    def __str__(self) -> str:
        heads = ("metric", "value", "interval", "floor", "better", "samples", "references", "note")
        table = text_table(map(_cells, self.rows), heads, align="lrrrlrrl")
        extra = self.about["extra"]
        head = [f"{key}: {extra[key]}" for key in ("verdict", "warning") if extra.get(key)]
        lines = []
        if any(row.interval for row in self.rows):
            lines.append(f"interval: {_INTERVAL}, unless noted; too wide near the floor")
        about = {**self.about, "protocol": self.about["protocol"].get("name"), **extra}
        for key, value in about.items():
            is_plain = isinstance(value, str | int | float) and not isinstance(value, bool)
            if is_plain and key not in ("verdict", "warning"):
                lines.append(f"{key}: {value}")
        bad = self.bad_samples
        if bad:
            lines.append(f"samples that cannot be used and are left out: {len(bad)}")
            lines += bad[:_SHOWN_BAD]
        if len(bad) > _SHOWN_BAD:
            lines.append(f"and {len(bad) - _SHOWN_BAD} more")
        return "\n".join([self.label, *head, "", table, "", *lines])

    def save(self, path: str | Path) -> None:
        """Write the evaluation as JSON."""
        write_text(path, json.dumps(asdict(self), indent=2, ensure_ascii=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what ``save`` wrote.

        Raises:
            ValueError: Naming the file and the fault.
        """
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
        """Results of each metric that has a value, one per evaluation; the paper's first."""
        names = list(PUBLISHED_SCALES)
        for evaluation in self.evaluations:
            names += [row.name for row in evaluation.rows if row.name not in names]
        columns = {name: [e.row(name) for e in self.evaluations] for name in names}
        return {name: column for name, column in columns.items() if any(column)}

    def marks(self, metric: str) -> list[Mark]:
        """Return the mark of each evaluation in a column; none where references differ."""
        marks: list[Mark] = [""] * len(self.evaluations)
        ranked = {
            index: result
            for index, result in enumerate(self.columns[metric])
            if result is not None and not self.evaluations[index].published
        }
        abouts = [self.evaluations[index].about for index in ranked]
        same = all(
            about[key] == abouts[0][key] for about in abouts for key in ("protocol", "reference")
        )
        if len(ranked) < 2 or not same:
            return marks
        places: tuple[Mark, ...] = ("best", "second")
        for place in places:
            best = min(ranked.values(), key=lambda result: result.sort_key)
            tied = [index for index, result in ranked.items() if result.ties_with(best)]
            if len(tied) > 1:
                for index in tied:
                    marks[index] = "tie"
                break
            marks[tied[0]] = place
            del ranked[tied[0]]
        return marks

    def __str__(self) -> str:
        def cell(result: MetricResult, mark: Mark) -> str:
            value = _MARKDOWN[mark].format(result.printed(result.value))
            return f"{value} {result.printed_interval}".strip()

        heads = []
        for result in map(_first, self.columns.values()):
            scale = f"1e{result.scale}" if result.scale else ""
            kind = [word for word in (scale, result.unit, result.direction) if word]
            heads.append(f"{result.name} ({', '.join(kind)})")
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
            scale = rf"$\times 10^{{{result.scale}}}$" if result.scale else ""
            name = result.name.translate(_LATEX_ESCAPES)
            heads.append(f"{name} {arrows[result.direction]} {scale}{result.unit}")
        lines = self._lines(lambda result, mark: _LATEX[mark].format(result.printed(result.value)))
        lines = [[name.translate(_LATEX_ESCAPES), *cells] for name, *cells in lines]
        table = text_table(lines, ["Method", *heads], "l" + "r" * len(heads), "latex_raw")
        for rule in ("toprule", "midrule", "bottomrule"):
            table = table.replace(r"\hline", f"\\{rule}", 1)
        return "\n".join([*(f"% {' '.join(note.split())}" for note in self.notes), table, ""])

    @property
    def notes(self) -> list[str]:
        """Differences between the evaluations, samples left out, reasons of absent values."""
        measured = [e for e in self.evaluations if not e.published]
        references = dict.fromkeys(e.about["reference"] for e in self.evaluations if e.published)
        notes = [f"published: against {name}, not ranked" for name in references]
        for key in ("protocol", "reference", "backbones"):
            if any(e.about[key] != measured[0].about[key] for e in measured[1:]):
                notes.append(f"not the same {key}: {', '.join(e.label for e in measured)}")
        notes += self._notes_on_counts()
        for e in measured:
            if e.bad_samples:
                left_out = f"samples that cannot be used and are left out: {len(e.bad_samples)}"
                notes.append(f"{e.name}: {left_out}")
            notes += [f"{e.name}, {row.name}: {row.note}" for row in e.rows if row.value is None]
        return notes

    def _notes_on_counts(self) -> list[str]:
        names_by_count: dict[str, list[str]] = {}
        for e in self.evaluations:
            numbers = sorted({row.num_samples for row in e.rows if row.num_samples})
            count = " or ".join(f"{number:,}" for number in numbers) or "an unknown number"
            names_by_count.setdefault(count, []).append(e.name)
        if len(names_by_count) < 2:
            return []
        parts = [f"{count} of {', '.join(names)}" for count, names in names_by_count.items()]
        return [f"not the same number of scenes: {'; '.join(parts)}"]

    def _lines(self, cell: Callable[[MetricResult, Mark], str]) -> list[list[str]]:
        """Lines of cells: the published evaluations, the others, the floors."""
        columns = []
        for metric, column in self.columns.items():
            texts = []
            for result, mark in zip(column, self.marks(metric), strict=True):
                texts.append("-" if result is None else cell(result, mark))
            columns.append([*texts, _range_of_floors(column)])
        names = [e.name.replace("|", "/") for e in self.evaluations]
        lines = [list(line) for line in zip([*names, _FLOOR], *columns, strict=True)]
        has_floors = any(text != "-" for text in lines[-1][1:])
        return lines if has_floors else lines[:-1]


def report(
    evaluation: Evaluation, reference: Mapping[str, Any], earlier: Sequence[Evaluation] = ()
) -> str:
    """Return all numbers of an evaluation, and its distances beside others.

    Args:
        evaluation: Numbers of one set of samples.
        reference: ``about`` of its reference.
        earlier: Evaluations to stand beside it. Default: the published ones, if the reference is of
            their data set.
    """
    text = f"{evaluation}\n\n{_comparison(evaluation, reference, earlier)}"
    if "dataset" not in reference and not earlier:
        text += _UNKNOWN_DATASET
    return text


def save_reports(
    evaluation: Evaluation,
    reference: Mapping[str, Any],
    out: Path,
    earlier: Sequence[Evaluation] = (),
) -> None:
    """Write ``evaluation.json`` and ``metrics.csv`` (all rows), ``table.md`` and ``table.tex``.

    The two tables have the distances beside others, see :func:`report`.
    """
    evaluation.save(out / "evaluation.json")
    save_csv((evaluation,), out / "metrics.csv")
    table = _comparison(evaluation, reference, earlier)
    write_text(out / "table.md", str(table))
    write_text(out / "table.tex", table.latex())


def save_csv(evaluations: Iterable[Evaluation], path: Path) -> None:
    """Write every row of every evaluation as a line, with values as they were computed."""
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
    evaluation: Evaluation, reference: Mapping[str, Any], earlier: Sequence[Evaluation]
) -> EvaluationTable:
    if earlier:
        return EvaluationTable([e.only(DISTANCES) for e in (*earlier, evaluation)])
    distances = evaluation.only(DISTANCES)
    if reference.get("dataset") != PUBLISHED_DATASET:
        return EvaluationTable([distances])
    names = [row.name for row in distances.rows]
    split: Split = "val-only" if reference.get("split") == "val" else "train-val"
    published = [e.only(names) for e in published_evaluations(split)]
    return EvaluationTable([*(e for e in published if e.rows), distances])


def published_evaluations(split: Split) -> tuple[Evaluation, ...]:
    """Return the main table of the paper, without intervals and floors.

    MMD was computed against validation scans alone and belongs to ``"val-only"``.

    Source: R3DPA (ICRA 2026), table of unconditional generation on KITTI-360.
    """
    evaluations = []
    for method in _PUBLISHED["methods"]:
        counts = dict.fromkeys(method[split], (method["num_samples"], None))
        evaluation = published_evaluation(
            method["label"],
            method[split],
            f"{PUBLISHED_DATASET}, {split}",
            _PUBLISHED["source"],
            counts | {"MMD": _PUBLISHED["counts_of_mmd"]},
            solver=method["solver"],
            steps=method["steps"],
        )
        evaluations.append(evaluation)
    return tuple(evaluations)


def published_evaluation(
    label: str,
    printed: Mapping[str, float],
    reference: str,
    source: str,
    counts: Mapping[str, tuple[int | None, int | None]] | None = None,
    **about: Any,
) -> Evaluation:
    """Return an evaluation of numbers as a paper printed them, with counts of scenes by metric."""
    rows = []
    for name, number in printed.items():
        scale = PUBLISHED_SCALES[name]
        value = float(f"{number}e{scale}")  # decimal shift, free of rounding
        samples, scans = (counts or {}).get(name, (None, None))
        row = MetricResult(name, value, scale=scale, num_samples=samples, num_references=scans)
        rows.append(row)
    about |= {
        "protocol": {"name": "published"},
        "reference": reference,
        "source": source,
        "published": True,
    }
    return Evaluation(label, tuple(rows), about)


def _cells(row: MetricResult) -> tuple[str, ...]:
    name = row.name
    if row.scale:
        name += f" x1e{row.scale}"
    if row.unit:
        name += f" ({row.unit})"
    return (
        name,
        row.printed(row.value),
        row.printed_interval or "-",
        row.printed(row.floor),
        row.direction,
        _printed_count(row.num_samples),
        _printed_count(row.num_references),
        row.note,
    )


def _printed_count(count: int | None) -> str:
    return "-" if count is None else f"{count:,}"


def _range_of_floors(column: Sequence[MetricResult | None]) -> str:
    """Smallest and largest floor of a column; ``-`` without any."""
    floors = [result.floor for result in column if result and result.floor is not None]
    if not floors:
        return "-"
    low, high = (_first(column).printed(floor) for floor in (min(floors), max(floors)))
    return low if low == high else f"{low} to {high}"


def _first(column: Sequence[MetricResult | None]) -> MetricResult:
    return next(result for result in column if result is not None)

"""Several evaluations side by side, as text, Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from r3dpa.io import atomic_path, text_table
from r3dpa.metrics.results import Evaluation, MetricResult, printed, published_evaluations

_COMPARABLE = ("protocol", "reference", "backbones")
_PAPER_ORDER = ("FRID", "FLD", "FSVD", "FPVD", "JSD", "MMD")
_DISTANCES = (*_PAPER_ORDER, "FWID", "FGEO")
_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "[": "{[}",  # at the start of a line, it and the star would be options of the line break
    "*": "{*}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
}


class Mark(NamedTuple):
    """Place of a value in its column: 1 best, 2 second, 0 neither; tied with others for a place."""

    place: int = 0
    tied: bool = False


@dataclass(frozen=True)
class EvaluationTable:
    """Evaluations as lines, metrics as columns; ``str`` gives the table for a terminal.

    The best and the second best value are marked where intervals and floors separate them from all
    that follow; tied values have an equals sign instead. A column with fewer than two ranked
    values has no marks.

    Args:
        evaluations: At least one; labels differ, except that a published one may repeat a label.
        rank_published: Rank the published numbers, too, which have no intervals.

    Raises:
        ValueError: If a label occurs twice, or direction, unit or scale of a metric differ.
    """

    evaluations: tuple[Evaluation, ...]
    rank_published: bool = False

    def __post_init__(self) -> None:
        if not self.evaluations:
            raise ValueError("got no evaluation; a table needs at least one")
        names = [evaluation.name for evaluation in self.evaluations]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"more than one evaluation is called {twice}; give each its own label")
        for metric, results in self._columns.items():
            for key in ("direction", "unit", "scale"):
                given = {name: getattr(result, key) for name, result in results.items()}
                if len(set(given.values())) > 1:
                    raise ValueError(f"{metric}: {key} differs: {given}; give all of them the same")

    @cached_property
    def _columns(self) -> dict[str, dict[str, MetricResult]]:
        """Results by metric and then by evaluation, where there is a value."""
        given = [row.name for e in self.evaluations for row in e.rows]
        columns = {
            metric: {e.name: result for e in self.evaluations if (result := e.row(metric))}
            for metric in dict.fromkeys([*_PAPER_ORDER, *given])
        }
        return {metric: results for metric, results in columns.items() if results}

    @property
    def metrics(self) -> tuple[str, ...]:
        """Columns: every metric that has a value; those of the paper first, in its order."""
        return tuple(self._columns)

    @property
    def _heads(self) -> list[MetricResult]:
        """A result of each column, for direction, unit and scale."""
        return [next(iter(results.values())) for results in self._columns.values()]

    def marks(self, metric: str) -> dict[str, Mark]:
        """Marks of the ranked evaluations in a column, by the name in the table."""
        ranked = {e.name for e in self.evaluations if self.rank_published or not e.published}
        left = {name: r for name, r in self._columns[metric].items() if name in ranked}
        marks = dict.fromkeys(left, Mark())
        for place in (1, 2):
            if len(marks) < 2 or not left:
                break
            best = min(left.values(), key=_badness)
            group = [name for name, result in left.items() if result.ties_with(best)]
            if len(group) > 1:
                return marks | dict.fromkeys(group, Mark(0, True))
            marks[group[0]] = Mark(place)
            left.pop(group[0])
        return marks

    def __str__(self) -> str:
        def cell(result: MetricResult, mark: Mark) -> str:
            return f"{' *+'[mark.place]}{'=' * mark.tied} {_value(result)}".strip()

        heads = [f"{r.name}\n{f'x1e{r.scale} ' * bool(r.scale)}{_kind(r)}" for r in self._heads]
        table = text_table(self._lines(cell), ["", *heads], align="l" + "r" * len(heads))
        return "\n".join([table, "", *self._legend("* best, + second"), *self.notes]) + "\n"

    def markdown(self) -> str:
        """The table in Markdown: best bold, second underlined, ``=`` where tied."""

        def cell(result: MetricResult, mark: Mark) -> str:
            wrap = ("{}", "**{}**", "<u>{}</u>")[mark.place]
            value, _, interval = _value(result).partition(" ")
            return f"{wrap.format(value)}{'<sup>=</sup>' * mark.tied} {interval}".strip()

        heads = [
            f"{_markdown(r.name)}{f' &times;10<sup>{r.scale}</sup>' * bool(r.scale)} ({_kind(r)})"
            for r in self._heads
        ]
        rows = [[_markdown(first), *cells] for first, *cells in self._lines(cell)]
        table = text_table(rows, ["", *heads], "l" + "r" * len(heads), "pipe")
        below = [*self._legend("**best**, <u>second</u>"), *map(_markdown, self.notes)]
        return "\n".join([table, "", *(f"- {text}" for text in below)]) + "\n"

    def latex(self) -> str:
        r"""The table as a ``tabular`` of the package booktabs: best bold, second underlined.

        Intervals, which would make it too wide for a page, are left out; legend and notes are
        comments.
        """

        def cell(result: MetricResult, mark: Mark) -> str:
            wrap = ("%s", r"\textbf{%s}", r"\underline{%s}")[mark.place]
            return wrap % printed(result.value, result.scale) + r"$^{=}$" * mark.tied

        def line(cells: Iterable[str]) -> str:
            return " & ".join(cells) + r" \\"

        arrows = {"lower": r"$\downarrow$", "higher": r"$\uparrow$"}
        names = [f"{_latex(r.name)} {arrows[r.direction]}" for r in self._heads]
        below = [
            rf"{{\footnotesize $\times 10^{{{r.scale}}}$}}" + f" {_latex(r.unit)}" * bool(r.unit)
            for r in self._heads
        ]
        legend = self._legend("bold best, underlined second", intervals=False)
        comments = ["needs the package booktabs", *legend, *self.notes]
        lines = [
            *(f"% {' '.join(text.split())}" for text in comments),
            rf"\begin{{tabular}}{{l{'c' * len(names)}}}",
            r"\toprule",
            line(["Method", *names]),
            line(["", *below]),
            r"\midrule",
            *(line([_latex(first), *cells]) for first, *cells in self._lines(cell)),
            r"\bottomrule",
            r"\end{tabular}",
        ]
        return "\n".join(lines) + "\n"

    def csv(self) -> str:
        """Every row of every evaluation as a line, with values as they were computed."""
        marks = {metric: self.marks(metric) for metric in self.metrics}
        heads = ["label", "published", "metric", "value", "low", "high", "floor", "unit"]
        heads += ["direction", "scale", "num_samples", "num_references", "place", "tie", "note"]
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(heads)
        for e in self.evaluations:
            for r in e.rows:
                ends = r.interval or (None, None)
                mark = marks.get(r.name, {}).get(e.name, Mark())
                about: list[Any] = [e.label, e.published, r.name, r.value, *ends, r.floor, r.unit]
                about += [r.direction, r.scale, r.num_samples, r.num_references]
                writer.writerow([*about, mark.place or None, mark.tied, r.note])
        return out.getvalue()

    def save(self, path: str | Path) -> None:
        """Writes the table in the format of the suffix: ``.txt``, ``.md``, ``.tex`` or ``.csv``.

        Raises:
            ValueError: If the suffix is another one.
        """
        writers: dict[str, Callable[[], str]] = {
            ".txt": self.__str__,
            ".md": self.markdown,
            ".tex": self.latex,
            ".csv": self.csv,
        }
        writer = writers.get(Path(path).suffix)
        if writer is None:
            raise ValueError(f"{path}: no table of this kind; give one of {', '.join(writers)}")
        with atomic_path(path) as temporary:
            temporary.write_text(writer(), encoding="utf-8")

    @property
    def notes(self) -> tuple[str, ...]:
        """Differences between the lines of a column, samples left out, notes of single numbers."""
        own = [e for e in self.evaluations if not e.published]
        notes = [
            f"not the same {key}: {', '.join(e.label for e in own)}"
            for key in _COMPARABLE
            if any(dict(e.about)[key] != dict(own[0].about)[key] for e in own[1:])
        ]
        for metric, results in self._columns.items():
            for key in ("num_samples", "num_references"):
                counts: dict[int, list[str]] = {}
                for name, result in results.items():
                    if (count := getattr(result, key)) is not None:
                        counts.setdefault(count, []).append(name)
                if len(counts) > 1:
                    listed = "; ".join(f"{c:,} of {', '.join(n)}" for c, n in counts.items())
                    notes.append(f"{metric}: not the same number of {key[4:]}: {listed}")
        notes += [
            f"{e.name}: samples that cannot be used and are left out: {len(e.bad_samples)}"
            for e in own
            if e.bad_samples
        ]
        rows = [(e.name, row) for e in self.evaluations for row in e.rows]
        return (*notes, *(f"{name}, {row.name}: {row.note}" for name, row in rows if row.note))

    def _lines(self, cell: Callable[[MetricResult, Mark], str]) -> list[list[str]]:
        """Lines of cells: the published evaluations, the others, the floors."""
        marks = {metric: self.marks(metric) for metric in self.metrics}
        lines = []
        for e in sorted(self.evaluations, key=lambda e: not e.published):
            cells = [e.name]
            for metric, results in self._columns.items():
                result, mark = results.get(e.name), marks[metric].get(e.name, Mark())
                cells.append("-" if result is None else cell(result, mark))
            lines.append(cells)
        floors = []
        for results in self._columns.values():
            known = sorted({r.floor for r in results.values() if r.floor is not None})
            scale = next(iter(results.values())).scale
            texts = dict.fromkeys(printed(floor, scale) for floor in known[:1] + known[-1:])
            floors.append(" to ".join(texts) or "-")
        return lines + [["real vs. real (floor)", *floors]] * any(f != "-" for f in floors)

    def _legend(self, marks: str, intervals: bool = True) -> list[str]:
        """Meaning of the marks and brackets of this table."""
        some = [mark for metric in self.metrics for mark in self.marks(metric).values()]
        results = [result for column in self._columns.values() for result in column.values()]
        lines = [f"{marks}, in each column"] if any(mark.place for mark in some) else []
        if any(mark.tied for mark in some):
            lines.append(
                "= tie for the next place: they differ by no more than the floor or their intervals"
            )
        if intervals and any(result.interval for result in results):
            lines.append("[low, high]: 95 % interval of the value at this number of scenes")
        published = {e.about["reference"]: None for e in self.evaluations if e.published}
        if published:
            ranked = "" if self.rank_published else ", not ranked"
            lines.append(f"published: against {' and '.join(published)}{ranked}")
        return lines


def report(evaluation: Evaluation, split: str | None) -> str:
    """All numbers of an evaluation, and its distances beside the published ones."""
    text, table = str(evaluation), _beside_published(evaluation, split)
    return text if table is None else f"{text}\n\n{table}"


def save_reports(evaluation: Evaluation, split: str | None, out: Path) -> None:
    """Writes ``evaluation.json`` and ``metrics.csv`` (all rows), ``table.md`` and ``table.tex``.

    The latter two have the distances beside the published ones.
    """
    evaluation.save(out / "evaluation.json")
    whole = EvaluationTable((evaluation,))
    whole.save(out / "metrics.csv")
    table = _beside_published(evaluation, split) or whole
    table.save(out / "table.md")
    table.save(out / "table.tex")


def _beside_published(evaluation: Evaluation, split: str | None) -> EvaluationTable | None:
    own = replace(evaluation, rows=tuple(r for r in evaluation.rows if r.name in _DISTANCES))
    names = {row.name for row in own.rows}
    others = [
        replace(other, rows=tuple(row for row in other.rows if row.name in names))
        for other in published_evaluations("val-only" if split == "val" else "train-val")
    ]
    others = [other for other in others if other.rows]
    return EvaluationTable((*others, own)) if others else None


def _badness(result: MetricResult) -> float:
    """Smaller is better."""
    assert result.value is not None
    return result.value if result.direction == "lower" else -result.value


def _value(result: MetricResult) -> str:
    ends = [printed(end, result.scale) for end in result.interval or ()]
    return printed(result.value, result.scale) + (f" [{', '.join(ends)}]" if ends else "")


def _kind(result: MetricResult) -> str:
    return ", ".join(filter(None, [result.unit, result.direction]))


def _markdown(text: str) -> str:
    """A text on one line, with markup escaped."""
    return "".join(f"\\{c}" if c in "\\|*_<>`" else c for c in " ".join(text.split()))


def _latex(text: str) -> str:
    """A text on one line, with commands escaped."""
    return "".join(_LATEX.get(character, character) for character in " ".join(text.split()))

"""Several evaluations side by side, as text, Markdown, LaTeX and CSV.

Evaluations are lines and metrics are columns. In every column the best value and the second best
are marked where they can be told from the others (``MetricResult.ties_with``).
"""

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
from r3dpa.metrics.scene_features import SPACES

_COMPARABLE = ("protocol", "reference", "backbones")
_PAPER_ORDER = ("FRID", "FLD", "FSVD", "FPVD", "JSD", "MMD")
_FLOOR = "real vs. real (floor)"
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
    """Place of a value in its column.

    Args:
        place: 1 best, 2 second, 0 neither or not ranked.
        tied: Whether it cannot be told from others that would have the same place.
    """

    place: int = 0
    tied: bool = False


@dataclass(frozen=True)
class EvaluationTable:
    """Evaluations beside each other; ``str`` gives the table for a terminal.

    The best value and the second best are marked only where their intervals and floors tell them
    from all that follow; values that tie for a place have an equals sign instead. A column with
    fewer than two ranked values has no marks. Published numbers, which stand apart and have no
    intervals of their own, are ranked only if asked for.

    Args:
        evaluations: At least one; labels differ, except that a published one may repeat a label.
        rank_published: Rank the published numbers together with the others.

    Raises:
        ValueError: If a label occurs twice, or direction, unit or scale of a metric differ.
    """

    evaluations: tuple[Evaluation, ...]
    rank_published: bool = False

    def __post_init__(self) -> None:
        """Checks that the columns are one thing each."""
        object.__setattr__(self, "evaluations", tuple(self.evaluations))
        if not self.evaluations:
            raise ValueError("got no evaluation; a table needs at least one")
        names = [_name(evaluation) for evaluation in self.evaluations]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
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
            metric: {_name(e): result for e in self.evaluations if (result := e.row(metric))}
            for metric in dict.fromkeys([*_PAPER_ORDER, *given])
        }
        return {metric: results for metric, results in columns.items() if results}

    @property
    def metrics(self) -> tuple[str, ...]:
        """Columns: every metric that has a value; those of the paper first, in its order."""
        return tuple(self._columns)

    def marks(self, metric: str) -> dict[str, Mark]:
        """Places of the ranked evaluations in a column, by the name that the table prints."""
        ranked = {_name(e) for e in self.evaluations if self.rank_published or not e.published}
        left = {name: r for name, r in self._columns[metric].items() if name in ranked}
        marks: dict[str, Mark] = dict.fromkeys(left, Mark())
        if len(left) < 2:
            return marks
        for place in (1, 2):
            anchor = min(left.values(), key=_badness)
            group = [name for name, result in left.items() if result.ties_with(anchor)]
            if len(group) > 1:
                return marks | dict.fromkeys(group, Mark(0, True))
            marks[group[0]] = Mark(place)
            left.pop(group[0])
            if not left:
                break
        return marks

    def __str__(self) -> str:
        """Aligned table with intervals, legend and notes, in plain ASCII but for the labels."""

        def cell(result: MetricResult, mark: Mark) -> str:
            return f"{' *+'[mark.place]}{'=' * mark.tied} {_value(result)}".strip()

        below = [f"{f'x1e{r.scale} ' * bool(r.scale)}{_kind(r)}" for r in self._heads]
        heads = ["", *(f"{r.name}\n{kind}" for r, kind in zip(self._heads, below, strict=True))]
        table = text_table(self._lines(cell), heads, align="l" + "r" * len(below))
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

        Intervals are left out, as they make the columns too wide for a page; they are in the other
        formats. Legend and notes are comments.
        """

        def cell(result: MetricResult, mark: Mark) -> str:
            wrap = ("%s", r"\textbf{%s}", r"\underline{%s}")[mark.place]
            assert result.value is not None
            return wrap % printed(result.value, result.scale) + r"$^{=}$" * mark.tied

        def line(cells: Iterable[str]) -> str:
            return " & ".join(cells) + r" \\"

        arrows = {"lower": r"$\downarrow$", "higher": r"$\uparrow$"}
        names = [f"{latex_text(r.name)} {arrows[r.direction]}" for r in self._heads]
        below = [
            rf"{{\footnotesize $\times 10^{{{r.scale}}}$}}"
            + f" {latex_text(r.unit)}" * bool(r.unit)
            for r in self._heads
        ]
        body = [line([latex_text(first), *cells]) for first, *cells in self._lines(cell)]
        comments = [
            "needs the package booktabs",
            *self._legend("bold best, underlined second", False),
        ]
        return "\n".join(
            [
                *(f"% {' '.join(text.split())}" for text in [*comments, *self.notes]),
                rf"\begin{{tabular}}{{l{'c' * len(names)}}}",
                r"\toprule",
                line(["Method", *names]),
                line(["", *below]),
                r"\midrule",
                *body,
                r"\bottomrule",
                r"\end{tabular}",
                "",
            ]
        )

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
                mark = marks.get(r.name, {}).get(_name(e), Mark())
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
        """Where columns compare unlike things, samples left out, and notes of single numbers."""
        own = [e for e in self.evaluations if not e.published]
        unlike = [
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
                    unlike.append(f"{metric}: not the same number of {key[4:]}: {listed}")
        unlike += [
            f"{_name(e)}: samples that cannot be used and are left out: {len(e.bad_samples)}"
            for e in own
            if e.bad_samples
        ]
        single = [
            f"{_name(e)}, {r.name}: {r.note}" for e in self.evaluations for r in e.rows if r.note
        ]
        return (*unlike, *single)

    @property
    def _heads(self) -> list[MetricResult]:
        """A result of each column, for what all of them share."""
        return [next(iter(results.values())) for results in self._columns.values()]

    @property
    def _floors(self) -> list[str]:
        """Floor of each column, the smallest and the largest if evaluations have several."""
        cells = []
        for results in self._columns.values():
            floors = sorted({r.floor for r in results.values() if r.floor is not None})
            scale = next(iter(results.values())).scale
            texts = dict.fromkeys(printed(floor, scale) for floor in floors[:1] + floors[-1:])
            cells.append(" to ".join(texts))
        return cells

    def _lines(self, cell: Callable[[MetricResult, Mark], str]) -> list[list[str]]:
        """Lines of cells: the published evaluations, the others, the floors."""
        marks = {metric: self.marks(metric) for metric in self.metrics}
        lines = []
        for e in sorted(self.evaluations, key=lambda e: not e.published):
            cells = [_name(e)]
            for metric in self.metrics:
                result = e.row(metric)
                mark = marks[metric].get(_name(e), Mark())
                cells.append("-" if result is None else cell(result, mark))
            lines.append(cells)
        floors = self._floors
        return [*lines, [_FLOOR, *(floor or "-" for floor in floors)]] if any(floors) else lines

    def _legend(self, marks: str, intervals: bool = True) -> list[str]:
        """What the marks and brackets of this table mean."""
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


def latex_text(text: str) -> str:
    """A text with the characters escaped that LaTeX would take for commands."""
    return "".join(_LATEX.get(character, character) for character in " ".join(text.split()))


def _name(evaluation: Evaluation) -> str:
    return evaluation.label + " (published)" * evaluation.published


def _badness(result: MetricResult) -> float:
    """Smaller is better."""
    assert result.value is not None
    return result.value if result.direction == "lower" else -result.value


def _value(result: MetricResult) -> str:
    assert result.value is not None
    numbers = [printed(number, result.scale) for number in (result.value, *(result.interval or ()))]
    return f"{numbers[0]} [{', '.join(numbers[1:])}]" if result.interval else numbers[0]


def _kind(result: MetricResult) -> str:
    return ", ".join(filter(None, [result.unit, result.direction]))


def _markdown(text: str) -> str:
    """A text on one line, without what Markdown would take for the end of a cell or for markup."""
    return "".join(f"\\{c}" if c in "\\|*_<>`" else c for c in " ".join(text.split()))


def report(evaluation: Evaluation, split: str | None) -> str:
    """All numbers of an evaluation, and below those that the paper has, beside the published."""
    text, table = str(evaluation), _beside_published(evaluation, split)
    return text if table is None else f"{text}\n\n{table}"


def save_reports(evaluation: Evaluation, split: str | None, out: Path) -> None:
    """Writes the tables of an evaluation to a folder; files of these names are replaced.

    ``evaluation.json`` and ``metrics.csv`` hold all rows; ``table.md`` and ``table.tex`` the
    distances beside the published ones.
    """
    evaluation.save(out / "evaluation.json")
    EvaluationTable((evaluation,)).save(out / "metrics.csv")
    table = _beside_published(evaluation, split) or EvaluationTable((evaluation,))
    table.save(out / "table.md")
    table.save(out / "table.tex")


def _beside_published(evaluation: Evaluation, split: str | None) -> EvaluationTable | None:
    """Distances without relatives of theirs, below the published rows that have some of them."""
    heads = {space.upper() for space in SPACES} | {"JSD", "MMD"}
    own = replace(evaluation, rows=tuple(r for r in evaluation.rows if r.name in heads))
    names = {row.name for row in own.rows}
    others = [
        replace(other, rows=tuple(row for row in other.rows if row.name in names))
        for other in published_evaluations("val-only" if split == "val" else "train-val")
    ]
    others = [other for other in others if other.rows]
    return EvaluationTable((*others, own)) if others else None

"""Results of evaluations: numbers with intervals and floors, and their provenance.

Values are stored as computed; a power of ten applies to the printed column only: JSD = 0.0567 is
stored, and 5.67 is printed below 10^-2.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, Self, TypedDict, get_args

from r3dpa.io import atomic_path, text_table

Direction = Literal["lower", "higher"]
Split = Literal["train-val", "val-only"]

_SHOWN_BAD = 20  # samples left out that are printed


@dataclass(frozen=True)
class MetricResult:
    """One number of an evaluation.

    Args:
        name: Of the metric, as in the head of a column.
        value: In ``unit``; None if unknown, with the reason in ``note``.
        interval: Ends of the 95 % interval: the spread of the value over sets of this many scenes.
            Not corrected for the bias of few scenes, except for extrapolated values.
        floor: Value of real scans against real scans.
        direction: Which values are better.
        unit: Of value, interval and floor; empty for a plain number.
        scale: Power of ten of the printed column.
        num_samples: Generated scans that were used, None if unknown.
        num_references: Real scans that were used, None if unknown.
        note: Remark for the reader; may be empty.

    Raises:
        ValueError: If a field is not as above; names metric and field.
    """

    name: str
    value: float | None
    interval: tuple[float, float] | None = None
    floor: float | None = None
    direction: Direction = "lower"
    unit: str = ""
    scale: int = 0
    num_samples: int | None = None
    num_references: int | None = None
    note: str = ""

    def __post_init__(self) -> None:
        ends = self.interval
        pair = isinstance(ends, tuple | list) and len(ends) == 2 and all(map(_is_finite, ends))
        checks = {
            "name": (isinstance(self.name, str) and self.name, "a text"),
            "value": (
                _is_finite(self.value) or (self.value is None and self.note),
                "a finite number, or None with the reason in the note",
            ),
            "interval": (
                ends is None or (pair and ends[0] <= ends[1]),
                "two finite numbers, the lower end first, or None",
            ),
            "floor": (
                self.floor is None or (_is_finite(self.floor) and self.floor >= 0),
                "0 or more",
            ),
            "direction": (self.direction in get_args(Direction), "lower or higher"),
        }
        for key, (valid, advice) in checks.items():
            if not valid:
                given = getattr(self, key)
                raise ValueError(f"metric {self.name!r}: {key} is {given!r}; give {advice}")
        object.__setattr__(self, "interval", None if ends is None else tuple(ends))

    @property
    def half_width(self) -> float:
        """Half the width of the interval; 0 without one."""
        return 0.0 if self.interval is None else (self.interval[1] - self.interval[0]) / 2

    def ties_with(self, other: MetricResult) -> bool:
        """Whether two values differ by no more than their floors or their intervals.

        The half widths of independent values add in squares, and unknown ones count as 0::

            |a - b| <= max(floor_a, floor_b, sqrt(half_width_a^2 + half_width_b^2))
        """
        if self.value is None or other.value is None:
            raise ValueError(f"{self.name}: a value that is None ties with nothing; leave it out")
        allowed = math.hypot(self.half_width, other.half_width)
        return abs(self.value - other.value) <= max(allowed, self.floor or 0.0, other.floor or 0.0)


class About(TypedDict):
    """Provenance of the numbers of an evaluation; None for what is unknown or does not apply.

    ``backbones`` has the card of each feature network, ``reference`` split, count and hash of the
    names of the real scans, ``precision`` the number format of the samples, ``commit`` the version
    of the code, ``feature_source`` the features the generator was aligned to, ``source`` the
    files of the samples or the line of the publication, and ``extra`` anything else, such as
    ``bad_samples``: those left out, each with the reason.
    """

    backbones: dict[str, dict[str, Any]]
    protocol: dict[str, Any]
    reference: str
    solver: str | None
    steps: int | None
    seed: int | None
    precision: str | None
    commit: str | None
    feature_source: str | None
    published: bool
    source: str
    extra: dict[str, Any]


@dataclass(frozen=True)
class Evaluation:
    """All numbers of one set of samples against one reference; ``str`` gives them as a table.

    Args:
        label: Of the generator or the run.
        rows: One for each metric.
        about: All keys of ``About``; kept as JSON holds it (tuples become lists).

    Raises:
        ValueError: If a metric occurs twice, or ``about`` lacks a key, has an unknown one, or
            holds what JSON cannot.
    """

    label: str
    rows: tuple[MetricResult, ...]
    about: About

    def __post_init__(self) -> None:
        if not isinstance(self.label, str) or not self.label.strip():
            raise ValueError(f"label of an evaluation is {self.label!r}; give a text")
        names = [row.name for row in self.rows]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"{self.label}: more than one row for {twice}; give one per metric")
        _check_keys(self.about, About.__annotations__, f"{self.label}: about")
        try:
            about = json.loads(json.dumps(self.about, allow_nan=False))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{self.label}: about is not for JSON: {error}") from None
        object.__setattr__(self, "rows", tuple(self.rows))
        object.__setattr__(self, "about", about)

    @property
    def published(self) -> bool:
        """Whether the numbers come from a publication."""
        return self.about["published"]

    @property
    def name(self) -> str:
        """Label in tables."""
        return self.label + " (published)" * self.published

    @property
    def bad_samples(self) -> list[str]:
        """Name and reason of each sample that was left out."""
        return self.about["extra"].get("bad_samples", [])

    def row(self, name: str) -> MetricResult | None:
        """Result of a metric; None without such a row or without a value."""
        return next((r for r in self.rows if r.name == name and r.value is not None), None)

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
            lines += bad[:_SHOWN_BAD]
        if len(bad) > _SHOWN_BAD:
            lines.append(f"and {len(bad) - _SHOWN_BAD} more")
        return "\n".join([self.label, *head, "", table, "", *lines])

    def save(self, path: str | Path) -> None:
        """Writes the evaluation as JSON."""
        with atomic_path(path) as temporary:
            text = json.dumps(asdict(self), indent=2, ensure_ascii=False)
            temporary.write_text(text + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads what ``save`` wrote; a ``ValueError`` names the file and the fault."""
        try:
            stored = json.loads(Path(path).read_text(encoding="utf-8"))
            _check_keys(stored, [field.name for field in fields(cls)], "evaluation")
            for number, row in enumerate(stored["rows"]):
                _check_keys(row, [f.name for f in fields(MetricResult)], f"row {number}")
            rows = tuple(MetricResult(**row) for row in stored["rows"])
            return cls(stored["label"], rows, stored["about"])
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path} holds no evaluation: {error}") from error


@cache
def published_evaluations(split: Split) -> tuple[Evaluation, ...]:
    """Rows of the main table of the paper, without intervals and floors.

    MMD was computed against validation scans alone and belongs to ``"val-only"``.

    Source: R3DPA (ICRA 2026), table of unconditional generation on KITTI-360.
    """
    if split not in get_args(Split):
        raise ValueError(f"split is {split!r}; the paper has {', '.join(get_args(Split))}")
    table = _published_table()
    found = []
    for method in table["methods"]:
        counts = dict.fromkeys(method[split], (method["num_samples"], None))
        counts["MMD"] = (table["num_mmd_samples"], table["num_mmd_references"])
        evaluation = published_evaluation(
            method["label"],
            method[split],
            f"KITTI-360, {split}",
            f"{table['source']}, line {method['line']}",
            counts,
        )
        about = evaluation.about
        about |= {"solver": method["solver"], "steps": method["steps"]}
        about["extra"] = {"venue": method["venue"]}
        found.append(evaluation)
    return tuple(found)


def published_evaluation(
    label: str,
    printed: Mapping[str, float],
    reference: str,
    source: str,
    counts: Mapping[str, tuple[int | None, int | None]] | None = None,
) -> Evaluation:
    """Evaluation of numbers as the paper printed them, with counts of scenes by metric."""
    scales = published_scales()
    rows = []
    for name, number in printed.items():
        num_samples, num_references = (counts or {}).get(name, (None, None))
        value = float(f"{number}e{scales[name]}")  # decimal shift, free of rounding
        rows.append(
            MetricResult(
                name,
                value,
                scale=scales[name],
                num_samples=num_samples,
                num_references=num_references,
            )
        )
    about: About = {
        "backbones": {},
        "protocol": {"name": "published"},
        "reference": reference,
        "solver": None,
        "steps": None,
        "seed": None,
        "precision": None,
        "commit": None,
        "feature_source": None,
        "published": True,
        "source": source,
        "extra": {},
    }
    return Evaluation(label, tuple(rows), about)


def published_scales() -> dict[str, int]:
    """Power of ten of the printed column of each metric of the paper."""
    return dict(_published_table()["scales"])


@cache
def _published_table() -> Any:
    return json.loads(files(__package__).joinpath("published.json").read_text(encoding="utf-8"))


def printed(value: float | None, scale: int = 0) -> str:
    """A number in a column of a power of ten: two decimals, more if it is small."""
    if value is None:
        return "-"
    number = value / 10.0**scale
    return f"{number:.2g}" if 0 < abs(number) < 0.1 else f"{number:.2f}"


def _cells(row: MetricResult) -> tuple[str, ...]:
    ends = [printed(end, row.scale) for end in row.interval or ()]
    counts = ["-" if n is None else f"{n:,}" for n in (row.num_samples, row.num_references)]
    name = row.name + (f" x1e{row.scale}" if row.scale else "")
    return (
        f"{name} ({row.unit})" if row.unit else name,
        printed(row.value, row.scale),
        ", ".join(ends).join("[]") if ends else "-",
        printed(row.floor, row.scale),
        row.direction,
        *counts,
        row.note,
    )


def _is_finite(number: Any) -> bool:
    is_number = isinstance(number, int | float) and not isinstance(number, bool)
    return is_number and math.isfinite(number)


def _check_keys(given: Any, expected: Iterable[str], what: str) -> None:
    if not isinstance(given, Mapping):
        raise ValueError(f"{what} is {given!r}; give keys with values")
    wanted = list(expected)
    missing = [key for key in wanted if key not in given]
    unknown = [key for key in given if key not in wanted]
    if missing or unknown:
        raise ValueError(
            f"{what} lacks the keys {missing} and has the unknown keys {unknown}; "
            f"give {', '.join(wanted)}"
        )

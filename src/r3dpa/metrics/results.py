"""Results of an evaluation: numbers with intervals and floors, and where they come from.

A value is kept as it was computed; a power of ten belongs to the printed column only, so that
JSD = 0.0567 is stored and 5.67 is printed below 10^-2.
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

_SHOWN_BAD = 20  # samples that could not be used, in print


@dataclass(frozen=True)
class MetricResult:
    """One number of an evaluation.

    Args:
        name: Of the metric, as in the head of a column.
        value: In ``unit``; None where it cannot be told, which ``note`` then explains.
        interval: Ends of the 95 % interval: how far the value spreads from one set of this many
            scenes to the next. It is for the value expected of this many, which few scenes raise
            above that of infinitely many; only an extrapolated value is for the latter.
        floor: Value that real scans reach against real scans.
        direction: Which values are better.
        unit: Of value, interval and floor; empty for a plain number.
        scale: Power of ten of the printed column.
        num_samples: Generated scans that were used, None if unknown.
        num_references: Real scans that were used, None if unknown.
        note: What a reader must know of this number; may be empty.

    Raises:
        ValueError: If a field is not as above; the error names metric and field.
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
        """Checks the fields, since results also come from files."""
        ends: Any = () if self.interval is None else self.interval
        pair = isinstance(ends, tuple | list) and len(ends) in (0, 2) and all(map(_is_finite, ends))
        counts = {key: getattr(self, key) for key in ("num_samples", "num_references")}
        checks: dict[str, tuple[Any, str]] = {
            "name": (isinstance(self.name, str) and self.name, "give the name of the metric"),
            "unit": (isinstance(self.unit, str), "give a text"),
            "note": (isinstance(self.note, str), "give a text"),
            "interval": (
                pair and (self.interval is None or ends) and list(ends) == sorted(ends),
                "give two finite numbers, the lower end first, or None",
            ),
            "value": (
                _is_finite(self.value) or (self.value is None and self.note),
                "give a finite number, or None and say in the note why there is none",
            ),
            "floor": (
                self.floor is None or (_is_finite(self.floor) and self.floor >= 0),
                "give the distance of real scans from real scans, or None",
            ),
            "direction": (self.direction in get_args(Direction), "give lower or higher"),
            "scale": (type(self.scale) is int, "give the power of ten as a whole number"),
        }
        for key, count in counts.items():
            valid = count is None or (type(count) is int and count >= 1)
            checks[key] = (valid, "give a count of at least 1, or None if it is unknown")
        for key, (ok, advice) in checks.items():
            if not ok:
                given = getattr(self, key)
                raise ValueError(f"metric {self.name!r}: {key} is {given!r}; {advice}")
        object.__setattr__(self, "interval", tuple(ends) or None)

    @property
    def half_width(self) -> float:
        """Half the width of the interval; 0 without one."""
        return 0.0 if self.interval is None else (self.interval[1] - self.interval[0]) / 2

    def ties_with(self, other: MetricResult) -> bool:
        """Whether the two values cannot be told apart.

        They cannot if they differ by no more than real scans differ from real scans, or by no more
        than their intervals allow::

            |a - b| <= max(floor_a, floor_b, sqrt(half_width_a^2 + half_width_b^2))

        The half widths of independent values add in squares. What is not known counts as 0: two
        values without interval and floor tie only if they are equal.
        """
        if self.value is None or other.value is None:
            raise ValueError(f"{self.name}: a value that is None ties with nothing; leave it out")
        allowed = math.hypot(self.half_width, other.half_width)
        allowed = max(allowed, self.floor or 0.0, other.floor or 0.0)
        return abs(self.value - other.value) <= allowed


class About(TypedDict):
    """Where the numbers of an evaluation come from; None for what is unknown or does not apply.

    ``backbones`` has the card of each feature network (layer, hash of the weights, preprocessing),
    ``reference`` split, count and hash of the names of the real scans, ``precision`` the number
    format of the samples, ``commit`` the version of the code that computed the numbers,
    ``feature_source`` what the generator was aligned to, ``source`` the files of the samples or
    the line of the publication, and ``extra`` anything else. ``bad_samples`` in ``extra`` lists
    the samples that were left out, each with the reason.
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
        """Checks label, rows and about, and copies the latter two."""
        if not isinstance(self.label, str) or not self.label.strip():
            raise ValueError(f"label of an evaluation is {self.label!r}; give a text")
        object.__setattr__(self, "rows", tuple(self.rows))
        names = [row.name for row in self.rows]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"{self.label}: more than one row for {twice}; give one per metric")
        _check_keys(self.about, About.__annotations__, f"{self.label}: about")
        if not isinstance(self.about["published"], bool):
            raise ValueError(
                f"{self.label}: about: published is {self.about['published']!r}; give true or false"
            )
        for key, value in self.about.items():
            try:
                json.dumps(value, allow_nan=False)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{self.label}: about: {key} is not for JSON: {error}") from None
        object.__setattr__(self, "about", json.loads(json.dumps(self.about)))

    @property
    def published(self) -> bool:
        """Whether the numbers come from a publication."""
        return self.about["published"]

    @property
    def bad_samples(self) -> list[str]:
        """Name and reason of each sample that could not be used and was left out."""
        return self.about["extra"].get("bad_samples", [])

    def row(self, name: str) -> MetricResult | None:
        """Result of a metric; None where this evaluation has no such row or no value."""
        return next((r for r in self.rows if r.name == name and r.value is not None), None)

    def __str__(self) -> str:
        """Verdict, rows with interval, floor, counts and notes, and where the numbers come from.

        Of many samples that were left out, the first are listed; the stored file has all.
        """
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
        """Reads what ``save`` wrote."""
        try:
            return cls.from_dict(json.loads(Path(path).read_text(encoding="utf-8")))
        except ValueError as error:
            raise ValueError(f"{path} holds no evaluation: {error}") from error

    @classmethod
    def from_dict(cls, stored: Any) -> Self:
        """Evaluation from what JSON gave; see ``load`` for the errors."""
        _check_keys(stored, (field.name for field in fields(cls)), "evaluation")
        if not isinstance(stored["rows"], list):
            raise ValueError(f"evaluation: rows is {stored['rows']!r}; give a list")
        keys = [field.name for field in fields(MetricResult)]
        for number, row in enumerate(stored["rows"]):
            _check_keys(row, keys, f"evaluation: row {number}")
        rows = tuple(MetricResult(**row) for row in stored["rows"])
        return cls(stored["label"], rows, stored["about"])


@cache
def published_evaluations(split: Split) -> tuple[Evaluation, ...]:
    """Rows of the main table of the paper, for comparison only.

    MMD was computed against validation scans alone and belongs to ``"val-only"``. The table gives
    neither intervals nor floors, nor the number of references of the other metrics.

    Source: R3DPA (ICRA 2026), table of unconditional generation on KITTI-360.
    """
    if split not in get_args(Split):
        raise ValueError(f"split is {split!r}; the paper has {', '.join(get_args(Split))}")
    table = _published_table()
    return tuple(_published(method, table, split) for method in table["methods"])


def published_scales() -> dict[str, int]:
    """Power of ten of the printed column of each metric of the paper."""
    scales: dict[str, int] = _published_table()["scales"]
    return scales


@cache
def _published_table() -> dict[str, Any]:
    text = files(__package__).joinpath("published.json").read_text(encoding="utf-8")
    table: dict[str, Any] = json.loads(text)
    return table


def _published(method: Mapping[str, Any], table: Mapping[str, Any], split: Split) -> Evaluation:
    rows = [
        MetricResult(
            name,
            float(f"{printed}e{table['scales'][name]}"),  # decimal shift, free of rounding
            scale=table["scales"][name],
            num_samples=table["num_mmd_samples"] if name == "MMD" else method["num_samples"],
            num_references=table["num_mmd_references"] if name == "MMD" else None,
        )
        for name, printed in method[split].items()
    ]
    about: About = {
        "backbones": {},
        "protocol": {"name": "published"},
        "reference": f"KITTI-360, {split}",
        "solver": method["solver"],
        "steps": method["steps"],
        "seed": None,
        "precision": None,
        "commit": None,
        "feature_source": None,
        "published": True,
        "source": f"{table['source']}, line {method['line']}",
        "extra": {"venue": method["venue"]},
    }
    return Evaluation(method["label"], tuple(rows), about)


def printed(value: float, scale: int = 0) -> str:
    """A number below the head of a column of a power of ten: two decimals, more if it is small."""
    number = value / 10.0**scale
    return f"{number:.2g}" if 0 < abs(number) < 0.1 else f"{number:.2f}"


def _cells(row: MetricResult) -> tuple[str, ...]:
    def number(value: float | None) -> str:
        return "-" if value is None else printed(value, row.scale)

    def count(value: int | None) -> str:
        return "-" if value is None else f"{value:,}"

    ends = "-" if row.interval is None else ", ".join(map(number, row.interval)).join("[]")
    scale = f" x1e{row.scale}" if row.scale else ""
    unit = f" ({row.unit})" if row.unit else ""
    counts = (count(row.num_samples), count(row.num_references))
    values = (number(row.value), ends, number(row.floor))
    return (f"{row.name}{scale}{unit}", *values, row.direction, *counts, row.note)


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

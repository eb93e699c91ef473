"""What ``r3dpa simulate --ablate`` prints and writes: what each effect buys and what it costs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from statistics import median, quantiles
from typing import Any, NamedTuple

from r3dpa.io import one_line
from r3dpa.metrics import MEASURES, Measure, ScanStatistics, known

#: Row in which nothing is switched off: how far two timings of one scan are apart.
NOTHING = "(nothing)"

# Changes of a distance to the reference that are counted.
_NOTICEABLE = 0.01
# Columns of the printed tables by measure. Signed: the difference of the values, else the distance.
_COLUMNS = {
    "returns per scan": ("returns", True),
    "valid share of the image": ("valid share", True),
    "range W1": ("range W1 (m)", False),
    "dropout by beam": ("dropout", True),
    "mixed pixels": ("mixed pixels", True),
    "range residual sd by beam": ("residual sd (mm)", True),
    "intensity JSD": ("intensity JSD", False),
    "last ground ring": ("last ring (m)", True),
    "BEV JSD, 0.5 m cells": ("BEV JSD", False),
}


class Change(NamedTuple):
    """One measure with all effects and without one; None where it cannot be told.

    ``with_all``, ``without``: the scans in one number. ``distance``: between both sets of scans.
    ``reference_with_all``, ``reference_without``: distance of each to the reference.
    """

    measure: str
    unit: str
    with_all: float | None
    without: float | None
    distance: float | None
    reference_with_all: float | None
    reference_without: float | None

    @property
    def difference(self) -> float | None:
        """What switching the effect off adds to the value."""
        if self.without is None or self.with_all is None:
            return None
        return self.without - self.with_all

    @property
    def gain(self) -> float:
        """How much nearer to the reference the effect brings the scans, as a share; 0 if unknown.

        The share is that of the larger distance, so that it lies in [-1, 1].
        """
        if self.reference_without is None or self.reference_with_all is None:
            return 0.0
        larger = max(self.reference_without, self.reference_with_all)
        return (self.reference_without - self.reference_with_all) / larger if larger else 0.0


@dataclass
class EffectAblation:
    """One effect in the scans that call for it.

    Args:
        why: Reason in the first of these scans.
        scans: Their number; 0 if none calls for it.
        saved_ms: Time of each scan with all effects minus that without this one, pair by pair.
        own_ms: What the effect itself took in each scan with all effects.
        with_all: Statistics of the scans with all effects.
        without: The same without this one.
    """

    why: str = ""
    scans: int = 0
    saved_ms: list[float] = field(default_factory=list)
    own_ms: list[float] = field(default_factory=list)
    with_all: ScanStatistics = field(default_factory=ScanStatistics)
    without: ScanStatistics = field(default_factory=ScanStatistics)

    def changes(self, reference: ScanStatistics | None) -> tuple[Change, ...]:
        """Every measure, in the order of ``MEASURES``."""
        return tuple(
            Change(
                measure.name,
                measure.unit,
                known(measure.value_in(self.with_all)),
                known(measure.value_in(self.without)),
                _distance(measure, self.with_all, self.without),
                _distance(measure, self.with_all, reference),
                _distance(measure, self.without, reference),
            )
            for measure in MEASURES
        )


@dataclass(frozen=True)
class Ablation:
    """The ablation of all effects; ``str`` gives the tables as Markdown.

    Args:
        strata: Scans by weather or instrument.
        effects: By name, in the order in which they are applied; first ``NOTHING``.
        reference: Statistics of real scans, or None.
        about: Settings, command, machine and versions.
    """

    strata: Mapping[str, int]
    effects: Mapping[str, EffectAblation]
    reference: ScanStatistics | None
    about: Mapping[str, str | dict[str, Any]]

    def __str__(self) -> str:
        """The table of changes, that of distances to the reference, and what they are about."""
        called = {name: effect for name, effect in self.effects.items() if effect.scans}
        changes = {name: effect.changes(self.reference) for name, effect in called.items()}
        headings = [heading for heading, _ in _COLUMNS.values()]
        strata = ", ".join(f"{name} {num}" for name, num in self.strata.items())
        idle = ", ".join(name for name in self.effects if name not in called)
        lines = [
            "# What each effect buys and what it costs",
            "",
            f"{sum(self.strata.values())} scans: {strata}. Each effect is switched off in the "
            "scans that call for it; all other random draws stay.",
            "",
            "Saved: time of a scan with all effects minus that without it, in pairs by turns, "
            "median and quartiles; own: what the effect itself took, median. "
            f"{NOTHING}: the same scan twice, the noise of these times. Other columns: without "
            "the effect minus with it; for W1 and JSD the distance between both.",
            "",
            *_markdown(
                ["off", "scans", "saved ms", "own ms", *headings],
                [
                    [name, str(effect.scans), *_cost_cells(effect), *_change_cells(changes[name])]
                    for name, effect in called.items()
                ],
            ),
            "",
            f"Not called for by any of these scans: {idle or 'none'}.",
        ]
        if self.reference is not None:
            lines += [
                "",
                f"## Distance to {self.reference.num_scans} scans of the reference",
                "",
                "Without the effect -> with it. Nearer with it: measures whose distance falls, of "
                f"all those where it changes by more than {_NOTICEABLE:.0%}. Weather that the "
                "reference does not have leads away from it, as it should.",
                "",
                *_markdown(
                    ["off", "nearer with it", *headings],
                    [
                        [name, *_reference_cells(changes[name])]
                        for name in called
                        if name != NOTHING
                    ],
                ),
            ]
        return "\n".join([*lines, "", *(f"- {k}: {one_line(v)}" for k, v in self.about.items())])

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON can hold it: all measures of all effects, every pair of timings."""
        effects = {
            name: {
                "scans": effect.scans,
                "why": effect.why,
                "saved_ms": effect.saved_ms,
                "own_ms": effect.own_ms,
                "measures": [change._asdict() for change in effect.changes(self.reference)],
            }
            for name, effect in self.effects.items()
        }
        return {**self.about, "strata": dict(self.strata), "effects": effects}

    def rows(self) -> Iterator[dict[str, Any]]:
        """A row for each measure of each effect that was called; None where it cannot be told."""
        for name, effect in self.effects.items():
            if effect.scans:
                about = {"effect": name, "scans": effect.scans}
                about["saved_ms"], about["own_ms"] = map(median, (effect.saved_ms, effect.own_ms))
                for change in effect.changes(self.reference):
                    yield about | change._asdict()


def _distance(measure: Measure, a: ScanStatistics, b: ScanStatistics | None) -> float | None:
    return None if b is None else known(measure.between(a, b))


def _change_cells(changes: Iterable[Change]) -> list[str]:
    """What the printed measures change by."""
    by_name = {change.measure: change for change in changes}
    cells = []
    for name, (_, is_signed) in _COLUMNS.items():
        change = by_name[name]
        number = change.difference if is_signed else change.distance
        cells.append("n/a" if number is None else _number(number, "+" if is_signed else ""))
    return cells


def _reference_cells(changes: Iterable[Change]) -> list[str]:
    """Distances of the printed measures to the reference, and in how many of all they fall."""
    by_name = {change.measure: change for change in changes}
    gains = [change.gain for change in by_name.values() if abs(change.gain) > _NOTICEABLE]
    cells = [f"{sum(gain > 0 for gain in gains)} of {len(gains)}"]
    for change in map(by_name.__getitem__, _COLUMNS):
        ends = (change.reference_without, change.reference_with_all)
        cells.append(" -> ".join("n/a" if end is None else _number(end) for end in ends))
    return cells


def _cost_cells(effect: EffectAblation) -> list[str]:
    low, middle, high = quantiles(effect.saved_ms, n=4, method="inclusive")
    return [f"{middle:.1f} ({low:.1f}..{high:.1f})", f"{median(effect.own_ms):.1f}"]


def _number(value: float, sign: str = "") -> str:
    return f"{value:{sign}.0f}" if abs(value) >= 1000 else f"{value:{sign}.3g}"


def _markdown(header: list[str], rows: Iterable[list[str]]) -> list[str]:
    """Lines of a table that is aligned as plain text, too."""
    table = [header, *rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    table.insert(1, ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])])
    lines = []
    for first, *numbers in table:
        cells = [f"{cell:>{width}}" for cell, width in zip(numbers, widths[1:], strict=True)]
        lines.append("| " + " | ".join([f"{first:<{widths[0]}}", *cells]) + " |")
    return lines

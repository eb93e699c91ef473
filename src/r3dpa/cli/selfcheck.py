"""``r3dpa selfcheck``: do the metrics notice when real scans are made worse?"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tqdm import tqdm

from r3dpa.data.scans import Scan, evenly, find_scans, read_scan
from r3dpa.io import atomic_path, command, machine, versions
from r3dpa.metrics.corruption import Corruption, Step, corruptions, steps
from r3dpa.metrics.distances import Resampling, histogram_rows, matching_rows
from r3dpa.metrics.evaluation import gather
from r3dpa.metrics.feature_distances import FeatureSample, feature_rows
from r3dpa.metrics.protocol import PROTOCOLS, Protocol
from r3dpa.metrics.reference import split_halves
from r3dpa.metrics.results import MetricResult, printed
from r3dpa.metrics.scene import EvaluationScene
from r3dpa.metrics.scene_features import FREE_SPACES, SceneFeatures
from r3dpa.metrics.scene_set import SceneSet
from r3dpa.scoring import feature_spaces

__all__ = ["CorruptionTable", "SelfCheck", "selfcheck"]

_SIMULATED = "simulated"
# The ranges of a turned scan are the same, and the descriptors of fgeo do not tell directions. (Its
# precision and relatives count neighbours: rounding may turn a tie.)
_BLIND_TO_ROTATION = ("W1 range", "FGEO", "FGEO KID")
# A change by less than this share of what the column spans is that of rounding: points on the
# border of a pixel.
_ROUNDING = 0.01
_LEGEND = (
    "Lower is better, but for precision, recall, density and coverage.",
    "<  not worse than the row before of its kind (the first: than the scans as they are)",
    "~  worse, but within the intervals of the two values; these share their scans, so that a step "
    "may be surer than that",
    "yes 3/4: worse at each of 4 steps, beyond the intervals at 3; no: not at those marked <",
    "sees rotation: seen (beyond the intervals), small (within them), none (up to rounding); ! "
    f"where none was due: {', '.join(_BLIND_TO_ROTATION)}",
)


class Row(NamedTuple):
    """What one corruption does to all metrics; ``real`` is the ladder of the scans as they are."""

    ladder: str
    level: str
    results: tuple[MetricResult, ...]

    def result(self, metric: str) -> MetricResult | None:
        """Result of a metric; None where it has no value."""
        return next((r for r in self.results if r.name == metric and r.value is not None), None)


@dataclass(frozen=True)
class CorruptionTable:
    """All corruptions against one set of real scans; ``str`` gives the table.

    Args:
        title: Says which set.
        rows: The first is of the scans as they are.
        spaces: Labels of the feature spaces.
    """

    title: str
    rows: tuple[Row, ...]
    spaces: tuple[str, ...]

    @property
    def metrics(self) -> list[str]:
        """Metrics that have a value in all rows."""
        names = [result.name for result in self.rows[0].results]
        return [name for name in names if all(row.result(name) for row in self.rows)]

    @property
    def ladders(self) -> list[str]:
        """Names of the ladders."""
        return list(dict.fromkeys(row.ladder for row in self.rows[1:]))

    def steps(self, ladder: str, metric: str) -> dict[str, Step]:
        """Steps of a metric on a ladder, by the level that each leads to."""
        rows = [row for row in self.rows[1:] if row.ladder == ladder]
        found = steps([_known(row, metric) for row in (self.rows[0], *rows)])
        return dict(zip([row.level for row in rows], found, strict=True))

    def verdict(self, ladder: str, metric: str) -> str:
        """What a metric makes of a ladder, as the legend of the table explains."""
        found = self.steps(ladder, metric)
        if ladder == "rotation":
            (step,) = found.values()
            values = [_known(row, metric).value or 0.0 for row in self.rows]
            if abs(step.worsening) <= _ROUNDING * (max(values) - min(values)):
                return "none"
            said = "seen" if step.clear else "small"
            return f"{said} !" if metric in _BLIND_TO_ROTATION else said
        not_worse = [level for level, step in found.items() if not step.worse]
        if not_worse:
            return f"no: {', '.join(not_worse)}" if any(not_worse) else "no"
        return f"yes {sum(step.clear for step in found.values())}/{len(found)}"

    def to_dict(self) -> dict[str, Any]:
        """Verdicts and numbers, for JSON."""
        return {
            "title": self.title,
            "verdicts": {
                metric: {ladder: self.verdict(ladder, metric) for ladder in self.ladders}
                for metric in self.metrics
            },
            "rows": [
                {"ladder": r.ladder, "level": r.level, "metrics": [asdict(m) for m in r.results]}
                for r in self.rows
            ],
        }

    def __str__(self) -> str:
        """A block of columns for the metrics without a network, and one for each feature space."""
        blocks: dict[str, list[str]] = {}
        for metric in self.metrics:
            space = metric.split()[0]
            blocks.setdefault(space if space in self.spaces else "", []).append(metric)
        told = [f"{r.name}: {r.note}" for r in self.rows[0].results if r.name not in self.metrics]
        return "\n\n".join(
            [self.title, *map(self._block, blocks.values()), "\n".join(told)]
        ).strip()

    def _block(self, metrics: Sequence[str]) -> str:
        says = {"rotation": "sees rotation", _SIMULATED: "worse if simulated"}
        heads = ["", *(f"{row.ladder} {row.level}".strip() for row in self.rows)]
        heads += [says.get(ladder, f"worsens with {ladder}") for ladder in self.ladders]
        columns = [heads, *map(self._column, metrics)]
        widths = [max(map(len, cells)) for cells in columns]
        lines = [
            "  ".join([f"{cells[0]:<{widths[0]}}", *map(str.rjust, cells[1:], widths[1:])]).rstrip()
            for cells in zip(*columns, strict=True)
        ]
        lines.insert(1 + len(self.rows), "-" * max(map(len, lines)))
        return "\n".join(lines)

    def _column(self, metric: str) -> list[str]:
        """Cells with a place for the mark at their ends."""
        clean = _known(self.rows[0], metric)
        scale = f" x1e{clean.scale}" if clean.scale else ""
        unit = f" ({clean.unit})" if clean.unit else ""
        cells = [f"{metric}{scale}{unit} "]
        for place, row in enumerate(self.rows):
            mark = " "
            if place and row.ladder != "rotation":
                step = self.steps(row.ladder, metric)[row.level]
                mark = "<" if not step.worse else " " if step.clear else "~"
            cells.append(printed(_known(row, metric).value or 0.0, clean.scale) + mark)
        # The marks tell the levels.
        verdicts = [self.verdict(ladder, metric).partition(":")[0] for ladder in self.ladders]
        return cells + [f"{verdict} " for verdict in verdicts]


@dataclass(frozen=True)
class SelfCheck:
    """What the metrics make of corrupted scans; ``str`` gives tables and legend.

    Args:
        tables: Against other real scans, and against the same ones.
        about: Command, data, counts, protocol, versions and machine.
    """

    tables: tuple[CorruptionTable, ...]
    about: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Everything, for JSON."""
        tables = [table.to_dict() for table in self.tables]
        return {**self.about, "legend": _LEGEND, "tables": tables}

    def __str__(self) -> str:
        """Tables, legend and counts."""
        return "\n\n".join([*map(str, self.tables), "\n".join((*_LEGEND, *self.about["notes"]))])


def selfcheck(
    data: Path,
    against: Path | None = None,
    spaces: Sequence[str] = FREE_SPACES,
    ckpt: Mapping[str, Path] | None = None,
    protocol: str = "default",
    limit: int | None = None,
    device: str = "auto",
    out: Path | None = None,
) -> SelfCheck:
    """Corrupts one half of real scans, and compares it with the other half and with itself.

    The halves are of different drives where there are several: what is far apart already may hide
    a small corruption, which the comparison of the half with itself then shows. Few scans are
    accepted, and counted below the table.

    Args:
        data: Folder of real scans.
        against: Folder of simulated ones, of which as many are used as there are real ones in a
            half, since some metrics depend on the count.
        spaces: Feature spaces.
        ckpt: Their weights by name.
        protocol: ``default`` or ``published``.
        limit: Use this many real scans at most, spread evenly.
        device: Where the networks compute.
        out: JSON file for all numbers.

    Raises:
        ValueError: If an argument is not as above, a half has fewer than two scans, or a scan
            cannot be used; the message names it.
    """
    start = time.perf_counter()
    setting = PROTOCOLS[protocol]
    found = feature_spaces(spaces, ckpt, setting, device)
    scans = evenly(find_scans(data), limit)
    half_of = split_halves([scan.name for scan in scans])
    tried, held = (
        evenly([scan for scan in scans if half_of[scan.name] == half], setting.num_samples)
        for half in (0, 1)
    )
    if min(len(tried), len(held)) < 2:
        raise ValueError(
            f"{data}: {len(scans)} scans give halves of {len(tried)} and {len(held)}; each needs "
            "at least 2. Give more scans"
        )
    cases: list[tuple[str, str, list[Scan], Corruption | None]] = [("real", "", tried, None)]
    cases += [(c.ladder, c.level, tried, c) for c in corruptions()]
    notes = [f"{data.name}: {_told(tried)}, compared with {_told(held)}; few tell little."]
    if against is not None:
        simulated = evenly(find_scans(against), len(tried))
        cases.append((_SIMULATED, "", simulated, None))
        notes.append(f"{_SIMULATED}: {_told(simulated)} of {against.name}.")

    other, _ = gather(_scenes(held, setting, None), found, setting)
    same: SceneSet | None = None
    of_other, of_same = [], []
    for ladder, level, chosen, corruption in tqdm(cases, "selfcheck", unit="row", disable=None):
        scenes, _ = gather(_scenes(chosen, setting, corruption), found, setting)
        of_other.append(Row(ladder, level, _results(other, scenes, found)))
        same = same or scenes
        if ladder != _SIMULATED:
            of_same.append(Row(ladder, level, _results(same, scenes, found)))
    labels = tuple(space.label for space in found)
    tables = (
        CorruptionTable(f"Against other real scans, {len(held)}", tuple(of_other), labels),
        CorruptionTable(f"Against the same scans, {len(tried)}", tuple(of_same), labels),
    )
    about = {
        "command": command(),
        "data": data.name,
        "against": None if against is None else against.name,
        "notes": notes,
        "protocol": setting.to_dict(),
        "spaces": {space.label: space.card for space in found},
        "seconds": round(time.perf_counter() - start, 1),
        "machine": machine() | {"threads": torch.get_num_threads()},
        "versions": versions(torch),
    }
    result = SelfCheck(tables, about)
    if out is not None:
        with atomic_path(out) as temporary:
            text = json.dumps(result.to_dict(), indent=1, allow_nan=False)
            temporary.write_text(text + "\n", encoding="utf-8")
    return result


def _scenes(
    scans: Sequence[Scan], protocol: Protocol, corruption: Corruption | None
) -> Iterator[EvaluationScene]:
    for scan in scans:
        points = torch.from_numpy(read_scan(scan.path, protocol.sensor))
        if corruption is not None:
            points = corruption.apply(points, scan.name)
        yield EvaluationScene(scan.name, points)


def _results(
    real: SceneSet, scenes: SceneSet, spaces: Sequence[SceneFeatures]
) -> tuple[MetricResult, ...]:
    """All metrics, as ``r3dpa evaluate`` computes them."""
    resampling = Resampling()
    rows = histogram_rows(real, scenes, resampling) + matching_rows(real, scenes, resampling)[0]
    for space in spaces:
        first, second = (FeatureSample.of(part, space.name) for part in (real, scenes))
        rows += feature_rows(space.label, first, second, resampling)
    return tuple(rows)


def _known(row: Row, metric: str) -> MetricResult:
    result = row.result(metric)
    assert result is not None, metric
    return result


def _told(scans: Sequence[Scan]) -> str:
    drives = len({scan.drive for scan in scans})
    return f"{len(scans)} scans of {drives} drive{'s' if drives > 1 else ''}"

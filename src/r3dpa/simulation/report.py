"""What a simulation did, effect by effect, and what it cost.

Two files of a data set hold measurements, and so are no function of the request:

``timings.csv``
    A row a scan with the milliseconds of each effect and part. A run that is killed loses the rows
    of the scans that it was at: these are written again, or in the data set without being timed.
``report.json``
    The :class:`SimulationReport` of the data set: what ``sim/*.json`` says of its scans, and costs.
"""

from __future__ import annotations

import csv
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

from r3dpa.simulation.effects import EFFECTS
from r3dpa.simulation.scan import effect_name

#: What a scan takes time for besides its effects.
PARTS = ("scene", "rays", "cast", "points", "write")
_EFFECTS = tuple(effect_name(effect) for effect in EFFECTS)
_COLUMNS = ("drive", "scan", *PARTS, *_EFFECTS, "total")


class ScanTiming(NamedTuple):
    """Milliseconds of one scan: of each part and effect, and of the whole as ``total``."""

    drive: str
    scan: int
    ms: Mapping[str, float]


class Cost(NamedTuple):
    """Mean and median milliseconds a scan, and the share of the mean total."""

    mean_ms: float
    median_ms: float
    share: float


@dataclass(frozen=True)
class EffectTotal:
    """An effect in all scans of a data set.

    Args:
        ran: Scans in which it ran.
        not_called: Scans that did not call for it.
        off: Scans in which it was switched off.
        why: Reason in the first scan in which it ran, or in the first scan where it never did.
        rays_per_scan: Rays that it touched, mean over all scans.
    """

    ran: int
    not_called: int
    off: int
    why: str
    rays_per_scan: float


@dataclass(frozen=True)
class SimulationReport:
    """What a data set holds, and what a call of ``simulate`` added to it.

    Args:
        scans_per_drive: Scans by drive (four digits).
        num_written: Scans simulated by this call; the others were there already.
        num_timed: Scans that ``costs`` is about.
        effects: What became of each effect, in the order in which they are applied.
        costs: Cost of each effect and each part, and ``total``; empty where nothing is timed.
    """

    scans_per_drive: dict[str, int]
    num_written: int
    num_timed: int
    effects: dict[str, EffectTotal]
    costs: dict[str, Cost]

    @property
    def accounted(self) -> float:
        """Share of the total that parts and effects add up to; 0 where nothing is timed."""
        return sum(cost.share for name, cost in self.costs.items() if name != "total")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> SimulationReport:
        """The report of ``to_dict``, of a call that wrote no scan.

        Raises:
            ValueError: If the values are not those of a report.
        """
        try:
            return cls(
                dict(values["scans_per_drive"]),
                0,
                values["num_timed"],
                {name: EffectTotal(**total) for name, total in values["effects"].items()},
                {name: Cost(**cost) for name, cost in values["costs"].items()},
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"these are not the values of a simulation report: {error!r}"
            ) from error

    def to_dict(self) -> dict[str, Any]:
        """The data set as plain values; how many scans this call wrote is left out."""
        values = asdict(self)
        del values["num_written"]
        values["costs"] = {name: cost._asdict() for name, cost in self.costs.items()}
        return values | {"accounted": self.accounted}

    def __str__(self) -> str:
        """A line for each effect, each part and the total, and one with the counts."""
        header = ["effect", "ran", "not called", "off", "rays/scan", "ms/scan", "median", "share"]
        rows = [[*header, "why, in the first scan"]]
        for name, total in self.effects.items():
            counts = [str(count) for count in (total.ran, total.not_called, total.off)]
            rays = f"{total.rays_per_scan:.0f}"
            rows.append([name, *counts, rays, *self._cost_cells(name), total.why])
        rows.append([""])
        for name in (*PARTS, "total"):
            rows.append([name, *[""] * 4, *self._cost_cells(name), ""])
        per_drive = ", ".join(f"{drive} {num}" for drive, num in self.scans_per_drive.items())
        lines = [
            _table(rows),
            f"scans: {sum(self.scans_per_drive.values())} (of drive {per_drive}), "
            f"{self.num_written} written now, {self.num_timed} timed",
        ]
        if self.costs:
            lines.append(f"effects and parts add up to {self.accounted:.1%} of the total")
        return "\n".join(lines)

    def _cost_cells(self, name: str) -> list[str]:
        if name not in self.costs:
            return ["-", "-", "-"]
        cost = self.costs[name]
        return [f"{cost.mean_ms:.2f}", f"{cost.median_ms:.2f}", f"{cost.share:.1%}"]


def make_report(
    summaries: Sequence[Mapping[str, Any]], timings: Iterable[ScanTiming], num_written: int
) -> SimulationReport:
    """Report of a data set.

    Args:
        summaries: What ``sim/*.json`` says of each scan; 1 or more.
        timings: Of some or all of these scans.
        num_written: Scans that this call simulated.
    """
    effects = {
        name: _effect_total([summary["effects"][name] for summary in summaries])
        for name in summaries[0]["effects"]
    }
    rows = [timing.ms for timing in timings]
    costs = {}
    if rows:
        total_ms = statistics.fmean(row["total"] for row in rows)
        for name in rows[0]:
            column = [row[name] for row in rows]
            mean_ms = statistics.fmean(column)
            costs[name] = Cost(mean_ms, statistics.median(column), mean_ms / total_ms)
    scans_per_drive = dict(Counter(summary["drive"] for summary in summaries))
    return SimulationReport(scans_per_drive, num_written, len(rows), effects, costs)


def start_timings(path: Path) -> None:
    """Make ``timings.csv`` ready for further rows: a row that was cut off by a kill is removed.

    Raises:
        ValueError: If the file holds something else.
    """
    header = f"{','.join(_COLUMNS)}\n".encode()
    content = path.read_bytes() if path.is_file() else b""
    if not header.startswith(content[: len(header)]):
        raise ValueError(
            f"{path} has other columns than this version of the simulator writes; it holds only "
            f"measured times: delete it"
        )
    whole = content[: content.rfind(b"\n") + 1]
    if not whole:
        path.write_bytes(header)
    elif len(whole) < len(content):
        with path.open("r+b") as stream:
            stream.truncate(len(whole))


def add_timings(path: Path, timings: Iterable[ScanTiming]) -> None:
    """Append rows to ``timings.csv``."""
    text = StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    for timing in timings:
        ms = {name: f"{value:.3f}" for name, value in timing.ms.items()}
        writer.writerow({"drive": timing.drive, "scan": timing.scan, **ms})
    with path.open("ab", buffering=0) as stream:
        stream.write(text.getvalue().encode())


def read_timings(path: Path) -> list[ScanTiming]:
    """Rows of ``timings.csv``; of a scan that was written twice, the last one.

    Raises:
        ValueError: If a row is damaged.
    """
    timings: dict[tuple[str, int], ScanTiming] = {}
    with path.open(newline="") as stream:
        for row in csv.DictReader(stream):
            try:
                drive, scan = row["drive"], int(row["scan"])
                ms = {name: float(row[name]) for name in _COLUMNS[2:]}
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(
                    f"{path} has a damaged row for drive {row.get('drive')}, scan "
                    f"{row.get('scan')} ({error!r}); it holds only measured times: delete it"
                ) from error
            timings[drive, scan] = ScanTiming(drive, scan, ms)
    return list(timings.values())


def _effect_total(records: Sequence[Mapping[str, Any]]) -> EffectTotal:
    counts = Counter(record["status"] for record in records)
    ran = (record["reason"] for record in records if record["status"] == "ran")
    return EffectTotal(
        ran=counts["ran"],
        not_called=counts["not_called"],
        off=counts["off"],
        why=next(ran, records[0]["reason"]),
        rays_per_scan=statistics.fmean(record["rays"] for record in records),
    )


def _table(rows: Sequence[Sequence[str]]) -> str:
    """Aligned columns: the first and the last to the left, numbers to the right."""
    num_columns = max(map(len, rows))
    full = [[*row, *[""] * (num_columns - len(row))] for row in rows]
    widths = [max(len(row[i]) for row in full) for i in range(num_columns)]
    lines = []
    for row in full:
        first, *numbers, last = row
        cells = [f"{cell:>{width}}" for cell, width in zip(numbers, widths[1:-1], strict=True)]
        lines.append("  ".join([f"{first:<{widths[0]}}", *cells, last]).rstrip())
    return "\n".join(lines)

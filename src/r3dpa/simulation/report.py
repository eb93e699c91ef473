"""Report on a simulated data set: effects and simulation times."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

from tabulate import tabulate

#: Steps of a scan besides its effects.
PARTS = ("scene", "rays", "cast", "points", "write")


class Cost(NamedTuple):
    """Mean and median milliseconds a scan, and the share of the mean total."""

    mean_ms: float
    median_ms: float
    share: float


class EffectTotal(NamedTuple):
    """An effect in all scans of a data set: counts by status, reason, and rays."""

    ran: int
    not_called: int
    off: int
    why: str  # reason in the first scan in which it ran, or in the first scan of all
    rays_per_scan: float  # selected rays, mean over all scans


@dataclass(frozen=True)
class SimulationReport:
    """Contents of a data set, and the scans added by a call of ``simulate``."""

    scans_per_drive: dict[str, int]  # by four-digit number
    num_written: int  # by this call; the others existed before
    num_empty: int  # without a single point
    effects: dict[str, EffectTotal]  # in the order in which they are applied
    num_timed: int  # scans behind the costs: those of the last call that wrote any
    costs: dict[str, Cost]  # of each effect, each part and the total; empty if nothing was timed

    @property
    def accounted(self) -> float:
        """Share of the total that parts and effects add up to; 0 if nothing was timed."""
        return sum(cost.share for name, cost in self.costs.items() if name != "total")

    def to_dict(self) -> dict[str, Any]:
        """The report as plain values, without ``num_written``."""
        values = asdict(self)
        del values["num_written"]
        values["effects"] = {name: total._asdict() for name, total in self.effects.items()}
        values["costs"] = {name: cost._asdict() for name, cost in self.costs.items()}
        return values | {"accounted": self.accounted}

    def __str__(self) -> str:
        header = ["effect", "ran", "not called", "off", "rays/scan", "ms/scan", "median", "share"]
        rows: list[list[str]] = []
        for name, total in self.effects.items():
            counts = [str(count) for count in (total.ran, total.not_called, total.off)]
            rays = f"{total.rays_per_scan:.0f}"
            rows.append([name, *counts, rays, *self._cost_cells(name), total.why])
        rows.append([])
        rows += [[name, *[""] * 4, *self._cost_cells(name)] for name in (*PARTS, "total")]
        table = tabulate(
            rows,
            [*header, "why, in the first scan"],
            tablefmt="plain",
            colalign=("left", *["right"] * 7, "left"),
            disable_numparse=True,
        )
        lines = [line.rstrip() for line in table.splitlines()]
        per_drive = ", ".join(f"{drive} {num}" for drive, num in self.scans_per_drive.items())
        num_scans = sum(self.scans_per_drive.values())
        lines += ["", f"{num_scans} scans ({per_drive}), {self.num_written} of them simulated now"]
        if self.num_empty:
            lines.append(
                f"{self.num_empty} of them hold no points: in this weather the sensor sees nothing"
            )
        lines.append(f"effects and parts add up to {self.accounted:.1%} of the total")
        return "\n".join(lines)

    def _cost_cells(self, name: str) -> list[str]:
        cost = self.costs.get(name)
        if cost is None:
            return ["-"] * 3
        return [f"{cost.mean_ms:.2f}", f"{cost.median_ms:.2f}", f"{cost.share:.1%}"]


def make_report(
    summaries: Sequence[Mapping[str, Any]], timings: Sequence[Mapping[str, float]]
) -> SimulationReport:
    """Report from ``sim/*.json`` of all scans and the milliseconds of the written ones."""
    effects = {
        name: _effect_total([summary["effects"][name] for summary in summaries])
        for name in summaries[0]["effects"]
    }
    costs = {}
    if timings:
        total_ms = statistics.fmean(row["total"] for row in timings)
        for name in timings[0]:
            column = [row[name] for row in timings]
            mean_ms = statistics.fmean(column)
            costs[name] = Cost(mean_ms, statistics.median(column), mean_ms / total_ms)
    return SimulationReport(
        scans_per_drive=dict(Counter(summary["drive"] for summary in summaries)),
        num_written=len(timings),
        num_empty=sum(summary["points"] == 0 for summary in summaries),
        effects=effects,
        num_timed=len(timings),
        costs=costs,
    )


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

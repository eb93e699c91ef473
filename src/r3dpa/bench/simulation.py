"""What a simulated scan costs: cast, effects and the whole, beside the simulator's budget.

Scans are simulated as ``r3dpa simulate`` does, without writing them: 64 x 2083 shots in streets of
every drive, under one weather per case. Each scan is simulated twice in a row, as two interleaved
series: how far their medians are apart tells the noise of the figures, which are of the first.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from r3dpa.checkpoints.networks import format_table
from r3dpa.io import atomic_path, command, machine, one_line, versions
from r3dpa.simulation import (
    EFFECTS,
    TRAIN_DRIVES,
    VAL_DRIVES,
    SpinningLidar,
    Street,
    Weather,
    effect_name,
    hdl64e,
    simulate_scan,
)

__all__ = ["DRIVES", "WEATHERS", "CaseCost", "ScanCost", "case_cost", "simulation"]

DRIVES = tuple(int(drive) for drive in (*VAL_DRIVES, *TRAIN_DRIVES))

#: Weather of each case; a plain street is dry and its sun stands high.
WEATHERS = {
    "plain": Weather(),
    "wet": Weather(water_film_mm=1.0, clear_sky=False),
    "rain": Weather(rain_mm_h=10.0, water_film_mm=1.0, clear_sky=False),
    "fog": Weather(visibility_m=100.0, clear_sky=False),
    "snow": Weather(snow_mm_h=1.5, clear_sky=False),
    "low sun": Weather(sun_elevation_deg=3.0),
}

#: Largest medians of a plain street on one core, milliseconds.
_CAST_BUDGET_MS, _SCAN_BUDGET_MS = 60.0, 100.0
#: Largest share of effects that are not called, and of time that no part accounts for.
_IDLE_BUDGET, _GAP_BUDGET = 0.01, 0.10
# Below this share of one core, other programs slowed the scans down.
_UNDISTURBED = 0.95
_PARTS = ("scene", "rays", "cast", *map(effect_name, EFFECTS), "points", "not called", "total")
_SEED = 0
# Far enough apart to share no block of street.
_SCANS_APART = 100


class ScanCost(NamedTuple):
    """Milliseconds of one scan.

    ``parts``: rays, cast and points. ``called``: effects that ran. ``idle``: all predicates that
    called for nothing, together. ``total``: the whole, ``again``: the same scan right after it.
    ``scene``: drawing the scene, which is not in the total.
    """

    primitives: int
    scene: float
    parts: Mapping[str, float]
    called: Mapping[str, float]
    idle: float
    total: float
    again: float


@dataclass(frozen=True)
class Spread:
    """Median, smallest and largest time in milliseconds of ``scans`` scans."""

    scans: int
    median: float
    min: float
    max: float

    @classmethod
    def of(cls, ms: Sequence[float]) -> Spread:
        """Spread of one or more times."""
        return cls(len(ms), median(ms), min(ms), max(ms))


@dataclass(frozen=True)
class CaseCost:
    """What the scans of one case cost.

    Args:
        primitives: Smallest, median and largest number of solids.
        ms: Spread by part and by effect (over the scans that called it), of all effects that were
            not called (``not called``), of drawing the scene (``scene``) and of the rest together
            (``total``).
        idle_share: Share of effects that were not called, of all time.
        accounted: Share of all time that parts and effects add up to.
        repeat_ratio: Median of the second series over that of the first.
    """

    primitives: tuple[int, float, int]
    ms: dict[str, Spread]
    idle_share: float
    accounted: float
    repeat_ratio: float


def case_cost(scans: Sequence[ScanCost]) -> CaseCost:
    """Sum up the scans of a case; 1 or more."""
    columns: dict[str, list[float]] = {}
    for scan in scans:
        row = {"scene": scan.scene, **scan.parts, **scan.called}
        for name, ms in (row | {"not called": scan.idle, "total": scan.total}).items():
            columns.setdefault(name, []).append(ms)
    total = sum(scan.total for scan in scans)
    idle = sum(scan.idle for scan in scans)
    known = sum(sum(scan.parts.values()) + sum(scan.called.values()) for scan in scans)
    counts = [scan.primitives for scan in scans]
    return CaseCost(
        (min(counts), median(counts), max(counts)),
        {name: Spread.of(columns[name]) for name in _PARTS if name in columns},
        idle / total,
        (known + idle) / total,
        median(scan.again for scan in scans) / median(scan.total for scan in scans),
    )


def simulation(quick: bool = False, out: Path | None = None) -> str:
    """Simulate scans of each case and say what they cost.

    Args:
        quick: Two scans a case, only to try it; else a plain street has four of each drive and
            the other cases have one.
        out: JSON file for the same figures, without rounding.

    Returns:
        A table of the plain street by part, one of the cases, and the budget.
    """
    sensor = hdl64e()
    wanted = {name: _places(1 if name != "plain" else 4) for name in WEATHERS}
    if quick:
        wanted = {name: places[:2] for name, places in wanted.items()}
    cases, wall_s, cpu_s = {}, time.perf_counter(), time.process_time()
    # Without a terminal there is no bar.
    with tqdm(total=sum(map(len, wanted.values())), unit="scan", disable=None) as progress:
        for name, places in wanted.items():
            costs = []
            for cost in _measured(WEATHERS[name], places, sensor):
                costs.append(cost)
                progress.update()
            cases[name] = case_cost(costs)
    cores_used = (time.process_time() - cpu_s) / (time.perf_counter() - wall_s)
    threads = os.environ.get("OMP_NUM_THREADS", "not set")
    about: dict[str, str | dict[str, Any]] = {
        "command": command(),
        "machine": machine() | {"OMP_NUM_THREADS": threads, "cores_used": round(cores_used, 3)},
        "versions": versions(np),
    }
    if out is not None:
        content = {**about, "cases": {name: asdict(case) for name, case in cases.items()}}
        with atomic_path(out) as temporary:
            temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    lines = [_part_table(cases["plain"]), "", _case_table(cases), "", *_verdicts(cases)]
    if cores_used < _UNDISTURBED:
        lines.append(f"The machine was busy ({cores_used:.2f} of a core): the times are too long.")
    return "\n".join([*lines, *(f"{name}: {one_line(values)}" for name, values in about.items())])


def _places(scans_per_drive: int) -> list[tuple[int, int]]:
    """Drives and numbers of the scans, the drives in turn."""
    return [(drive, _SCANS_APART * i) for i in range(scans_per_drive) for drive in DRIVES]


def _measured(
    weather: Weather, places: list[tuple[int, int]], sensor: SpinningLidar
) -> Iterator[ScanCost]:
    """Cost of each scan, after one that pays for what is made only once."""
    drive, number = places[0]
    scene = Street(_SEED, drive, weather).scene(number)
    simulate_scan(scene, sensor, (_SEED, "effects", drive, number))
    for drive, number in places:
        street = Street(_SEED, drive, weather)
        # A scan shares its blocks with the one before, as it does where a drive is simulated.
        street.scene(number)
        start = time.perf_counter()
        scene = street.scene(number + 1)
        scene_ms = 1000 * (time.perf_counter() - start)
        totals = []
        for _ in range(2):
            start = time.perf_counter()
            scan = simulate_scan(scene, sensor, (_SEED, "effects", drive, number + 1))
            totals.append((1000 * (time.perf_counter() - start), scan))
        (total, scan), (again, _) = totals
        yield ScanCost(
            len(scene.primitives),
            scene_ms,
            scan.parts_ms,
            {effect.name: effect.ms for effect in scan.effects if effect.status == "ran"},
            sum(effect.ms for effect in scan.effects if effect.status == "not_called"),
            total,
            again,
        )


def _part_table(case: CaseCost) -> str:
    """Times of one case by part."""
    whole = case.ms["total"]
    rows = []
    for name, spread in case.ms.items():
        share = "-" if name == "scene" else f"{spread.median / whole.median:.1%}"
        cells = [f"{ms:.2f}" for ms in (spread.median, spread.min, spread.max)]
        rows.append([name, str(spread.scans), *cells, share])
    return format_table(["plain street", "scans", "median ms", "min", "max", "of total"], rows)


def _case_table(cases: Mapping[str, CaseCost]) -> str:
    """A line for each case."""
    rows = []
    for name, case in cases.items():
        total = case.ms["total"]
        added = [
            f"{effect} {spread.median:.1f}"
            for effect, spread in case.ms.items()
            if effect not in cases["plain"].ms
        ]
        low, middle, high = case.primitives
        rows.append(
            [
                name,
                str(total.scans),
                f"{middle:.0f} ({low}..{high})",
                f"{case.ms['cast'].median:.1f}",
                f"{total.median:.1f} ({total.min:.1f}..{total.max:.1f})",
                f"{case.idle_share:.2%}",
                f"{case.accounted:.1%}",
                f"{case.repeat_ratio:.3f}",
                ", ".join(added) or "-",
            ]
        )
    header = ["case", "scans", "primitives", "cast ms", "scan ms (min..max)", "not called"]
    return format_table([*header, "parts/total", "again/first", "effects not in plain, ms"], rows)


def _verdicts(cases: Mapping[str, CaseCost]) -> list[str]:
    """Each budget, what was measured, and whether it is kept."""
    plain = cases["plain"]
    cast, scan = plain.ms["cast"].median, plain.ms["total"].median
    idle = max(case.idle_share for case in cases.values())
    gap = max(abs(case.accounted - 1) for case in cases.values())
    budgets = (
        ("cast of a plain street", cast, _CAST_BUDGET_MS, "ms"),
        ("scan of a plain street", scan, _SCAN_BUDGET_MS, "ms"),
        ("effects not called, worst case", 100 * idle, 100 * _IDLE_BUDGET, "% of a scan"),
        ("parts and total differ, worst case", 100 * gap, 100 * _GAP_BUDGET, "%"),
    )
    return [
        f"{name}: {found:.3g} {unit}, at most {limit:g}: {'kept' if found <= limit else 'MISSED'}"
        for name, found, limit, unit in budgets
    ]

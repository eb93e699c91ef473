"""Simulated data sets: split into scans, worker processes, and the manifest.

::

    simulation.json                     the request
    data_3d_raw/, data_poses/           the scans and their poses, see ``drive_files``
    report.json                         what each effect did
"""

from __future__ import annotations

import os
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from numbers import Integral
from pathlib import Path
from typing import Any, Literal, NamedTuple

from lidarsim.clouds import READERS, suffix_of
from lidarsim.drive_files import (
    DriveFiles,
    drive_name,
    read_json,
    to_json,
    weather_to_dict,
    write,
)
from lidarsim.io import differences, in_processes, json_values, number_of, only_writer, text_table
from lidarsim.scan import Simulator, check_switches
from lidarsim.scene import Conditions, Semantic
from lidarsim.sensors.files import load_sensor
from lidarsim.sensors.spinning import SpinningLidar
from lidarsim.street.streets import LAST_SCAN

TRAIN_DRIVES = ("0003", "0004", "0005", "0006", "0007", "0009", "0010")
VAL_DRIVES = ("0000", "0002")
VAL_SHARE = 0.2

_MANIFEST = "simulation.json"
_CLASSES = "classes.yaml"  # names of the class ids of the labels
_START_AGAIN = "simulate the data set again into an empty folder"
# Raised whenever the same request gives other scans than before.
SIMULATOR_VERSION = 7
# Neighbouring scans share their blocks of street, so a worker takes a few in a row.
_SCANS_PER_TASK = 8
# Numbers of the scans of one drive, and their stride.
_Task = tuple[DriveFiles, Simulator, list[int], int]


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
    num_empty: int  # without a single point
    effects: dict[str, EffectTotal]  # in the order in which they are applied
    num_written: int  # by this call; the others existed before

    def to_dict(self) -> dict[str, Any]:
        """Content that depends on the request alone, as plain values."""
        effects = {name: total._asdict() for name, total in self.effects.items()}
        about = {"scans_per_drive": self.scans_per_drive, "num_empty": self.num_empty}
        return about | {"effects": effects}

    def __str__(self) -> str:
        heads = ["effect", "ran", "not called", "off", "rays/scan"]
        rows = []
        for name, total in self.effects.items():
            counts = [str(count) for count in (total.ran, total.not_called, total.off)]
            rows.append([name, *counts, f"{total.rays_per_scan:.0f}", total.why])
        table = text_table(rows, [*heads, "why, in the first scan"], "lrrrrl", "plain")
        per_drive = ", ".join(f"{drive} {num}" for drive, num in self.scans_per_drive.items())
        scans = number_of(sum(self.scans_per_drive.values()), "scan")
        lines = [f"{scans} ({per_drive}), {self.num_written} of them simulated now"]
        if self.num_empty:
            lines.append(
                f"{self.num_empty} of them hold no points: in this weather the sensor sees nothing"
            )
        return "\n".join([table, "", *lines])


def simulate(
    out: Path,
    scans: int = 100,
    seed: int = 0,
    workers: int = 1,
    drives: Sequence[str] | None = None,
    sensor: str | SpinningLidar = "hdl64e",
    return_mode: Literal["strongest", "dual"] | None = None,
    effects: Mapping[str, str | bool] | None = None,
    weather: Conditions | None = None,
    every: int = 1,
) -> SimulationReport:
    """Write a simulated data set in the layout of KITTI-360, complete one, or add scans to one.

    Each scan depends only on the request and its number: the files are the same bytes for any
    number of workers. Files are written atomically, so an interrupted call is completed by the
    same call, which also deletes the temporary files of killed runs. A call for more scans adds
    them and keeps the existing ones; one for fewer uses the first ones of each drive. A second call
    for the same folder waits for the first.

    Args:
        out: Root folder of the data set; made if missing.
        scans: Scans of all drives together, 1 or more.
        seed: Seed of streets and instrument, 0 or greater.
        workers: Processes; more than one needs an importable main module, as ``spawn`` does.
        drives: Four-digit drives, such as ``0000 0003``; default: all of training and validation.
            With drives of both splits, a fifth of the scans (at least one, if there are two or
            more) is for validation.
        sensor: Preset of ``r3dpa data sensors``, or a YAML of ``r3dpa data sensor`` or of
            ``velodyne_pointcloud``, for an HDL-64E; in Python any instrument.
        return_mode: Strongest return of each shot, or the two strongest; default: as the sensor.
        effects: ``off`` or ``auto`` by effect, such as ``--effects.fog off``; default: ``auto``.
        weather: Weather of all scans, such as ``--weather.rain_mm_h 10``; default: drawn for each
            stretch of street.
        every: Stride in scans of a drive, which are 0.1 s apart: 40 sees more street, but has more
            of it to build.

    Returns:
        Contents of the data set by effect, also written to ``report.json``.

    Raises:
        ValueError: If a value is out of range, an effect or a drive is unknown, a drive is named
            twice, or ``out`` holds other data or the data set of another request.
        ChildProcessError: If a worker was killed.
    """
    for name, value in (("workers", workers), ("every", every)):
        if not (isinstance(value, Integral) and value >= 1):
            raise ValueError(f"{name} must be a whole number, 1 or greater, got {value}")
    if not isinstance(sensor, SpinningLidar):
        sensor = load_sensor(sensor)
    if return_mode is not None:
        sensor = replace(sensor, return_mode=return_mode)
    names = (*TRAIN_DRIVES, *VAL_DRIVES) if drives is None else tuple(drives)
    counts = split_scans(scans, names)
    if (last := (max(counts.values()) - 1) * every) > LAST_SCAN:
        raise ValueError(
            f"every {every} leads to scan {last} of a drive, which has {LAST_SCAN}: give a smaller "
            "stride or more drives"
        )
    simulators = {drive: Simulator(seed, int(drive), weather, sensor, effects) for drive in counts}
    request = {
        "simulator_version": SIMULATOR_VERSION,
        "seed": seed,
        "scans": scans,
        "drives": list(names),
        "sensor": json_values(asdict(sensor)),
        "effects": check_switches(effects or {}),
        "weather": None if weather is None else weather_to_dict(weather),
    }
    if every > 1:
        request["every"] = every
    files = {DriveFiles(out, drive): count for drive, count in counts.items()}
    serves = _check_folder(out, request) and _is_finished(out, files)
    read_only = out.is_dir() and not os.access(out, os.W_OK)
    if (read_only or serves) and not any(d.missing(count) for d, count in files.items()):
        return make_report(_summaries(files), 0)
    out.mkdir(parents=True, exist_ok=True)
    with only_writer(out / ".lock", f"simulates into {out}", wait=True):
        # Again, since another process may have written meanwhile.
        holds_more = _check_folder(out, request)
        if not holds_more:
            write(out / _MANIFEST, to_json(request))
        classes = "".join(f"{int(semantic)}: {semantic.name.lower()}\n" for semantic in Semantic)
        write(out / _CLASSES, classes.encode())
        num_written = _write_missing(files, simulators, every, workers)
        if holds_more and _is_finished(out, files):
            return make_report(_summaries(files), num_written)
        return _finish(out, files, num_written, every)


def _write_missing(
    files: Mapping[DriveFiles, int], simulators: Mapping[str, Simulator], every: int, workers: int
) -> int:
    """Simulate the scans that are not there yet, and return their number."""
    from tqdm import tqdm  # simulated scans that are not written do not need it

    tasks: list[_Task] = []
    for drive, count in files.items():
        missing = drive.missing(count)
        for start in range(0, len(missing), _SCANS_PER_TASK):
            numbers = missing[start : start + _SCANS_PER_TASK]
            tasks.append((drive, simulators[drive.drive], numbers, every))
    num_missing = sum(len(numbers) for _, _, numbers, _ in tasks)
    total = sum(files.values())
    # disable=None: no bar without a terminal.
    with tqdm(
        total=total, initial=total - num_missing, unit="scan", desc="simulate", disable=None
    ) as bar:
        for num_written in in_processes(_run, tasks, workers):
            bar.update(num_written)
    return num_missing


def split_scans(scans: int, drives: Sequence[str]) -> dict[str, int]:
    """Scans of each drive: a fifth of them for validation, evenly within each split.

    More scans never give a drive fewer of them, so that a data set can grow.

    Raises:
        ValueError: If there is no scan, no drive, an unknown drive, or one is named twice.
    """
    if scans < 1:
        raise ValueError(f"scans must be 1 or greater, got {scans}")
    unknown = sorted(set(drives) - {*TRAIN_DRIVES, *VAL_DRIVES})
    if unknown or not drives or len(set(drives)) < len(drives):
        raise ValueError(
            f"drives must be different ones of {', '.join((*TRAIN_DRIVES, *VAL_DRIVES))}, "
            f"got {', '.join(drives) or 'none'}"
        )
    train = [drive for drive in TRAIN_DRIVES if drive in drives]
    val = [drive for drive in VAL_DRIVES if drive in drives]
    if not train:
        num_val = scans
    elif not val or scans == 1:
        num_val = 0
    else:
        num_val = max(1, round(VAL_SHARE * scans))
    return _share(scans - num_val, train) | _share(num_val, val)


def expected_scans(root: Path) -> dict[str, int] | None:
    """Scans by drive folder of a complete simulated data set; None if ``root`` holds none."""
    manifest = root / _MANIFEST
    if not manifest.is_file():
        return None
    request = read_json(manifest, _START_AGAIN)
    try:
        counts = split_scans(request["scans"], request["drives"])
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise ValueError(
            f"{manifest} does not say which scans were simulated ({error!r}): {_START_AGAIN}"
        ) from error
    return {drive_name(drive): count for drive, count in sorted(counts.items())}


def _share(scans: int, drives: list[str]) -> dict[str, int]:
    """Deal scans out to drives in turn; a drive that gets none is left out."""
    counts = (len(range(place, scans, len(drives))) for place in range(len(drives)))
    return {drive: count for drive, count in zip(drives, counts, strict=True) if count}


def _check_folder(out: Path, request: dict[str, Any]) -> bool:
    """Refuse a folder with other data; return whether it holds more scans of this data set."""
    manifest = out / _MANIFEST
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file; give the folder of the data set")
    if not manifest.exists():
        if (out / "data_3d_raw").exists():
            raise ValueError(
                f"{out} holds a data set that was not simulated ({_MANIFEST} is missing); "
                f"give another folder"
            )
        if others := [file for file in sorted(out.glob("*")) if suffix_of(file) in READERS]:
            raise ValueError(
                f"{out} holds scans that were not simulated, such as {others[0].name}, which "
                "readers would no longer find: give another folder"
            )
        return False
    stored = read_json(manifest, _START_AGAIN)
    num_stored, num_wanted = stored.get("scans"), request["scans"]
    if isinstance(num_stored, int):  # another number of scans is no other request
        stored = stored | {"scans": num_wanted}
    if different := list(differences(stored, request)):
        raise ValueError(
            f"{out} holds a data set of another request ({'; '.join(different)}); give another "
            f"folder, or delete it"
        )
    return isinstance(num_stored, int) and num_stored > num_wanted


def _run(task: _Task) -> int:
    files, simulator, numbers, every = task
    for number in numbers:
        files.write_scan(number, simulator.scan(number * every))
    return len(numbers)


def _is_finished(out: Path, files: Mapping[DriveFiles, int]) -> bool:
    """Whether the report, the last file of a data set, covers as many scans of each drive."""
    path = out / "report.json"
    if not path.exists():
        return False
    counts = read_json(path, "delete it and simulate again")["scans_per_drive"]
    return all(counts.get(drive.drive, 0) >= count for drive, count in files.items())


def _finish(
    out: Path, files: Mapping[DriveFiles, int], num_written: int, every: int
) -> SimulationReport:
    summaries = []
    for drive, count in files.items():
        of_drive = drive.summaries(count)
        drive.write_times_and_poses(of_drive, every)
        summaries += of_drive
        # At the end: the workers of a killed run may outlive it by a moment.
        drive.delete_unfinished()
    for path in out.glob(".*.partial.*"):
        path.unlink(missing_ok=True)
    report = make_report(summaries, num_written)
    write(out / "report.json", to_json(report.to_dict()))
    return report


def _summaries(files: Mapping[DriveFiles, int]) -> list[dict[str, Any]]:
    return [summary for drive, count in files.items() for summary in drive.summaries(count)]


def make_report(summaries: Sequence[Mapping[str, Any]], num_written: int) -> SimulationReport:
    """Report from ``sim/*.json`` of all scans."""
    effects = {
        name: _effect_total([summary["effects"][name] for summary in summaries])
        for name in summaries[0]["effects"]
    }
    return SimulationReport(
        scans_per_drive=dict(Counter(summary["drive"] for summary in summaries)),
        num_empty=sum(summary["points"] == 0 for summary in summaries),
        effects=effects,
        num_written=num_written,
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

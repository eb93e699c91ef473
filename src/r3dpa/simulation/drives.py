"""Simulated data sets: which scans there are, who writes them, and what holds a set together.

::

    simulation.json                     what was asked for
    data_3d_raw/, data_poses/           the scans and their poses, see ``drive_files``
    timings.csv, report.json            what was measured, see ``report``

All files but the two measured ones are the same bytes for equal requests, whatever the number of
workers and however often a run was killed and started again.
"""

from __future__ import annotations

import fcntl
import json
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from r3dpa.simulation.drive_files import (
    DriveFiles,
    delete,
    drive_name,
    to_json,
    weather_to_dict,
    write,
)
from r3dpa.simulation.effects import Switch
from r3dpa.simulation.report import (
    ScanTiming,
    SimulationReport,
    add_timings,
    make_report,
    read_timings,
    start_timings,
)
from r3dpa.simulation.scan import check_switches, simulate_scan
from r3dpa.simulation.scene import Weather
from r3dpa.simulation.sensor import SpinningLidar, load_sensor, sensor_to_dict
from r3dpa.simulation.street import Street

TRAIN_DRIVES = ("0003", "0004", "0005", "0006", "0007", "0009", "0010")
VAL_DRIVES = ("0000", "0002")
VAL_SHARE = 0.2

_MANIFEST = "simulation.json"
_TIMINGS = "timings.csv"
_REPORT = "report.json"
_LOCK = ".lock"
# Raised whenever the same request gives other scans than before.
_SIMULATOR_VERSION = 2
# Neighbouring scans share their blocks of street, so a worker takes a few in a row.
_SCANS_PER_TASK = 8

_log = logging.getLogger(__name__)


def simulate(
    out: Path,
    scans: int,
    seed: int = 0,
    workers: int = 1,
    drives: Sequence[str] | None = None,
    sensor: str | SpinningLidar = "hdl64e",
    effects: Mapping[str, str | bool] | None = None,
    weather: Weather | None = None,
) -> SimulationReport:
    """Write a simulated data set in the layout of KITTI-360, or complete one.

    Each scan follows from the request and its number alone: the files are the same bytes for any
    number of workers. A file appears under its name only when it is whole, so an interrupted call
    is completed by the same call, which also deletes what killed runs left; a complete data set is
    left as it is. A second call for the same folder waits until the first has ended.

    Args:
        out: Root folder of the data set; made if missing.
        scans: Scans of all drives together, 1 or more.
        seed: Seed of streets and instrument, 0 or greater.
        workers: Processes; more than one needs an importable main module, as ``spawn`` does.
        drives: Four-digit drives to write; by default all official training and validation
            drives. Where there are drives of both splits, a fifth of the scans (at least one, if
            there are two or more) goes to validation.
        sensor: Instrument, or what ``load_sensor`` takes.
        effects: ``auto``, ``on`` or ``off`` by effect; those not named are ``auto``. True and
            False, which YAML makes of a bare ``on`` and ``off``, mean the same.
        weather: Of all scans; drawn for each stretch of street if None.

    Returns:
        What the data set holds, effect by effect, and what the scans cost; also written to
        ``report.json``.

    Raises:
        ValueError: If a value is out of range, an effect or a drive is unknown, a drive is named
            twice, or ``out`` holds other data or the data set of another request.
        ChildProcessError: If a worker was killed.
    """
    if workers < 1:
        raise ValueError(f"workers must be 1 or greater, got {workers}")
    if seed < 0:
        raise ValueError(f"seed must be 0 or greater, got {seed}")
    switches = _switches(effects or {})
    if isinstance(sensor, str):
        sensor = load_sensor(sensor)
    names = (*TRAIN_DRIVES, *VAL_DRIVES) if drives is None else tuple(drives)
    counts = split_scans(scans, names)
    request = {
        "simulator_version": _SIMULATOR_VERSION,
        "seed": seed,
        "scans": scans,
        "drives": list(names),
        "sensor": sensor_to_dict(sensor),
        "effects": switches,
        "weather": None if weather is None else weather_to_dict(weather),
    }
    _check_folder(out, request)
    files = [DriveFiles(out, drive) for drive in counts]
    read_only = out.is_dir() and not os.access(out, os.W_OK)
    if read_only and not any(drive.missing(counts[drive.drive]) for drive in files):
        return SimulationReport.from_dict(_read_json(out / _REPORT))
    out.mkdir(parents=True, exist_ok=True)
    with _locked(out):
        _check_folder(out, request)  # again: who held the lock may have written
        write(out / _MANIFEST, to_json(request))
        tasks = [
            _Task(drive, numbers, seed, sensor, switches, weather)
            for drive in files
            for numbers in _stretches(drive.missing(counts[drive.drive]))
        ]
        num_missing = sum(len(task.numbers) for task in tasks)
        start_timings(out / _TIMINGS)
        # Without a terminal there is no bar.
        with tqdm(
            total=scans, initial=scans - num_missing, unit="scan", desc="simulate", disable=None
        ) as progress:

            def note(timings: list[ScanTiming]) -> None:
                add_timings(out / _TIMINGS, timings)
                progress.update(len(timings))

            _run_all(tasks, workers, note)
        return _finish(out, files, counts, num_missing)


def split_scans(scans: int, drives: Sequence[str]) -> dict[str, int]:
    """Scans of each drive: a fifth of them for validation, evenly within each split.

    Args:
        scans: All scans, 1 or more.
        drives: Four-digit official drives.

    Returns:
        Count by drive, training drives first; drives that get none are left out.

    Raises:
        ValueError: If there is no scan, or a drive is not an official one, is named twice, or
            there is none.
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
    elif not val or scans < 2:
        num_val = 0
    else:
        num_val = max(1, round(VAL_SHARE * scans))
    return _share(scans - num_val, train) | _share(num_val, val)


def expected_scans(root: Path) -> dict[str, int] | None:
    """Scans that a simulated data set holds when it is complete.

    Args:
        root: Root folder of a data set.

    Returns:
        Number of scans by drive folder, sorted; None where ``root`` holds no simulated data set.

    Raises:
        ValueError: If the manifest of the data set is damaged.
    """
    manifest = root / _MANIFEST
    if not manifest.is_file():
        return None
    request = _read_json(manifest)
    try:
        counts = split_scans(request["scans"], request["drives"])
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise ValueError(
            f"{manifest} does not say which scans were simulated ({error!r}); simulate the data "
            f"set again into an empty folder"
        ) from error
    return {drive_name(drive): count for drive, count in sorted(counts.items())}


def _share(scans: int, drives: list[str]) -> dict[str, int]:
    counts = {
        drive: scans // len(drives) + (place < scans % len(drives))
        for place, drive in enumerate(drives)
    }
    return {drive: count for drive, count in counts.items() if count}


class _Task(NamedTuple):
    """Scans of one drive for one worker to write."""

    files: DriveFiles
    numbers: tuple[int, ...]
    seed: int
    sensor: SpinningLidar
    switches: dict[str, Switch]
    weather: Weather | None


def _switches(effects: Mapping[str, str | bool]) -> dict[str, Switch]:
    """The switches that are not ``auto``, sorted by name."""
    words: dict[Any, Any] = {True: "on", False: "off"}
    checked = check_switches({name: words.get(switch, switch) for name, switch in effects.items()})
    return {name: switch for name, switch in sorted(checked.items()) if switch != "auto"}


def _stretches(numbers: Sequence[int]) -> Iterator[tuple[int, ...]]:
    for start in range(0, len(numbers), _SCANS_PER_TASK):
        yield tuple(numbers[start : start + _SCANS_PER_TASK])


def _check_folder(out: Path, request: dict[str, Any]) -> None:
    """Refuse a folder that holds anything but this data set."""
    manifest = out / _MANIFEST
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file; give the folder of the data set")
    if not manifest.exists():
        if (out / "data_3d_raw").exists():
            raise ValueError(
                f"{out} holds a data set that was not simulated ({_MANIFEST} is missing); "
                f"give another folder"
            )
        return
    if different := list(_differences(_read_json(manifest), request)):
        raise ValueError(
            f"{out} holds a data set of another request ({'; '.join(different)}); give another "
            f"folder, or delete it"
        )


def _differences(stored: Any, wanted: Any, name: str = "") -> Iterator[str]:
    """Each value that differs, by its place, with both values."""
    if isinstance(stored, dict) and isinstance(wanted, dict):
        for key in stored | wanted:
            place = f"{name}.{key}" if name else key
            yield from _differences(stored.get(key), wanted.get(key), place)
    elif stored != wanted:
        yield f"{name} {_short(stored)} there, {_short(wanted)} now"


def _short(value: Any) -> str:
    """A value for a message; tables of the lasers are not spelled out."""
    long = isinstance(value, list) and len(value) > len((*TRAIN_DRIVES, *VAL_DRIVES))
    return f"{len(value)} values" if long else repr(value)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text())
        if not isinstance(values, dict):
            raise ValueError(f"it holds {type(values).__name__}, not an object")
    except ValueError as error:
        raise ValueError(
            f"{path} is damaged ({error}); simulate the data set again into an empty folder"
        ) from error
    return values


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Holds the folder's lock, which the system releases when the process dies."""
    with (out / _LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _log.warning("waiting for another process that simulates into %s", out)
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _run_all(tasks: list[_Task], workers: int, note: Callable[[list[ScanTiming]], None]) -> None:
    """Run the tasks; ``note`` is told of each as it ends, in any order."""
    if workers == 1 or len(tasks) < 2:
        for task in tasks:
            note(_run(task))
        return
    # spawn: forking a process that runs threads (torch, CUDA) can deadlock.
    pool = ProcessPoolExecutor(
        min(workers, len(tasks)),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_worker,
    )
    try:
        for future in as_completed([pool.submit(_run, task) for task in tasks]):
            note(future.result())
    except BrokenProcessPool as error:
        raise ChildProcessError(
            "a worker process ended before its work: it was killed, as happens when memory runs "
            "out, or could not start. The same request goes on where this one stopped; use fewer "
            "workers, or one to see the error itself"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker() -> None:
    """A worker leaves an interrupt to its parent, and ends when that is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _run(task: _Task) -> list[ScanTiming]:
    """Simulate and write the scans of a task."""
    drive = task.files.drive
    weather = () if task.weather is None else (task.weather,)
    street = Street(task.seed, int(drive), *weather)
    timings = []
    for number in task.numbers:
        start = time.perf_counter()
        scene = street.scene(number, task.sensor.mount_height_m)
        drawn = time.perf_counter()
        key = (task.seed, "effects", street.drive, number)
        scan = simulate_scan(scene, task.sensor, key, task.switches)
        scanned = time.perf_counter()
        task.files.write_scan(number, scene, scan)
        written = time.perf_counter()
        ms = {"scene": 1000 * (drawn - start), **scan.parts_ms}
        ms |= {"write": 1000 * (written - scanned)}
        ms |= {effect.name: effect.ms for effect in scan.effects}
        timings.append(ScanTiming(drive, number, ms | {"total": 1000 * (written - start)}))
    return timings


def _finish(
    out: Path, files: Sequence[DriveFiles], counts: Mapping[str, int], num_written: int
) -> SimulationReport:
    """Write what is about whole drives and the whole data set."""
    summaries = []
    for drive in files:
        of_drive = drive.summaries(counts[drive.drive])
        drive.write_times_and_poses(of_drive)
        summaries += of_drive
        # At the end: the workers of a killed run may outlive it by a moment.
        delete(drive.partial_files())
    for name in (_MANIFEST, _REPORT):
        stem, suffix = name.split(".")
        delete(out.glob(f".{stem}.*.partial.{suffix}"))
    report = make_report(summaries, read_timings(out / _TIMINGS), num_written)
    write(out / _REPORT, to_json(report.to_dict()))
    return report

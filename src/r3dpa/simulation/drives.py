"""Simulated data sets on disk, in the layout of KITTI-360.

::

    simulation.json                                      what was asked for
    data_3d_raw/2013_05_28_drive_XXXX_sync/velodyne_points/
        timestamps.txt                                   one line a scan, 10 Hz
        data/%010d.bin                                   (P, 4) float32 x, y, z, intensity
        labels/%010d.label                               (P,) uint32 semantic | instance << 16
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

from r3dpa.atomic import atomic_path
from r3dpa.simulation.scan import simulate_scan
from r3dpa.simulation.sensor import HDL64E
from r3dpa.simulation.street import Street

TRAIN_DRIVES = ("0003", "0004", "0005", "0006", "0007", "0009", "0010")
VAL_DRIVES = ("0000", "0002")
VAL_SHARE = 0.2

_MANIFEST = "simulation.json"
# Raised whenever the same request gives other scans than before.
_SIMULATOR_VERSION = 1
# Neighbouring scans share their blocks of street, so a worker takes a few in a row.
_SCANS_PER_TASK = 8
_FIRST_SCAN = datetime(2013, 5, 28, 8, 46, 2)
_SCAN_PERIOD = timedelta(seconds=0.1)
# A scan takes well under a second: an older temporary file was left by a run that was killed, a
# newer one may belong to another process.
_ABANDONED_S = 60


@dataclass(frozen=True)
class SimulationReport:
    """What a call of ``simulate`` did.

    Args:
        scans_per_drive: Scans that the data set holds, by drive (four digits).
        num_written: Scans simulated by this call; the others were there already.
        ms_per_scan: Mean time of one written scan on one core, milliseconds, writing included;
            0 where none was written.
    """

    scans_per_drive: dict[str, int]
    num_written: int
    ms_per_scan: float

    def __str__(self) -> str:
        """One line per drive and one with the totals."""
        lines = [f"drive {drive}: {count} scans" for drive, count in self.scans_per_drive.items()]
        written = f"{self.num_written} written"
        if self.num_written:
            written += f", {self.ms_per_scan:.0f} ms each"
        return "\n".join([*lines, f"{sum(self.scans_per_drive.values())} scans, {written}"])


def simulate(
    out: Path,
    scans: int,
    seed: int = 0,
    workers: int = 1,
    shots: int = 2083,
    drives: Sequence[str] | None = None,
) -> SimulationReport:
    """Write a simulated data set in the layout of KITTI-360, or complete one.

    Each scan follows from (seed, drive, number) alone: the files are the same bytes for any number
    of workers. A file appears under its name only when it is whole, so an interrupted call is
    completed by the same call, which also deletes temporary files of killed runs; a complete data
    set is left as it is.

    Args:
        out: Root folder of the data set; made if missing.
        scans: Scans of all drives together, 1 or more.
        seed: Seed of the streets, 0 or greater.
        workers: Processes; more than one needs an importable main module, as ``spawn`` does.
        shots: Shots per laser and turn, see ``HDL64E``.
        drives: Four-digit drives to write; by default all official training and validation
            drives. Where there are drives of both splits, a fifth of the scans (at least one, if
            there are two or more) goes to validation.

    Returns:
        Scans per drive and the time per scan.

    Raises:
        ValueError: If a value is out of range, a drive is unknown or named twice, or ``out`` holds
            other data or the data set of another request.
    """
    if workers < 1:
        raise ValueError(f"workers must be 1 or greater, got {workers}")
    if seed < 0:
        raise ValueError(f"seed must be 0 or greater, got {seed}")
    sensor = HDL64E(shots=shots)
    names = (*TRAIN_DRIVES, *VAL_DRIVES) if drives is None else tuple(drives)
    counts = split_scans(scans, names)
    request = {
        "simulator_version": _SIMULATOR_VERSION,
        "seed": seed,
        "scans": scans,
        "drives": list(names),
        "sensor": asdict(sensor),
    }
    _claim(out, request)
    _delete_abandoned(out)
    for drive, count in counts.items():
        _make_drive(_points_folder(out, drive), count)
    tasks = [
        task
        for drive, count in counts.items()
        for task in _missing(out, drive, count, seed, sensor)
    ]
    if workers == 1 or len(tasks) < 2:
        seconds = [_run(task) for task in tasks]
    else:
        # spawn: forking a process that runs threads (torch, CUDA) can deadlock.
        pool = ProcessPoolExecutor(min(workers, len(tasks)), mp_context=get_context("spawn"))
        with pool:
            seconds = list(pool.map(_run, tasks))
    num_written = sum(len(task.numbers) for task in tasks)
    return SimulationReport(
        counts, num_written, 1000 * sum(seconds) / num_written if num_written else 0.0
    )


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


def drive_name(number: str) -> str:
    """Folder of a drive in the KITTI-360 layout, of its four-digit number."""
    return f"2013_05_28_drive_{number}_sync"


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
    request = _read_manifest(manifest)
    try:
        counts = split_scans(request["scans"], request["drives"])
    except (KeyError, TypeError, ValueError) as error:
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

    folder: Path
    drive: str
    numbers: tuple[int, ...]
    seed: int
    sensor: HDL64E


def _points_folder(out: Path, drive: str) -> Path:
    return out / "data_3d_raw" / drive_name(drive) / "velodyne_points"


def _claim(out: Path, request: dict[str, Any]) -> None:
    """Write the request into a new data set; refuse a folder that holds anything else."""
    manifest = out / _MANIFEST
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file; give the folder of the data set")
    if not manifest.exists():
        if (out / "data_3d_raw").exists():
            raise ValueError(
                f"{out} holds a data set that was not simulated ({_MANIFEST} is missing); "
                f"give another folder"
            )
        out.mkdir(parents=True, exist_ok=True)
        _write(manifest, (json.dumps(request, indent=2) + "\n").encode())
        return
    stored = _read_manifest(manifest)
    different = [key for key in request if stored.get(key) != request[key]]
    if different:
        listed = "; ".join(
            f"{key} {stored.get(key)} there, {request[key]} now" for key in different
        )
        raise ValueError(
            f"{out} holds a data set of another request ({listed}); give another folder, "
            f"or delete it"
        )


def _read_manifest(manifest: Path) -> dict[str, Any]:
    try:
        request = json.loads(manifest.read_text())
        if not isinstance(request, dict):
            raise ValueError(f"it holds {type(request).__name__}, not an object")
    except ValueError as error:
        raise ValueError(
            f"{manifest} is damaged ({error}); simulate the data set again into an empty folder"
        ) from error
    return request


def _delete_abandoned(out: Path) -> None:
    for path in out.rglob(".*.partial.*"):
        with suppress(FileNotFoundError):  # another process has just finished its file
            if path.stat().st_mtime < time.time() - _ABANDONED_S:
                path.unlink()


def _make_drive(folder: Path, count: int) -> None:
    for name in ("data", "labels"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    stamps = (_FIRST_SCAN + number * _SCAN_PERIOD for number in range(count))
    # KITTI-360 stores nanoseconds.
    lines = "".join(f"{stamp:%Y-%m-%d %H:%M:%S.%f}000\n" for stamp in stamps)
    if not (folder / "timestamps.txt").exists():
        _write(folder / "timestamps.txt", lines.encode())


def _missing(out: Path, drive: str, count: int, seed: int, sensor: HDL64E) -> Iterator[_Task]:
    folder = _points_folder(out, drive)
    data, labels = (
        {path.stem for path in (folder / name).iterdir()} for name in ("data", "labels")
    )
    complete = data & labels
    for first in range(0, count, _SCANS_PER_TASK):
        numbers = tuple(
            number
            for number in range(first, min(first + _SCANS_PER_TASK, count))
            if f"{number:010d}" not in complete
        )
        if numbers:
            yield _Task(folder, drive, numbers, seed, sensor)


def _run(task: _Task) -> float:
    """Simulate and write the scans of a task; seconds that it took."""
    street = Street(task.seed, int(task.drive))
    start = time.perf_counter()
    for number in task.numbers:
        scene = street.scene(number, task.sensor.mount_height_m)
        scan = simulate_scan(scene, task.sensor, (task.seed, "effects", street.drive, number))
        name = f"{number:010d}"
        _write(task.folder / "labels" / f"{name}.label", scan.labels.astype("<u4").tobytes())
        _write(task.folder / "data" / f"{name}.bin", scan.points.astype("<f4").tobytes())
    return time.perf_counter() - start


def _write(path: Path, content: bytes) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)

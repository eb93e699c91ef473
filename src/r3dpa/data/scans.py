"""LiDAR scans on disk: finding and checking them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from glob import glob, has_magic
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from tqdm import tqdm

from lidarsim import TRAIN_DRIVES, VAL_DRIVES, drive_name, expected_scans
from lidarsim.cloud_formats import READABLE, READERS, ScanError, unreadable
from lidarsim.clouds import read_cloud, suffix_of
from lidarsim.scan_files import read_scan, rows_of
from lidarsim.scan_folders import files_below, find_files, without_range_images
from r3dpa.data.store import ItemKey
from r3dpa.geometry import LidarSensor
from r3dpa.io import number_of, refuse_name

Split = Literal["train", "val"]
T = TypeVar("T")
#: Drives of KITTI-360 by split, as in R2DM and RangeLDM (LiDAR-Diffusion validates on drive 3).
KITTI360_DRIVES: dict[Split, tuple[str, ...]] = {
    "train": tuple(drive_name(number) for number in TRAIN_DRIVES),
    "val": tuple(drive_name(number) for number in VAL_DRIVES),
}
RAW = "data_3d_raw"
# Beginnings of the names of folders beside ``RAW`` or in it.
_KITTI360_NAMES = ("data_2d_", "data_3d_", "data_poses", "2013_05_28_drive_")
VELODYNE = Path("velodyne_points") / "data"


@dataclass(frozen=True, order=True, slots=True)
class Scan:
    """One sensor sweep in a file.

    ``drive`` is the KITTI-360 drive, or the folder relative to the root; ``frame`` the file name
    without its suffix; ``columns`` the names of the columns of a file without names, see
    :func:`lidarsim.scan_files.read_scan`. Scans of two data sets may have the same drive and frame.
    """

    drive: str
    frame: str
    path: Path
    columns: tuple[str, ...] = field(default=(), compare=False)

    @property
    def name(self) -> str:
        """``drive/frame``, unique within a data set."""
        return f"{self.drive}/{self.frame}"

    @property
    def cache_key(self) -> ItemKey:
        """Name with the columns if these are given, size and time of change of the file."""
        try:
            about = self.path.stat()
        except OSError as error:
            raise unreadable(self.path, error) from error
        name = f"{self.name}@{','.join(self.columns)}" if self.columns else self.name
        return name, about.st_size, about.st_mtime_ns

    def read(self, sensor: LidarSensor | None = None) -> np.ndarray:
        """Points ``(P, 4)``, see :func:`lidarsim.scan_files.read_scan`."""
        return read_scan(self.path, sensor, self.columns)


def find_scans(
    source: str | Path | Sequence[str | Path], columns: Sequence[str] = ()
) -> list[Scan]:
    """Return all scans of a folder (with its sub-folders), file, glob, or list of these, sorted.

    A folder in the KITTI-360 layout (one that holds ``data_3d_raw``) gives its Velodyne scans.
    Other folders and globs give their ``.bin`` files; if there are none, the files of the only
    other format that can be read. Links to folders are followed; hidden files are left out. The
    drive of a scan is its folder relative to the given folder, or to the common parent of a glob or
    list.

    Args:
        source: Folder, file, glob, or list of these.
        columns: Names of the columns of files without names.

    Raises:
        ValueError: If nothing is found, several formats other than ``.bin`` are, a file is named
            twice, or the name of a scan cannot be the name of an output file.
    """
    given = [source] if isinstance(source, str | Path) else list(source)
    entries = [_without_dots(Path(entry).absolute()) for entry in given]
    single = len(entries) == 1 and Path(entries[0]).is_dir()
    files = sorted(file.absolute() for entry in entries for file in scan_files(entry))
    if not files:
        raise ValueError(
            f"no scan found in {', '.join(str(e) for e in given)}: give a scan or a folder of "
            "scans (in Python and in YAML files also a glob such as 'drives/**/*.bin', or a list "
            f"of these); can be read: {READABLE}"
        )
    twice = [str(file) for file, count in Counter(files).items() if count > 1]
    if twice:
        raise ValueError(f"scans given twice: {', '.join(twice[:5])}; name every file once")
    parent = os.path.commonpath([file.parent for file in files])
    root = entries[0] if single else Path(parent)
    scans = sorted(
        Scan(_drive_name(file.parent, root), file.stem, file, tuple(columns)) for file in files
    )
    for scan in scans:  # they become names of reconstructions and of feature grids
        if reason := refuse_name(scan.name):
            raise ValueError(f"{scan.path}: the name of the scan {reason}; rename the file")
    return scans


def _without_dots(path: Path) -> Path:
    """The path without ``..``, which leads out of the folder that a link before it points to."""
    parts = path.parts
    if ".." not in parts:
        return path
    last = max(place for place, part in enumerate(parts) if part == "..")
    return Path(*parts[: last + 1]).resolve().joinpath(*parts[last + 1 :])


def kitti360_scans(root: str | Path, split: Split) -> list[Scan]:
    """Scans of one split of a data set in the KITTI-360 layout, sorted by drive and frame.

    Absent drives are skipped; ``ValueError`` if both splits are empty.
    """
    raw = Path(root).absolute() / RAW
    scans = [
        Scan(drive, file.stem, file)
        for drive in KITTI360_DRIVES[split]
        for file in _drive_files(raw / drive)
    ]
    others = KITTI360_DRIVES["val" if split == "train" else "train"]
    if not scans and not any(any(_drive_files(raw / drive)) for drive in others):
        raise ValueError(
            f"no scan of the {split} split in {root}, nor of the other one: `r3dpa data check "
            f"{root}` names what is missing; use LidarDataModule for scans in other folders"
        )
    return sorted(scans)


def evenly(items: Sequence[T], num: int | None) -> list[T]:
    """Up to ``num`` items, evenly spread over the sequence, the first among them; all if None."""
    num = len(items) if num is None else min(num, len(items))
    return [items[place * len(items) // num] for place in range(num)]


def scan_files(entry: str | Path) -> Iterator[Path]:
    """Scan files of a folder, file or glob."""
    path = Path(entry)
    if (path / RAW).is_dir():
        for drive in (path / RAW).iterdir():
            yield from _drive_files(drive)
    elif path.is_dir():
        yield from _of_one_format(path, without_range_images(list(files_below(path))))
    elif path.is_file():
        yield path
    elif has_magic(str(entry)):
        yield from _of_one_format(path, _files_of_glob(path.absolute()))


def _files_of_glob(pattern: Path) -> list[Path]:
    """Files of a glob, with links and hidden files as in :func:`files_below`."""
    parts = (*pattern.parts, "**")
    fixed = Path(*parts[: parts.index("**")])
    # Path.glob, which ruff prefers, also takes hidden folders where a part has a wildcard.
    places = [Path(name) for name in sorted(glob(str(fixed)))]  # noqa: PTH207
    if fixed == pattern:
        return places
    return [
        file
        for root in places
        for file in files_below(root)
        if _matches(file.relative_to(root).parts, pattern.parts[len(fixed.parts) :])
    ]


def _matches(names: tuple[str, ...], pattern: tuple[str, ...]) -> bool:
    """Whether the parts of a path match the parts of a glob, of which ``**`` is any number."""
    if not pattern:
        return not names
    if pattern[0] == "**":
        return any(_matches(names[start:], pattern[1:]) for start in range(len(names) + 1))
    return bool(names) and fnmatch(names[0], pattern[0]) and _matches(names[1:], pattern[1:])


def _of_one_format(source: Path, files: Iterable[Path]) -> list[Path]:
    """Return the ``.bin`` files, or else the files of the only other format."""
    scans: dict[str, list[Path]] = {}
    for file in files:
        if suffix_of(file) in READERS and not file.name.startswith("."):
            scans.setdefault(file.suffix.lower(), []).append(file)
    if len(scans) > 1 and ".bin" not in scans:
        formats = ", ".join(f"{len(files)} {suffix}" for suffix, files in sorted(scans.items()))
        raise ValueError(
            f"{source}: holds several formats ({formats}), perhaps each scan more than once: give "
            "a folder of one (in Python and in YAML files also a glob such as '**/*.pcd')"
        )
    return scans.get(".bin") or [file for paths in scans.values() for file in paths]


def _drive_files(drive: Path) -> Iterator[Path]:
    return filter(_is_scan, (drive / VELODYNE).glob("*"))


def _is_scan(file: Path) -> bool:
    """Whether a file is a scan; the hidden ones are of writers that have not finished."""
    return file.suffix == ".bin" and not file.name.startswith(".")


def _drive_name(folder: Path, root: Path) -> str:
    parts = folder.relative_to(root).parts
    if parts[-2:] == VELODYNE.parts:
        parts = parts[:-2]
    if parts[:1] == (RAW,):
        parts = parts[1:]
    return "/".join(parts) or root.name


def check(path: str | Path) -> tuple[str, bool]:
    """Text about every scan of a data set, folder or file, and whether nothing is wrong with it.

    A folder with folders of KITTI-360 is compared with its layout and nine LiDAR drives; a
    simulated one with its manifest (``ValueError`` if that is damaged).
    Every scan needs 16 points, ranges in metres, and a point within the range limits of
    :class:`LidarSensor`; a file of labels beside it needs one for each point.
    """
    root, sensor = Path(path).absolute(), LidarSensor()
    scans = find_scans(root) if any(scan_files(root)) else []
    counts = dict(sorted(Counter(scan.drive for scan in scans).items()))
    problems = _compare_layout(root, counts)
    if not scans and not problems:
        try:
            find_files(root)
        except ScanError as error:
            problems.append(f"bad: {error}")

    def examine(scan: Scan) -> tuple[float, float] | str:
        try:
            cloud = read_cloud(scan.path, scan.columns)
            cloud.check_metres()
            intensity = rows_of(scan.path, cloud, sensor)[:, 3]
        except ScanError as error:
            return f"bad: {error}"
        return float(intensity.min()), float(intensity.max())

    with ThreadPool(8) as pool:
        results = list(tqdm(pool.imap(examine, scans), total=len(scans), unit="scan", disable=None))
    problems += [result for result in results if isinstance(result, str)]
    lines = [
        *(f"{drive}: {number_of(count, 'scan')}" for drive, count in counts.items()),
        *problems,
    ]
    if limits := [result for result in results if not isinstance(result, str)]:
        low, high = min(low for low, _ in limits), max(high for _, high in limits)
        outside = " (expected 0..1)" if low < 0 or high > 1 else ""
        lines.append(f"intensity: {low:.3g}..{high:.3g}{outside}")
    in_drives = f" in {number_of(len(counts), 'drive')}" if scans else ""
    lines.append(f"{root}: {verdict(len(scans), len(problems), in_drives)}")
    return "\n".join(lines), not problems


def verdict(num_scans: int, num_problems: int, place: str = "") -> str:
    """Return how many scans were checked, and whether they can be used."""
    usable = f"problems: {num_problems}" if num_problems else "all usable"
    return f"{number_of(num_scans, 'scan')}{place}, {usable}"


def _compare_layout(root: Path, counts: dict[str, int]) -> list[str]:
    raw, simulated = root / RAW, expected_scans(root)
    if not root.exists():
        return [f"missing: {root}"]
    if not raw.is_dir():
        is_layout = any(path.name.startswith(_KITTI360_NAMES) for path in root.glob("*"))
        is_expected = simulated is not None or (is_layout and not counts)
        return [f"missing: {raw}"] if is_expected else []
    problems = []
    official = dict.fromkeys(KITTI360_DRIVES["train"] + KITTI360_DRIVES["val"], 1)
    for drive, expected in sorted((simulated or official).items()):
        folder, count = raw / drive, counts.get(drive, 0)
        if not count:
            problems.append(f"missing: {folder / VELODYNE if folder.is_dir() else folder}")
        elif count < expected:
            advice = "simulate again to complete it"
            problems.append(f"bad: {folder}: holds {count} of {expected} scans; {advice}")
    return problems

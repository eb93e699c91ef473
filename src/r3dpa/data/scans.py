"""LiDAR scans on disk: finding, reading, checking and writing them."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from glob import has_magic
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from r3dpa.atomic import atomic_path
from r3dpa.geometry import LidarSensor, in_range
from r3dpa.simulation import TRAIN_DRIVES, VAL_DRIVES, split_scans

Split = Literal["train", "val"]
#: Drives of KITTI-360 by split, as in R2DM and RangeLDM (LiDAR-Diffusion validates on drive 3).
KITTI360_DRIVES: dict[Split, tuple[str, ...]] = {
    "train": tuple(f"2013_05_28_drive_{number}_sync" for number in TRAIN_DRIVES),
    "val": tuple(f"2013_05_28_drive_{number}_sync" for number in VAL_DRIVES),
}
_MANIFEST = "simulation.json"  # in the root of a simulated data set
_RAW = "data_3d_raw"
_VELODYNE = Path("velodyne_points") / "data"
_KITTI360_FOLDERS = (_RAW, "data_2d_raw", "data_poses", "calibration", _MANIFEST)
_BYTES_PER_POINT = 16
_PLY_TYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1"}


class ScanError(ValueError):
    """A scan file that cannot be used; the message names the file and the reason."""


@dataclass(frozen=True, order=True)
class Scan:
    """One sensor sweep in a file.

    Args:
        drive: Name of the recording: the KITTI-360 drive, or the folder relative to the root.
        frame: File name without its suffix.
        path: The ``.bin`` file.
    """

    drive: str
    frame: str
    path: Path = field(compare=False)

    @property
    def name(self) -> str:
        """``drive/frame``, unique within a data set."""
        return f"{self.drive}/{self.frame}"


def find_scans(source: str | Path | Sequence[str | Path]) -> list[Scan]:
    """All scans of a folder (with its sub-folders), file, glob, or list of these, sorted.

    The drive of a scan is its folder relative to the root: the given folder itself, or the
    common parent of the files where a glob or a list is given. The fixed folders of the
    KITTI-360 layout are left out of the name.

    Raises:
        ValueError: If nothing is found, or one file is named twice.
    """
    entries = [source] if isinstance(source, str | Path) else list(source)
    single = len(entries) == 1 and Path(entries[0]).is_dir()
    files = sorted(file.absolute() for entry in entries for file in _files(entry))
    if not files:
        raise ValueError(
            f"No scan found in {', '.join(str(e) for e in entries)}: give a folder that holds .bin "
            "files, a .bin file, a glob such as 'drives/**/*.bin', or a list of these."
        )
    twice = [str(file) for file, count in Counter(files).items() if count > 1]
    if twice:
        raise ValueError(f"Scans given twice: {', '.join(twice[:5])}. Name every file once.")
    root = Path(entries[0]).absolute() if single else _common_parent(files)
    return sorted(Scan(_drive_name(file.parent, root), file.stem, file) for file in files)


def kitti360_scans(root: str | Path, split: Split) -> list[Scan]:
    """Scans of one split of a data set in the KITTI-360 layout, sorted by drive and frame.

    The layout is ``root/data_3d_raw/<drive>/velodyne_points/data/<frame>.bin``; drives that are
    absent are skipped (``r3dpa check`` names them).

    Args:
        root: Folder that holds ``data_3d_raw``.
        split: ``"train"`` or ``"val"``, see :data:`KITTI360_DRIVES`.

    Raises:
        ValueError: If no scan of the split exists.
    """
    scans = [
        Scan(drive, file.stem, file)
        for drive in KITTI360_DRIVES[split]
        for file in sorted((Path(root).absolute() / _RAW / drive / _VELODYNE).glob("*.bin"))
    ]
    if not scans:
        raise ValueError(
            f"No scan of the {split} split in {root}: expected {_RAW}/<drive>/{_VELODYNE}/*.bin "
            f"for a drive of {', '.join(KITTI360_DRIVES[split])}. `r3dpa check {root}` names what "
            "is missing; use LidarDataModule for scans in other folders."
        )
    return sorted(scans)


def read_scan(path: str | Path, sensor: LidarSensor | None = None) -> np.ndarray:
    """Points of one ``.bin`` scan, checked.

    Args:
        path: KITTI ``.bin`` file, float32 rows x, y, z (metres) and intensity.
        sensor: If given, at least one point must lie within its range limits.

    Returns:
        ``(P, 4)`` float32 in storage order, P >= 1.

    Raises:
        ScanError: If the file is unreadable, empty, not made of 16-byte points, holds NaN or
            infinite values, or has no point in range; the message names the file.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ScanError(f"{path}: cannot be read ({error.strerror or error})") from error
    if not data:
        raise ScanError(f"{path}: is empty")
    if len(data) % _BYTES_PER_POINT:
        raise ScanError(
            f"{path}: has {len(data)} bytes, not a multiple of 16 (x, y, z, intensity as float32)"
        )
    points = np.frombuffer(data, dtype="<f4").reshape(-1, 4).copy()
    bad = np.count_nonzero(~np.isfinite(points).all(axis=1))
    if bad:
        raise ScanError(f"{path}: has NaN or infinite values in {bad} of {len(points)} points")
    if sensor is not None and not in_range(torch.from_numpy(points[:, :3]), sensor).any():
        limits = f"{sensor.range_min_m:g}..{sensor.range_max_m:g} m"
        raise ScanError(f"{path}: has no point within the sensor's range {limits}")
    return points


def write_bin(path: str | Path, points: np.ndarray | torch.Tensor) -> None:
    """Write one scan as a KITTI ``.bin`` file, atomically.

    Args:
        path: File to write.
        points: ``(P, 3)`` or ``(P, 4)`` x, y, z in metres and intensity (0 where not given).

    Raises:
        ValueError: If the shape is another or a value is not finite.
    """
    rows = _rows(points)
    if rows.shape[1] == 3:
        rows = np.concatenate([rows, np.zeros((len(rows), 1), np.float32)], axis=1)
    with atomic_path(path) as temporary:
        temporary.write_bytes(rows.astype("<f4").tobytes())


def write_ply(path: str | Path, points: np.ndarray | torch.Tensor) -> None:
    """Write one scan as a binary little-endian ``.ply`` file, atomically.

    Args:
        path: File to write.
        points: ``(P, 3)`` or ``(P, 4)`` x, y, z in metres and, where given, intensity.

    Raises:
        ValueError: If the shape is another or a value is not finite.
    """
    rows = _rows(points)
    names = ("x", "y", "z", "intensity")[: rows.shape[1]]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(header).encode("ascii") + rows.astype("<f4").tobytes())


def read_ply(path: str | Path) -> np.ndarray:
    """Points of a binary little-endian ``.ply`` file whose first element is ``vertex``.

    Returns:
        ``(P, 3)`` float32 x, y, z in metres, or ``(P, 4)`` where the file has an intensity.

    Raises:
        ScanError: If the file has another format or lacks x, y or z.
    """
    path = Path(path)
    head, separator, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii", errors="replace").split("\n")
    if not separator or lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise ScanError(f"{path}: is not a binary little-endian .ply file")
    words = [line.split() for line in lines[2:] if line and not line.startswith("comment")]
    elements = [word for word in words if word[0] == "element"]
    properties = [word for word in words if word[0] == "property"]
    if len(elements) != 1 or elements[0][1] != "vertex":
        raise ScanError(f"{path}: holds other elements than vertex; export the points alone")
    unknown = [" ".join(word) for word in properties if word[1] not in _PLY_TYPES]
    names = [word[2] for word in properties if word[1] in _PLY_TYPES]
    if unknown or not {"x", "y", "z"} <= set(names):
        raise ScanError(f"{path}: needs float properties x, y, z; found {names + unknown}")
    layout = np.dtype([(word[2], _PLY_TYPES[word[1]]) for word in properties])
    count = int(elements[0][2])
    if len(body) != count * layout.itemsize:
        raise ScanError(f"{path}: holds {len(body)} bytes for {count} points of {layout.itemsize}")
    table = np.frombuffer(body, dtype=layout)
    wanted = ["x", "y", "z"] + ["intensity"] * ("intensity" in names)
    return np.stack([table[name].astype(np.float32) for name in wanted], axis=1)


def write_npz(path: str | Path, scans: Mapping[str, np.ndarray | torch.Tensor]) -> None:
    """Write many scans to one compressed ``.npz`` file, atomically.

    Args:
        path: File to write.
        scans: Points by name, each ``(P, 3)`` or ``(P, 4)``, metres.

    Raises:
        ValueError: If a shape is another or a value is not finite.
    """
    arrays = {name: _rows(points) for name, points in scans.items()}
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """Scans of a ``.npz`` file by name, each ``(P, 3)`` or ``(P, 4)`` float32, metres."""
    with np.load(Path(path), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


@dataclass(frozen=True)
class CheckReport:
    """What :func:`check` found.

    Args:
        root: The checked folder.
        num_scans: Scans by drive, bad ones included.
        bad: ``(file, reason)`` of every scan that cannot be used.
        missing: Folders that should exist or hold scans.
    """

    root: Path
    num_scans: dict[str, int]
    bad: tuple[tuple[Path, str], ...]
    missing: tuple[Path, ...]

    @property
    def ok(self) -> bool:
        """Whether every scan is usable and no folder is missing."""
        return not self.bad and not self.missing

    def __str__(self) -> str:
        """Report for the terminal."""
        lines = [f"{drive}: {count} scans" for drive, count in self.num_scans.items()]
        lines += [f"missing: {folder}" for folder in self.missing]
        lines += [f"bad: {file}: {reason}" for file, reason in self.bad]
        total = sum(self.num_scans.values())
        summary = f"{self.root}: {total} scans in {len(self.num_scans)} drives, "
        if self.ok:
            return "\n".join([*lines, f"{summary}all usable"])
        problems = f"{len(self.bad)} bad, {len(self.missing)} folders missing or without scans"
        return "\n".join([*lines, summary + problems])


def check(path: str | Path, sensor: LidarSensor | None = None) -> CheckReport:
    """Read every scan of a data set or folder and report all that is wrong with it.

    A folder with a KITTI-360 sub-folder, or without any scan, is held against the KITTI-360
    layout with its nine LiDAR drives; a simulated one against the scans that its manifest asks for.

    Args:
        path: Root of a data set, or any folder or file of scans.
        sensor: Every scan must have a point within its range limits; default sensor if None.

    Raises:
        ValueError: If the manifest of a simulated data set cannot be understood.
    """
    root = Path(path).absolute()
    sensor = sensor or LidarSensor()
    scans = find_scans(root) if any(_files(root)) else []
    counts = dict(sorted(Counter(scan.drive for scan in scans).items()))
    bad: list[tuple[Path, str]] = []
    missing: list[Path] = []
    if not root.exists():
        missing.append(root)
    elif not scans or any((root / name).exists() for name in _KITTI360_FOLDERS):
        missing, bad = _compare_layout(root, counts)
    for scan in scans:
        try:
            read_scan(scan.path, sensor)
        except ScanError as error:
            bad.append((scan.path, str(error).removeprefix(f"{scan.path}: ")))
    return CheckReport(root, counts, tuple(bad), tuple(missing))


def _compare_layout(
    root: Path, counts: dict[str, int]
) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Folders that a data set lacks, and drives that lack scans, with the reason."""
    if not (root / _RAW).is_dir():
        return [root / _RAW], []
    missing, incomplete = [], []
    for drive, expected in _expected_counts(root).items():
        folder = root / _RAW / drive
        if not folder.is_dir():
            missing.append(folder)
        elif drive not in counts:
            missing.append(folder / _VELODYNE)
        elif expected is not None and counts[drive] < expected:
            reason = f"holds {counts[drive]} of {expected} scans; simulate again to complete it"
            incomplete.append((folder, reason))
    return missing, incomplete


def _expected_counts(root: Path) -> dict[str, int | None]:
    """Drives that a data set must have, with their number of scans where it is known."""
    manifest = root / _MANIFEST
    if not manifest.is_file():
        return dict.fromkeys(sorted(KITTI360_DRIVES["train"] + KITTI360_DRIVES["val"]))
    try:
        request = json.loads(manifest.read_text())
        counts = split_scans(request["scans"], request["drives"])
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(
            f"{manifest} does not say which scans were simulated ({error!r}); simulate the data "
            "set again into an empty folder."
        ) from error
    return {f"2013_05_28_drive_{number}_sync": count for number, count in sorted(counts.items())}


def _files(entry: str | Path) -> Iterator[Path]:
    path = Path(entry)
    if path.is_dir():
        yield from path.rglob("*.bin")
    elif path.is_file():
        yield path
    elif has_magic(str(entry)):
        root = Path(path.absolute().anchor)
        found = root.glob(str(path.absolute().relative_to(root)))
        yield from (file for file in found if file.suffix == ".bin")


def _common_parent(files: list[Path]) -> Path:
    return Path(os.path.commonpath([file.parent for file in files]))


def _drive_name(folder: Path, root: Path) -> str:
    parts = folder.relative_to(root).parts
    if parts[-2:] == _VELODYNE.parts:
        parts = parts[:-2]
    if parts[:1] == (_RAW,):
        parts = parts[1:]
    return "/".join(parts) or root.name


def _rows(points: np.ndarray | torch.Tensor) -> np.ndarray:
    rows = np.asarray(torch.as_tensor(points).detach().cpu().numpy(), dtype=np.float32)
    if rows.ndim != 2 or rows.shape[1] not in (3, 4):
        raise ValueError(f"A scan to write must be (P, 3) or (P, 4), got {rows.shape}.")
    if not np.isfinite(rows).all():
        raise ValueError("A scan to write holds NaN or infinite values; drop these points first.")
    return rows

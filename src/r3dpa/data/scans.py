"""LiDAR scans on disk: finding, reading, checking and writing them."""

from __future__ import annotations

import lzma
import math
import os
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from glob import has_magic
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import IO, Literal, TypeVar

import numpy as np
import torch
from tqdm import tqdm

from r3dpa.geometry import LidarSensor, in_range
from r3dpa.io import UNPICKLING_ERRORS, atomic_path, refuse_name
from r3dpa.simulation import TRAIN_DRIVES, VAL_DRIVES, drive_name, expected_scans
from r3dpa.unpickling import array_header

Split = Literal["train", "val"]
T = TypeVar("T")
#: Drives of KITTI-360 by split, as in R2DM and RangeLDM (LiDAR-Diffusion validates on drive 3).
KITTI360_DRIVES: dict[Split, tuple[str, ...]] = {
    "train": tuple(drive_name(number) for number in TRAIN_DRIVES),
    "val": tuple(drive_name(number) for number in VAL_DRIVES),
}
_RAW = "data_3d_raw"
_VELODYNE = Path("velodyne_points") / "data"
_BYTES_PER_POINT = 16
_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}


#: Bytes of an array in an archive that are read at most: a few packed ones may stand for many.
MOST_BYTES = 2**32
#: Of archives that are damaged, or packed or encrypted in a way that is not read.
ARCHIVE_ERRORS = (*UNPICKLING_ERRORS, zlib.error, lzma.LZMAError)


class ScanError(ValueError):
    """A scan file that cannot be used; the message names the file and the reason."""


@dataclass(frozen=True, order=True, slots=True)
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

    @property
    def num_bytes(self) -> int:
        """Size of the file now.

        Raises:
            ScanError: If it cannot be told, as when the file is gone; names it.
        """
        try:
            return self.path.stat().st_size
        except OSError as error:
            raise ScanError(f"{self.path}: cannot be read ({error.strerror or error})") from error

    @property
    def cache_key(self) -> tuple[str, int, int]:
        """Name, size and time of change: a file written anew has another time, if not another size.

        A copied file has another time as well: what was cached of it is made again.

        Raises:
            ScanError: As :attr:`num_bytes`.
        """
        return self.name, self.num_bytes, self.path.stat().st_mtime_ns


def find_scans(source: str | Path | Sequence[str | Path]) -> list[Scan]:
    """All scans of a folder (with its sub-folders), file, glob, or list of these, sorted.

    Of a data set in the KITTI-360 layout (a folder that holds ``data_3d_raw``), the Velodyne scans
    alone. Links to folders are followed; hidden files, among them unfinished ones, are left out.
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
        ValueError: If there is no scan of the split, and none of the other one either.
    """
    raw = Path(root).absolute() / _RAW
    scans = {
        part: [Scan(name, file.stem, file) for name in drives for file in _drive_files(raw / name)]
        for part, drives in KITTI360_DRIVES.items()
    }
    if not any(scans.values()):
        raise ValueError(
            f"No scan of the {split} split in {root}, nor of the other one: expected {_RAW}/<drive>"
            f"/{_VELODYNE}/*.bin for a drive of {', '.join(KITTI360_DRIVES[split])}. `r3dpa check "
            f"{root}` names what is missing; use LidarDataModule for scans in other folders."
        )
    return sorted(scans[split])


def evenly(items: Sequence[T], num: int | None) -> list[T]:
    """Up to ``num`` items, evenly spread over the sequence, the first among them; all if None."""
    num = len(items) if num is None else min(num, len(items))
    return [items[place * len(items) // num] for place in range(num)]


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
    data = _read_bytes(path)
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


def read_beside(scan: str | Path, kind: Literal["labels", "origins"]) -> np.ndarray | None:
    """What the simulator knows of each point of one of its scans.

    Args:
        scan: The scan's ``data/<frame>.bin``.
        kind: ``"labels"``: uint32, KITTI-360 class in the lower 16 bits and instance in the upper;
            ``"origins"``: uint8, what made the point, see :class:`r3dpa.simulation.Origin`.

    Returns:
        ``(P,)``; None where there is no such file, as for real scans.

    Raises:
        ScanError: If the file is unreadable or of another length than the scan; it is named.
    """
    scan = Path(scan)
    suffix, dtype = {"labels": (".label", "<u4"), "origins": (".origin", "u1")}[kind]
    path = scan.parents[1] / kind / f"{scan.stem}{suffix}"
    if scan.parts[-3:-1] != ("velodyne_points", "data") or not path.exists():
        return None
    data, num_points = _read_bytes(path), scan.stat().st_size // _BYTES_PER_POINT
    if len(data) != num_points * np.dtype(dtype).itemsize:
        raise ScanError(
            f"{path} holds {len(data) / np.dtype(dtype).itemsize:g} numbers but {scan} "
            f"{num_points} points: simulate both again, or delete the one that does not belong"
        )
    return np.frombuffer(data, dtype=dtype)


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
        ScanError: If the file is unreadable, has another format, or lacks x, y or z; the message
            names the file.
    """
    path = Path(path)
    head, separator, body = _read_bytes(path).partition(b"end_header\n")
    lines = head.decode("ascii", errors="replace").split("\n")
    if not separator or lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise ScanError(f"{path}: is not a binary little-endian .ply file")
    words = [line.split() for line in lines[2:] if line.strip() and not line.startswith("comment")]
    elements = [word for word in words if word[0] == "element"]
    properties = [word for word in words if word[0] == "property"]
    if [word[1:2] for word in elements] != [["vertex"]] or len(elements[0]) != 3:
        raise ScanError(f"{path}: holds other elements than vertex; export the points alone")
    unknown = [" ".join(p) for p in properties if len(p) != 3 or p[1] not in _PLY_TYPES]
    if unknown:
        raise ScanError(f"{path}: has {', '.join(unknown)}, but only single numbers can be read")
    names = [word[2] for word in properties]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise ScanError(
            f"{path}: needs properties x, y and z, each name once; found {', '.join(names)}"
        )
    layout = np.dtype([(word[2], _PLY_TYPES[word[1]]) for word in properties])
    count = int(elements[0][2]) if elements[0][2].isdecimal() and len(elements[0][2]) < 20 else -1
    if count < 0 or len(body) != count * layout.itemsize:
        raise ScanError(
            f"{path}: holds {len(body)} bytes for {elements[0][2]:.20} points of {layout.itemsize}"
        )
    table = np.frombuffer(body, dtype=layout)
    wanted = ["x", "y", "z"] + ["intensity"] * ("intensity" in names)
    return np.stack([table[name].astype(np.float32) for name in wanted], axis=1)


def write_npz(
    path: str | Path,
    scans: Mapping[str, np.ndarray | torch.Tensor]
    | Iterable[tuple[str, np.ndarray | torch.Tensor]],
) -> None:
    """Write many scans to one compressed ``.npz`` file, atomically and one after the other.

    Args:
        path: File to write.
        scans: Points by name, or pairs of name and points, which need not be in memory together;
            each ``(P, 3)`` or ``(P, 4)``, metres.

    Raises:
        ValueError: If a shape is another or a value is not finite.
    """
    pairs = scans.items() if isinstance(scans, Mapping) else scans
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for name, points in pairs:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, _rows(points))


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """Scans of a ``.npz`` file by name, each ``(P, 3)`` or ``(P, 4)`` float32, metres.

    Raises:
        ScanError: If the file is damaged, or holds what :func:`check_archive` refuses.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            check_archive(archive, path)
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except ScanError:
        raise
    except ARCHIVE_ERRORS as error:
        raise ScanError(f"{path}: is damaged or no .npz file of scans ({error})") from error


def check_archive(archive: zipfile.ZipFile, path: Path) -> list[str]:
    """Names of the arrays of a ``.npz`` file, after a look at what reading them would take.

    Raises:
        ScanError: If a name leads out of a folder, an array holds objects, is larger than its
            member says, or than any scan or stack of images; file and member are named.
    """
    members = [info for info in archive.infolist() if info.filename.endswith(".npy")]
    for info in members:
        where = f"{path}, member {info.filename!r:.80}"
        if reason := refuse_name(info.filename):
            raise ScanError(f"{where}: its name {reason}; write the file again with other names")
        with archive.open(info) as stream:
            shape, _, dtype = read_array_header(stream, where)
        size = math.prod(shape) * dtype.itemsize
        if dtype.hasobject:
            raise ScanError(f"{where}: holds objects, which are not unpickled")
        if not 0 <= size <= min(info.file_size, MOST_BYTES):
            raise ScanError(
                f"{where}: an array {shape} of {dtype} needs {size} bytes, but the member has "
                f"{info.file_size}, and at most {MOST_BYTES} are read"
            )
    return [info.filename for info in members]


def read_array_header(stream: IO[bytes], where: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether in Fortran order, and type of an array in NumPy's format.

    Raises:
        ScanError: If it is none.
    """
    try:
        return array_header(stream)
    except zipfile.BadZipFile:  # what holds the array is damaged
        raise
    except UNPICKLING_ERRORS as error:
        raise ScanError(f"{where}: is not an array in NumPy's format ({error})") from error


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


def check(path: str | Path, sensor: LidarSensor | None = None, workers: int = 8) -> CheckReport:
    """Read every scan of a data set or folder and report all that is wrong with it.

    A folder with ``data_3d_raw``, or without any scan, is held against the KITTI-360 layout with
    its nine LiDAR drives; a simulated one against the scans that its manifest asks for. A terminal
    shows the progress.

    Args:
        path: Root of a data set, or any folder or file of scans.
        sensor: Every scan must have a point within its range limits; default sensor if None.
        workers: Threads that read.

    Raises:
        ValueError: If the manifest of a simulated data set cannot be understood.
    """
    root = Path(path).absolute()
    sensor = sensor or LidarSensor()
    scans = find_scans(root) if any(_files(root)) else []
    counts = dict(sorted(Counter(scan.drive for scan in scans).items()))
    missing, bad = _compare_layout(root, counts)

    def reason(scan: Scan) -> str | None:
        try:
            read_scan(scan.path, sensor)
        except ScanError as error:
            return str(error).removeprefix(f"{scan.path}: ")
        return None

    with ThreadPool(workers) as pool:
        reasons = tqdm(pool.imap(reason, scans), total=len(scans), unit="scan", disable=None)
        bad += [(s.path, why) for s, why in zip(scans, reasons, strict=True) if why is not None]
    return CheckReport(root, counts, tuple(bad), tuple(missing))


def _compare_layout(
    root: Path, counts: dict[str, int]
) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Folders that a data set lacks, and drives that lack scans, with the reason."""
    raw, simulated = root / _RAW, expected_scans(root)
    if not root.exists():
        return [root], []
    if not raw.is_dir():
        return ([] if counts and simulated is None else [raw]), []
    missing, incomplete = [], []
    official = dict.fromkeys(KITTI360_DRIVES["train"] + KITTI360_DRIVES["val"], 1)
    for drive, expected in sorted((simulated or official).items()):
        folder, count = raw / drive, counts.get(drive, 0)
        if not folder.is_dir():
            missing.append(folder)
        elif not count:
            missing.append(folder / _VELODYNE)
        elif count < expected:
            reason = f"holds {count} of {expected} scans; simulate again to complete it"
            incomplete.append((folder, reason))
    return missing, incomplete


def _files(entry: str | Path) -> Iterator[Path]:
    path = Path(entry)
    if (path / _RAW).is_dir():
        for drive in (path / _RAW).iterdir():
            yield from _drive_files(drive)
    elif path.is_dir():
        seen = set()
        for folder, below, names in os.walk(path, followlinks=True):
            real = os.path.realpath(folder)
            if real in seen:
                below.clear()
            else:
                below.sort()  # of a folder and a link to it, the same one on every machine
                seen.add(real)
                yield from filter(_is_scan, (Path(folder, name) for name in names))
    elif path.is_file():
        yield path
    elif has_magic(str(entry)):
        root = Path(path.absolute().anchor)
        yield from filter(_is_scan, root.glob(str(path.absolute().relative_to(root))))


def _drive_files(drive: Path) -> Iterator[Path]:
    """Scans of a drive in the KITTI-360 layout."""
    return filter(_is_scan, (drive / _VELODYNE).glob("*"))


def _is_scan(file: Path) -> bool:
    """Whether a file is a scan; the hidden ones are of writers that have not finished."""
    return file.suffix == ".bin" and not file.name.startswith(".")


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ScanError(f"{path}: cannot be read ({error.strerror or error})") from error


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

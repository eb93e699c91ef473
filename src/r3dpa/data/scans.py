"""LiDAR scans on disk: finding, reading, writing and checking them."""

from __future__ import annotations

import lzma
import os
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from glob import has_magic
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
import torch
from tqdm import tqdm

from r3dpa.data.store import DataError, ItemKey
from r3dpa.geometry import LidarSensor, in_range
from r3dpa.io import UNPICKLING_ERRORS, atomic_path, refuse_name
from r3dpa.simulation import TRAIN_DRIVES, VAL_DRIVES, drive_name, expected_scans

Split = Literal["train", "val"]
T = TypeVar("T")
#: Drives of KITTI-360 by split, as in R2DM and RangeLDM (LiDAR-Diffusion validates on drive 3).
KITTI360_DRIVES: dict[Split, tuple[str, ...]] = {
    "train": tuple(drive_name(number) for number in TRAIN_DRIVES),
    "val": tuple(drive_name(number) for number in VAL_DRIVES),
}
RAW = "data_3d_raw"
VELODYNE = Path("velodyne_points") / "data"
_BYTES_PER_POINT = 16
_PLY_NAMES = ["char", "uchar", "short", "ushort", "int", "uint", "float", "double"]
_PLY_NAMES += ["int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"]
_PLY_TYPES = dict(
    zip(_PLY_NAMES, ["i1", "u1", "<i2", "<u2", "<i4", "<u4", "<f4", "<f8"] * 2, strict=True)
)
_PLY_KINDS: dict[str, Literal["<", ">"]] = {
    "ascii 1.0": "<",
    "binary_little_endian 1.0": "<",
    "binary_big_endian 1.0": ">",
}


class ScanError(DataError):
    """A scan file that cannot be used; the message names the file and the reason."""


@dataclass(frozen=True, order=True, slots=True)
class Scan:
    """One sensor sweep in a ``.bin`` file.

    ``drive`` is the KITTI-360 drive, or the folder relative to the root; ``frame`` the file name
    without its suffix.
    """

    drive: str
    frame: str
    path: Path = field(compare=False)

    @property
    def name(self) -> str:
        """``drive/frame``, unique within a data set."""
        return f"{self.drive}/{self.frame}"

    @property
    def cache_key(self) -> ItemKey:
        """Name, size and time of change of the file."""
        try:
            about = self.path.stat()
        except OSError as error:
            raise _unreadable(self.path, error) from error
        return self.name, about.st_size, about.st_mtime_ns


def find_scans(source: str | Path | Sequence[str | Path]) -> list[Scan]:
    """All scans of a folder (with its sub-folders), file, glob, or list of these, sorted.

    In the KITTI-360 layout (a folder that holds ``data_3d_raw``), only the Velodyne scans. Links
    to folders are followed; hidden files are left out. The drive of a scan is its folder relative
    to the given folder, or to the common parent of a glob or list. ``ValueError`` if nothing is
    found, one file is named twice, or a name could not be that of an output file.
    """
    given = [source] if isinstance(source, str | Path) else list(source)
    entries = [_without_dots(Path(entry).absolute()) for entry in given]
    single = len(entries) == 1 and Path(entries[0]).is_dir()
    files = sorted(file.absolute() for entry in entries for file in scan_files(entry))
    if not files:
        raise ValueError(
            f"No scan found in {', '.join(str(e) for e in given)}: give a folder that holds .bin "
            "files, a .bin file, a glob such as 'drives/**/*.bin', or a list of these."
        )
    twice = [str(file) for file, count in Counter(files).items() if count > 1]
    if twice:
        raise ValueError(f"Scans given twice: {', '.join(twice[:5])}. Name every file once.")
    parent = os.path.commonpath([file.parent for file in files])
    root = entries[0] if single else Path(parent)
    scans = sorted(Scan(_drive_name(file.parent, root), file.stem, file) for file in files)
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
    scans = {
        part: [Scan(name, file.stem, file) for name in drives for file in _drive_files(raw / name)]
        for part, drives in KITTI360_DRIVES.items()
    }
    if not any(scans.values()):
        raise ValueError(
            f"No scan of the {split} split in {root}, nor of the other one: `r3dpa data check "
            f"{root}` names what is missing; use LidarDataModule for scans in other folders."
        )
    return sorted(scans[split])


def evenly(items: Sequence[T], num: int | None) -> list[T]:
    """Up to ``num`` items, evenly spread over the sequence, the first among them; all if None."""
    num = len(items) if num is None else min(num, len(items))
    return [items[place * len(items) // num] for place in range(num)]


def read_scan(path: str | Path, sensor: LidarSensor | None = None) -> np.ndarray:
    """Points ``(P, 4)`` of one KITTI ``.bin`` scan: float32 x, y, z (metres), intensity 0..1.

    ``ScanError`` names a file that is unreadable, empty, of another layout, holds NaN or infinite
    values, has intensities above 1 in more than a thousandth of its points, or has no point within
    the range limits of ``sensor``.
    """
    path = Path(path)
    data = read_bytes(path)
    if not data:
        raise ScanError(f"{path}: is empty")
    whole = len(data) % _BYTES_PER_POINT == 0
    if len(data) % 20 == 0:
        # Where the size fits both, the values decide: an intensity is never negative.
        values = np.frombuffer(data, dtype="<f4")
        four = whole and not (values[3::4] < 0).any()
        if not four and (values[3::5] >= 0).all():
            raise ScanError(
                f"{path}: has {len(data)} bytes, and its values are those of 5 columns, as "
                "nuScenes has them (x, y, z, intensity 0..255, ring): save the first 4 as float32, "
                "the intensity divided by 255"
            )
    if not whole:
        expected = "a multiple of 16 (x, y, z, intensity as float32)"
        raise ScanError(f"{path}: has {len(data)} bytes, not {expected}")
    points = np.frombuffer(data, dtype="<f4").reshape(-1, 4).copy()
    finite = np.isfinite(points)
    if not finite.all():
        bad = np.count_nonzero(~finite.all(axis=1))
        raise ScanError(f"{path}: has NaN or infinite values in {bad} of {len(points)} points")
    bright = np.count_nonzero(points[:, 3] > 1)
    if bright > len(points) / 1000:  # of some sensors, single returns exceed their full scale
        raise ScanError(
            f"{path}: has intensities up to {points[:, 3].max():g} and above 1 in {bright} of "
            f"{len(points)} points, not 0..1: divide the fourth column by its full scale, such as "
            "255"
        )
    if sensor is not None and not in_range(torch.from_numpy(points[:, :3]), sensor).any():
        raise out_of_range(path, sensor)
    return points


def out_of_range(path: str | Path, sensor: LidarSensor) -> ScanError:
    """Error of a scan without a point within the range limits."""
    limits = f"{sensor.range_min_m:g}..{sensor.range_max_m:g} m"
    return ScanError(f"{path}: has no point within the sensor's range {limits}")


def read_beside(scan: str | Path, kind: Literal["labels", "origins"]) -> np.ndarray | None:
    """Label or origin ``(P,)`` of each point of a simulated scan; None where there is no such file.

    Labels are uint32, KITTI-360 class in the lower 16 bits and instance in the upper; origins
    uint8, see :class:`r3dpa.simulation.Origin`. ``ScanError`` if the file is of another length
    than the scan.
    """
    scan = Path(scan)
    suffix, dtype = {"labels": (".label", "<u4"), "origins": (".origin", "u1")}[kind]
    path = scan.parents[1] / kind / f"{scan.stem}{suffix}"
    if scan.parts[-3:-1] != ("velodyne_points", "data") or not path.exists():
        return None
    data, num_points = read_bytes(path), scan.stat().st_size // _BYTES_PER_POINT
    if len(data) != num_points * np.dtype(dtype).itemsize:
        raise ScanError(
            f"{path} holds {len(data) / np.dtype(dtype).itemsize:g} numbers but {scan} "
            f"{num_points} points: simulate both again, or delete the one that does not belong"
        )
    return np.frombuffer(data, dtype=dtype)


def write_bin(path: str | Path, points: np.ndarray | torch.Tensor) -> None:
    """Write ``(P, 3)`` or ``(P, 4)`` x, y, z (metres), intensity (else 0) as KITTI ``.bin``.

    Atomic; ``ValueError`` for another shape, NaN or infinite values.
    """
    rows = _rows(points)
    if rows.shape[1] == 3:
        rows = np.concatenate([rows, np.zeros((len(rows), 1), np.float32)], axis=1)
    with atomic_path(path) as temporary:
        temporary.write_bytes(rows.astype("<f4").tobytes())


def write_ply(path: str | Path, points: np.ndarray | torch.Tensor) -> None:
    """Write ``(P, 3)`` or ``(P, 4)`` x, y, z (metres), intensity as binary ``.ply``.

    Atomic; ``ValueError`` for another shape, NaN or infinite values.
    """
    rows = _rows(points)
    names = ("x", "y", "z", "intensity")[: rows.shape[1]]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(header).encode("ascii") + rows.astype("<f4").tobytes())


def read_ply(path: str | Path) -> np.ndarray:
    """Points ``(P, 3)``, or ``(P, 4)`` with intensity, of a ``.ply`` file of vertices.

    ``ScanError`` for other elements than ``vertex``, or no x, y or z.
    """
    table, _ = ply_table(Path(path))
    wanted = ["x", "y", "z"] + ["intensity"] * ("intensity" in (table.dtype.names or ()))
    try:
        return np.stack([table[name].astype(np.float32) for name in wanted], axis=1)
    except ValueError as error:
        raise ScanError(f"{path}: has no x, y or z ({error})") from error


def ply_table(path: Path) -> tuple[np.ndarray, list[str]]:
    """Vertices ``(P,)`` of an ASCII or binary ``.ply`` file as named columns, and its header."""
    head, mark, body = read_bytes(path).partition(b"end_header")
    header = (head + mark).decode("ascii", errors="replace").splitlines()
    words = [line.split() for line in header]
    kind = " ".join(words[1][1:]) if mark and words[0] == ["ply"] and words[1:] else ""
    if kind not in _PLY_KINDS:
        raise ScanError(f"{path}: is no .ply file of one of {', '.join(_PLY_KINDS)}")
    try:
        ((_, count),) = (line[1:] for line in words if line[0] == "element" and line[2] != "0")
        fields = [
            (line[2], _PLY_TYPES[line[1]])
            for line in words
            if line[0] == "property" and line[1] != "list"
        ]
        layout = np.dtype(fields).newbyteorder(_PLY_KINDS[kind])
        return parse_table(body.partition(b"\n")[2], layout, int(count), kind[0] == "a"), header
    except (KeyError, ValueError, IndexError) as error:
        raise ScanError(
            f"{path}: must hold points alone, with x, y, z and other single numbers ({error})"
        ) from error


def parse_table(data: bytes, layout: np.dtype, count: int, is_text: bool) -> np.ndarray:
    """Rows ``(count,)`` of named columns from binary data, or from lines of numbers."""
    if is_text:
        lines = data.decode("ascii").splitlines()
        table = np.loadtxt(lines, layout, ndmin=1) if count else np.empty(0, layout)
    elif len(data) == count * layout.itemsize:
        return np.frombuffer(data, layout)
    else:
        raise ValueError(f"{len(data)} bytes for {count} points of {layout.itemsize}")
    if len(table) != count:
        raise ValueError(f"{len(table)} lines for {count} points")
    return table


def write_npz(path: str | Path, scans: Iterable[tuple[str, np.ndarray | torch.Tensor]]) -> None:
    """Write many scans to one compressed ``.npz`` file, atomically and one after the other.

    ``scans`` are pairs of a name and points ``(P, 3)`` or ``(P, 4)``, which need not be in memory
    together; ``ValueError`` for another shape, NaN or infinite values.
    """
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for name, points in scans:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, _rows(points))


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """Scans ``(P, 3)`` or ``(P, 4)`` of a ``.npz`` file by name; ``ScanError`` if it is damaged."""
    return dict(npz_arrays(Path(path)))


def npz_arrays(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Name and content of each array of a ``.npz`` file; ``ScanError`` if it is damaged."""
    where = str(path)
    _refuse_devices(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            members = archive.zip.infolist()
            if sum(info.file_size for info in members) > max(2**28, 100 * path.stat().st_size):
                raise ValueError("its arrays are far larger than the file")
            for info in members:
                member = info.filename
                where = f"{path}, member {member!r:.80}"
                if not member.endswith(".npy"):
                    continue
                if reason := refuse_name(member):
                    raise ValueError(f"its name {reason}")
                if isinstance(array := archive[member], bytes):
                    raise ValueError("it is no array")
                yield member.removesuffix(".npy"), array
    except (*UNPICKLING_ERRORS, zlib.error, lzma.LZMAError) as error:
        raise ScanError(f"{where}: is damaged or no .npz file of numbers ({error})") from error


def scan_files(entry: str | Path) -> Iterator[Path]:
    """Scan files of a folder, file or glob."""
    path = Path(entry)
    if (path / RAW).is_dir():
        for drive in (path / RAW).iterdir():
            yield from _drive_files(drive)
    elif path.is_dir():
        yield from filter(_is_scan, files_below(path))
    elif path.is_file():
        yield path
    elif has_magic(str(entry)):
        root = Path(path.absolute().anchor)
        yield from filter(_is_scan, root.glob(str(path.absolute().relative_to(root))))


def files_below(root: Path) -> Iterator[Path]:
    """Files of a folder and its sub-folders, links followed, without hidden ones."""
    seen = set()
    for folder, below, names in os.walk(root, followlinks=True):
        real = os.path.realpath(folder)
        # Of a folder and a link to it, the same one on every machine; of a link upwards, none.
        below[:] = [] if real in seen else sorted(name for name in below if name[0] != ".")
        if real not in seen:
            yield from (Path(folder, name) for name in names if name[0] != ".")
        seen.add(real)


def _drive_files(drive: Path) -> Iterator[Path]:
    return filter(_is_scan, (drive / VELODYNE).glob("*"))


def _is_scan(file: Path) -> bool:
    """Whether a file is a scan; the hidden ones are of writers that have not finished."""
    return file.suffix == ".bin" and not file.name.startswith(".")


def read_bytes(path: Path) -> bytes:
    """Content of a file; ``ScanError`` if it cannot be read."""
    try:
        _refuse_devices(path)
        return path.read_bytes()
    except OSError as error:
        raise _unreadable(path, error) from error


def _refuse_devices(path: Path) -> None:
    """Refuse pipes, which would be waited for, and devices, which may never end."""
    if path.exists() and not path.is_file():
        raise ScanError(f"{path}: is no regular file")


def _unreadable(path: Path, error: OSError) -> ScanError:
    return ScanError(f"{path}: cannot be read ({error.strerror or error})")


def _drive_name(folder: Path, root: Path) -> str:
    parts = folder.relative_to(root).parts
    if parts[-2:] == VELODYNE.parts:
        parts = parts[:-2]
    if parts[:1] == (RAW,):
        parts = parts[1:]
    return "/".join(parts) or root.name


def _rows(points: np.ndarray | torch.Tensor) -> np.ndarray:
    rows = np.asarray(torch.as_tensor(points).detach().cpu().numpy(), dtype=np.float32)
    if rows.ndim != 2 or rows.shape[1] not in (3, 4):
        raise ValueError(f"A scan to write must be (P, 3) or (P, 4), got {rows.shape}.")
    if not np.isfinite(rows).all():
        raise ValueError("A scan to write holds NaN or infinite values; drop these points first.")
    return rows


def check(path: str | Path) -> tuple[str, bool]:
    """Text about every scan of a data set, folder or file, and whether nothing is wrong with it.

    A folder with ``data_3d_raw``, or without any scan, is compared with the KITTI-360 layout and
    its nine LiDAR drives; a simulated one with its manifest (``ValueError`` if that is damaged).
    Every scan needs a point within the range limits of :class:`LidarSensor`.
    """
    root, sensor = Path(path).absolute(), LidarSensor()
    scans = find_scans(root) if any(scan_files(root)) else []
    counts = dict(sorted(Counter(scan.drive for scan in scans).items()))
    problems = _compare_layout(root, counts)

    def examine(scan: Scan) -> tuple[float, float] | str:
        try:
            intensity = read_scan(scan.path, sensor)[:, 3]
        except ScanError as error:
            return f"bad: {error}"
        return float(intensity.min()), float(intensity.max())

    with ThreadPool(8) as pool:
        results = list(tqdm(pool.imap(examine, scans), total=len(scans), unit="scan", disable=None))
    problems += [result for result in results if isinstance(result, str)]
    lines = [*(f"{drive}: {count} scans" for drive, count in counts.items()), *problems]
    if limits := [result for result in results if not isinstance(result, str)]:
        low, high = min(low for low, _ in limits), max(high for _, high in limits)
        outside = " (expected 0..1)" if low < 0 or high > 1 else ""
        lines.append(f"intensity: {low:.3g}..{high:.3g}{outside}")
    verdict = f"problems: {len(problems)}" if problems else "all usable"
    lines.append(f"{root}: {len(scans)} scans in {len(counts)} drives, {verdict}")
    return "\n".join(lines), not problems


def _compare_layout(root: Path, counts: dict[str, int]) -> list[str]:
    raw, simulated = root / RAW, expected_scans(root)
    if not root.exists():
        return [f"missing: {root}"]
    if not raw.is_dir():
        return [] if counts and simulated is None else [f"missing: {raw}"]
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

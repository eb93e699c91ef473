"""Scans as ``.bin``, ``.ply`` and ``.npz`` files: reading, writing and checking them."""

from __future__ import annotations

import lzma
import os
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.io import UNPICKLING_ERRORS, atomic_path, refuse_name
from lidarsim.sensors.view import LidarSensor, in_range


class DataError(ValueError):
    """A file that cannot be used; a one-line message, also from a loader process."""

    def __init__(self, message: object) -> None:
        text = str(message)
        if "Original Traceback" in text:  # which torch adds to errors of loader processes
            text = text.strip().rpartition("\n")[2].partition("Error: ")[2]
        super().__init__(text)


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
    if sensor is not None and not in_range(points[:, :3], sensor).any():
        raise out_of_range(path, sensor)
    return points


def out_of_range(path: str | Path, sensor: LidarSensor) -> ScanError:
    """Error of a scan without a point within the range limits."""
    limits = f"{sensor.range_min_m:g}..{sensor.range_max_m:g} m"
    return ScanError(f"{path}: has no point within the sensor's range {limits}")


def read_beside(scan: str | Path, kind: Literal["labels", "origins"]) -> np.ndarray | None:
    """Label or origin ``(P,)`` of each point of a simulated scan; None where there is no such file.

    Labels are uint32, KITTI-360 class in the lower 16 bits and instance in the upper; origins
    uint8, see :class:`lidarsim.Origin`. ``ScanError`` if the file is of another length
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


def write_bin(path: str | Path, points: ArrayLike) -> None:
    """Write ``(P, 3)`` or ``(P, 4)`` x, y, z (metres), intensity (else 0) as KITTI ``.bin``.

    Atomic; ``ValueError`` for another shape, NaN or infinite values.
    """
    rows = _rows(points)
    if rows.shape[1] == 3:
        rows = np.concatenate([rows, np.zeros((len(rows), 1), np.float32)], axis=1)
    with atomic_path(path) as temporary:
        temporary.write_bytes(rows.astype("<f4").tobytes())


def write_ply(path: str | Path, points: ArrayLike) -> None:
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


def write_npz(path: str | Path, scans: Iterable[tuple[str, ArrayLike]]) -> None:
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


def read_bytes(path: Path) -> bytes:
    """Content of a file; ``ScanError`` if it cannot be read."""
    try:
        _refuse_devices(path)
        return path.read_bytes()
    except OSError as error:
        raise unreadable(path, error) from error


def _refuse_devices(path: Path) -> None:
    """Refuse pipes, which would be waited for, and devices, which may never end."""
    if path.exists() and not path.is_file():
        raise ScanError(f"{path}: is no regular file")


def unreadable(path: Path, error: OSError) -> ScanError:
    """Error of a file that the system cannot read."""
    return ScanError(f"{path}: cannot be read ({error.strerror or error})")


def _rows(points: Any) -> np.ndarray:
    on_host = points.detach().cpu() if hasattr(points, "detach") else points  # tensors of torch
    rows = np.asarray(on_host, dtype=np.float32)
    if rows.ndim != 2 or rows.shape[1] not in (3, 4):
        raise ValueError(f"A scan to write must be (P, 3) or (P, 4), got {rows.shape}.")
    if not np.isfinite(rows).all():
        raise ValueError("A scan to write holds NaN or infinite values; drop these points first.")
    return rows

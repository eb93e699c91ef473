"""Formats of point clouds: each becomes one table of named columns, and bytes again.

PLY is read here since the package plyfile is under the GPL.
"""

from __future__ import annotations

import io
import lzma
import math
import re
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from lidarsim.io import UNPICKLING_ERRORS, refuse_name

Table = NDArray[np.void]  # (P,) rows of named columns, in the order of the file
#: Names of columns without names.
ROWS = ("x", "y", "z", "intensity", "ring")
_ADVICE = (
    "name the columns with --columns, such as x,y,z,intensity,time, here or in `r3dpa data convert`"
)
# Share of the points whose intensity may be odd: single returns exceed the full scale of a sensor.
ODD_SHARE = 1 / 1000
# Of intensities from 0 to 255 more than this share exceed 1.
_FEWEST_ABOVE_ONE = 1 / 20
_MOST_BEAMS, _MOST_COLUMNS = 256, 4096
_MOST_RATIO = 100  # size of data over size of its file; LZF reaches 88
_OTHER_WIDTHS = (5, 6, 7, 8, 10, 12)
# Rows whose parts are compared, see ``_are_parts``: a multiple of 2 and 3.
_COMPARED_ROWS, _FEWEST_ROWS = 4080, 192
_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4",
    "float": "<f4", "double": "<f8", "int8": "i1", "uint8": "u1", "int16": "<i2",
    "uint16": "<u2", "int32": "<i4", "uint32": "<u4", "float32": "<f4", "float64": "<f8",
}  # fmt: skip
_PLY_KINDS: dict[str, Literal["<", ">"]] = {
    "ascii 1.0": "<",
    "binary_little_endian 1.0": "<",
    "binary_big_endian 1.0": ">",
}


class DataError(ValueError):
    """A file that cannot be used; a one-line message, also from a loader process."""

    def __init__(self, message: object) -> None:
        text = str(message)
        if "Original Traceback" in text:  # which torch adds to errors of loader processes
            text = text.strip().rpartition("\n")[2].partition("Error: ")[2]
        super().__init__(text)


class ScanError(DataError):
    """A scan file that cannot be used; the message names the file and the reason."""


class Stored(NamedTuple):
    """Content of a file."""

    kind: str  # format in words
    table: Table
    pack: Callable[[Table], bytes]  # content of the file for other rows


def read_bytes(path: Path) -> bytes:
    """Return the content of a file; ``ScanError`` if it cannot be read."""
    try:
        _refuse_devices(path)
        return path.read_bytes()
    except OSError as error:
        raise unreadable(path, error) from error


def unreadable(path: Path, error: OSError) -> ScanError:
    """Return the error of a file that the system does not give."""
    return ScanError(f"{path}: cannot be read ({error.strerror or error})")


def _refuse_devices(path: Path) -> None:
    """Refuse folders, pipes, which would be waited for, and devices, which may never end."""
    if path.is_dir():
        raise ScanError(f"{path}: is a folder; give one scan")
    if path.exists() and not path.is_file():
        raise ScanError(f"{path}: is no regular file")


def refuse_two_scales(intensity: NDArray, where: str | Path) -> None:
    """Refuse floats of which 0.1 to 5 % exceed 1: too many for odd values, too few for bytes.

    Raw intensities without a largest value, as Waymo's, are such; as bytes they would be 255 times
    too dark.
    """
    share = np.count_nonzero(intensity > 1) / max(len(intensity), 1)
    if intensity.dtype.kind == "f" and ODD_SHARE < share < _FEWEST_ABOVE_ONE:
        raise ScanError(
            f"{where}: {share:.1%} of the intensities exceed 1, up to {intensity.max():g}, and all "
            "others do not: give their full scale as full_intensity"
        )


def table_of(columns: Mapping[str, NDArray], num_points: int) -> Table:
    """Return columns ``(P,)`` as one table; ``ValueError`` if one is of another shape."""
    table = np.empty(num_points, [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        if column.shape != (num_points,):
            raise ValueError(
                f"{name} must have one value for each of {num_points} points, "
                f"got the shape {column.shape}"
            )
        table[name] = column
    return table


def _with_names(path: Path, rows: NDArray, columns: tuple[str, ...]) -> Table:
    """Return rows ``(P, C)`` of floats as a table."""
    names = columns or ROWS[: rows.shape[-1]]
    are_rows = rows.ndim == 2 and rows.dtype.kind == "f" and rows.shape[1] == len(names)
    if not are_rows or not (columns or _can_be_rows(rows)):
        raise ScanError(
            f"{path}: holds {rows.dtype} of shape {rows.shape}, not rows of {len(names)} floats "
            f"that can be {', '.join(names)}: {_ADVICE}"
        )
    return np.ascontiguousarray(rows).view([(name, rows.dtype) for name in names])[:, 0]


def _can_be_rows(rows: NDArray) -> bool:
    """Return whether columns ``(P, C)`` can be :data:`ROWS`; NaN is for a later check."""
    intensity, ring = rows[:, 3:4], rows[:, 4:]
    if np.count_nonzero(intensity < 0) > ODD_SHARE * len(rows):
        return False
    return not ((ring < 0).any() or (ring >= _MOST_BEAMS).any() or (ring % 1 > 0).any())


def _are_parts(rows: NDArray) -> bool:
    """Return whether rows are the halves or thirds of longer rows, as 4 columns are of 8 or 12.

    First and second half of a longer row hold other quantities, so that their columns 0 and 1 have
    another mean or spread; successive points of a scan have the same.
    """
    for num_parts in (2, 3):
        if len(rows) % num_parts or len(rows) < _FEWEST_ROWS:
            continue
        parts = rows[:_COMPARED_ROWS, :2].astype(np.float64)
        parts = parts[: len(parts) // num_parts * num_parts].reshape(-1, num_parts, 2)
        mean, spread = parts.mean(axis=0), parts.std(axis=0)
        low, high = spread.min(axis=0), spread.max(axis=0)
        if ((np.ptp(mean, axis=0) > high) | (high > 8 * low)).any():
            return True
    return False


def _read_bin(path: Path, data: bytes, columns: tuple[str, ...]) -> Stored:
    widths = [len(columns)] if columns else [5] if path.stem.endswith(".pcd") else [4, 5]
    if all(len(data) % (4 * width) for width in widths):
        sizes = " or ".join(str(4 * width) for width in widths)
        names = ", ".join(columns or ROWS[: widths[0]])
        raise ScanError(
            f"{path}: has {len(data)} bytes, not a multiple of {sizes} ({names} as float32): "
            f"{_ADVICE}"
        )
    for width in widths:
        rows = _bin_rows(data, width)
        if rows is not None and (columns or (_can_be_rows(rows) and not _are_parts(rows))):
            table = _with_names(path, rows, columns)
            return Stored(f"{width} columns of float32", table, np.ndarray.tobytes)
    others = [rows for width in _OTHER_WIDTHS if (rows := _bin_rows(data, width)) is not None]
    likely = [rows for rows in others if _can_be_rows(rows[:, :4]) and not _are_parts(rows)]
    rather = f", rather of {likely[0].shape[1]} columns" if likely else ""
    raise ScanError(
        f"{path}: its values do not fit {' or '.join(map(str, widths))} columns "
        f"{', '.join(ROWS)}{rather}: {_ADVICE}"
    )


def _bin_rows(data: bytes, width: int) -> NDArray[np.float32] | None:
    """Return rows of a width; None if the size does not fit."""
    return None if len(data) % (4 * width) else np.frombuffer(data, "<f4").reshape(-1, width)


def npz_arrays(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Yield name and content of each array of a ``.npz``; ``ScanError`` if it is damaged."""
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


def _npy_array(path: Path) -> NDArray:
    # A memory map is never larger than its file, whatever the header says.
    return np.array(np.lib.format.open_memmap(path, mode="r"))


def organised_points(path: Path) -> NDArray | None:
    """Return the array ``(H, W, C)`` of a NumPy file; None if its points are in rows."""
    suffix = path.suffix.lower()
    if suffix not in (".npy", ".npz"):
        return None
    arrays = dict(npz_arrays(path)) if suffix == ".npz" else {"": _npy_array(path)}
    points = arrays[_main_array(arrays)]
    return points if points.ndim == 3 else None


def is_one_cloud(path: Path) -> bool:
    """Return whether a ``.npz`` holds points and columns of one scan, not scans by name."""
    with suppress(zipfile.BadZipFile, OSError), zipfile.ZipFile(path) as archive:
        return _name_of_points([name.removesuffix(".npy") for name in archive.namelist()]) != ""
    return False


def _name_of_points(names: Collection[str]) -> str:
    """Return the array that holds the points of one scan, or their x; empty if there is none."""
    if {"x", "y", "z"}.issubset(names):
        return "x"
    return next((name for name in ("xyz", "points") if name in names), "")


def _main_array(arrays: Mapping[str, NDArray]) -> str:
    """Return the name of the only array, or of the points; empty if there are none."""
    return next(iter(arrays)) if len(arrays) == 1 else _name_of_points(arrays)


def _read_numpy(path: Path, data: bytes, columns: tuple[str, ...]) -> Stored:
    is_archive = data[:2] == b"PK"
    arrays = dict(npz_arrays(path)) if is_archive else {"": _npy_array(path)}
    shape, parts = _point_arrays(path, arrays, columns)
    others: dict[str, Any] = {name: a for name, a in arrays.items() if name not in parts}
    named = {name: column for part in parts.values() for name, column in part.items()}
    if len(named) < sum(map(len, parts.values())):
        raise ScanError(f"{path}: has a column twice: {', '.join(named)}; keep one of each name")
    is_organised = len(shape) == 2
    is_one_table = len(arrays) == 1
    if is_organised and "ring" not in named:
        named["ring"] = np.indices(shape, dtype=np.uint16)[0]
        if not is_one_table:
            parts["ring"] = {"ring": named["ring"]}
    table = table_of({name: column.reshape(-1) for name, column in named.items()}, math.prod(shape))
    if is_organised:  # shots without a return are 0 or NaN
        table = table[_are_returns(table)]

    def pack(table: Table) -> bytes:
        stream, packed = io.BytesIO(), dict[str, Any]()
        for name, columns in parts.items():
            array = arrays.get(name)
            has_names = array is not None and array.dtype.names
            if has_names or (is_organised and is_one_table):  # with its ring
                packed[name] = table
            elif list(columns) == [name]:
                packed[name] = table[name]
            else:
                packed[name] = structured_to_unstructured(table[list(columns)])
        if is_archive:
            np.savez_compressed(stream, **packed, **others)
        else:
            np.save(stream, packed[""])
        return stream.getvalue()

    return Stored(path.suffix, table, pack)


def _point_arrays(
    path: Path, arrays: Mapping[str, NDArray], columns: tuple[str, ...]
) -> tuple[tuple[int, ...], dict[str, dict[str, NDArray]]]:
    """Return the shape of one value per point, and by array the columns that it holds."""
    main = _main_array(arrays)
    if main not in arrays:
        names = ", ".join(arrays) or "none"
        raise ScanError(
            f"{path}: must hold one scan, as an array of rows, xyz or points with further columns, "
            f"or x, y, z; its arrays are {names}"
        )
    has_columns = len(arrays) > 1 and main == "x"
    are_rows = not has_columns and not arrays[main].dtype.names
    shape = arrays[main].shape[:-1] if are_rows else arrays[main].shape
    if len(shape) not in (1, 2) or (len(shape) == 2 and shape[0] > _MOST_BEAMS):
        raise ScanError(
            f"{path}: holds {arrays[main].dtype} of shape {arrays[main].shape}, not rows (P, C) of "
            f"floats, nor organised (H, W, C) with at most {_MOST_BEAMS} beams: {_ADVICE}"
        )
    parts = {}
    for name, array in arrays.items():
        if name == main and are_rows:
            array = _with_names(path, array.reshape(-1, array.shape[-1]), columns)
        if array.dtype.names:
            parts[name] = {column: array[column] for column in array.dtype.names}
        elif array.shape == shape:
            parts[name] = {name: array}
    return shape, parts


def _are_returns(table: Table) -> NDArray[np.bool_]:
    """Return which rows ``(P,)`` have finite x, y, z that are not all zero."""
    axes = [name for name in table.dtype.names or () if name.lower() in ("x", "y", "z")]
    points = np.stack([table[name] for name in axes], axis=1)
    finite: NDArray[np.bool_] = np.isfinite(points).all(axis=1)
    return finite & points.any(axis=1)


def _read_ply(path: Path, data: bytes, columns: tuple[str, ...]) -> Stored:
    head, mark, body = data.partition(b"end_header")
    header = (head + mark).decode(errors="replace").splitlines()
    words = [line.split() for line in header]
    kind = " ".join(words[1][1:]) if mark and words[0] == ["ply"] and words[1:] else ""
    if kind not in _PLY_KINDS:
        raise ScanError(f"{path}: is no .ply file of one of {', '.join(_PLY_KINDS)}")
    is_text = kind.startswith("ascii")
    try:
        ((_, count),) = (line[1:] for line in words if line[0] == "element" and line[2] != "0")
        fields = [
            (line[2], _PLY_TYPES[line[1]])
            for line in words
            if line[0] == "property" and line[1] != "list"
        ]
        layout = np.dtype(fields).newbyteorder(_PLY_KINDS[kind])
        table = _parse_table(body.partition(b"\n")[2], layout, int(count), is_text)
    except (KeyError, ValueError, IndexError) as error:
        raise ScanError(
            f"{path}: must hold only points, with x, y, z and other single numbers ({error})"
        ) from error

    def pack(table: Table) -> bytes:
        text = re.sub(r"(?m)^element vertex .*", f"element vertex {len(table)}", "\n".join(header))
        return f"{text}\n".encode() + (_text_of(table) if is_text else table.tobytes())

    return Stored(f".ply, {kind.split()[0]}", table, pack)


def _parse_table(data: bytes, layout: np.dtype, count: int, is_text: bool) -> Table:
    """Return rows ``(count,)`` of named columns from binary data, or from lines of numbers."""
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


def ply_of(table: Table) -> bytes:
    """Return the binary ``.ply`` of a table."""
    names = {code: name for name, code in reversed(_PLY_TYPES.items())}
    lines, layout = [], []
    for name in table.dtype.names or ():
        kind = table.dtype[name].newbyteorder("<")
        code = kind.str.lstrip("|")
        code = code if code in names else "<f8"  # PLY has no 64-bit integers
        if not name.isascii():
            raise ScanError(f"column {name!r} cannot be written to .ply, which is ASCII: rename it")
        lines.append(f"property {names[code]} {name.replace(' ', '_')}")
        layout.append((name, code))
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header = "\n".join([*head, *lines, "end_header", ""])
    return header.encode("ascii") + table.astype(layout).tobytes()


def _read_pcd(path: Path, data: bytes, columns: tuple[str, ...]) -> Stored:
    try:
        from pypcd4 import Encoding, PointCloud
    except ImportError as error:
        raise ScanError(f"{path}: .pcd needs pypcd4: pip install 'r3dpa[pcd]'") from error
    _check_pcd_header(data)
    cloud: Any = PointCloud.from_fileobj(cast(Any, io.BytesIO(data)))
    about, rows = cloud.metadata, cloud.pc_data
    if len(rows) != about.points:
        raise ScanError(f"{path}: is damaged: holds {len(rows)} of {about.points} points")
    # Padding has random names.
    names = [f"_{n}" if "#" in name else name for n, name in enumerate(rows.dtype.names)]
    table = rows.view([(name, rows.dtype[n]) for n, name in enumerate(names)])

    def pack(table: Table) -> bytes:
        changed = PointCloud(about.derive(points=len(table), width=len(table), height=1), table)
        if about.data is Encoding.ASCII:  # the package keeps ten decimals
            return changed.metadata.compose_header().encode() + _text_of(table)
        stream = io.BytesIO()
        changed.save(stream, about.data)
        return stream.getvalue()

    return Stored(f".pcd, {about.data.value}", table, pack)


def _check_pcd_header(data: bytes) -> None:
    """Refuse numbers for which the package would take very long, or much memory."""
    head, _, body = data.partition(b"\nDATA ")
    most = {b"SIZE": _MOST_COLUMNS, b"COUNT": _MOST_COLUMNS}
    most |= dict.fromkeys((b"WIDTH", b"HEIGHT", b"POINTS"), _MOST_RATIO * len(data))
    for line in head.splitlines():
        name, *numbers = line.split() or [b""]
        if name in most and sum(map(int, numbers)) > most[name]:
            raise ValueError(f"{name.decode()} is too large for {len(data)} bytes")
    kind, _, content = body.partition(b"\n")
    size = int.from_bytes(content[4:8], "little")
    if kind.strip() == b"binary_compressed" and size > _MOST_RATIO * len(data):
        raise ValueError(f"{size} bytes are too many for {len(data)}")


def _text_of(table: Table) -> bytes:
    """Return lines of numbers, each with the fewest digits that give it again."""
    parts = [table[name].astype(str) for name in table.dtype.names or ()]
    return "".join(f"{' '.join(row)}\n" for row in zip(*parts, strict=True)).encode()


def _read_las(path: Path, data: bytes, columns: tuple[str, ...]) -> Stored:
    try:
        from lidarsim import clouds_las
    except ImportError as error:
        raise ScanError(f"{path}: {path.suffix} needs laspy: pip install 'r3dpa[las]'") from error
    table, pack = clouds_las.read(data, path.suffix)
    return Stored(path.suffix, table, pack)


READERS: dict[str, Callable[[Path, bytes, tuple[str, ...]], Stored]] = {
    ".bin": _read_bin,
    ".pcd.bin": _read_bin,
    ".npy": _read_numpy,
    ".npz": _read_numpy,
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".las": _read_las,
    ".laz": _read_las,
}
#: Formats that can be read, for messages.
READABLE = ", ".join(READERS)

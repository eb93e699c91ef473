"""Scans of any lidar from files, and back, with every column as it was.

``.bin`` holds float32 rows x, y, z, intensity (KITTI), the ring as fifth (nuScenes, ``.pcd.bin``),
or other columns that are named; ``.pcd`` needs the package pypcd4; ``.ply`` is ASCII or binary, of
vertices alone; ``.npy`` and ``.npz`` hold such rows, or columns with names. Labels lie in a
``.label`` of SemanticKITTI: beside the scan, or in ``labels`` in or beside its folder.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from lidarsim.io import UNPICKLING_ERRORS, atomic_path, first_line
from lidarsim.recorded import RecordedScan
from lidarsim.scan_files import ScanError, files_below, npz_arrays, ply_table, read_bytes
from lidarsim.weather import WeatheredScan

Table = NDArray[np.void]  # (P,) rows of named columns, in the order of the file
_Read = tuple[str, Table, Callable[[Table], bytes]]  # format, rows, and file of other rows
_ROWS = ("x", "y", "z", "intensity", "ring")  # of rows without names
_ADVICE = "name the columns with --columns, such as x,y,z,intensity,time"
_NAMES = {
    **{axis: axis for axis in "xyz"},
    "intensity": "intensity i reflectivity reflectance remission scalar_intensity",
    "ring": "ring line channel laser laser_id beam scalar_ring",
    "time_s": "time_s time t timestamp time_stamp time_offset scalar_time",
}
# No lidar's ranges in metres have a greater median, or end before.
_FAR_MEDIAN_M, _NEAR_MAX_M = 250.0, 1.5
_FEWEST_POINTS = 16


@dataclass(frozen=True)
class ScanFile:
    """A scan and what is needed to write it again.

    Args:
        path: File that was read.
        kind: Format in words.
        table: Rows ``(P,)`` with all columns of the file.
        columns: Name in the table of x, y, z and, where known, intensity, ring, time_s.
        pack: Bytes of the file for other rows of this table.
        data: Bytes of the file with these rows, if known.
        labels: ``(P,)`` uint32 from ``label_path``, or None.
        label_path: File of the labels.
    """

    path: Path
    kind: str
    table: Table
    columns: dict[str, str]
    pack: Callable[[Table], bytes]
    data: bytes | None
    labels: NDArray[np.uint32] | None = None
    label_path: Path | None = None

    @property
    def scan(self) -> RecordedScan:
        """The points as float32, and the columns that are understood."""
        given = {key: self.table[name] for key, name in self.columns.items()}
        points = np.stack([given.pop(axis).astype(np.float32) for axis in "xyz"], axis=1)
        try:
            return RecordedScan(points, **given, labels=self.labels)
        except ValueError as error:
            raise ScanError(f"{self.path}: {error}") from error

    def changed(self, result: WeatheredScan) -> Self:
        """The file of a changed scan: rows of kept points, then those of added ones.

        Other columns of an added point, such as the ring, are those of its shot.
        """
        scan, rows = self.scan, self.table[result.shot]
        away = (result.points != scan.points[result.shot]).any(axis=1)
        for axis, values in zip("xyz", result.points.T, strict=True):
            rows[self.columns[axis]][away] = values[away]
        if result.intensity is not None:
            rows[self.columns["intensity"]] = result.intensity
        same = rows.tobytes() == self.table.tobytes()
        return replace(self, table=rows, labels=result.labels, data=self.data if same else None)

    def describe(self) -> str:
        """Format, columns, number of points, ranges and intensities in one line."""
        names = ", ".join(self.table.dtype.names or ())
        parts = [f"{self.kind} ({names})", f"{len(self.table)} points"]
        range_m = np.linalg.norm(self.scan.points, axis=1)
        for name, values in (("range", range_m), ("intensity", self.scan.intensity)):
            if values is not None:
                parts.append(f"{name} {values.min():.3g}..{values.max():.4g}")
        return ", ".join(parts + ["labels"] * (self.labels is not None))


def find_files(source: Path) -> tuple[Path, list[Path]]:
    """Folder that names are relative to, and the scans of a file or folder, sorted."""
    if source.is_file():
        return source.parent, [source]
    files = sorted(file for file in files_below(source) if file.suffix.lower() in _READERS)
    if not files:
        readable = ", ".join(_READERS)
        raise ScanError(f"{source}: is no folder with scans and no scan; can be read: {readable}")
    return source, files


def read_file(path: Path, columns: Sequence[str] = (), drop_nan: bool = False) -> ScanFile:
    """Scan of a file, checked.

    Args:
        path: File of a format above.
        columns: Names of the columns of rows without names; default: as the values show.
        drop_nan: Leave out points with NaN or infinite numbers, which organised clouds hold for
            shots without return.

    Raises:
        ScanError: If the file is damaged, its columns are ambiguous, or its values are no scan in
            metres.
    """
    data, suffix = read_bytes(path), path.suffix.lower()
    if not data or suffix not in _READERS:
        reason = f"of no known format; can be read: {', '.join(_READERS)}" if data else "empty"
        raise ScanError(f"{path}: is {reason}")
    try:
        kind, table, pack = _READERS[suffix](path, data, tuple(columns))
    except ScanError:
        raise
    except UNPICKLING_ERRORS as error:
        reason = f"is damaged or of another layout ({first_line(error)})"
        raise ScanError(f"{path}: {reason}") from error
    known = _known_columns(path, table)
    labels, label_path = _labels(path, len(table))
    values = [table[name].astype(np.float64) for name in known.values()]
    finite = np.isfinite(values).all(axis=0)
    if num_bad := np.count_nonzero(~finite):
        if not drop_nan:
            raise ScanError(
                f"{path}: has NaN or infinite values in {num_bad} of {len(table)} points; "
                "--drop_nan leaves them out"
            )
        table, labels = table[finite], None if labels is None else labels[finite]
    if len(table) < _FEWEST_POINTS:
        raise ScanError(
            f"{path}: holds {len(table)} of at least {_FEWEST_POINTS} points; remove it"
        )
    range_m = np.sqrt(np.square(values[:3]).sum(axis=0))[finite]
    median, largest = float(np.median(range_m)), float(range_m.max())
    if median > _FAR_MEDIAN_M or largest < _NEAR_MAX_M:
        advice = "divide the coordinates, by 100 or 1000" if median > 1 else "multiply them"
        raise ScanError(
            f"{path}: ranges have the median {median:.3g} and reach {largest:.4g}, which are no "
            f"metres: {advice}"
        )
    return ScanFile(path, kind, table, known, pack, None if num_bad else data, labels, label_path)


def write_file(file: ScanFile, root: Path, out: Path) -> dict[str, int]:
    """Write a scan, its labels first, to the place below ``out`` that it has below ``root``.

    Labels from outside ``root`` are written beside the scan.

    Returns:
        Size of each written file by its name below ``out``.

    Raises:
        ScanError: If a link leads out of ``out``.
    """
    path = out / file.path.relative_to(root)
    contents: dict[Path, bytes] = {}
    if file.labels is not None and file.label_path is not None:
        place = Path(os.path.relpath(file.label_path, root))
        beside = place.parts[0] == ".."
        label_path = path.with_name(place.name) if beside else out / place
        contents[label_path] = file.labels.astype("<u4").tobytes()
    contents[path] = file.pack(file.table) if file.data is None else file.data
    for written, content in contents.items():
        refuse_outside(written, out)
        with atomic_path(written) as temporary:
            temporary.write_bytes(content)
    return {written.relative_to(out).as_posix(): len(data) for written, data in contents.items()}


def refuse_outside(path: Path, out: Path) -> None:
    """Refuse a file to write or delete that is not below ``out``, once links are followed.

    Raises:
        ScanError: With the name of the file.
    """
    if not path.parent.resolve().is_relative_to(out.resolve()):
        raise ScanError(f"{path}: leads out of {out}: give another --out")


def inputs_of(path: Path, root: Path) -> dict[str, list[int]]:
    """Size and time of change in ns of a scan and its labels, by their names from ``root``."""
    stats = {file: file.stat() for file in (path, label_path_of(path)) if file and file.is_file()}
    return {
        Path(os.path.relpath(file, root)).as_posix(): [about.st_size, about.st_mtime_ns]
        for file, about in stats.items()
    }


def refuse_shared_labels(paths: Iterable[Path]) -> None:
    """Refuse scans of which two have the same file of labels, also in their results.

    Raises:
        ScanError: With the names of two such scans.
    """
    scan_of: dict[Path, Path] = {}
    for path in sorted(paths):
        label_path = label_path_of(path)
        if label_path is not None and scan_of.setdefault(label_path, path) != path:
            raise ScanError(
                f"{label_path}: would be the labels of {scan_of[label_path]} and of {path}: keep "
                "one of these scans, or its labels in another folder"
            )


def _known_columns(path: Path, table: Table) -> dict[str, str]:
    names = {name.lower(): name for name in table.dtype.names or ()}
    known: dict[str, str] = {}
    for key, others in _NAMES.items():
        name = next((names[other] for other in others.split() if other in names), None)
        if name is None and key in "xyz":
            raise ScanError(f"{path}: has no column {key}, only {', '.join(names.values())}")
        if name is not None:
            known[key], kind = name, table.dtype[name]
            if kind.kind not in ("f" if key in "xyz" else "fiu"):
                raise ScanError(f"{path}: column {name} is of {kind}; {key} must be one float")
    return known


def label_path_of(path: Path) -> Path | None:
    """File of the labels of a scan, if there is one."""
    name = f"{path.stem.removesuffix('.pcd')}.label"
    folder = path.absolute().parent
    places = (folder / name, folder / "labels" / name, folder.parent / "labels" / name)
    return next((place for place in places if place.is_file()), None)


def _labels(path: Path, num_points: int) -> tuple[NDArray[np.uint32] | None, Path | None]:
    place = label_path_of(path)
    if place is None:
        return None, None
    data = read_bytes(place)
    if len(data) != 4 * num_points:
        raise ScanError(
            f"{place}: holds {len(data) / 4:g} labels but {path} {num_points} points: "
            "delete the one that does not belong"
        )
    return np.frombuffer(data, "<u4"), place


def _with_names(path: Path, rows: NDArray, columns: tuple[str, ...]) -> Table:
    """Rows ``(P, C)`` of floats as a table."""
    named = columns or _ROWS[: rows.shape[-1]]
    is_table = rows.ndim == 2 and rows.dtype.kind == "f" and rows.shape[1] == len(named)
    if not is_table or not (columns or _can_be_rows(rows)):
        raise ScanError(
            f"{path}: holds {rows.dtype} of shape {rows.shape}, not rows of {len(named)} floats "
            f"that can be {', '.join(named)}: {_ADVICE}"
        )
    return np.ascontiguousarray(rows).view([(name, rows.dtype) for name in named])[:, 0]


def _can_be_rows(rows: NDArray) -> bool:
    """Whether columns ``(P, C)`` without names can be those of ``_ROWS``."""
    shares, ring = rows[:, 3:], rows[:, 4:]  # NaN is for a later message
    return not ((shares < 0).any() or (ring > 255).any() or (ring % 1 > 0).any())


def _read_bin(path: Path, data: bytes, columns: tuple[str, ...]) -> _Read:
    counts = [len(columns)] if columns else [5] if path.stem.endswith(".pcd") else [4, 5]
    fitting = [np.frombuffer(data, "<f4").reshape(-1, n) for n in counts if not len(data) % (4 * n)]
    likely = [rows for rows in fitting if columns or _can_be_rows(rows)]
    if len(likely) != 1:
        raise ScanError(
            f"{path}: its {len(data)} bytes are no rows of {' or '.join(map(str, counts))} float32 "
            f"numbers that can be {', '.join(_ROWS)}: {_ADVICE}"
        )
    table = _with_names(path, likely[0], columns)
    return f"{likely[0].shape[1]} columns of float32", table, np.ndarray.tobytes


def _read_numpy(path: Path, data: bytes, columns: tuple[str, ...]) -> _Read:
    arrays = dict(npz_arrays(path)) if data[:2] == b"PK" else {}
    array, *others = arrays.values() or [np.load(io.BytesIO(data), allow_pickle=False)]
    if {one.shape for one in (array, *others)} != {array.shape[:1] if others else array.shape}:
        raise ScanError(f"{path}: must hold one scan: one array of rows, or columns of one length")
    if others:
        array = np.empty(len(array), [(name, one.dtype) for name, one in arrays.items()])
        for name, one in arrays.items():
            array[name] = one
    table = array if array.dtype.names else _with_names(path, array, columns)

    def pack(table: Table) -> bytes:
        stream, rows = io.BytesIO(), table
        if not array.dtype.names:
            rows = structured_to_unstructured(table)
        packed: dict[str, Any] = {name: table[name] if others else rows for name in arrays}
        np.savez_compressed(stream, **packed) if arrays else np.save(stream, rows)
        return stream.getvalue()

    return path.suffix, table, pack


def _read_ply(path: Path, data: bytes, columns: tuple[str, ...]) -> _Read:
    table, header = ply_table(path)

    def pack(table: Table) -> bytes:
        text = re.sub(r"(?m)^element vertex .*", f"element vertex {len(table)}", "\n".join(header))
        rows = _text(table) if "ascii" in header[1] else table.tobytes()
        return f"{text}\n".encode("ascii") + rows

    return f".ply, {header[1].split()[1]}", table, pack


def _read_pcd(path: Path, data: bytes, columns: tuple[str, ...]) -> _Read:
    try:
        from pypcd4 import Encoding, PointCloud
    except ImportError as error:
        raise ScanError(f"{path}: .pcd needs pypcd4: pip install 'r3dpa[pcd]'") from error
    cloud: Any = PointCloud.from_fileobj(cast(Any, io.BytesIO(data)))
    about, rows = cloud.metadata, cloud.pc_data
    if len(rows) != about.points:
        raise ScanError(f"{path}: is damaged: holds {len(rows)} of {about.points} points")
    # Padding has random names.
    names = [f"_{n}" if "#" in name else name for n, name in enumerate(rows.dtype.names)]
    table = rows.view([(name, rows.dtype[n]) for n, name in enumerate(names)])

    def pack(table: Table) -> bytes:
        kept = PointCloud(about.derive(points=len(table), width=len(table), height=1), table)
        if about.data is Encoding.ASCII:  # the package keeps ten decimals
            return kept.metadata.compose_header().encode() + _text(table)
        stream = io.BytesIO()
        kept.save(stream, about.data)
        return stream.getvalue()

    return f".pcd, {about.data.value}", table, pack


def _text(table: Table) -> bytes:
    """Rows of numbers, each with the fewest digits that give it again."""
    parts = [table[name].astype(str) for name in table.dtype.names or ()]
    return "".join(f"{' '.join(row)}\n" for row in zip(*parts, strict=True)).encode()


_READERS: dict[str, Callable[[Path, bytes, tuple[str, ...]], _Read]] = {
    ".bin": _read_bin,
    ".npy": _read_numpy,
    ".npz": _read_numpy,
    ".ply": _read_ply,
    ".pcd": _read_pcd,
}

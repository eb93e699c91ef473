"""Point clouds of any LiDAR from files, and back, with every column as it was.

============ =====================================================================================
suffix       content
============ =====================================================================================
``.bin``     float32 rows x, y, z, intensity (KITTI), the ring as fifth column (nuScenes), or other
             columns if they are named
``.pcd.bin`` five columns: x, y, z, intensity 0..255, ring counted from the lowest (nuScenes)
``.pcd``     ASCII, binary or compressed; needs the package pypcd4
``.ply``     ASCII or binary, only vertices
``.npy``     rows ``(P, C)``, a structured array, or an organised ``(H, W, C)`` with a row per beam
``.npz``     one such array; or ``xyz`` or ``points`` and further columns; or columns by name
``.las``     also ``.laz``; needs the package laspy
============ =====================================================================================

Labels lie in a ``.label`` of SemanticKITTI: beside the scan, or in ``labels`` in or beside its
folder. Everything else needs only NumPy.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.cloud_formats import (
    ODD_SHARE,
    READABLE,
    READERS,
    ROWS,
    ScanError,
    Table,
    ply_of,
    read_bytes,
    refuse_two_scales,
    table_of,
)
from lidarsim.io import UNPICKLING_ERRORS, first_line, write_bytes

_NAMES = {
    **{axis: axis for axis in "xyz"},
    "intensity": "intensity i reflectivity reflectance remission scalar_intensity signal",
    "ring": "ring line channel laser laser_id beam scalar_ring",
    "time_s": "time_s time t timestamp time_stamp time_offset scalar_time gps_time",
}
# Columns that may hold the length of x, y, z, and the largest relative difference from it.
_RANGES, _SAME_RANGE = {"range", "range_m", "range_mm", "distance", "depth"}, 0.01
# No lidar's ranges in metres have a greater median, or end before.
_FAR_MEDIAN_M, _NEAR_MAX_M = 250.0, 1.5
_FEWEST_POINTS = 16
_LAS_FULL_INTENSITY = 65535.0  # of 16 bits, as LAS asks for


class CloudFile(NamedTuple):
    """File that a cloud was read from, and how to write it again."""

    path: Path
    kind: str  # format in words
    pack: Callable[[Table], bytes] | None  # content for other rows; None for other columns
    data: bytes | None = None  # content for the rows of the cloud, if known
    label_path: Path | None = None


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of one scan, in the order of their file.

    Args:
        table: Rows ``(P,)`` with all columns, named and typed as in the file.
        names: Name in the table of x, y, z (metres) and, where known, intensity, ring, time_s.
        labels: ``(P,)`` uint32, or None.
        file: File that it was read from; None for a cloud that was made.

    Example:
        >>> cloud = PointCloud.of(np.ones((2, 3), np.float32), ring=[0, 1], azimuth=[0.1, 0.2])
        >>> cloud.points.shape, cloud.ring.tolist(), list(cloud.columns)
        ((2, 3), [0, 1], ['azimuth'])
    """

    table: Table
    names: Mapping[str, str]
    labels: NDArray[np.uint32] | None = None
    file: CloudFile | None = None

    @classmethod
    def of(
        cls, points: ArrayLike, labels: NDArray[np.uint32] | None = None, **columns: ArrayLike
    ) -> Self:
        """Make a cloud of points ``(P, 3)``, or ``(P, 4)`` with intensity, and columns ``(P,)``.

        Raises:
            ValueError: If the points have another shape.
        """
        rows = np.asarray(points)
        if rows.ndim != 2 or rows.shape[1] not in (3, 4):
            raise ValueError(f"points must be (P, 3) or (P, 4), got {rows.shape}")
        if rows.dtype.kind != "f":
            rows = rows.astype(np.float32)
        named = dict(zip(ROWS, rows.T, strict=False))
        named |= {name: np.asarray(column) for name, column in columns.items()}
        table = table_of(named, len(rows))
        return cls(table, known_columns("the cloud", table), labels)

    def __len__(self) -> int:
        return len(self.table)

    @cached_property
    def points(self) -> NDArray[np.floating]:
        """``(P, 3)`` metres, float64 where a coordinate is, else float32."""
        return np.stack([self.table[self.names[axis]] for axis in "xyz"], axis=1)

    @property
    def intensity(self) -> NDArray | None:
        """``(P,)`` in units of the file."""
        return self._column("intensity")

    @property
    def ring(self) -> NDArray | None:
        """``(P,)`` laser of each point, as the file numbers them."""
        return self._column("ring")

    @property
    def time_s(self) -> NDArray | None:
        """``(P,)`` time of each point, as the file gives it."""
        return self._column("time_s")

    @property
    def columns(self) -> dict[str, NDArray]:
        """Further columns ``(P,)`` by name, without padding."""
        known = set(self.names.values())
        names = (n for n in self.table.dtype.names or () if n not in known and n[0] != "_")
        return {name: self.table[name] for name in names}

    def _column(self, name: str) -> NDArray | None:
        return self.table[self.names[name]] if name in self.names else None

    def intensity_shares(self, full_scale: float | None = None) -> NDArray[np.float32]:
        """Intensities ``(P,)`` as shares of a full scale, 0 where the file has none.

        The default full scale is 1, or 255 for integers and where intensities exceed 1, or 65535
        of LAS files.

        Raises:
            ScanError: If intensities exceed 255, or few of them 1, and no ``full_scale`` is given.
        """
        values = self.intensity
        if values is None:
            return np.zeros(len(self), np.float32)
        if full_scale is None:
            full_scale = self.full_intensity
        return values.astype(np.float32) / np.float32(full_scale)

    @property
    def full_intensity(self) -> float:
        """Full scale of the intensities, see :meth:`intensity_shares`; 1 without intensities."""
        intensity = self.intensity
        if intensity is None:
            return 1.0
        num_above = np.count_nonzero(intensity > 1)
        if intensity.dtype.kind == "f" and num_above <= ODD_SHARE * len(self):
            return 1.0
        refuse_two_scales(intensity, self.where)
        largest = intensity.max(initial=0)
        if largest <= 255:
            return 255.0
        is_las = self.file is not None and self.file.kind in (".las", ".laz")
        if is_las and largest <= _LAS_FULL_INTENSITY:
            return _LAS_FULL_INTENSITY
        raise ScanError(
            f"{self.where}: has intensities up to {largest:g}, of an unknown full scale: give it "
            "to `r3dpa data convert --full_intensity`"
        )

    def rows(self, full_scale: float | None = None) -> NDArray[np.float32]:
        """``(P, 4)`` x, y, z and the share of the intensity, see :meth:`intensity_shares`."""
        points = self.points.astype(np.float32)
        return np.column_stack([points, self.intensity_shares(full_scale)])

    def with_column(self, name: str, values: NDArray) -> Self:
        """Cloud with another column ``(P,)``, or one column more."""
        columns = {known: self.table[known] for known in self.table.dtype.names or ()}
        table = table_of(columns | {name: values}, len(self))
        file = self.file
        if file is not None:
            pack = file.pack if table.dtype == self.table.dtype else None
            file = file._replace(pack=pack, data=None)
        return replace(self, table=table, names=known_columns(self.where, table), file=file)

    def changed(
        self,
        index: NDArray[np.int64],
        points: NDArray[np.floating],
        intensity: NDArray | None = None,
        labels: NDArray[np.uint32] | None = None,
    ) -> Self:
        """Cloud of the rows ``index`` ``(Q,)`` with other points, intensities and labels.

        Other columns, such as the ring, keep the values of the rows; columns of ranges are
        computed from the points.
        """
        rows, before = self.table[index], self.points.astype(np.float32)[index]
        away = (points != before).any(axis=1)
        for axis, values in zip("xyz", points.T, strict=True):
            rows[self.names[axis]][away] = values[away]
        for name in self.columns:
            unit = self._range_unit(name) if name.lower() in _RANGES else None
            if unit is not None:
                range_m = np.linalg.norm(points[away].astype(float), axis=1)
                is_whole = rows.dtype[name].kind in "iu"
                rows[name][away] = np.rint(unit * range_m) if is_whole else unit * range_m
        if intensity is not None:
            rows[self.names["intensity"]] = intensity
        file = self.file
        if file is not None and rows.tobytes() != self.table.tobytes():
            file = file._replace(data=None)
        return replace(self, table=rows, labels=labels, file=file)

    def _range_unit(self, name: str) -> float | None:
        """Factor from metres to a column of ranges; None if it holds something else."""
        range_m = np.linalg.norm(self.points.astype(float), axis=1)
        far = range_m > 1
        ratio = self.table[name][far] / range_m[far]
        unit = float(np.median(ratio)) if far.any() else 0.0
        is_range = unit > 0 and np.mean(np.abs(ratio / unit - 1) < _SAME_RANGE) > 0.5
        return unit if is_range else None

    def check_metres(self) -> None:
        """Refuse clouds of fewer than 16 points, and ranges that cannot be metres.

        Raises:
            ScanError: With what to do.
        """
        check_metres(self.where, self.points)

    def without_origin(self) -> Self:
        """Cloud without points at (0, 0, 0), as which drivers write shots without a return."""
        is_return = self.points.any(axis=1)
        if is_return.all():
            return self
        labels = None if self.labels is None else self.labels[is_return]
        file = None if self.file is None else self.file._replace(data=None)
        return replace(self, table=self.table[is_return], labels=labels, file=file)

    def describe(self) -> str:
        """Format, columns, number of points, ranges and intensities in one line."""
        names = ", ".join(self.table.dtype.names or ())
        kind = "made" if self.file is None else self.file.kind
        parts = [f"{kind} ({names})", f"{len(self)} points"]
        range_m = np.linalg.norm(self.points.astype(np.float32), axis=1)
        for name, values in (("range", range_m), ("intensity", self.intensity)):
            if values is not None:
                parts.append(f"{name} {values.min():.3g}..{values.max():.4g}")
        if self.labels is not None:
            parts.append("labels")
        return ", ".join(parts)

    @property
    def where(self) -> str:
        """Path of the file, for messages."""
        return "the cloud" if self.file is None else str(self.file.path)


def check_metres(where: str | Path, points: NDArray[np.floating]) -> None:
    """Refuse fewer than 16 points ``(P, 3)`` or more columns, and ranges that cannot be metres.

    Points at (0, 0, 0) do not count.

    Raises:
        ScanError: With what to do; ``where`` names the scan.
    """
    num_all = len(points)
    points = points[points[:, :3].any(axis=1)]
    if num_all and not len(points):
        raise ScanError(f"{where}: all of its {num_all} points are 0; export it again")
    if len(points) < _FEWEST_POINTS:
        raise ScanError(
            f"{where}: holds {len(points)} of at least {_FEWEST_POINTS} points; remove it"
        )
    range_m = np.linalg.norm(points[:, :3].astype(float), axis=1)
    median, largest = float(np.median(range_m)), float(range_m.max())
    if median > _FAR_MEDIAN_M or largest < _NEAR_MAX_M:
        advice = "divide the coordinates, by 100 or 1000" if median > 1 else "multiply them"
        raise ScanError(
            f"{where}: ranges have the median {median:.3g} and reach {largest:.4g}, "
            f"which are no metres: {advice}"
        )


def suffix_of(path: Path) -> str:
    """Suffix of a scan in lower case; ``.pcd.bin`` is one."""
    name = path.name.lower()
    return ".pcd.bin" if name.endswith(".pcd.bin") else path.suffix.lower()


def read_cloud(
    path: str | Path,
    columns: Sequence[str] = (),
    drop_nan: bool = False,
    with_labels: bool = True,
) -> PointCloud:
    """Point cloud of a file.

    Args:
        path: File of a format above.
        columns: Names of the columns of rows without names; default: as the values show.
        drop_nan: Leave out points with NaN or infinite numbers.
        with_labels: Read the file of labels too, if there is one.

    Raises:
        ScanError: If the file is damaged, holds NaN, or its columns are ambiguous.
    """
    path = Path(path)
    suffix, data = suffix_of(path), read_bytes(path)
    if not data:
        raise ScanError(f"{path}: is empty")
    if suffix not in READERS:
        raise ScanError(f"{path}: is of no known format; can be read: {READABLE}")
    try:
        kind, table, pack = READERS[suffix](path, data, tuple(columns))
    except ScanError:
        raise
    except UNPICKLING_ERRORS as error:
        reason = f"is damaged or of another layout ({first_line(error)})"
        raise ScanError(f"{path}: {reason}") from error
    names = known_columns(path, table)
    labels, label_path = labels_beside(path, len(table)) if with_labels else (None, None)
    is_finite = np.all([np.isfinite(table[name]) for name in names.values()], axis=0)
    if is_finite.all():
        return PointCloud(table, names, labels, CloudFile(path, kind, pack, data, label_path))
    if not drop_nan:
        raise ScanError(
            f"{path}: has NaN or infinite values in {np.count_nonzero(~is_finite)} of {len(table)} "
            "points; `r3dpa data convert SCANS OUT --to bin --drop_nan true` leaves them out"
        )
    labels = None if labels is None else labels[is_finite]
    file = CloudFile(path, kind, pack, None, label_path)
    return PointCloud(table[is_finite], names, labels, file)


def write_cloud(path: str | Path, cloud: PointCloud) -> None:
    """Write a cloud in the format of the suffix, atomically.

    In the format of its own file, every column is written as it was read. ``.bin`` takes x, y, z
    and the share of the intensity, ``.pcd.bin`` 255 times the share and the ring.

    Raises:
        ScanError: If the format cannot be written, or cannot hold the cloud.
    """
    write_bytes(path, packed(Path(path), cloud))


def packed(path: Path, cloud: PointCloud) -> bytes:
    """Return the content of a file of a cloud, see :func:`write_cloud`."""
    suffix, file = suffix_of(path), cloud.file
    if file is not None and file.pack is not None and suffix_of(file.path) == suffix:
        return file.pack(cloud.table) if file.data is None else file.data
    if suffix not in WRITERS:
        raise ScanError(f"{path}: cannot be written; choose from {', '.join(WRITERS)}")
    return WRITERS[suffix](cloud, None)


def _kitti_of(cloud: PointCloud, full_scale: float | None) -> bytes:
    return cloud.rows(full_scale).tobytes()


def _nuscenes_of(cloud: PointCloud, full_scale: float | None) -> bytes:
    rows = cloud.rows(full_scale)
    if cloud.ring is None:
        raise ScanError(
            f"{cloud.where}: has no column ring, which .pcd.bin needs: give another --to"
        )
    rows[:, 3] *= 255
    return np.column_stack([rows, cloud.ring.astype(np.float32)]).tobytes()


def _all_columns(cloud: PointCloud, full_scale: float | None) -> dict[str, NDArray]:
    """Return x, y, z and all columns, known ones by their usual names, without padding."""
    columns = {key: cloud.table[name] for key, name in cloud.names.items()}
    if full_scale is not None and cloud.intensity is not None:
        columns["intensity"] = cloud.intensity_shares(full_scale)
    return columns | cloud.columns


def _ply_of(cloud: PointCloud, full_scale: float | None) -> bytes:
    return ply_of(table_of(_all_columns(cloud, full_scale), len(cloud)))


def _npy_of(cloud: PointCloud, full_scale: float | None) -> bytes:
    stream = io.BytesIO()
    np.save(stream, cloud.rows(full_scale))
    return stream.getvalue()


def _npz_of(cloud: PointCloud, full_scale: float | None) -> bytes:
    stream, columns = io.BytesIO(), _all_columns(cloud, full_scale)
    others: dict[str, Any] = {
        name: column for name, column in columns.items() if name not in ("x", "y", "z")
    }
    for name in ("file", "xyz"):
        if name in others:
            raise ScanError(f"column {name!r} cannot be written to .npz: rename it")
    np.savez_compressed(stream, xyz=cloud.points, **others)
    return stream.getvalue()


def _las_of(cloud: PointCloud, full_scale: float | None, suffix: str = ".las") -> bytes:
    try:
        from lidarsim import clouds_las
    except ImportError as error:
        raise ScanError(f"{suffix} needs laspy: pip install 'r3dpa[las]'") from error
    columns = _all_columns(cloud, None)
    if "intensity" in columns:
        shares = cloud.intensity_shares(full_scale).clip(0, 1)
        columns["intensity"] = np.rint(shares * _LAS_FULL_INTENSITY).astype(np.uint16)
    try:
        return clouds_las.las_of(columns, suffix)
    except ValueError as error:
        raise ScanError(f"{cloud.where}: {error}") from error


#: Formats that can be written from any other, by suffix.
WRITERS: dict[str, Callable[[PointCloud, float | None], bytes]] = {
    ".bin": _kitti_of,
    ".pcd.bin": _nuscenes_of,
    ".ply": _ply_of,
    ".npy": _npy_of,
    ".npz": _npz_of,
    ".las": _las_of,
    ".laz": partial(_las_of, suffix=".laz"),
}


def label_path_of(path: Path) -> Path | None:
    """Return the file of the labels of a scan, if there is one."""
    name = f"{path.stem.removesuffix('.pcd')}.label"
    folder = path.absolute().parent
    places = (folder / name, folder / "labels" / name, folder.parent / "labels" / name)
    return next((place for place in places if place.is_file()), None)


def labels_beside(path: Path, num_points: int) -> tuple[NDArray[np.uint32] | None, Path | None]:
    """Labels ``(P,)`` of a scan as its file has them, and this file; None without one.

    Raises:
        ScanError: If there is another number of labels.
    """
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


def known_columns(where: str | Path, table: Table) -> dict[str, str]:
    """Return the names of the columns that are understood."""
    names = {name.lower(): name for name in table.dtype.names or ()}
    known: dict[str, str] = {}
    for key, others in _NAMES.items():
        name = next((names[other] for other in others.split() if other in names), None)
        if name is None and key in "xyz":
            raise ScanError(f"{where}: has no column {key}, only {', '.join(names.values())}")
        if name is not None:
            known[key] = name
            kind = table.dtype[name]
            allowed = "f" if key in "xyz" else "fiu"
            if kind.kind not in allowed:
                raise ScanError(f"{where}: column {name} is of {kind}; {key} must be one float")
    return known

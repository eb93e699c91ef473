"""Scans as arrays: points and intensities of files, and files of them."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.cloud_formats import (
    ODD_SHARE,
    ROWS,
    ScanError,
    is_one_cloud,
    npz_arrays,
    ply_of,
    read_bytes,
)
from lidarsim.clouds import PointCloud, read_cloud, suffix_of
from lidarsim.io import atomic_path, write_bytes
from lidarsim.sensors.view import LidarSensor, in_range

_KITTI = np.dtype([(name, "<f4") for name in ROWS[:4]])


def read_scan(
    path: str | Path, sensor: LidarSensor | None = None, columns: Sequence[str] = ()
) -> np.ndarray:
    """Return points ``(P, 4)`` of a scan: float32 x, y, z (metres), intensity 0..1.

    Takes all formats of :mod:`lidarsim.clouds`. A ``.bin`` of four columns must hold intensities of
    0..1; intensities of other files are divided by their full scale. ``columns`` names the columns
    of files without names.

    Raises:
        ScanError: If the file is unreadable, empty, of another layout, holds NaN or infinite
            values, has intensities above 1 in more than a thousandth of its points, or has no point
            within the range limits of ``sensor``.
    """
    path = Path(path)
    return rows_of(path, read_cloud(path, columns, with_labels=False), sensor)


def rows_of(path: Path, cloud: PointCloud, sensor: LidarSensor | None = None) -> np.ndarray:
    """Return points ``(P, 4)`` of the cloud of a file, as :func:`read_scan`."""
    if cloud.table.dtype == _KITTI and suffix_of(path) == ".bin":
        points = cloud.table.view("<f4").reshape(-1, 4).copy()
        _refuse_bright(path, points[:, 3])
    else:
        points = cloud.rows()
    if sensor is not None and not in_range(points[:, :3], sensor).any():
        raise out_of_range(path, sensor)
    return points


def _refuse_bright(path: Path, intensity: np.ndarray) -> None:
    """Refuse intensities of another full scale than 1; single returns may exceed full scale."""
    num_bright = np.count_nonzero(intensity > 1)
    if num_bright > ODD_SHARE * len(intensity):
        raise ScanError(
            f"{path}: has intensities up to {intensity.max():g} and above 1 in {num_bright} of "
            f"{len(intensity)} points, not 0..1: divide the fourth column by its full scale, such "
            "as 255, or let `r3dpa data convert` do so"
        )


def read_points(path: str | Path, columns: Sequence[str] = ()) -> np.ndarray:
    """Return points ``(P, 3)``, or ``(P, 4)`` if the file has intensities, as :func:`read_scan`."""
    cloud = read_cloud(path, columns, with_labels=False)
    return cloud.rows()[:, : 3 if cloud.intensity is None else 4]


def read_clouds(path: str | Path, columns: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Return points ``(P, 3)`` or ``(P, 4)`` of each scan of a file, by name.

    A ``.npz`` holds one scan, see :mod:`lidarsim.clouds`, or scans by name, as
    :func:`write_npz` writes them.
    """
    path = Path(path)
    if suffix_of(path) != ".npz":
        is_rows = suffix_of(path) == ".bin"
        points = read_scan(path, None, columns) if is_rows else read_points(path, columns)
        return {path.stem: points}
    if is_one_cloud(path):
        return {path.stem: read_points(path, columns)}
    clouds = read_npz(path)
    if len(clouds) == 1:
        return {name: read_points(path, columns) for name in clouds}
    for name, points in clouds.items():
        if points.ndim != 2 or points.shape[1] not in (3, 4):
            raise ScanError(
                f"{path}: {name} must be points (P, 3) or (P, 4), got shape {points.shape}"
            )
        if num_bad := np.count_nonzero(~np.isfinite(points).all(axis=1)):
            raise ScanError(
                f"{path}: {name} has NaN or infinite values in {num_bad} of {len(points)} points: "
                "drop these points first"
            )
    if not clouds:
        raise ScanError(f"{path}: holds no scan")
    return clouds


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
    scan = Path(scan).absolute()  # of a name alone, the folders above it
    suffix, dtype = {"labels": (".label", "<u4"), "origins": (".origin", "u1")}[kind]
    path = scan.parents[1] / kind / f"{scan.stem}{suffix}"
    if scan.parts[-3:-1] != ("velodyne_points", "data") or not path.exists():
        return None
    data = read_bytes(path)
    num_points = scan.stat().st_size // _KITTI.itemsize
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
    write_bytes(path, rows.astype("<f4").tobytes())


def write_ply(path: str | Path, points: ArrayLike) -> None:
    """Write ``(P, 3)`` or ``(P, 4)`` x, y, z (metres), intensity as binary ``.ply``.

    Atomic; ``ValueError`` for another shape, NaN or infinite values.
    """
    write_bytes(path, ply_of(PointCloud.of(_rows(points)).table))


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


def _rows(points: Any) -> np.ndarray:
    on_host = points.detach().cpu() if hasattr(points, "detach") else points  # tensors of torch
    rows = np.asarray(on_host, dtype=np.float32)
    if rows.ndim != 2 or rows.shape[1] not in (3, 4):
        raise ValueError(f"a scan to write must be (P, 3) or (P, 4), got {rows.shape}")
    if not np.isfinite(rows).all():
        raise ValueError("a scan to write holds NaN or infinite values: drop these points first")
    return rows

"""Scans in other formats: ``r3dpa data convert``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidarsim.cloud_formats import ScanError
from lidarsim.clouds import WRITERS, PointCloud, read_cloud, suffix_of
from lidarsim.clouds_bag import is_bag, read_bag
from lidarsim.io import number_of, write_bytes
from lidarsim.rings import rings_of
from lidarsim.scan_folders import find_files
from lidarsim.weather import recorded_scan

Format = Literal["bin", "pcd.bin", "ply", "npy", "npz", "las", "laz"]
_LEAST_SURE = 0.9  # share of the points whose ring must be sure to be written


def convert(
    source: Path,
    out: Path,
    *,
    to: Format | None = None,
    columns: Sequence[str] = (),
    drop_nan: bool = False,
    full_intensity: float | None = None,
    topic: str | None = None,
) -> str:
    """Write scans in another format, with the labels beside them.

    ``bin`` and ``npy`` hold intensities of 0 to 1, as every command reads them, ``pcd.bin``
    intensities up to 255 and the ring. Other formats keep all columns, with their units, but for
    the intensity of ``las`` and ``laz``, in 16 bits. These two need the package laspy.

    Args:
        source: Scan, or folder of scans of any format that can be read; or a ROS bag or MCAP file.
        out: File for a single scan, or folder, in which scans keep their names.
        to: Format; default: by the suffix of ``out``.
        columns: Columns of files without names, such as ``x,y,z,intensity,ring,time``; default: by
            the values.
        drop_nan: Leave out points with NaN.
        full_intensity: Intensity of the full scale; default: 1, or 255 above that.
        topic: Topic of the scans of a bag; needed if several hold some.

    Raises:
        ScanError: If a scan cannot be read or written, or its file exists, or one of other labels.
        ValueError: If the format is unknown, or an option is not for this source.
    """
    suffix = suffix_of(out) if to is None else f".{to}"
    if suffix not in WRITERS:
        choices = ", ".join(name.removeprefix(".") for name in WRITERS)
        raise ValueError(f"{out}: unknown format {suffix!r}; choose --to from {choices}")
    if full_intensity is not None and not 0 < full_intensity < np.inf:
        raise ValueError(f"full_intensity must be positive, got {full_intensity:g}")
    if is_bag(source):
        if columns:
            raise ValueError(f"{source}: the scans of a bag have names for their columns")
        scans = ((out / f"{name}{suffix}", cloud) for name, cloud in read_bag(source, topic))
    else:
        if topic is not None:
            raise ValueError(f"{source}: topic {topic!r} is given, but it is no bag")
        targets = _targets(source, out, suffix)
        scans = ((file, read_cloud(path, columns, drop_nan)) for file, path in targets.items())
    num_written = 0
    for target, cloud in scans:
        _refuse_existing(target)
        content = _content(cloud, suffix, full_intensity)
        if cloud.labels is not None:
            labels = cloud.labels.astype("<u4").tobytes()
            label_path = target.with_name(f"{_stem(target)}.label")
            if not (label_path.exists() and label_path.read_bytes() == labels):
                _refuse_existing(label_path)
                write_bytes(label_path, labels)
        write_bytes(target, content)
        num_written += 1
    return f"{number_of(num_written, 'scan')} written to {out} as {suffix}"


def _targets(source: Path, out: Path, suffix: str) -> dict[Path, Path]:
    """Scans of a file or folder, by the files to write."""
    root, files = find_files(source)
    if source.is_file() and suffix_of(out) == suffix:
        return {out: source}
    targets: dict[Path, Path] = {}
    for path in files:
        name = path.relative_to(root)
        target = out / name.with_name(_stem(name) + suffix)
        if target in targets:
            raise ScanError(f"{path}: would be written as {target}, as would {targets[target]}")
        _refuse_existing(target)
        targets[target] = path
    return targets


def _refuse_existing(target: Path) -> None:
    if target.exists():
        raise ScanError(f"{target}: exists: delete it, or give another name")


def _content(cloud: PointCloud, suffix: str, full_intensity: float | None) -> bytes:
    cloud.check_metres()
    if suffix == ".pcd.bin" and cloud.ring is None:
        rings = rings_of(recorded_scan(cloud))
        if rings.sure < _LEAST_SURE:
            raise ScanError(
                f"{cloud.where}: has no column ring, and only {rings.sure:.0%} of its points are "
                "sure of one: give another --to"
            )
        cloud = cloud.with_column("ring", rings.ring)
    if suffix == ".pcd.bin":
        cloud = cloud.with_column("ring", _from_lowest(cloud))
    return WRITERS[suffix](cloud, full_intensity)


def _from_lowest(cloud: PointCloud) -> NDArray[np.integer]:
    """Rings of a cloud, counted from the lowest beam, as in nuScenes."""
    assert cloud.ring is not None
    x, y, z = cloud.points.T.astype(float)
    inclination_rad = np.arctan2(z, np.hypot(x, y))
    rises = ((cloud.ring - cloud.ring.mean()) * inclination_rad).sum() >= 0
    return cloud.ring if rises else cloud.ring.max() - cloud.ring


def _stem(path: Path) -> str:
    return path.name[: -len(suffix_of(path))]

"""Scans to estimate a sensor from, and the beams of their points.

Letters: P points, H beams, W columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarsim.cloud_formats import organised_points
from lidarsim.clouds import PointCloud, check_metres, read_cloud
from lidarsim.recorded import RecordedScan
from lidarsim.rings import Rings, rings_of
from lidarsim.scan_files import ScanError
from lidarsim.sensors.beams import BeamFit, fit_beams, nearest_line, search_beams
from lidarsim.weather import recorded_scan

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

LEAST_DISTANCE_M = 0.1  # of points of a beam, in the plane: nearer ones have no azimuth
_FEWEST_BEAMS = 4
_LEAST_SHARE = 0.6  # of the beams of the fullest scan; a scan with fewer is of another sensor
_FEW_POINTS = 0.1  # of a ring off its line
# Mean squares of the direction cosines: the flat axis of a turn, and least of the two others.
_FLAT_SHARE, _TURNED = 0.5, 0.1
_SAME_BEAM_SHARE = 0.15  # of the pitch between the same beam of two scans
WORKS_STILL = "`r3dpa data weather`, `r3dpa data view` and metrics on points still take such scans"


class SensorScan(NamedTuple):
    """A scan, and its columns where it is an organised array."""

    name: str
    cloud: PointCloud
    column: Indices | None  # (P,) of an organised array
    num_columns: int | None


class BeamPoints(NamedTuple):
    """Points of all scans, with their beams in any order."""

    xyz: Floats
    beam: Indices
    scan: Indices
    column: Indices | None
    how: str


def read_scan_of(scan: Any, number: int) -> SensorScan:
    """Scan of a file, cloud or array, see :func:`lidarsim.sensors.estimation.estimate_sensor`."""
    name, column, shape = f"scan {number}", None, None
    if isinstance(scan, PointCloud):
        cloud = scan
        name = cloud.where if cloud.file is not None else name
    elif isinstance(scan, (str, Path)):
        name, cloud = str(scan), read_cloud(scan, drop_nan=True, with_labels=False)
        organised = organised_points(Path(scan))
        if organised is not None:
            shape, column = organised.shape, _returns(organised)[1]
    else:
        array = np.asarray(scan)
        if array.ndim == 3:
            row, column = _returns(array)
            shape = array.shape
            cloud = PointCloud.of(array[row, column, :3], ring=row)
        else:
            cloud = PointCloud.of(array)
    check_metres(name, cloud.points)
    cloud = cloud.without_origin()
    _check_upright(name, cloud.points)
    if column is None or shape is None or len(column) != len(cloud):
        return SensorScan(name, cloud, None, None)
    return SensorScan(name, cloud, column, shape[1])


def _check_upright(name: str, points: NDArray) -> None:
    """Refuse a turn around another axis than z, as in the frame of a camera."""
    range_m = np.linalg.norm(points.astype(float), axis=1).clip(LEAST_DISTANCE_M)
    x, y, z = np.square(points / range_m[:, None]).mean(axis=0)
    for axis, along, other in (("x", x, y), ("y", y, x)):
        if along < _FLAT_SHARE * z and min(other, z) > _TURNED:
            raise ScanError(
                f"{name}: the scan is flattest along {axis}: turn the points so that z points up, "
                "x forward and y left"
            )


def _returns(array: NDArray) -> tuple[Indices, Indices]:
    """Row and column of the returns of an organised array."""
    xyz = array[..., :3]
    row, column = np.nonzero(np.isfinite(xyz).all(axis=2) & xyz.any(axis=2))
    return row.astype(np.int64), column.astype(np.int64)


def combine(read: Sequence[SensorScan]) -> tuple[BeamPoints, list[str]]:
    """Points of all scans with their beams, and notes about the scans."""
    notes: list[str] = []
    rings = _with_searched_beams(read, [rings_of(recorded_scan(scan.cloud)) for scan in read])
    most = max(range(len(read)), key=lambda i: rings[i].num_rings)
    usual = rings[most].num_rings
    is_stored = all(ring.how == "stored" for ring in rings)
    odd = [i for i, ring in enumerate(rings) if ring.num_rings != usual]
    other = next((i for i in odd if rings[i].num_rings < _LEAST_SHARE * usual), None)
    if odd and not is_stored:
        rings, strange = _with_common_beams(read, rings, most)
        other = strange if other is None else other
        notes.append(f"{len(odd)} of {len(read)} scans show fewer than {usual} beams")
    if other is not None:
        raise ValueError(
            f"{read[most].name} shows {usual} beams, {read[other].name} "
            f"{rings[other].num_rings}: give scans of one sensor"
        )
    unsure = next((i for i, ring in enumerate(rings) if ring.sure == 0), None)
    if usual < _FEWEST_BEAMS or unsure is not None:
        name = read[unsure or 0].name
        raise ValueError(
            f"{name}: no beams found, as in scans of solid-state or non-repetitive LiDARs, which "
            f"have none; {WORKS_STILL}"
        )
    parts, columns = [], []
    for number, (scan, ring) in enumerate(zip(read, rings, strict=True)):
        beam = np.asarray(scan.cloud.ring).astype(np.int64) if is_stored else ring.ring
        xyz = scan.cloud.points.astype(float)
        keep = np.hypot(xyz[:, 0], xyz[:, 1]) > LEAST_DISTANCE_M
        parts.append((xyz[keep], beam[keep], np.full(np.count_nonzero(keep), number)))
        columns.append(None if scan.column is None else scan.column[keep])
    xyz, beam, place = (np.concatenate(column) for column in zip(*parts, strict=True))
    organised = [column for column in columns if column is not None]
    column = np.concatenate(organised) if len(organised) == len(columns) else None
    beam = np.unique(beam, return_inverse=True)[1]
    how = "a stored ring" if is_stored else "the " + rings[most].how
    return BeamPoints(xyz, beam, place, column, how), notes


def _with_searched_beams(read: Sequence[SensorScan], rings: list[Rings]) -> list[Rings]:
    """Rings of which those by the inclination of one scan are searched for in all of them.

    Where that fails, alice-lri searches in the first scan, if it is installed.
    """
    if all(ring.how != "inclination" for ring in rings):
        return rings
    counts = [len(scan.cloud) for scan in read]
    points = np.concatenate([scan.cloud.points.astype(np.float32) for scan in read])
    distance_m = np.hypot(points[:, 0].astype(float), points[:, 1]).clip(LEAST_DISTANCE_M)
    z_m = points[:, 2].astype(float)
    guess = rings_of(RecordedScan(points))
    if guess.num_rings < _FEWEST_BEAMS:
        return rings
    beam = search_beams(guess.ring, distance_m, z_m)
    if beam is None:
        beam = _beams_by_alice(points[: counts[0]], distance_m, z_m)
    if beam is None:
        return rings
    num_beams = int(beam.max()) + 1
    parts = np.split(beam, np.cumsum(counts)[:-1])
    return [
        ring._replace(ring=part, num_rings=num_beams, how="inclination", sure=1.0)
        for ring, part in zip(rings, parts, strict=True)
    ]


def _beams_by_alice(some: NDArray, distance_m: Floats, z_m: Floats) -> Indices | None:
    """Beam ``(P,)`` by the lines that alice-lri fits to some points ``(Q, 3)``, in minutes."""
    try:
        from alice_lri import estimate_intrinsics
    except ImportError:
        return None
    some = some[np.hypot(some[:, 0], some[:, 1]) > LEAST_DISTANCE_M].astype(float)
    lines = estimate_intrinsics(*(np.ascontiguousarray(axis) for axis in some.T)).scanlines
    inclination, height_m = (
        np.array([getattr(line, name) for line in lines])
        for name in ("vertical_angle", "vertical_offset")
    )
    beam, _ = nearest_line(inclination, height_m, distance_m, z_m)
    return np.unique(beam, return_inverse=True)[1]


def _with_common_beams(
    read: Sequence[SensorScan], rings: list[Rings], most: int
) -> tuple[list[Rings], int | None]:
    """Rings numbered alike in all scans, by their inclination, as some scans lack some beams.

    The second value is a scan most of whose beams are none of the others, or None.
    """
    lines = _fit(read[most], rings[most])
    known, height_m = lines.inclination, lines.height_m
    strange, numbered = None, list(rings)
    for number in sorted(range(len(read)), key=lambda i: -rings[i].num_rings):
        ring = rings[number].ring
        lines = _fit(read[number], rings[number])
        near = _SAME_BEAM_SHARE * np.median(-np.diff(np.sort(known)[::-1]))
        is_new = np.abs(lines.inclination[:, None] - known).min(axis=1) > near
        if 2 * np.count_nonzero(is_new) > len(is_new):
            strange = number
        # Sparse beams without a wrap between them are one ring, far from a line.
        off_line = np.bincount(ring, np.abs(lines.residual) > near) / np.bincount(ring)
        is_new &= off_line < _FEW_POINTS
        known = np.append(known, lines.inclination[is_new])
        height_m = np.append(height_m, lines.height_m[is_new])
        beam, _ = nearest_line(known, height_m, *_place(read[number]))
        numbered[number] = rings[number]._replace(ring=beam)
    return numbered, strange


def _place(scan: SensorScan) -> tuple[Floats, Floats]:
    """Distance in the horizontal plane, and height, of the points ``(P,)``."""
    xyz = scan.cloud.points.astype(float)
    return np.hypot(xyz[:, 0], xyz[:, 1]).clip(LEAST_DISTANCE_M), xyz[:, 2]


def _fit(scan: SensorScan, rings: Rings) -> BeamFit:
    return fit_beams(rings.ring, *_place(scan))

"""Estimate of a spinning LiDAR from its scans.

Letters: P points, H beams.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarsim.cloud_formats import ODD_SHARE
from lidarsim.ground import ground_around, plane_of
from lidarsim.io import number_of
from lidarsim.scan_folders import find_files
from lidarsim.sensors.beams import MORE_THAN_A_TURN, BeamFit, ColumnFit, fit_beams, fit_columns
from lidarsim.sensors.files import SensorFile, write_sensor
from lidarsim.sensors.recordings import (
    WORKS_STILL,
    BeamPoints,
    SensorScan,
    combine,
    read_scan_of,
)
from lidarsim.sensors.spinning import Lasers, SpinningLidar

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

_NEAR_LINE_SHARE, _NEAR_LINE_DEG = 0.15, 0.02  # of the pitch, and of the angle, around a beam
# Of the pitch, where beams are known: compensation of motion smears points over less than that.
_KNOWN_BEAM_SHARE = 0.5
_FEWEST_NEAR_SHARE = 0.6
_SMEAR_DEG = 0.02
_MIXED_SHARE = 0.3  # of the pitch between the beams of one scan and of all scans
_COHERENT = 0.5
_DOUBLE_SHARE = 0.05
_SECTOR_DEG, _WHOLE_TURN_DEG = 2, 350
_FEW_POINTS = 0.02  # of the median of all degrees of azimuth: a blind sector has fewer
_VEHICLE_HEIGHT_M = 0.5  # more above the origin: frame of a vehicle
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


class Mount(NamedTuple):
    """Ground around the sensor."""

    height_m: float  # of the origin above the ground
    pitch_deg: float  # slope of the ground ahead
    roll_deg: float  # slope of the ground to the left
    spread_m: float  # standard deviation of the height over scans


@dataclass(frozen=True, eq=False)
class SensorEstimate:
    """A sensor as scans show it.

    Args:
        sensor: Its beams, columns, range limits and height; the rest are the defaults of
            :class:`SpinningLidar`.
        num_scans: Number of scans that were combined.
        beams_by: ``a stored ring``, ``the order`` or ``the inclination``, see
            :func:`lidarsim.rings.rings_of`.
        confidence: Share from 0 to 1 by quantity.
        residual_deg: ``(H, 5)`` quantiles 5, 25, 50, 75 and 95 % of the angle of the points of each
            beam to its line, degrees.
        direction: ``clockwise`` or ``counter-clockwise`` seen from above; None if unknown.
        blind_sectors_deg: From and to of azimuths without points.
        dropped_share: Missing shots on surfaces, as a share of all.
        full_intensity: Full scale of the intensities; None without intensities.
        mount: None if too little ground is seen.
        notes: What to know about the scans.
    """

    sensor: SpinningLidar
    num_scans: int
    beams_by: str
    confidence: Mapping[str, float]
    residual_deg: Floats
    direction: str | None
    blind_sectors_deg: tuple[tuple[int, int], ...]
    dropped_share: float
    full_intensity: float | None
    mount: Mount | None
    notes: tuple[str, ...]

    def save(self, path: str | Path, name: str = "") -> None:
        """Write a YAML file that ``load_sensor`` reads."""
        source = f"estimated from {number_of(self.num_scans, 'scan')}"
        write_sensor(path, SensorFile(name or Path(path).stem, source, self.sensor), self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """Return mount, confidences and other findings beside the sensor, as plain values."""
        mount = None
        if self.mount is not None:
            mount = {name: round(value, 4) for name, value in self.mount._asdict().items()}
        return {
            "scans": self.num_scans,
            "beams_by": self.beams_by,
            "confidence": {name: round(value, 4) for name, value in self.confidence.items()},
            "rotation": self.direction or "unknown",
            "blind_sectors_deg": [list(sector) for sector in self.blind_sectors_deg],
            "dropped_share": round(self.dropped_share, 5),
            "full_intensity": self.full_intensity,
            "mount": mount,
            "notes": list(self.notes),
        }

    def rows(self) -> list[list[str]]:
        """Quantity, value and confidence, for a table."""
        lasers, sensor = self.sensor.lasers, self.sensor
        degrees = np.degrees(lasers.inclination_rad)
        off_deg = np.degrees(np.ptp(lasers.azimuth_offset_rad))
        sectors = ", ".join(f"{start} to {end}" for start, end in self.blind_sectors_deg)
        low_m, high_m = min(lasers.height_m), max(lasers.height_m)
        values = {
            "beams": f"{len(degrees)} by {self.beams_by}",
            "inclination": f"{degrees[0]:.3f} to {degrees[-1]:.3f} degrees",
            "optical centres": f"{low_m:.3f} to {high_m:.3f} m above the origin",
            "azimuth offsets": f"within {off_deg:.3f} degrees",
            "columns": f"{sensor.shots}",
            "range": f"{sensor.min_range_m:.2f} to {sensor.max_range_m:.1f} m",
            "rotation": self.direction or "unknown",
            "blind sectors": f"{sectors} degrees" if sectors else "none",
            "dropped shots": f"{self.dropped_share:.2%} of those on surfaces",
        }
        if self.full_intensity is not None:
            values["intensity"] = f"full scale {self.full_intensity:g}"
        if self.mount is not None:
            values["mount"] = (
                f"{self.mount.height_m:.2f} m above the ground, which rises by "
                f"{self.mount.pitch_deg:.1f} degrees ahead, {self.mount.roll_deg:.1f} to the left"
            )
        rows = []
        for quantity, value in values.items():
            share = self.confidence.get(quantity)
            rows.append([quantity, value, "" if share is None else f"{share:.0%}"])
        return rows


def estimate_sensor(scans: Sequence[Any] | str | Path) -> SensorEstimate:
    """Estimate the sensor that recorded scans, all of one sensor.

    Beams come from a ring column or the rows of an organised array; otherwise from the order of the
    file, or of the peaks of the inclination. Each beam is then a line in the plane of distance and
    height, so that its optical centre is known too. Azimuth offsets are those within one column,
    unless the array is organised, where they are those from the direction of the column.

    Args:
        scans: File or folder of scans, or a sequence of files, :class:`PointCloud` or arrays:
            ``(P, 3)``, ``(P, 4)`` with intensity, or organised ``(H, W, 3)``, 0 without return.

    Raises:
        ValueError: If the scans are of different sensors, or not of a spinning LiDAR.
    """
    if isinstance(scans, (str, Path)):
        scans = find_files(Path(scans))[1]
    if not len(scans):
        raise ValueError("no scans given")
    read = [read_scan_of(scan, number) for number, scan in enumerate(scans)]
    widths = {scan.num_columns for scan in read if scan.num_columns}
    if len(widths) > 1:
        named = " and ".join(map(str, sorted(widths)))
        raise ValueError(f"the scans have {named} columns: give scans of one mode")
    points, notes = combine(read)
    distance_m = np.hypot(points.xyz[:, 0], points.xyz[:, 1])
    beams = fit_beams(points.beam, distance_m, points.xyz[:, 2])
    points, beams = _highest_first(points, beams)
    near_share = _check_spinning(points, beams)
    notes += _disagreement(points, beams, [scan.name for scan in read])
    notes += _notes_on_beams(beams)

    azimuth = np.arctan2(points.xyz[:, 1], points.xyz[:, 0])
    columns = fit_columns(points.beam, azimuth, distance_m, points.scan)
    direction, head = _rotation(read, points, azimuth)
    num_columns, offset, sure_columns = columns.columns, columns.offset, columns.coherence
    if points.column is not None and head is not None:
        num_columns, sure_columns = int(read[0].num_columns or 0), 1.0
        turned = azimuth - columns.lateral_m[points.beam] / distance_m - head
        offset = _offsets(points, turned, 2 * math.pi / num_columns)
    sectors, covered_deg = _blind_sectors(azimuth)
    notes += _notes_on_columns(columns, covered_deg)

    height_m, mount, mount_notes = _mount(read, beams)
    up_m = float((beams.height_m - height_m)[0])  # of the sensor in the frame of a vehicle
    range_m = np.sqrt(np.square(points.xyz - (0, 0, up_m)).sum(axis=1))
    settings: dict[str, Any] = {} if mount is None else {"mount_height_m": round(mount.height_m, 4)}
    sensor = SpinningLidar(
        _lasers(beams, columns, offset, height_m),
        num_columns,
        min_range_m=math.floor(100 * range_m.min()) / 100,
        max_range_m=math.ceil(10 * range_m.max()) / 10,
        return_mode="dual" if columns.double_share > _DOUBLE_SHARE else "strongest",
        **settings,
    )
    confidence = {
        "beams": near_share,
        "inclination": near_share,
        "optical centres": near_share * float(beams.is_sure_height.mean()),
        "azimuth offsets": sure_columns,
        "columns": sure_columns,
    }
    if mount is not None:
        confidence["mount"] = float(np.exp(-mount.spread_m / 0.1))
    return SensorEstimate(
        sensor,
        len(read),
        points.how,
        confidence,
        _residual_quantiles(points.beam, beams.residual),
        direction,
        sectors,
        columns.dropped_share,
        _full_intensity(read),
        mount,
        tuple(notes + mount_notes),
    )


def _notes_on_beams(beams: BeamFit) -> list[str]:
    """Notes on points off their beams, and on optical centres that the ranges do not show."""
    notes = []
    smear_deg = float(np.degrees(np.median(np.abs(beams.residual))))
    if smear_deg > _SMEAR_DEG:
        notes.append(
            f"points lie {smear_deg:.3f} degrees (median) off their beams, as in scans compensated "
            "for motion: raw scans give better angles and centres"
        )
    if not beams.is_sure_height.all():
        num = np.count_nonzero(~beams.is_sure_height)
        notes.append(
            f"{num} of {len(beams.is_sure_height)} beams see one distance: their optical centres "
            "are interpolated"
        )
    return notes


def _notes_on_columns(columns: ColumnFit, covered_deg: int) -> list[str]:
    """Notes on columns, turns, sectors and second returns; ``covered_deg`` degrees have points."""
    notes = []
    if columns.coherence < _COHERENT:
        notes.append("azimuths lie on no common steps: the columns follow from the mean step")
    if columns.turns > MORE_THAN_A_TURN:
        notes.append(
            f"a scan is {360 * columns.turns:.0f} degrees long: directions that it sees twice have "
            "one pixel in an image"
        )
    if covered_deg < _WHOLE_TURN_DEG:
        notes.append(f"the scans cover {covered_deg} of 360 degrees; columns are of a whole turn")
    if columns.double_share > _DOUBLE_SHARE:
        notes.append(f"{columns.double_share:.0%} of the points are second returns of a shot")
    return notes


def _highest_first(points: BeamPoints, beams: BeamFit) -> tuple[BeamPoints, BeamFit]:
    order = np.argsort(-beams.inclination, kind="stable")
    points = points._replace(beam=np.argsort(order)[points.beam])
    return points, BeamFit(
        beams.inclination[order],
        beams.height_m[order],
        beams.is_sure_height[order],
        beams.residual,
    )


def _pitch(inclination: Floats) -> Floats:
    """Distance ``(H,)`` of each beam to its nearest neighbour."""
    gap = -np.diff(inclination)
    return np.minimum(np.append(gap, np.inf), np.append(np.inf, gap))


def _check_spinning(points: BeamPoints, beams: BeamFit) -> float:
    """Share of the points near the line of their beam; ValueError if there are no such lines."""
    pitch, off = float(np.median(_pitch(beams.inclination))), np.abs(beams.residual)
    near = max(_NEAR_LINE_SHARE * pitch, math.radians(_NEAR_LINE_DEG))
    share = float((off < near).mean())
    is_guess = points.how.endswith("inclination")
    loose_share = share if is_guess else float((off < _KNOWN_BEAM_SHARE * pitch).mean())
    if loose_share < _FEWEST_NEAR_SHARE:
        raise ValueError(
            f"only {loose_share:.0%} of the points lie on {len(beams.inclination)} beams found by "
            f"{points.how}: the scans are of a solid-state or non-repetitive LiDAR, or shuffled; "
            f"give scans in their original order or with a ring column, or install "
            f"'r3dpa[sensor]', which looks for beams longer. {WORKS_STILL}"
        )
    return share


def _disagreement(points: BeamPoints, beams: BeamFit, names: Sequence[str]) -> list[str]:
    """Note about the scan whose beams lie farthest from the common ones."""
    numbers = np.unique(points.scan)
    if len(numbers) < 2:
        return []
    num_beams, largest = len(beams.inclination), (0.0, 0.0, 0)
    for number in numbers:
        rows = np.flatnonzero(points.scan == number)
        order = rows[np.argsort(points.beam[rows], kind="stable")]
        counts = np.bincount(points.beam[rows], minlength=num_beams)
        groups = np.split(beams.residual[order], np.cumsum(counts))
        median = np.array([np.median(group) if len(group) else 0.0 for group in groups[:num_beams]])
        typical = float(np.median(np.abs(median)))
        largest = max(largest, (typical, float(np.abs(median).max()), int(number)))
    typical, most, number = largest
    if typical > _MIXED_SHARE * np.median(_pitch(beams.inclination)):
        raise ValueError(
            f"{names[number]}: its beams lie {np.degrees(typical):.2f} degrees from the beams of "
            "the other scans: give scans of one sensor"
        )
    return [
        f"beams of single scans lie within {np.degrees(most):.4f} degrees of the beams of all "
        f"{len(numbers)} (largest in {names[number]})"
    ]


def _rotation(
    read: Sequence[SensorScan], points: BeamPoints, azimuth: Floats
) -> tuple[str | None, Floats | None]:
    """Direction of rotation, and azimuth of the head at each point of organised arrays."""
    head = None
    first = read[0].cloud
    if points.column is not None:
        order = np.lexsort((points.column, points.beam, points.scan))
        sign = _sign(azimuth[order], points.beam[order])
        head = sign * 2 * math.pi * points.column / int(read[0].num_columns or 1)
    elif first.time_s is not None and np.ptp(first.time_s) > 0:
        beams = np.zeros(len(first)) if first.ring is None else first.ring
        by_time = np.argsort(first.time_s, kind="stable")
        order = by_time[np.argsort(beams[by_time], kind="stable")]
        xyz = first.points.astype(float)
        sign = _sign(np.arctan2(xyz[:, 1], xyz[:, 0])[order], beams[order])
    elif first.ring is not None and (np.diff(first.ring) != 0).mean() > 0.5:
        # Firing after firing, in the order of time.
        rows = np.flatnonzero(points.scan == points.scan[0])
        order = rows[np.argsort(points.beam[rows], kind="stable")]
        sign = _sign(azimuth[order], points.beam[order])
    else:
        return None, None
    return ("counter-clockwise" if sign > 0 else "clockwise"), head


def _sign(azimuth: Floats, beam: NDArray) -> float:
    """Sign of the usual step of azimuth within beams."""
    step = (np.diff(azimuth) + math.pi) % (2 * math.pi) - math.pi
    return float(np.sign(np.median(step[np.diff(beam) == 0])))


def _offsets(points: BeamPoints, turned: Floats, column_rad: float) -> Floats:
    """Azimuth offset ``(H,)`` from the head, whose mean is less than half a column."""
    num_beams = int(points.beam.max()) + 1
    real = np.bincount(points.beam, np.cos(turned), num_beams)
    imaginary = np.bincount(points.beam, np.sin(turned), num_beams)
    offset = np.arctan2(imaginary, real)
    middle = math.atan2(np.sin(offset).mean(), np.cos(offset).mean())
    middle = round(middle / column_rad) * column_rad  # whole columns, to keep the steps of azimuth
    return (offset - middle + math.pi) % (2 * math.pi) - math.pi


def _blind_sectors(azimuth: Floats) -> tuple[tuple[tuple[int, int], ...], int]:
    """Sectors without points from and to whole degrees, and degrees that hold points."""
    counts = np.bincount(
        np.floor(np.degrees(azimuth % (2 * math.pi))).astype(int) % 360, minlength=360
    )
    is_blind = counts < _FEW_POINTS * np.median(counts[counts > 0])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_blind.astype(int), [0]])))
    sectors = [(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= _SECTOR_DEG]
    return tuple(sectors), int(360 - sum(b - a for a, b in sectors))


def _mount(read: Sequence[SensorScan], beams: BeamFit) -> tuple[Floats, Mount | None, list[str]]:
    """Height of the optical centres, ground, and notes about the frame."""
    notes, height_m = [], beams.height_m
    shift_m = float(np.median(height_m))
    is_shifted = abs(shift_m) > _VEHICLE_HEIGHT_M
    grounds = [ground_around(scan.cloud.points) for scan in read]
    planes = [plane_of(ground) for ground in grounds if ground is not None]
    if is_shifted:
        notes.append(
            f"the beams start {shift_m:.2f} m above the origin, as in the frame of a vehicle: "
            "subtract that, as all commands take the sensor as the origin"
        )
        height_m = height_m - shift_m
    if not planes:
        return (
            height_m,
            None,
            [*notes, "little ground is seen: the mount of the HDL-64E is assumed"],
        )
    slopes = np.median(planes, axis=0)
    heights = np.array([plane[2] for plane in planes])
    above_m = (shift_m if is_shifted else 0.0) - float(np.median(heights))
    if above_m <= 0:
        raise ValueError(
            f"{read[0].name}: the ground lies above the sensor: turn the points so that z points "
            "up, x forward and y left"
        )
    pitch_deg, roll_deg = (float(np.degrees(np.arctan(slope))) for slope in slopes[:2])
    return height_m, Mount(above_m, pitch_deg, roll_deg, float(heights.std())), notes


def _lasers(beams: BeamFit, columns: ColumnFit, offset: Floats, height_m: Floats) -> Lasers:
    inclination, least = beams.inclination.copy(), math.radians(1e-6)
    for number in range(1, len(inclination)):  # beams side by side, at the same inclination
        inclination[number] = min(inclination[number], inclination[number - 1] - least)
    zeros = np.zeros(len(offset))
    table = (inclination, offset, height_m, columns.lateral_m, zeros, zeros + 1)
    return Lasers(*(tuple(map(float, column)) for column in table))


def _residual_quantiles(beam: Indices, residual: Floats) -> Floats:
    order = np.argsort(beam, kind="stable")
    groups = np.split(residual[order], np.cumsum(np.bincount(beam))[:-1])
    return np.degrees([np.quantile(group, _QUANTILES) for group in groups])


def _full_intensity(read: Sequence[SensorScan]) -> float | None:
    columns = [scan.cloud.intensity for scan in read if scan.cloud.intensity is not None]
    if not columns:
        return None
    values = np.concatenate(columns)
    if values.dtype.kind == "f" and np.count_nonzero(values > 1) <= ODD_SHARE * len(values):
        return 1.0
    largest = float(values.max())
    return next((full for full in (255.0, 65535.0) if largest <= full), largest)

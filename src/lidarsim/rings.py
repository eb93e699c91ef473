"""Laser and shot of every point of a recorded scan."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from lidarsim.recorded import RecordedScan
from lidarsim.ring_order import rings_in_order
from lidarsim.sensors.view import LidarSensor, angles_of, phase_of

How = Literal["stored", "order", "inclination"]
_MOST_BEAMS = 256
# Histogram of the inclinations: bins, smoothing, and the least height of a peak over its valleys.
_BIN_DEG, _BLUR_BINS, _PROMINENCE = 0.01, 3.0, 0.1
# Points farther from the middle of their ring than this share of the pitch are not sure.
_SURE_SHARE = 0.25
_LARGE_STEP_RAD = math.radians(5)
# A first pass has at least this many rings, and this share of its steps in one direction.
_FEWEST_RINGS, _ONE_WAY = 4, 0.9
_LEAP = 0.2  # over this share of the field of view
# Steps of inclination from ring to ring, as shares of the mean pitch; azimuths at which rings may
# start, of which the likeliest are tried.
_LEAST_STEP, _MOST_STEP, _SEAM_BINS, _MOST_SEAMS = 0.3, 3.0, 360, 12
# Median step of inclination along stored rings, over the standard deviation of all: at most 0.01 in
# scans of three sensors, in the frame of the vehicle too, and at least 0.4 in rings by chance.
_MOST_STEP_SHARE = 0.25


class Rings(NamedTuple):
    """Laser and shot of every point, and how they were found."""

    ring: NDArray[np.int64]  # (P,) in [0, num_rings), 0 the highest
    shot: NDArray[np.int64]  # (P,) in [0, num_shots), counter-clockwise from ahead
    num_rings: int
    num_shots: int
    how: How
    sure: float  # share of the points whose ring is sure, see ``rings_of``


def rings_of(scan: RecordedScan) -> Rings:
    """Laser and shot of every point: stored, by the order of the file, or by the inclination.

    ``stored``
        The column of the file. All points are sure; none is if there are more than 256 rings, or
        if points of a ring with almost the same azimuth have unrelated inclinations.
    ``order``
        Files that hold ring after ring: a ring ends where the azimuth wraps, in either direction,
        at azimuth 0 or where the rings of the file start.
        Points that follow their predecessor by at most 5 degrees are sure. Points after the last
        ring, such as those that weather adds, have the ring of the nearest inclination.
    ``inclination``
        Peaks of the histogram of the inclination. Points within a quarter of the pitch of their
        peak are sure. Optical centres far from each other blur the peaks: many points of a
        shuffled HDL-64E scan are not.

    Rings are numbered by their mean inclination. The number of shots follows from the median step
    of azimuth within the rings. Points at (0, 0, 0), which are no returns, have ring and shot 0.
    """
    is_return = scan.points.any(axis=1)
    if not is_return.all() and is_return.any():
        ring_column = None if scan.ring is None else scan.ring[is_return]
        rings = rings_of(RecordedScan(scan.points[is_return], ring=ring_column))
        ring, shot = np.zeros((2, len(scan)), np.int64)
        ring[is_return], shot[is_return] = rings.ring, rings.shot
        return rings._replace(ring=ring, shot=shot)
    inclination, azimuth = angles_of(scan.points)
    azimuth %= 2 * np.pi
    if scan.ring is None:
        ring, how, sure = _in_order(inclination, azimuth) or _by_inclination(inclination)
    else:
        ring = np.unique(scan.ring, return_inverse=True)[1]
        how = "stored"
        sure = 1.0
    mean = np.bincount(ring, inclination) / np.bincount(ring)
    ring = np.argsort(np.argsort(-mean))[ring]
    order = np.lexsort((azimuth, ring))
    is_beside = np.diff(ring[order]) == 0
    if how == "stored":
        is_apart = np.abs(np.diff(inclination[order])) > _MOST_STEP_SHARE * inclination.std()
        num_apart = np.count_nonzero(is_apart & is_beside)
        by_chance = 2 * num_apart > np.count_nonzero(is_beside)
        sure = 0.0 if by_chance or len(mean) > _MOST_BEAMS else 1.0
    step = np.diff(azimuth[order])[is_beside]
    step = step[step > 1e-5]
    num_shots = round(2 * math.pi / float(np.median(step))) if len(step) else 1
    # Columns begin halfway between shots, so that rounding moves no shot to the next one.
    offset, _ = phase_of(ring, azimuth, num_shots, len(mean))
    shot = np.rint((azimuth - offset[ring]) / (2 * np.pi) * num_shots).astype(np.int64) % num_shots
    return Rings(ring, shot, len(mean), num_shots, how, sure)


def _in_order(
    inclination: NDArray[np.float64], azimuth: NDArray[np.float64]
) -> tuple[NDArray[np.int64], How, float] | None:
    """Rings of a file that holds ring after ring, in either direction; None for another order."""
    low, high = np.degrees(np.quantile(inclination, [0.001, 0.999]))
    limits = {
        "inclination_min_deg": max(low - 0.5, -90.0),
        "inclination_max_deg": min(high + 0.5, 90.0),
    }
    sensor = LidarSensor(_MOST_BEAMS // 2, **limits)
    for turned in (azimuth, -azimuth % (2 * np.pi)):
        with suppress(ValueError):
            ring, turned = _from_seam(inclination, turned, sensor)
            num_first = _first_pass(ring, inclination)
            step = np.diff(turned[:num_first])[np.diff(ring[:num_first]) == 0]
            sure = float((np.abs(step) < _LARGE_STEP_RAD).mean()) if len(step) else 0.0
            if num_first < len(ring):
                first = ring[:num_first]
                ring = np.append(first, _nearest_ring(inclination, first)[num_first:])
                sure *= num_first / len(ring)
            return ring, "order", sure
    return None


def _from_seam(
    inclination: NDArray[np.float64], azimuth: NDArray[np.float64], sensor: LidarSensor
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rings ``(P,)`` from the wraps of the azimuth, and the azimuth from where rings start.

    A cut at another azimuth splits the first ring and the last one, so that there is one ring more.
    """
    ring, num_rings = rings_in_order(inclination, azimuth, sensor)
    pitch = float(np.ptp(np.quantile(inclination, [0.001, 0.999]))) / num_rings
    at_wraps = np.diff(inclination)[np.diff(ring) != 0]
    if len(at_wraps) and abs(np.median(at_wraps)) < _LEAST_STEP * pitch:
        for seam in _likely_seams(inclination, azimuth, pitch):
            from_seam = (azimuth - seam) % (2 * np.pi)
            with suppress(ValueError):
                other, num_other = rings_in_order(inclination, from_seam, sensor)
                if num_other < num_rings:
                    return other, from_seam
    return ring, azimuth


def _likely_seams(
    inclination: NDArray[np.float64], azimuth: NDArray[np.float64], pitch: float
) -> Iterator[float]:
    """Yield azimuths at which many rings may end, radians, the likeliest first.

    There the inclination steps by about the pitch, all over the scan in one direction.
    """
    step, turn = np.diff(inclination), np.diff(azimuth)
    is_step = (np.abs(step) > _LEAST_STEP * pitch) & (np.abs(step) < _MOST_STEP * pitch)
    is_step &= np.abs(turn) < 2 * np.pi / _SEAM_BINS
    sign, middle = np.sign(step[is_step]), (azimuth[:-1] + turn / 2)[is_step]
    place = (middle / (2 * np.pi) * _SEAM_BINS).astype(np.int64) % _SEAM_BINS
    balance = np.bincount(place, sign, _SEAM_BINS)
    for likely in np.argsort(-np.abs(balance))[:_MOST_SEAMS]:
        is_here = (place == likely) & (sign == np.sign(balance[likely]))
        if is_here.any():
            yield float(np.median(middle[is_here]))


def _first_pass(ring: NDArray[np.int64], inclination: NDArray[np.float64]) -> int:
    """Return the number of points before the rings start again, as added points of weather do.

    There the inclination leaps back over a part of the rings, which until then lead one way.
    """
    mean = np.bincount(ring, inclination) / np.bincount(ring)
    step = np.diff(mean)
    for last in range(_FEWEST_RINGS - 1, len(step)):
        way = np.sign(mean[last] - mean[0])
        leaps_back = -way * step[last] > _LEAP * abs(mean[last] - mean[0])
        # Rings that are stored in another order leap too, but soon, and most of them follow.
        if leaps_back and (way * step[:last] > 0).mean() > _ONE_WAY and 2 * last + 2 >= len(mean):
            return int(np.searchsorted(ring, last + 1))
    return len(ring)


def _nearest_ring(inclination: NDArray[np.float64], known: NDArray[np.int64]) -> NDArray[np.int64]:
    """Ring of each point ``(P,)`` by the mean inclination of the rings of the first points."""
    mean = np.bincount(known, inclination[: len(known)]) / np.bincount(known)
    order = np.argsort(mean)
    borders = (mean[order][1:] + mean[order][:-1]) / 2
    return order[np.searchsorted(borders, inclination)]


def _by_inclination(inclination: NDArray[np.float64]) -> tuple[NDArray[np.int64], How, float]:
    """Rings by the peaks of the histogram, and the share of points near their middle."""
    from scipy.signal import find_peaks  # half a second, which most commands do not need

    angle = np.degrees(inclination) / _BIN_DEG
    first = math.floor(angle.min()) - 10
    place = np.floor(angle).astype(np.int64) - first
    density = gaussian_filter1d(np.bincount(place, minlength=place.max() + 10) + 0.0, _BLUR_BINS)
    peaks, _ = find_peaks(density, prominence=_PROMINENCE * np.quantile(density[place], 0.5))
    if len(peaks) < 2:
        return np.zeros(len(angle), dtype=np.int64), "inclination", 0.0
    middles = peaks + first + 0.5
    ring = np.searchsorted((middles[1:] + middles[:-1]) / 2, angle)
    pitch = np.gradient(middles)[ring]
    sure = float((np.abs(angle - middles[ring]) < _SURE_SHARE * pitch).mean())
    return ring, "inclination", sure

"""Laser and shot of every point of a recorded scan."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from r3dpa.weather.recorded import RecordedScan

_MOST_BEAMS = 256
# Histogram of the inclinations: bins, smoothing, and the least height of a peak over its valleys.
_BIN_DEG, _BLUR_BINS, _PROMINENCE = 0.01, 3.0, 0.1
# Points farther from the middle of their ring than this share of the pitch are not sure.
_SURE_SHARE = 0.25
_LARGE_STEP_RAD = math.radians(5)


class Rings(NamedTuple):
    """Laser and shot of every point, and how they were found."""

    ring: NDArray[np.int64]  # (P,) in [0, num_rings), 0 the highest
    shot: NDArray[np.int64]  # (P,) in [0, num_shots), counter-clockwise from ahead
    num_rings: int
    num_shots: int
    how: Literal["stored", "order", "inclination"]
    sure: float  # share of the points whose ring is sure, see ``rings_of``


def rings_of(scan: RecordedScan) -> Rings:
    """Laser and shot of every point: stored, by the order of the file, or by the inclination.

    ``stored``
        The column of the file, in the order of the mean inclination. All points are sure.
    ``order``
        Files that hold ring after ring: a ring ends where the azimuth wraps, in either direction.
        Points that follow their predecessor by at most 5 degrees are sure.
    ``inclination``
        Peaks of the histogram of the inclination. Points within a quarter of the pitch of their
        peak are sure. Optical centres far from each other blur the peaks: many points of a
        shuffled HDL-64E scan are not.

    The number of shots is that of the median step of azimuth within the rings.
    """
    inclination, azimuth = angles(scan.points)
    if scan.ring is not None:
        _, ring = np.unique(scan.ring, return_inverse=True)
        return _rings(ring, inclination, azimuth, "stored", 1.0)
    for turned in (azimuth, -azimuth % (2 * np.pi)):
        in_order = _in_order(inclination, turned)
        if in_order is not None:
            step = np.diff(turned)[np.diff(in_order) == 0]
            sure = float((np.abs(step) < _LARGE_STEP_RAD).mean()) if len(step) else 0.0
            return _rings(in_order, inclination, azimuth, "order", sure)
    ring, sure = _by_inclination(inclination)
    return _rings(ring, inclination, azimuth, "inclination", sure)


def angles(points: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Inclination and azimuth in [0, 2 pi) of points ``(P, 3)``, each ``(P,)`` radians."""
    x, y, z = points.T.astype(float)
    return np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x) % (2 * np.pi)


def _in_order(
    inclination: NDArray[np.float64], azimuth: NDArray[np.float64]
) -> NDArray[np.int64] | None:
    """Rings of a file that holds ring after ring; None for another order."""
    low, high = np.degrees(np.quantile(inclination, [0.001, 0.999]))
    limits = {"inclination_min_deg": low - 0.5, "inclination_max_deg": high + 0.5}
    import torch  # not for the options of the commands

    from r3dpa.geometry import LidarSensor
    from r3dpa.geometry.rings import rings_in_order

    sensor = LidarSensor(_MOST_BEAMS // 2, **limits)
    try:
        ring, _ = rings_in_order(torch.from_numpy(inclination), torch.from_numpy(azimuth), sensor)
    except ValueError:
        return None
    return ring.numpy()


def _by_inclination(inclination: NDArray[np.float64]) -> tuple[NDArray[np.int64], float]:
    """Rings by the peaks of the histogram, and the share of points near their middle."""
    angle = np.degrees(inclination) / _BIN_DEG
    first = math.floor(angle.min()) - 10
    place = np.floor(angle).astype(np.int64) - first
    density = gaussian_filter1d(np.bincount(place, minlength=place.max() + 10) + 0.0, _BLUR_BINS)
    peaks, _ = find_peaks(density, prominence=_PROMINENCE * np.quantile(density[place], 0.5))
    if len(peaks) < 2:
        return np.zeros(len(angle), dtype=np.int64), 0.0
    middles = peaks + first + 0.5
    ring = np.searchsorted((middles[1:] + middles[:-1]) / 2, angle)
    pitch = np.gradient(middles)[ring]
    return ring, float((np.abs(angle - middles[ring]) < _SURE_SHARE * pitch).mean())


def _rings(
    ring: NDArray[np.int64],
    inclination: NDArray[np.float64],
    azimuth: NDArray[np.float64],
    how: Literal["stored", "order", "inclination"],
    sure: float,
) -> Rings:
    """Rings numbered from the highest, and the shots."""
    count = np.bincount(ring)
    mean = np.bincount(ring, inclination) / count
    ring = (np.argsort(np.argsort(-mean)))[ring] if how == "stored" else ring
    if how != "stored" and mean[0] < mean[-1]:
        ring = len(mean) - 1 - ring
    order = np.lexsort((azimuth, ring))
    step = np.diff(azimuth[order])[np.diff(ring[order]) == 0]
    step = step[step > 1e-5]
    num_shots = round(2 * math.pi / float(np.median(step))) if len(step) else 1
    shot = np.floor(azimuth / (2 * np.pi) * num_shots).astype(np.int64) % num_shots
    return Rings(ring, shot, len(mean), num_shots, how, sure)

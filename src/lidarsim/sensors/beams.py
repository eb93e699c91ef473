"""Beams and columns of a spinning LiDAR, fitted to points whose beams are known.

Letters: P points, H beams. All angles in radians, azimuth counter-clockwise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from lidarsim.sensors.view import phase_of

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

_ROUNDS = 10  # of reweighted least squares
# The first rounds minimise the absolute residual of points that are not near.
_START_ROUNDS, _START_REACH = 4, 3.0
_TUKEY = 4.685  # times the scale of the residuals; beyond it a point has no weight
_LEAST_SCALE_RAD = 1e-6  # of float32 coordinates
_SURE_HEIGHT_M = 0.02  # heights of larger standard error are interpolated
_MOST_LATERAL_M = 0.1
_UNBROKEN = 1.35  # times the median step of azimuth
MORE_THAN_A_TURN = 1.01
_SAME_SURFACE = 0.05  # relative difference of distance of neighbours on a surface
_COLUMN_SEARCH = 0.03  # share of the first guess of the columns searched to both sides
# Search of beams: points this near to a line are on it, bins of further lines, least peak of them.
_SEARCHES, _NEAR_DEG, _BIN_DEG, _PEAK, _FEWEST_REST_SHARE = 12, 0.03, 0.01, 0.2, 1e-3
_MOST_BEAMS = 140  # of lines: 128 beams, and some that are merged later
_COHERENT = 0.5  # less, and azimuths lie on no common steps
_SOME_BEAMS = 16
_MOST_DROPPED = 3  # longer gaps are no dropped shots
_DOUBLE_STEP = 0.25  # of a column, below which two points of a beam are one shot


class BeamFit(NamedTuple):
    """Lines ``z = height + tan(inclination) * distance`` of beams."""

    inclination: Floats  # (H,)
    height_m: Floats  # (H,)
    is_sure_height: Mask  # (H,)
    #: (P,) inclination of each point seen from the centre of its beam, minus the beam's.
    residual: Floats


class ColumnFit(NamedTuple):
    """Steps in azimuth of beams."""

    columns: int
    coherence: float  # 1 if azimuths lie on equal steps, 0 if anywhere
    lateral_m: Floats  # (H,)
    offset: Floats  # (H,) azimuth within a column, in [0, 2 pi / columns); 0 where unknown
    dropped_share: float  # of the shots on surfaces
    double_share: float  # points of the same shot as their neighbour
    turns: float  # of the head within a scan; less where points are in another order


def fit_beams(beam: Indices, distance_m: Floats, z_m: Floats) -> BeamFit:
    """Fit the line of each beam by reweighted least squares (Tukey) in the angle.

    Args:
        beam: ``(P,)`` in ``[0, H)``, each with at least one point.
        distance_m: ``(P,)`` in the horizontal plane, positive.
        z_m: ``(P,)``.
    """
    tangent, inverse = z_m / distance_m, 1 / distance_m
    order = np.argsort(beam, kind="stable")
    starts = np.searchsorted(beam[order], np.arange(beam.max() + 2))
    slope, height_m, error_m = (np.zeros(len(starts) - 1) for _ in range(3))
    for number in range(len(slope)):
        rows = order[starts[number] : starts[number + 1]]
        slope[number], height_m[number], error_m[number] = _line(inverse[rows], tangent[rows])
    is_sure = error_m < _SURE_HEIGHT_M
    if is_sure.any() and not is_sure.all():
        rising = np.flatnonzero(is_sure)[np.argsort(slope[is_sure])]
        usual = np.interp(slope, slope[rising], height_m[rising])
        for number in np.flatnonzero(~is_sure).tolist():
            rows = order[starts[number] : starts[number + 1]]
            height_m[number] = usual[number]
            slope[number] = np.median(tangent[rows] - height_m[number] * inverse[rows])
    residual = np.arctan2(z_m - height_m[beam], distance_m) - np.arctan(slope)[beam]
    return BeamFit(np.arctan(slope), height_m, is_sure, residual)


def _line(x: Floats, y: Floats) -> tuple[float, float, float]:
    """Robust offset and slope of ``y`` over ``x``, and the standard error of the slope."""
    if len(x) < 3:
        return float(np.median(y)), 0.0, math.inf
    is_far = x <= _START_REACH * np.median(x)  # near points have a large say in the slope
    offset, slope, weight = float(np.median(y)), 0.0, is_far + 0.0
    spread = 0.0
    for attempt in range(_ROUNDS):
        total = weight.sum()
        mean_x, mean_y = (weight @ x) / total, (weight @ y) / total
        spread = float(weight @ np.square(x - mean_x))
        slope = float(weight @ ((x - mean_x) * (y - mean_y))) / spread if spread > 0 else 0.0
        offset = float(mean_y - slope * mean_x)
        residual = np.abs(y - offset - slope * x)
        scale = max(1.4826 * float(np.median(residual)), _LEAST_SCALE_RAD)
        weight = np.square((1 - np.square(residual / (_TUKEY * scale))).clip(0))
        if attempt < _START_ROUNDS:
            weight = is_far / np.maximum(residual, scale)
    error = scale / math.sqrt(spread) if spread > 0 else math.inf
    return offset, slope, error


def fit_columns(beam: Indices, azimuth: Floats, distance_m: Floats, scan: Indices) -> ColumnFit:
    """Fit columns per turn, lateral offset and azimuth offset of each beam.

    The step of azimuth is first measured between neighbours on a surface; their steps at edges of
    surfaces show the lateral offset of the beam. The number of columns is then the one near the
    first guess for which the azimuths of each beam and scan are most coherent::

        coherence(columns) = mean over beams of |mean over points of exp(i columns azimuth)|

    or the guess where the speed of the head varies too much for that.

    Args:
        beam: ``(P,)`` in ``[0, H)``.
        azimuth: ``(P,)``.
        distance_m: ``(P,)`` in the horizontal plane.
        scan: ``(P,)`` number of the scan of each point.

    Raises:
        ValueError: If no beam has neighbours in azimuth.
    """
    wrapped, inverse = azimuth % (2 * math.pi), 1 / distance_m
    order = np.lexsort((wrapped, beam, scan))
    before, after = order[:-1], order[1:]
    is_beside = (beam[before] == beam[after]) & (scan[before] == scan[after])
    before, after = before[is_beside], after[is_beside]
    step = wrapped[after] - wrapped[before]
    change = inverse[after] - inverse[before]
    is_level = np.abs(change) < _SAME_SURFACE * inverse[after]
    ahead = step[is_level & (step > 1e-5)]
    if len(ahead) == 0:
        raise ValueError("no beam has neighbouring points, so its columns are unknown")
    usual = float(np.median(ahead))
    turns = _turns(beam, azimuth, scan)
    column_rad = usual  # where shots of a second turn lie between the first ones
    if turns < MORE_THAN_A_TURN:
        column_rad = float(ahead[ahead < _UNBROKEN * usual].mean())

    num_beams = int(beam.max()) + 1
    lateral_m = _lateral(beam[before], step, change, column_rad, num_beams)
    straight = wrapped - lateral_m[beam] * inverse
    columns, coherence = _most_coherent(scan * num_beams + beam, straight, 2 * math.pi / column_rad)
    column_rad = 2 * math.pi / columns
    offset, agreement = phase_of(beam, straight, columns, num_beams)
    offset[agreement < _COHERENT] = 0.0

    shots = (straight[after] - straight[before]) / column_rad
    dropped_share = _dropped_share(shots[is_level])
    double_share = float((np.abs(shots) < _DOUBLE_STEP).sum() / len(azimuth))
    return ColumnFit(columns, coherence, lateral_m, offset, dropped_share, double_share, turns)


def _dropped_share(shots: Floats) -> float:
    """Share of dropped shots by the steps between neighbours on surfaces, in columns."""
    missing = np.rint(shots).astype(np.int64) - 1
    num_dropped = int(missing[(missing > 0) & (missing <= _MOST_DROPPED)].sum())
    return num_dropped / (num_dropped + len(shots))


def _turns(beam: Indices, azimuth: Floats, scan: Indices) -> float:
    """Turns of the head within a scan, by the steps of azimuth in the order of the file."""
    order = np.lexsort((beam, scan))
    group = (scan * (beam.max() + 1) + beam)[order]
    step = (np.diff(azimuth[order]) + math.pi) % (2 * math.pi) - math.pi
    is_beside = group[1:] == group[:-1]
    total = np.bincount(group[1:][is_beside], step[is_beside])
    return float(np.median(np.abs(total[np.unique(group[1:][is_beside])]))) / (2 * math.pi)


def _lateral(
    beam: Indices, step: Floats, change: Floats, column_rad: float, num_beams: int
) -> Floats:
    """Lateral offset ``(H,)`` by the steps of azimuth at small changes of the inverse distance."""
    rest = (step + column_rad / 2) % column_rad - column_rad / 2
    used = (np.abs(change) * _MOST_LATERAL_M < 0.45 * column_rad) & (step < 2.5 * column_rad)
    used &= np.abs(rest) < 0.45 * column_rad
    beam, rest, change = beam[used], rest[used], change[used]
    square = np.bincount(beam, np.square(change), num_beams)
    product = np.bincount(beam, change * rest, num_beams)
    lateral_m = np.divide(product, square, out=np.zeros(num_beams), where=square > 0)
    return lateral_m.clip(-_MOST_LATERAL_M, _MOST_LATERAL_M)


def _most_coherent(group: Indices, azimuth: Floats, guess: float) -> tuple[int, float]:
    """Most coherent number of columns near a guess; the guess if none is coherent.

    ``group`` is the scan and beam of each point, as turns of a real sensor start anywhere.
    """
    fullest = np.argsort(-np.bincount(group))[:_SOME_BEAMS]
    used = np.isin(group, fullest)
    group, azimuth = np.unique(group[used], return_inverse=True)[1], azimuth[used]
    reach = max(2, math.ceil(_COLUMN_SEARCH * guess))
    candidates = range(max(8, round(guess) - reach), round(guess) + reach + 1)
    num_groups = int(group.max()) + 1
    coherence = [
        float(phase_of(group, azimuth, columns, num_groups)[1].mean()) for columns in candidates
    ]
    best = int(np.argmax(coherence))
    if coherence[best] < _COHERENT:
        return round(guess), coherence[best]
    return candidates[best], coherence[best]


def search_beams(beam: Indices, distance_m: Floats, z_m: Floats) -> Indices | None:
    """Improve a guess of the beam ``(P,)`` of each point of an unordered scan.

    Lines are fitted to the guess and points given to the nearest line. Lines side by side are
    merged, and peaks of the inclination of the points on no line become further ones. None if
    points on no line are left in the end, as where optical centres lie far from each other.
    """
    near, bin_rad = math.radians(_NEAR_DEG), math.radians(_BIN_DEG)
    for _ in range(_SEARCHES):
        fit = fit_beams(beam, distance_m, z_m)
        order = np.argsort(-fit.inclination)
        is_new = np.append(True, np.diff(fit.inclination[order]) < -near)
        inclination, height_m = fit.inclination[order][is_new], fit.height_m[order][is_new]
        beam, off = nearest_line(inclination, height_m, distance_m, z_m)
        rest = np.flatnonzero(off > near)
        if len(rest) < _FEWEST_REST_SHARE * len(z_m):
            return np.unique(beam, return_inverse=True)[1]
        if len(inclination) > _MOST_BEAMS:
            break
        seen = np.arctan2(z_m[rest] - np.median(height_m), distance_m[rest])
        place = np.floor((seen - seen.min()) / bin_rad).astype(np.int64) + 5
        density = gaussian_filter1d(np.bincount(place, minlength=place.max() + 5) + 0.0, 1.0)
        peaks, _ = find_peaks(density, prominence=_PEAK * density.max())
        middle = seen.min() + (peaks - 4.5) * bin_rad
        if len(middle):
            nearest = np.searchsorted((middle[1:] + middle[:-1]) / 2, seen)
            is_close = np.abs(seen - middle[nearest]) < near
            beam[rest[is_close]] = len(inclination) + nearest[is_close]
        beam = np.unique(beam, return_inverse=True)[1]
    return None


def nearest_line(
    inclination: Floats, height_m: Floats, distance_m: Floats, z_m: Floats
) -> tuple[Indices, Floats]:
    """Line ``(P,)`` whose angle is nearest to each point, and the difference."""
    nearest, least = np.zeros(len(z_m), np.int64), np.full(len(z_m), np.inf)
    for number in range(len(inclination)):
        off = np.abs(np.arctan2(z_m - height_m[number], distance_m) - inclination[number])
        nearest[off < least] = number
        least = np.minimum(least, off)
    return nearest, least

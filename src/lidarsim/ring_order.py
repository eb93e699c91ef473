"""Rings of a scan that is stored ring after ring.

Letters: P points, R rings found.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lidarsim.sensors.view import LidarSensor

_BACKWARD_RAD = 1.0  # a smaller step back is jitter, a larger one starts the next ring
_STRAY_SHARE = 0.01  # a ring with fewer returns than this share of the median ring is no ring


def rings_in_order(
    inclination: NDArray[np.float64], azimuth: NDArray[np.float64], sensor: LidarSensor
) -> tuple[NDArray[np.int64], int]:
    """Ring ``(P,)`` of each return from the wraps of the azimuth, and the number of rings.

    ``inclination`` and ``azimuth`` are ``(P,)`` radians in the order of the file.

    Raises:
        ValueError: If the scan is not stored ring after ring.
    """
    if len(azimuth) == 0:
        return np.zeros(0, dtype=np.int64), 0
    turned = azimuth % (2 * math.pi)
    step = np.diff(turned, prepend=turned[:1])
    # Jitter may step back over the seam, which looks like a step ahead of almost a turn.
    turn = (step < -_BACKWARD_RAD).astype(np.int64) - (step > 2 * math.pi - _BACKWARD_RAD)
    if turn.sum() < 0:
        raise not_in_ring_order("the azimuth falls", sensor)
    if (num_wraps := np.count_nonzero(turn > 0)) > 2 * sensor.beams:
        raise not_in_ring_order(f"the azimuth wraps {num_wraps} times", sensor)
    ring = turn.cumsum()
    ring = ring - ring.min()
    counts = np.bincount(ring)
    stray = counts < _STRAY_SHARE * np.quantile(counts, 0.5, method="lower")
    ring = ((~stray).cumsum() - 1).clip(min=0)[ring]  # strays join the ring before them
    num_rings = int(ring.max()) + 1

    mean = _mean_per_ring(inclination, ring)
    variance = _mean_per_ring(np.square(inclination - mean[ring]), ring)
    spread = math.sqrt(np.quantile(variance, 0.5, method="lower"))
    # Inclinations spread evenly over the field of view have a deviation of 0.29 times it.
    if spread > sensor.field_of_view_rad / 6:
        deviation_deg = math.degrees(spread)
        reason = f"inclinations within one turn have a deviation of {deviation_deg:.1f} degrees"
        raise not_in_ring_order(reason, sensor)
    return ring, num_rings


def not_in_ring_order(reason: str, sensor: LidarSensor) -> ValueError:
    """Error of a scan that is not stored ring after ring."""
    return ValueError(
        f"the scan is not stored ring after ring (highest first, each by growing azimuth from 0): "
        f"{reason}, for a sensor of {sensor.beams} beams; keep the order of the original file, or "
        "use projection: beams with a sensor that has a name or a YAML of `r3dpa data sensor`, or "
        "projection: spherical, which need no order"
    )


def _mean_per_ring(values: NDArray[np.float64], ring: NDArray[np.int64]) -> NDArray[np.float64]:
    """Mean ``(R,)`` of values ``(P,)`` per ring; every ring in ``[0, R)`` has a return."""
    return np.bincount(ring, values) / np.bincount(ring)

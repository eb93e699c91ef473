"""Laser rings of scans that are stored ring after ring, from the azimuth of the returns."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from r3dpa.geometry.sensor import LidarSensor

_BACKWARD_RAD = 1.0  # a smaller step back is jitter, a larger one starts the next ring
_STRAY_SHARE = 0.01  # a ring with fewer returns than this share of the median ring is no ring


def rings_in_order(inclination: Tensor, azimuth: Tensor, sensor: LidarSensor) -> tuple[Tensor, int]:
    """Ring of each return from the turns of the azimuth, and the number of rings.

    Args:
        inclination: ``(P,)`` radians, returns in the order of the file.
        azimuth: ``(P,)`` radians.
        sensor: Number of beams and field of view, to recognise scans in another order.

    Returns:
        ``(P,)`` int64 from 0, and the number of rings.

    Raises:
        ValueError: If the returns are not stored ring after ring.
    """
    if len(azimuth) == 0:
        return torch.zeros_like(azimuth, dtype=torch.int64), 0
    step = (azimuth % (2 * math.pi)).diff(prepend=azimuth[:1] % (2 * math.pi))
    # Jitter may step back over the seam, which looks like a step ahead of almost a turn.
    turn = (step < -_BACKWARD_RAD).long() - (step > 2 * math.pi - _BACKWARD_RAD).long()
    if (num_wraps := int((turn > 0).sum())) > 2 * sensor.beams:
        raise _not_in_ring_order(f"the azimuth wraps {num_wraps} times", sensor)
    ring = turn.cumsum(0)
    ring = ring - ring.min()
    counts = torch.bincount(ring)
    stray = counts < _STRAY_SHARE * counts.median()
    ring = ((~stray).cumsum(0) - 1).clamp(min=0)[ring]  # strays join the ring before them
    num_rings = int(ring.max()) + 1

    mean = mean_per_ring(inclination, ring, num_rings)
    spread = mean_per_ring((inclination - mean[ring]).square(), ring, num_rings).sqrt().median()
    # Inclinations spread evenly over the field of view have a deviation of 0.29 times it.
    if spread > (sensor.inclination_max_rad - sensor.inclination_min_rad) / 6:
        found = f"inclinations within one turn have a deviation of {spread.rad2deg():.1f} degrees"
        raise _not_in_ring_order(found, sensor)
    return ring, num_rings


def match_in_order(measured: Tensor, known: Tensor) -> Tensor:
    """Beam of each measured ring: the order-keeping choice with the least sum of differences.

    Args:
        measured: ``(R,)`` mean inclinations of the rings found, radians, R <= H.
        known: ``(H,)`` inclinations of the beams, radians.

    Returns:
        ``(R,)`` int64, strictly increasing.
    """
    costs = (measured.cpu().unsqueeze(1) - known.unsqueeze(0)).abs()
    total, choices = costs[0], []
    for cost in costs[1:]:
        best_before, choice = torch.cummin(total[:-1], dim=0)
        total = torch.cat([cost[:1] + math.inf, cost[1:] + best_before])
        choices.append(choice)
    beams = [int(total.argmin())]
    for choice in reversed(choices):
        beams.append(int(choice[beams[-1] - 1]))
    return torch.tensor(beams[::-1])


def mean_per_ring(values: Tensor, ring: Tensor, num_rings: int) -> Tensor:
    """Mean of values per ring.

    Args:
        values: ``(P,)``, one per return.
        ring: ``(P,)`` int64 in ``[0, R)``, no ring without a return.
        num_rings: R.

    Returns:
        ``(R,)`` in the unit of ``values``.
    """
    sums = values.new_zeros(num_rings).index_add(0, ring, values)
    return sums / torch.bincount(ring, minlength=num_rings)


def _not_in_ring_order(found: str, sensor: LidarSensor) -> ValueError:
    return ValueError(
        f"the scan is not stored ring after ring: {found}, for a sensor of {sensor.beams} beams; "
        "keep the order of the original file, or use SphericalProjection, which needs no order"
    )

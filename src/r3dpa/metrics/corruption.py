"""Scans made worse by a known amount, and whether a metric notices.

A metric that is worth reporting worsens with every step of a ladder of corruptions. The same noise
is scaled from step to step, and what a step drops stays dropped in the next, so that the steps of a
scan differ in nothing but the amount.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from r3dpa.metrics.results import MetricResult

#: Standard deviations of the range noise, metres.
NOISE_M = (0.02, 0.05, 0.1, 0.2)
#: Shares of the points that are dropped.
DROPPED = (0.1, 0.3)
#: Turn about the vertical axis: a quarter, which moves no point between pixels of a row.
TURN_RAD = math.pi / 2


@dataclass(frozen=True)
class Corruption:
    """One way to make a scan worse.

    Args:
        ladder: Corruptions of one kind, by growing amount: ``noise``, ``drop``, ``rotation``.
        level: The amount, for a reader.
        apply: ``(points, scan name) -> points``, with points ``(P, 3)`` or ``(P, 4)``.
    """

    ladder: str
    level: str
    apply: Callable[[Tensor, str], Tensor]


def add_range_noise(points: Tensor, deviation_m: float, generator: torch.Generator) -> Tensor:
    """Points moved along their rays by normal noise, as an imprecise range measurement would.

    A point that the noise would carry through the sensor stops in it; one that lies in the sensor
    has no ray and stays.

    Args:
        points: ``(P, 3)`` or ``(P, 4)`` x, y, z in metres from the sensor, and what is kept.
        deviation_m: Standard deviation of the noise.
        generator: Gives one number per point, whatever the deviation.
    """
    range_m = points[:, :3].norm(dim=1, keepdim=True)
    noise_m = deviation_m * torch.randn(len(points), 1, generator=generator).to(points)
    factor = torch.where(range_m > 0, (range_m + noise_m).clamp(min=0) / range_m, 1.0)
    return torch.cat([points[:, :3] * factor, points[:, 3:]], dim=1)


def drop_points(points: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Points without a random share of them, each dropped or not by itself.

    Args:
        points: ``(P, F)``.
        share: Probability of each point to be dropped.
        generator: Gives one number per point, whatever the share: what a smaller share drops, a
            larger one drops, too.
    """
    return points[(torch.rand(len(points), generator=generator) >= share).to(points.device)]


def rotate_about_z(points: Tensor, angle_rad: float) -> Tensor:
    """Points turned about the vertical axis of the sensor, to the left where the angle is positive.

    Args:
        points: ``(P, 3)`` or ``(P, 4)`` x, y, z in metres, and what is kept.
        angle_rad: The turn.
    """
    x, y = points[:, 0].double(), points[:, 1].double()
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    turned = torch.stack([cos * x - sin * y, sin * x + cos * y], dim=1).to(points)
    return torch.cat([turned, points[:, 2:]], dim=1)


def corruptions() -> list[Corruption]:
    """All of them, ladder by ladder, by growing amount; seeded by the names of the scans."""

    def noise(points: Tensor, name: str, deviation_m: float) -> Tensor:
        return add_range_noise(points, deviation_m, _generator(name, "noise"))

    def drop(points: Tensor, name: str, share: float) -> Tensor:
        return drop_points(points, share, _generator(name, "drop"))

    def fixed(function: Callable[[Tensor, str, float], Tensor], amount: float) -> _Apply:
        return lambda points, name: function(points, name, amount)

    return [
        *(Corruption("noise", f"{100 * m:g} cm", fixed(noise, m)) for m in NOISE_M),
        *(Corruption("drop", f"{100 * share:g} %", fixed(drop, share)) for share in DROPPED),
        Corruption(
            "rotation",
            f"{math.degrees(TURN_RAD):g} deg",
            lambda points, _: rotate_about_z(points, TURN_RAD),
        ),
    ]


@dataclass(frozen=True)
class Step:
    """How a metric answers to one more corruption.

    Args:
        worsening: Change of the value, positive where it got worse.
        allowed: Half width of the interval of that change, both values taken as independent. They
            share their scans, so it is wider than needed: a step above it is sure, one below it
            may still be.
    """

    worsening: float
    allowed: float

    @property
    def worse(self) -> bool:
        """Whether the value got worse at all."""
        return self.worsening > 0

    @property
    def clear(self) -> bool:
        """Whether it changed, for better or worse, by more than the intervals allow."""
        return abs(self.worsening) > self.allowed


def steps(results: Sequence[MetricResult]) -> list[Step]:
    """Steps of one metric along a ladder.

    Args:
        results: Of the scans as they are and of each corruption, by growing amount.

    Raises:
        ValueError: If a value is None, or they are of several metrics.
    """
    names = {row.name for row in results}
    if len(names) > 1:
        raise ValueError(f"results of {', '.join(sorted(names))}; give those of one metric")
    found = []
    for before, after in pairwise(results):
        if before.value is None or after.value is None:
            raise ValueError(f"{after.name}: a value that is None has no step; leave it out")
        change = after.value - before.value
        found.append(
            Step(
                change if after.direction == "lower" else -change,
                math.hypot(before.half_width, after.half_width),
            )
        )
    return found


_Apply = Callable[[Tensor, str], Tensor]


def _generator(name: str, kind: str) -> torch.Generator:
    """Randomness of a scan: the same for every amount, another one for every kind."""
    digest = hashlib.sha256(f"{kind}/{name}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "big") >> 1)

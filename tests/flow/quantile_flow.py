"""A mixture of Gaussians in one dimension, whose flow map is known from its quantiles.

The ODE of one coordinate keeps the order of points, so a point keeps its quantile:
``F_r(x_r) = F_t(x_t)`` with the distribution function ``F_t`` of the noisy data.
"""

from __future__ import annotations

import torch

from r3dpa.bench.problems import GaussianMixture

MIXTURE = GaussianMixture(torch.tensor([[-1.0], [1.2]]).double(), 0.25, torch.tensor([0.4, 0.6]))


def quantile(x, time):
    """``F_t(x)`` of float64 points ``(B, 1)`` at times ``(B,)``."""
    t = time[:, None]
    width = ((1 - t).square() * MIXTURE.std**2 + t.square()).sqrt()
    z = (x - (1 - t) * MIXTURE.means[:, 0]) / width
    return (MIXTURE.weights.double() * torch.special.ndtr(z)).sum(dim=1, keepdim=True)


def flow_map(x, time, target):
    """Points ``(B, 1)`` at ``target`` of the paths through ``x`` at ``time``, by bisection."""
    x, time, target = x.double(), time.double(), target.double()
    wanted = quantile(x, time)
    low, high = torch.full_like(x, -8.0), torch.full_like(x, 8.0)
    for _ in range(60):
        middle = (low + high) / 2
        below = quantile(middle, target) < wanted
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return (low + high) / 2


def average_velocity(x, time, target):
    """``(x_t - x_r) / (t - r)``, and the velocity itself at r = t; in float64."""
    length = (time - target).double()[:, None]
    moved = x.double() - flow_map(x, time, target)
    exact = MIXTURE.velocity(x.double(), time.double())
    return torch.where(length > 0, moved / length.clamp(min=1e-12), exact)

"""Average velocities: steps of any length with one evaluation each.

An average velocity ``u(x, t, r) = (x_t - x_r) / (t - r)`` is the mean of the velocity along the
path through ``x`` from time t to the target time r < t; at r = t it is the velocity itself. Its
functions are called ``(x (B, ...), time (B,), target (B,)) -> (B, ...)``.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from r3dpa.flow.times import batch_time, ode_times, step_pairs

AverageVelocity = Callable[[Tensor, Tensor, Tensor], Tensor]
AVERAGE_STEPS = (1, 2, 4, 8)
TIME_SHIFT = 2.5  # of the best AB3 grid


def average_times(steps: int) -> Tensor:
    """Times ``(steps + 1,)`` from 1 to 0; fewer steps take some of the times of 8."""
    return ode_times(AVERAGE_STEPS[-1], shift=TIME_SHIFT)[:: AVERAGE_STEPS[-1] // steps]


@torch.no_grad()
def average_velocity_steps(average: AverageVelocity, x: Tensor, times: Tensor) -> Tensor:
    """State at the last time, by one evaluation per step: ``x + (r - t) u(x, t, r)``."""
    for now, then in step_pairs(times):
        slope = average(x, batch_time(now, x), batch_time(then, x))
        x = x + (then - now) * slope.to(x.dtype)
    return x

"""Average velocities: steps of any length with one evaluation, and what trains them.

An average velocity ``u(x, t, r) = (x_t - x_r) / (t - r)`` is the mean of the velocity along the
path through ``x`` from time t to the target time r < t; at r = t it is the velocity itself. Its
functions are called ``(x (B, ...), time (B,), target (B,)) -> (B, ...)``.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from r3dpa.flow.solvers import Velocity
from r3dpa.flow.times import batch_time, ode_times, per_sample, step_pairs

AverageVelocity = Callable[[Tensor, Tensor, Tensor], Tensor]
AVERAGE_STEPS = (1, 2, 4, 8)
TIME_SHIFT = 2.5  # of the times, that of the best AB3 grid


def average_times(steps: int) -> Tensor:
    """Times ``(steps + 1,)`` from 1 to 0; those of fewer steps are among those of 8."""
    return ode_times(steps, shift=TIME_SHIFT)


@torch.no_grad()
def average_velocity_steps(average: AverageVelocity, x: Tensor, times: Tensor) -> Tensor:
    """State at the last time, by one evaluation a step: ``x + (r - t) u(x, t, r)``."""
    for now, then in step_pairs(times):
        slope = average(x, batch_time(now, x), batch_time(then, x))
        x = x + (then - now) * slope.to(x.dtype)
    return x


@torch.no_grad()
def two_step_target(average: AverageVelocity, x: Tensor, time: Tensor, target: Tensor) -> Tensor:
    """Average velocity of two steps of half the length (shortcut models, Frans et al. 2024)."""
    middle = (time + target) / 2
    first = average(x, time, middle)
    halfway = x + per_sample(middle - time, x) * first
    return (first + average(halfway, middle, target)) / 2


@torch.no_grad()
def identity_target(
    average: AverageVelocity,
    velocity: Velocity,
    x: Tensor,
    time: Tensor,
    target: Tensor,
    step: float = 5e-3,
) -> Tensor:
    """Target ``v - (t - r) du/dt`` of the MeanFlow identity, du/dt along the path of x.

    The derivative is a central difference: no forward-mode differentiation, which fast attention
    lacks. Source: MeanFlow (Geng et al. 2025), eq. 6.
    """
    slope = velocity(x, time)
    late, early = (time + step / 2).clamp(max=1), (time - step / 2).maximum(target)
    ends = [average(x + per_sample(t - time, x) * slope, t, target) for t in (late, early)]
    width = per_sample((late - early).clamp(min=step / 4), x)
    return slope - per_sample(time - target, x) * (ends[0] - ends[1]) / width

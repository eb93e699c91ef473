"""Time grids of the solvers: float64 with both ends, between t = 1 (noise) and t = 0 (data)."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor


def ode_times(num_steps: int, start: float = 1.0, stop: float = 0.0, shift: float = 1.0) -> Tensor:
    """Times ``(num_steps + 1,)`` of an ODE solver, equidistant in the unshifted time u.

    The shift spends steps near the noise (``s > 1``) or near the data (``s < 1``)::

        t = s u / (1 + (s - 1) u)        u = t / (s - (s - 1) t)

    A part of the way, from ``start`` to ``stop``, follows the same curve as the whole. ``stop``
    above ``start`` goes from data towards noise.

    Source: resolution-dependent shift of Stable Diffusion 3 (Esser et al. 2024, eq. 23).
    """
    _check_num_steps(num_steps)
    if not (0 <= start <= 1 and 0 <= stop <= 1) or start == stop:
        raise ValueError(f"start and stop must be two times in [0, 1], got {start} and {stop}")
    if not 0 < shift < float("inf"):
        raise ValueError(f"the shift of the times must be above 0, got {shift}")
    first, last = (time / (shift - (shift - 1) * time) for time in (start, stop))
    unshifted = torch.linspace(first, last, num_steps + 1, dtype=torch.float64)
    times = shift * unshifted / (1 + (shift - 1) * unshifted)
    times[0], times[-1] = start, stop  # not exact after there and back
    return times


def sde_times(num_steps: int, last: float = 0.04) -> Tensor:
    """Times ``(num_steps + 1,)`` of the SDE: equidistant from 1 to ``last``, then one step to 0.

    The last step is noise-free. Detail finer than about ``last`` standard deviations is lost with
    few steps near the data; 0.005 keeps it.
    """
    _check_num_steps(num_steps)
    if not 0 < last < 1:
        raise ValueError(f"the last time before 0 must lie in (0, 1), got {last}")
    return torch.cat([torch.linspace(1.0, last, num_steps, dtype=torch.float64), torch.zeros(1)])


def step_pairs(times: Tensor) -> list[tuple[float, float]]:
    """Start and end of every step; raises ValueError unless times are strictly monotonic."""
    if times.dim() != 1 or len(times) < 2:
        raise ValueError(f"a solver needs two or more times, got shape {tuple(times.shape)}")
    steps = list(pairwise(times.tolist()))
    if len({then > now for now, then in steps}) > 1 or any(now == then for now, then in steps):
        raise ValueError(f"times must all increase or all decrease, got {times.tolist()}")
    return steps


def batch_time(time: float, x: Tensor) -> Tensor:
    """One time for every sample: ``(B,)`` on the device of ``x``, at least float32."""
    dtype = torch.promote_types(x.dtype, torch.float32)
    return torch.full((len(x),), time, dtype=dtype, device=x.device)


def per_sample(values: Tensor, x: Tensor) -> Tensor:
    """``(B,)`` values with the axes of ``x``, to be broadcast."""
    if values.shape != x.shape[:1]:
        raise ValueError(
            f"time must hold one value per sample, shape ({x.shape[0]},), got {tuple(values.shape)}"
        )
    return values.reshape(-1, *[1] * (x.dim() - 1))


def check_interval(interval: tuple[float, float], name: str) -> None:
    """Refuse an interval that is not two increasing times in [0, 1]."""
    if not 0 <= interval[0] < interval[1] <= 1:
        raise ValueError(
            f"{name} must be two times 0 <= first < last <= 1 (0 data, 1 noise), "
            f"got {interval[0]} and {interval[1]}"
        )


def _check_num_steps(num_steps: int) -> None:
    if num_steps < 1:
        raise ValueError(f"a solver needs at least one step, got {num_steps}")

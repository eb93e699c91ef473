"""Dormand-Prince 5(4) with the step control and the dense output of torchdiffeq.

Recorded results of the adaptive solver contain its own errors, up to 1e-2 in single pixels: our
solvers converge to the solution, not to these.
"""

from __future__ import annotations

import torch

_STAGES = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_NODES = (1 / 5, 3 / 10, 4 / 5, 8 / 9, 1, 1)
_LOWER = (1951 / 21600, 0, 22642 / 50085, 451 / 720, -12231 / 42400, 649 / 6300, 1 / 60)
_ERROR = [a - b for a, b in zip((*_STAGES[-1], 0), _LOWER, strict=True)]
_MIDDLE = (
    *(6025192743 / 30085553152, 0, 51252292925 / 65400821598, -2691868925 / 45128329728),
    *(187940372067 / 1594534317056, -1776094331 / 19743644256, 11237099 / 235043384),
)


def _sum(weights, slopes):
    return sum(weight * slope for weight, slope in zip(weights, slopes, strict=True))


def _rms(values):
    return values.square().mean().sqrt().item()


@torch.no_grad()
def dopri5(slope, state, tol):
    """State at time 1 of ``slope(state, time)`` from time 0, and the number of evaluations."""
    time, first = 0.0, slope(state, 0.0)
    scale = tol + tol * state.abs()
    sizes = _rms(state / scale), _rms(first / scale)
    step = 0.01 * sizes[0] / sizes[1]
    bend = _rms((slope(state + step * first, step) - first) / scale) / step
    step, calls = min(100 * step, (0.01 / max(sizes[1], bend)) ** 0.2), 2
    while True:
        slopes = [first]
        for weights, node in zip(_STAGES, _NODES, strict=True):
            after = state + step * _sum(weights, slopes)
            slopes.append(slope(after, time + node * step))
        calls += 6
        allowed = tol + tol * torch.maximum(state.abs(), after.abs())
        ratio = _rms(step * _sum(_ERROR, slopes) / allowed)
        factor = min(10, max(0.9 / ratio**0.2, 1.0 if ratio < 1 else 0.2))
        if ratio <= 1:
            if time + step >= 1:
                return _between(state, after, slopes, step, (1 - time) / step), calls
            time, state, first = time + step, after, slopes[-1]
        step *= factor


def _between(before, after, slopes, step, x):
    """Quartic through both ends, their slopes and the middle of a step, at ``x`` in [0, 1]."""
    middle = before + step / 2 * _sum(_MIDDLE, slopes)
    start, end = step * slopes[0], step * slopes[-1]
    a = 2 * (end - start) - 8 * (after + before) + 16 * middle
    b = 5 * start - 3 * end + 18 * before + 14 * after - 32 * middle
    c = end - 4 * start - 11 * before - 5 * after + 16 * middle
    return before + x * (start + x * (c + x * (b + x * a)))

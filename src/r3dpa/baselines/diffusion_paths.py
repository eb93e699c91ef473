"""Gaussian diffusion as a path of the solvers, and completion by its ancestral steps.

Time runs from 0 (data) to 1 (noise). The state is ``alpha data + sigma noise`` with
``alpha^2 = sigmoid(log_snr)`` and ``sigma^2 = sigmoid(-log_snr)``. Letters: B batch, ``...`` any
further axes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor

from r3dpa.flow.interpolant import Interpolant, PathCoefficients
from r3dpa.flow.sde import ancestral_step
from r3dpa.flow.solvers import Velocity
from r3dpa.flow.times import batch_time, per_sample, step_pairs

Schedule = Literal["cosine", "linear"]
_LOG_SNR = 15.0  # of the cosine schedule at both ends
_LEAST_TIME = 1e-4  # where the rate of the linear schedule vanishes


@dataclass(frozen=True)
class DiffusionPath(Interpolant):
    """Variance-preserving path with a log-SNR in continuous time.

    Every such path is the cosine path at other times: with ``alpha = cos(u)``, ``sigma = sin(u)``
    the velocity is ``u'(t) v`` with ``v = alpha noise - sigma data``. So all solvers of
    :mod:`r3dpa.flow` apply.

    ``cosine``: ``log_snr = -2 ln tan(u)``, u linear in t between the angles of a log-SNR of 15 and
    -15. ``linear``: ``log_snr = -ln(exp(1e-4 + 10 t^2) - 1)``.

    Source: Kingma et al. 2021; shift: Hoogeboom et al. 2023 (simple diffusion).

    Args:
        path: Always ``cosine``.
        schedule: Which log-SNR.
        shift: Added to it: ``2 ln(noise_d / image_d)`` for noise of the resolution ``noise_d``
            in images of the resolution ``image_d``.
    """

    path: Literal["linear", "cosine"] = "cosine"
    schedule: Schedule = "cosine"
    shift: float = 0.0

    def log_snr(self, time: Tensor) -> Tensor:
        """Log signal-to-noise ratio at times in [0, 1] of any shape."""
        if self.schedule == "linear":
            return -torch.log(torch.expm1(1e-4 + 10 * time.square())) + self.shift
        return -2 * torch.log(torch.tan(self._angle(time))) + self.shift

    def _angle(self, time: Tensor) -> Tensor:
        least, most = (math.atan(math.exp(end * _LOG_SNR / 2)) for end in (-1, 1))
        return least + time * (most - least)

    def _rate(self, time: Tensor) -> Tensor:
        """Derivative of the log-SNR, below 0."""
        if self.schedule == "linear":
            time = time.clamp(min=_LEAST_TIME)
            exponent = 1e-4 + 10 * time.square()
            return -20 * time * torch.exp(exponent) / torch.expm1(exponent)
        step = self._angle(torch.ones(())).item() - self._angle(torch.zeros(())).item()
        return -4 * step / torch.sin(2 * self._angle(time))

    def coefficients(self, time: Tensor) -> PathCoefficients:
        """Path coefficients at times in [0, 1] of any shape, in their shape and dtype."""
        log_snr = self.log_snr(time)
        alpha, sigma = log_snr.sigmoid().sqrt(), (-log_snr).sigmoid().sqrt()
        turn = -0.5 * self._rate(time) * alpha * sigma
        return PathCoefficients(alpha, sigma, -turn * sigma, turn * alpha)

    def velocity(self, data: Tensor, x: Tensor, time: Tensor) -> Tensor:
        """Velocity of noisy samples given their expected data, the inverse of :meth:`denoise`."""
        alpha, sigma, _, d_sigma = self.coefficients(per_sample(time, x))
        return (alpha * x - data) / sigma * (d_sigma / alpha)

    def score(self, velocity: Tensor, x: Tensor, time: Tensor) -> Tensor:
        """Gradient of the log density, finite as sigma never vanishes."""
        alpha, sigma, _, _ = self.coefficients(per_sample(time, x))
        return (alpha * self.denoise(velocity, x, time) - x) / sigma.square()

    def sde_drift(self, velocity: Tensor, x: Tensor, time: Tensor) -> Tensor:
        """Drift ``v - t score`` of the SDE with diffusion ``w = 2 t``."""
        return velocity - per_sample(time, x) * self.score(velocity, x, time)


@dataclass(frozen=True)
class StepPath(DiffusionPath):
    """Path of a diffusion in discrete steps; between two steps the log-SNR is interpolated.

    The roots of the variances of the steps rise linearly, ``linear`` in LDM and LiDM. The first
    step is at time 0 and not free of noise.
    """

    first_beta: float = 0.0015
    last_beta: float = 0.0195
    num_steps: int = 1000

    @cached_property
    def betas(self) -> Tensor:
        """Variances ``(num_steps,)`` of the steps, float64."""
        ends = self.first_beta**0.5, self.last_beta**0.5
        return torch.linspace(*ends, self.num_steps, dtype=torch.float64).square()

    @cached_property
    def signal(self) -> Tensor:
        """``alpha^2`` of each step ``(num_steps,)``, float64."""
        return (1 - self.betas).cumprod(0)

    def step_of(self, time: Tensor) -> Tensor:
        """Step of a time, with a fraction; times of whole steps have none."""
        step = (time * self.num_steps).clamp(0, self.num_steps - 1)
        return torch.where((step - step.round()).abs() < 1e-3, step.round(), step)

    def log_snr(self, time: Tensor) -> Tensor:
        """Log signal-to-noise ratio at times in [0, 1] of any shape."""
        step = self.step_of(time)
        table = self.signal.logit().to(time.device)
        low = step.floor().long().clamp(max=self.num_steps - 2)
        return torch.lerp(table[low], table[low + 1], (step - low).double()).to(time.dtype)

    def _rate(self, time: Tensor) -> Tensor:
        table = self.signal.logit().to(time.device).diff() * self.num_steps
        low = self.step_of(time).floor().long().clamp(max=self.num_steps - 2)
        return table[low].to(time.dtype)


@torch.no_grad()
def repaint(
    velocity: Velocity,
    known: Tensor,
    mask: Tensor,
    draws: Iterator[Tensor],
    path: Interpolant,
    steps: int,
    resamplings: int = 1,
    jump: int = 1,
) -> Tensor:
    """Complete samples whose values are known where the mask is 1.

    Each interval of time is crossed ``resamplings`` times by ancestral steps, with steps back to
    its start between, so that unknown values come to fit the known ones. The last interval is
    crossed once.

    Source: RePaint (Lugmayr et al. 2022), as in R2DM.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)`` on ``path``.
        known: ``(B, ...)`` samples; values where the mask is 0 do not count.
        mask: ``(B, ...)`` 1 or 0.
        draws: Gaussian draws ``(B, ...)``: the first state, then for each step one for the known
            part and one for the step, and one for each step back.
        path: Path of the velocity.
        steps: Number of intervals.
        resamplings: How often each interval is crossed.
        jump: Steps within an interval.
    """
    if min(steps, resamplings, jump) < 1:
        raise ValueError(
            "RePaint needs steps, resamplings and jump of at least 1, got "
            f"{steps}, {resamplings} and {jump}"
        )
    x = next(draws)
    grid = torch.linspace(1, 0, steps + 1)
    for index, (start, end) in enumerate(pairwise(grid)):
        fine = start + torch.linspace(0, 1, jump + 1) * (end - start)
        times = [batch_time(time, x) for time in fine.tolist()]
        for crossing in range(resamplings):
            for here, there in pairwise(times):
                noised = path.interpolate(known, next(draws), there)
                data = path.denoise(velocity(x, here), x, here)
                generated = ancestral_step(data, x, here, there, next(draws), interpolant=path)
                x = mask * noised + (1 - mask) * generated
            if index == steps - 1 or crossing == resamplings - 1:
                break
            for here, there in pairwise(reversed(times)):
                x = forward_step(x, here, there, next(draws), path)
    return x


def forward_step(x: Tensor, here: Tensor, there: Tensor, draw: Tensor, path: Interpolant) -> Tensor:
    """State at later times ``there`` ``(B,)`` of a state ``(B, ...)`` at times ``here``."""
    alpha_s, sigma_s, *_ = path.coefficients(per_sample(here, x))
    alpha_t, sigma_t, *_ = path.coefficients(per_sample(there, x))
    ratio = alpha_t / alpha_s
    return ratio * x + (sigma_t.square() - (ratio * sigma_s).square()).sqrt() * draw


@torch.no_grad()
def inpaint(
    velocity: Velocity,
    x: Tensor,
    known: Tensor,
    mask: Tensor,
    times: Tensor,
    draws: Iterator[Tensor],
    path: Interpolant,
) -> Tensor:
    """DDIM without noise, whose state is overwritten before each step where the mask is 1.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
        x: ``(B, ...)`` Gaussian noise, the state at the first time.
        known: ``(B, ...)`` data.
        mask: Broadcast to ``known``; 1 where it is kept.
        times: ``(T,)`` decreasing times.
        draws: T - 1 Gaussian draws ``(B, ...)`` for the known part.
        path: Path of the velocity.
    """
    for now, then in step_pairs(times):
        here, there = batch_time(now, x), batch_time(then, x)
        x = mask * path.interpolate(known, next(draws), here) + (1 - mask) * x
        data = path.denoise(velocity(x, here), x, here)
        x = ancestral_step(data, x, here, there, None, interpolant=path)
    return x

"""Gaussian diffusion as a path of :mod:`r3dpa.flow`: schedules, targets, weights, RePaint.

Time runs from 0 (data) to 1 (noise). The state is ``alpha data + sigma noise`` with
``alpha^2 = sigmoid(log_snr)`` and ``sigma^2 = sigmoid(-log_snr)``. Letters: B batch, ``...`` any
further axes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from r3dpa.flow.interpolant import Interpolant, PathCoefficients
from r3dpa.flow.sde import ancestral_step
from r3dpa.flow.solvers import Velocity
from r3dpa.flow.times import batch_time, per_sample

Prediction = Literal["eps", "v", "x_0"]
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

    def denoise(self, velocity: Tensor, x: Tensor, time: Tensor) -> Tensor:
        """Expected data given noisy samples and their velocity."""
        alpha, sigma, _, d_sigma = self.coefficients(per_sample(time, x))
        return alpha * x - sigma * velocity * (alpha / d_sigma)

    def velocity(self, data: Tensor, x: Tensor, time: Tensor) -> Tensor:
        """Inverse of :meth:`denoise`."""
        alpha, sigma, _, d_sigma = self.coefficients(per_sample(time, x))
        return (alpha * x - data) / sigma * (d_sigma / alpha)

    def score(self, velocity: Tensor, x: Tensor, time: Tensor) -> Tensor:
        """Gradient of the log density, finite as sigma never vanishes."""
        alpha, sigma, _, _ = self.coefficients(per_sample(time, x))
        return (alpha * self.denoise(velocity, x, time) - x) / sigma.square()

    def sde_drift(self, velocity: Tensor, x: Tensor, time: Tensor) -> Tensor:
        """Drift ``v - t score`` of the SDE with diffusion ``w = 2 t``."""
        return velocity - per_sample(time, x) * self.score(velocity, x, time)


def data_of(
    prediction: Tensor, kind: Prediction, x: Tensor, alpha: Tensor, sigma: Tensor
) -> Tensor:
    """Clean data that a network predicts as noise, as v or directly; all ``(B, ...)``."""
    if kind == "eps":
        return (x - sigma * prediction) / alpha
    return alpha * x - sigma * prediction if kind == "v" else prediction


def target_of(
    kind: Prediction, data: Tensor, noise: Tensor, alpha: Tensor, sigma: Tensor
) -> Tensor:
    """Training target of a network whose output :func:`data_of` converts to data."""
    return {"eps": noise, "v": alpha * noise - sigma * data, "x_0": data}[kind]


def loss_weight(log_snr: Tensor, kind: Prediction, gamma: float | None = 5.0) -> Tensor:
    """Weight of the squared error of a prediction, of the shape of ``log_snr``.

    Relative to the error of the data it is ``min(snr, gamma)``, or ``snr`` where gamma is None.

    Source: min-SNR (Hang et al. 2023).
    """
    snr = log_snr.exp()
    weight = snr if gamma is None else snr.clamp(max=gamma)
    return {"eps": weight / snr, "v": weight / (snr + 1), "x_0": weight}[kind]


def sample_errors(
    prediction: Tensor,
    target: Tensor,
    norm: Literal["l2", "l1", "huber"] = "l2",
    mask: Tensor | None = None,
) -> Tensor:
    """Mean error ``(B,)`` of each sample ``(B, ...)`` where a mask of the same shape is 1."""
    losses = {"l2": F.mse_loss, "l1": F.l1_loss, "huber": F.smooth_l1_loss}
    error = losses[norm](prediction, target, reduction="none").flatten(1)
    if mask is None:
        return error.mean(dim=1)
    mask = mask.flatten(1)
    return (error * mask).sum(dim=1) / (mask.sum(dim=1) + 1e-8)


def weighted_mean(errors: Tensor, weights: Tensor, official: bool = False) -> Tensor:
    """Mean of weighted errors, both ``(B,)``.

    The released code multiplies errors (B, 1) and weights (B, 1, 1, 1): ``official`` gives its
    result, the product of the two means, in which the weights only scale the loss of a batch.
    """
    return errors.mean() * weights.mean() if official else (errors * weights).mean()


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
    """Completes samples whose values are known where the mask is 1.

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
                made = ancestral_step(data, x, here, there, next(draws), interpolant=path)
                x = mask * noised + (1 - mask) * made
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

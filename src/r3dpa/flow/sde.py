"""Samplers with noise from t = 1 to t = 0 (data), with the conventions of the ODE solvers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Literal

import torch
from torch import Tensor

from r3dpa.flow.interpolant import LINEAR, Interpolant
from r3dpa.flow.solvers import Velocity
from r3dpa.flow.times import batch_time, per_sample, step_pairs

DriftChange = Callable[[Tensor, Tensor, Tensor], Tensor]


@torch.no_grad()
def euler_maruyama(
    velocity: Velocity,
    x: Tensor,
    times: Tensor,
    noise: torch.Generator | Iterable[Tensor],
    *,
    eta: float = 1.0,
    interpolant: Interpolant = LINEAR,
    last: Literal["denoise", "mean"] = "denoise",
    change_drift: DriftChange | None = None,
) -> Tensor:
    """Solve the reverse SDE with diffusion ``w = 2 eta t`` by Euler-Maruyama steps.

    All eta have the same marginals. The drift is ``v - (w / 2) score``, and linear in eta::

        drift = (1 - eta) v + eta (v - t score)

    One evaluation per step; every step but the last adds ``sqrt(w |dt|)`` times a Gaussian draw.

    Source: SiT (Ma et al. 2024), eq. 6; ``last="mean"`` with ``eta=1`` is the published sampler
    of R3DPA.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
        x: ``(B, ...)`` Gaussian noise, the state at t = 1.
        times: ``(T,)`` decreasing times, see :func:`r3dpa.flow.times.sde_times`; ``denoise`` needs
            0 as the last one.
        noise: The T - 2 Gaussian draws ``(B, ...)`` in order, or the generator to draw them with.
            Draws that are given per sample make a sample independent of its batch.
        eta: Strength of the noise, 0 or above; 0 is the ODE, and then
            :func:`r3dpa.flow.solvers.euler` but for ``change_drift``.
        interpolant: Path of the velocity.
        last: Noise-free last step. ``denoise`` goes to the expected data; ``mean`` takes a full
            step of drift, which for ``eta=1`` removes the noise twice and shrinks detail (data of
            standard deviation 0.1 comes out at 0.077 from t = 0.04).
        change_drift: ``(drift, x, time) -> drift`` applied in every step but the last.
    """
    if last not in ("denoise", "mean"):
        raise ValueError(f"last must be 'denoise' or 'mean', got {last!r}")
    if not 0 <= eta < math.inf:
        raise ValueError(f"eta must be 0 or above, got {eta}")
    *steps, (now, then) = step_pairs(times)
    if then >= now:
        raise ValueError(
            f"the SDE runs from noise to data: its times must decrease, got {times.tolist()}"
        )
    if last == "denoise" and then != 0:
        raise ValueError(f"last='denoise' ends at t = 0, but the last time is {then}")

    def drift_of(slope: Tensor, x: Tensor, time: Tensor) -> Tensor:
        return (1 - eta) * slope + eta * interpolant.sde_drift(slope, x, time)

    draws = _draws(noise, x, len(steps))
    for step_now, step_then in steps:
        time = batch_time(step_now, x)
        drift = drift_of(velocity(x, time), x, time)
        if change_drift is not None:
            drift = change_drift(drift, x, time)
        step = step_then - step_now
        spread = math.sqrt(2 * eta * step_now * -step)
        x = x + step * drift.to(x.dtype) + spread * next(draws)
    time = batch_time(now, x)
    final_velocity = velocity(x, time)
    if last == "denoise":
        return interpolant.denoise(final_velocity, x, time).to(x.dtype)
    return x + (then - now) * drift_of(final_velocity, x, time).to(x.dtype)


@torch.no_grad()
def ancestral(
    velocity: Velocity,
    x: Tensor,
    times: Tensor,
    noise: torch.Generator | Iterable[Tensor],
    *,
    eta: float = 1.0,
    interpolant: Interpolant = LINEAR,
) -> Tensor:
    """DDPM (``eta`` 1) or DDIM (``eta`` 0) steps, see :func:`ancestral_step`.

    Source: Ho et al. 2020, Song et al. 2021 (eq. 12), for a path with any coefficients.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
        x: ``(B, ...)`` Gaussian noise, the state at t = 1.
        times: ``(T,)`` decreasing times.
        noise: The T - 1 Gaussian draws ``(B, ...)`` in order, none for ``eta`` 0, or the generator
            to draw them with.
        eta: Strength of the noise, 0 to 1.
        interpolant: Path of the velocity.
    """
    if not 0 <= eta <= 1:
        raise ValueError(f"eta of ancestral steps must be in [0, 1], got {eta}")
    steps = step_pairs(times)
    draws = _draws(noise, x, len(steps) if eta else 0)
    for now, then in steps:
        here, there = batch_time(now, x), batch_time(then, x)
        data = interpolant.denoise(velocity(x, here), x, here)
        draw = next(draws) if eta else None
        x = ancestral_step(data, x, here, there, draw, eta=eta, interpolant=interpolant).to(x.dtype)
    return x


def ancestral_step(
    data: Tensor,
    x: Tensor,
    here: Tensor,
    there: Tensor,
    draw: Tensor | None,
    *,
    eta: float = 1.0,
    interpolant: Interpolant = LINEAR,
) -> Tensor:
    """State at times ``there`` ``(B,)`` given the state at later times ``here`` and its clean data.

    With ``k = 1 - (alpha_t sigma_s / (alpha_s sigma_t))^2``, the share of the variance that the
    step renews, and the noise ``e = (x_t - alpha_t data) / sigma_t`` of the state::

        x_s = alpha_s data + sigma_s (sqrt(1 - eta^2 k) e + eta sqrt(k) draw)

    For ``eta`` 1 this is the posterior ``q(x_s | x_t, data)`` of any path ``alpha, sigma``.
    """
    alpha_t, sigma_t, *_ = interpolant.coefficients(per_sample(here, x))
    alpha_s, sigma_s, *_ = interpolant.coefficients(per_sample(there, x))
    error = (x - alpha_t * data) / sigma_t
    if draw is None or eta == 0:
        return alpha_s * data + sigma_s * error
    renewed = (1 - (alpha_t * sigma_s / (alpha_s * sigma_t)).square()).clamp(min=0)
    kept = (1 - eta**2 * renewed).sqrt()
    return alpha_s * data + sigma_s * (kept * error + eta * renewed.sqrt() * draw)


def _draws(
    noise: torch.Generator | Iterable[Tensor], x: Tensor, num_draws: int
) -> Iterator[Tensor]:
    """Draws of the shape, dtype and device of ``x``, each made when it is needed."""
    given = iter(()) if isinstance(noise, torch.Generator) else iter(noise)
    for index in range(num_draws):
        draw: Tensor | None
        if isinstance(noise, torch.Generator):
            draw = torch.randn(x.shape, generator=noise, device=noise.device, dtype=x.dtype)
        else:
            draw = next(given, None)
        if draw is None or draw.shape != x.shape:
            got = f"{index} draws" if draw is None else f"a draw of shape {tuple(draw.shape)}"
            raise ValueError(f"{num_draws} draws of shape {tuple(x.shape)} are needed, got {got}")
        yield draw.to(x.device, x.dtype)

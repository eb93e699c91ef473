"""Editing of given latents: transport towards noise and feature-guided inpainting.

Letters: B batch, C latent channels, h x w latent size.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from r3dpa.flow.interpolant import Interpolant
from r3dpa.flow.solvers import Velocity, euler
from r3dpa.flow.times import ode_times

__all__ = ["pnp_flow_feature", "transport_to_time"]


def transport_to_time(
    velocity: Velocity, latents: Tensor, target_time: float, num_steps: int
) -> Tensor:
    """Carry data along the probability flow from t = 0 to a later time by Euler steps.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
        latents: ``(B, ...)`` normalised latents of data.
        target_time: Time to stop at, in (0, 1].
        num_steps: Number of steps, one evaluation each.

    Returns:
        ``(B, ...)`` noisy latents at ``target_time``.

    Raises:
        ValueError: If ``target_time`` is outside (0, 1] or there is no step.
    """
    return euler(velocity, latents, ode_times(num_steps, start=0.0, stop=target_time))


@torch.no_grad()
def pnp_flow_feature(
    velocity: Velocity,
    feature_term: Velocity,
    latents: Tensor,
    edit_mask: Tensor,
    times: Tensor,
    noise: Iterable[Tensor],
    *,
    exponent: float = 1.5,
) -> Tensor:
    """Inpaint latents towards given features, plug-and-play with the flow as denoiser.

    Starts from zero. At every time, with step ``t^exponent``: a step along the feature term, a
    step that pulls the kept region to the given latents, fresh noise to reach time t, and the
    expected data on the linear path::

        x <- x - t^a feature_term(x, t)
        x <- x - t^a keep (x - latents)
        z  = (1 - t) x + t noise
        x <- z - t v(z, t)

    Source: PnP-Flow (Martin et al. 2025), alg. 3, with the feature term of R3DPA (ICRA 2026).

    Args:
        velocity: ``(x (B, C, h, w), time (B,)) -> (B, C, h, w)`` without guidance.
        feature_term: Guidance term of the same signature, see
            :meth:`r3dpa.flow.guidance.FeatureGuidance.term`.
        latents: ``(B, C, h, w)`` normalised latents of the scene to edit.
        edit_mask: ``(B, 1, h, w)`` bool, True where latents are generated anew.
        times: ``(T,)`` decreasing times that include both ends, see
            :func:`r3dpa.flow.times.ode_times`.
        noise: T Gaussian draws ``(B, C, h, w)``, one per time.
        exponent: Step sizes are ``t^exponent``.

    Returns:
        ``(B, C, h, w)`` edited latents, dtype of ``latents``.

    Raises:
        ValueError: If ``edit_mask`` does not fit the latents or there are not T draws.
    """
    batch, _, rows, columns = latents.shape
    if edit_mask.shape != (batch, 1, rows, columns) or edit_mask.dtype != torch.bool:
        raise ValueError(
            f"edit_mask must be bool of shape {(batch, 1, rows, columns)}, got "
            f"{edit_mask.dtype} of shape {tuple(edit_mask.shape)}"
        )
    draws = list(noise)
    if len(draws) != len(times):
        raise ValueError(f"one draw per time is needed: {len(times)} times, {len(draws)} draws")
    path = Interpolant("linear")
    time_dtype = torch.promote_types(latents.dtype, torch.float32)
    x = torch.zeros_like(latents)
    for now, draw in zip(times.tolist(), draws, strict=True):
        time = torch.full((batch,), now, dtype=time_dtype, device=x.device)
        step = now**exponent
        x = x - step * feature_term(x, time).to(x.dtype)
        x = torch.where(edit_mask, x, x - step * (x - latents))
        noisy = path.interpolate(x, draw.to(x), time)
        x = path.denoise(velocity(noisy, time), noisy, time).to(x.dtype)
    return x

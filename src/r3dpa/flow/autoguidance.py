"""Guidance away from a weaker velocity: of another model, or of perturbed attention.

Letters: B batch, C latent channels, ``...`` further axes of the latents.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from r3dpa.flow.interpolant import LINEAR, Interpolant, PathCoefficients
from r3dpa.flow.solvers import Velocity
from r3dpa.flow.times import check_interval, per_sample


@dataclass(frozen=True)
class PerturbedAttention:
    """Guidance of a SiT away from itself without attention between the tokens in one block.

    Formula: ``perturbed + scale (velocity - perturbed)``.

    Source: Ahn et al., "Self-rectifying diffusion sampling with perturbed-attention guidance"
    (2024).

    Args:
        block: Perturbed block, counted from 1.
        scale: Strength, at least 1; 1 for none.
    """

    block: int
    scale: float

    def __post_init__(self) -> None:
        check_scale(self.scale)
        if self.block < 1:
            raise ValueError(f"blocks are counted from 1, got block {self.block}")


def autoguided(
    velocity: Velocity, weak: Velocity, scale: float, interval: tuple[float, float] = (0.0, 1.0)
) -> Velocity:
    """Velocity extrapolated from a weak model through the model itself.

    Both models err in the same direction, the weak one further: the difference points to the data.
    It needs no classes. Formula: ``weak + scale (velocity - weak)`` at times inside the interval,
    ``velocity`` outside, where ``weak`` is not evaluated.

    Source: Karras et al., "Guiding a diffusion model with a bad version of itself" (2024), eq. 3;
    interval: Kynkäänniemi et al. 2024.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)`` of the model.
        weak: The same of a weaker one, in the same normalised latents: see :func:`renormalised`.
        scale: Strength, at least 1; at 1 the result is ``velocity`` itself.
        interval: First and last time that is guided, in [0, 1]. Shorter ones read the times, which
            waits for a GPU.
    """
    first, last = interval
    check_scale(scale)
    check_interval(interval, "the interval of autoguidance")
    if scale == 1:
        return velocity
    everywhere = first == 0 and last == 1

    def guided(x: Tensor, time: Tensor) -> Tensor:
        strong = velocity(x, time)
        inside = per_sample((time >= first) & (time <= last), strong)
        if not (everywhere or inside.any()):
            return strong
        weaker = weak(x, time)
        if weaker.shape != strong.shape:
            raise ValueError(
                f"the weak model answers {tuple(weaker.shape)}, the model {tuple(strong.shape)}; "
                "both must be of the same latents"
            )
        pushed = extrapolated(strong, weaker, scale)
        return pushed if everywhere else torch.where(inside, pushed, strong.to(pushed.dtype))

    return guided


def check_scale(scale: float) -> None:
    """Refuse a strength of guidance below 1 or not finite."""
    if not (math.isfinite(scale) and scale >= 1):
        raise ValueError(
            f"the scale of guidance must be a number of 1 or more, got {scale}; 1 is no "
            "guidance, and less would move towards the weak model"
        )


def extrapolated(velocity: Tensor, weak: Tensor, scale: float) -> Tensor:
    """``weak + scale (velocity - weak)``, in float32 or wider: a small difference, magnified."""
    dtype = torch.promote_types(velocity.dtype, torch.float32)
    return torch.lerp(weak.to(dtype), velocity.to(dtype), scale)


def renormalised(
    weak: Velocity, scale: float, shift: Tensor, interpolant: Interpolant = LINEAR
) -> Velocity:
    """Velocity of a model whose latents are ``scale * latents + shift``, for these latents.

    Exact. A noisy latent is ``x = alpha z + sigma e``; the model knows ``z' = scale z + shift``
    and, since the noise of its path has unit variance too, another ratio of data and noise. At the
    time t' of its path with ``sigma' / alpha' = scale sigma / alpha`` its noisy latent is::

        x' = alpha' z' + sigma' e = (alpha' / alpha) scale x + alpha' shift

    with the same noise ``e``, so what it expects of ``z'`` and ``e`` given ``x'`` holds given
    ``x``, and ``v = d_alpha (z' - shift) / scale + d_sigma e``. Nothing is divided by t or 1 - t.

    One number ``scale`` serves all channels: with one for each, ``e`` would have to differ in
    strength between channels, which the model never saw.

    Args:
        weak: ``(x' (B, C, ...), time' (B,)) -> (B, C, ...)`` in its own latents.
        scale: Positive number.
        shift: ``(C,)`` on the device of the latents.
        interpolant: Path of both models.
    """
    if not (math.isfinite(scale) and scale > 0) or shift.dim() != 1:
        raise ValueError(
            "scale must be positive and finite and shift have shape (C,), got "
            f"{scale} and {tuple(shift.shape)}"
        )
    if scale == 1 and not shift.any():
        return weak

    def velocity(x: Tensor, time: Tensor) -> Tensor:
        here = interpolant.coefficients(per_sample(time, x))
        there_time, length = _renormalised_time(here, scale, interpolant)
        there = interpolant.coefficients(there_time)
        offset = shift.to(there_time.dtype).reshape(-1, *[1] * (x.dim() - 2))
        there_x = scale / length * x + there.alpha * offset
        slope = weak(there_x.to(x.dtype), there_time.flatten())
        data, noise = there.data_and_noise(there_x, slope)
        return here.d_alpha * (data - offset) / scale + here.d_sigma * noise

    return velocity


def renormalised_times(
    times: Tensor, scale: float, shift: Tensor, interpolant: Interpolant = LINEAR
) -> Tensor:
    """Times ``(T,)`` at which :func:`renormalised` evaluates the weak model for given times."""
    if scale == 1 and not shift.any():
        return times
    return _renormalised_time(interpolant.coefficients(times), scale, interpolant)[0]


def _renormalised_time(
    here: PathCoefficients, scale: float, interpolant: Interpolant
) -> tuple[Tensor, Tensor]:
    """Time t' with ``sigma' / alpha' = scale sigma / alpha``, and ``alpha / alpha'`` there."""
    scaled = scale * here.sigma
    if interpolant.path == "linear":
        length = here.alpha + scaled
        return scaled / length, length
    length = torch.hypot(here.alpha, scaled)
    return torch.atan2(scaled, here.alpha) * (2 / math.pi), length

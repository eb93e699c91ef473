"""Path between data and noise: coefficients, velocity target, conversions, time sampling.

Time runs from t = 0 (data) to t = 1 (noise) everywhere. Letters: B batch, ``...`` any further axes.
Data, noise, ``x`` and velocities are ``(B, ...)``, flow times ``(B,)``; methods raise a
ValueError for other times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from r3dpa.flow.times import per_sample


class PathCoefficients(NamedTuple):
    """Coefficients of ``x_t = alpha data + sigma noise`` and their time derivatives.

    ``alpha`` falls from 1 at t = 0 to 0 at t = 1, ``sigma`` rises from 0 to 1.
    """

    alpha: Tensor
    sigma: Tensor
    d_alpha: Tensor
    d_sigma: Tensor

    def data_and_noise(self, x: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
        """Recover data and noise from a state and its velocity."""
        determinant = self.alpha * self.d_sigma - self.sigma * self.d_alpha
        data = (self.d_sigma * x - self.sigma * velocity) / determinant
        return data, (self.alpha * velocity - self.d_alpha * x) / determinant


@dataclass(frozen=True)
class Interpolant:
    """Path ``x_t = alpha(t) data + sigma(t) noise`` and what follows from its velocity.

    ``linear``: alpha = 1 - t, sigma = t. ``cosine``: alpha = cos(pi t / 2), sigma = sin(pi t / 2).

    Source: stochastic interpolants (Albergo et al. 2023), SiT (Ma et al. 2024), sec. 2.

    Args:
        path: Which path.

    Example:
        >>> path = Interpolant()
        >>> path.interpolate(torch.tensor([4.0]), torch.tensor([0.0]), torch.tensor([0.25]))
        tensor([3.])
    """

    path: Literal["linear", "cosine"] = "linear"

    def __post_init__(self) -> None:
        if self.path not in ("linear", "cosine"):
            raise ValueError(f"path must be 'linear' or 'cosine', got {self.path!r}")

    def coefficients(self, time: Tensor) -> PathCoefficients:
        """Path coefficients at times in [0, 1] of any shape, in their shape and dtype."""
        if self.path == "linear":
            ones = torch.ones_like(time)
            return PathCoefficients(1 - time, time, -ones, ones)
        quarter = math.pi / 2
        cosine, sine = torch.cos(quarter * time), torch.sin(quarter * time)
        return PathCoefficients(cosine, sine, -quarter * sine, quarter * cosine)

    def interpolate(self, data: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        """Noisy samples, ``alpha data + sigma noise``."""
        alpha, sigma, _, _ = self.coefficients(per_sample(time, data))
        return alpha * data + sigma * noise

    def target(self, data: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        """Velocity to learn, ``d_alpha data + d_sigma noise``; linear path: ``noise - data``."""
        _, _, d_alpha, d_sigma = self.coefficients(per_sample(time, data))
        return d_alpha * data + d_sigma * noise

    def denoise(self, velocity: Tensor, x: Tensor, time: Tensor) -> Tensor:
        """Expected data given noisy samples and their velocity, finite at all times.

        Formula: linear ``x - t v``; cosine ``cos(u) x - (2 / pi) sin(u) v`` with ``u = pi t / 2``.
        """
        time = per_sample(time, x)
        if self.path == "linear":
            return x - time * velocity
        return self.coefficients(time).data_and_noise(x, velocity)[0]

    def sde_drift(self, velocity: Tensor, x: Tensor, time: Tensor) -> Tensor:
        """Drift ``v - t score`` of the SDE with diffusion ``w = 2 t``, finite on [0, 1].

        The score is the gradient of the log density. Formula, without the division by t: linear
        ``(2 - t) v + x``; cosine ``(1 + (4 / pi^2) u cot(u)) v + t x`` with ``u = pi t / 2``.
        """
        time = per_sample(time, x)
        if self.path == "linear":
            return (2 - time) * velocity + x
        u_cot_u = torch.cos(math.pi / 2 * time) / torch.sinc(time / 2)
        return (1 + (4 / math.pi**2) * u_cot_u) * velocity + time * x


LINEAR = Interpolant("linear")


def sample_time(
    batch_size: int,
    kind: Literal["uniform", "lognormal", "u_shaped"] = "uniform",
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Draw one flow time per sample, ``(B,)`` float32 in [0, 1].

    ``uniform`` on [0, 1); ``lognormal`` is ``sigmoid(n)`` with n standard Gaussian, denser in the
    middle (Esser et al. 2024, logit-normal); ``u_shaped`` has a density like ``exp(4 t)`` plus
    ``exp(4 (1 - t))``, denser at both ends (Lee et al. 2024, for pairs of a trained flow).

    Args:
        batch_size: Number of samples B.
        kind: Distribution of the times.
        generator: Source of randomness; the draw is made on its device. Default: torch's own.
    """
    device = None if generator is None else generator.device
    time = torch.empty(batch_size, device=device, dtype=torch.float32)
    if kind == "uniform":
        return time.uniform_(generator=generator)
    if kind == "lognormal":
        return time.normal_(generator=generator).sigmoid()
    if kind == "u_shaped":
        rising = _exponential(time.uniform_(generator=generator))
        chosen = torch.randperm(2 * batch_size, generator=generator, device=device)[:batch_size]
        return torch.cat([rising, 1 - rising])[chosen]
    raise ValueError(f"times are drawn 'uniform', 'lognormal' or 'u_shaped', got {kind!r}")


def _exponential(uniform: Tensor, rate: float = 4.0) -> Tensor:
    """Times of a density like ``exp(rate t)`` on [0, 1], from uniform ones."""
    return torch.log1p(uniform * math.expm1(rate)) / rate

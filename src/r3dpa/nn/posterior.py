"""Gaussian posterior of the raw latents.

Letters: B batch, C latent channels, h x w latent size.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from r3dpa.nn.layers import at_least_float32

__all__ = ["Posterior"]


class _StraightThroughClamp(torch.autograd.Function):
    """Clamp whose backward is the identity, so that an escaped value can come back."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, low: float, high: float) -> Tensor:
        return values.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return gradient, None, None


class Posterior:
    """Diagonal Gaussian over the raw latents of each image, in float32.

    The log-variance is clamped to [-30, 20]. Its gradient passes the clamp (straight-through):
    with a plain clamp, as in the official code, a value outside would stay there for ever.

    Args:
        moments: ``(B, 2C, h, w)`` means, then log-variances.

    Attributes:
        mean: ``(B, C, h, w)``.
        logvar: ``(B, C, h, w)`` natural logarithm of the variance, in [-30, 20].
        std: ``(B, C, h, w)`` standard deviation.
    """

    def __init__(self, moments: Tensor) -> None:
        self.mean, logvar = at_least_float32(moments).chunk(2, dim=1)
        self.logvar: Tensor = _StraightThroughClamp.apply(logvar, -30.0, 20.0)
        self.std = torch.exp(0.5 * self.logvar)

    def sample(self, noise: Tensor) -> Tensor:
        """Raw latents ``mean + std * noise`` for standard normal noise ``(B, C, h, w)``."""
        return self.mean + self.std * noise

    def kl(self) -> Tensor:
        """Kullback-Leibler divergence from N(0, 1), ``(B,)`` nats summed over C, h and w.

        Formula: ``0.5 * sum(mean^2 + exp(logvar) - 1 - logvar)``.
        """
        terms = self.mean.square() + self.logvar.exp() - 1.0 - self.logvar
        return 0.5 * terms.flatten(1).sum(dim=1)

    def nll(self, latents: Tensor) -> Tensor:
        """Negative log-likelihood of raw latents, ``(B,)`` nats summed over C, h and w.

        Args:
            latents: ``(B, C, h, w)``.
        """
        squares = (latents - self.mean).square() * torch.exp(-self.logvar)
        return 0.5 * (math.log(2 * math.pi) + self.logvar + squares).flatten(1).sum(dim=1)

"""Mixture of Gaussians: data whose velocity is known exactly, to measure solvers without a network.

Letters: B batch, K Gaussians, D dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class GaussianMixture:
    """Data distribution ``sum_k weight_k N(mean_k, std^2 I)`` and its velocity on the linear path.

    ``means`` are ``(K, D)``, ``std`` is that of every Gaussian in every direction, and the
    ``weights`` ``(K,)`` need not sum to 1.
    """

    means: Tensor
    std: float
    weights: Tensor

    def velocity(self, x: Tensor, time: Tensor) -> Tensor:
        """Exact velocity ``E[noise - data | x_t = x]`` on the path ``(1 - t) data + t noise``.

        Given the Gaussian k, ``x_t`` is Gaussian about ``(1 - t) mean_k`` with variance
        ``V = (1 - t)^2 std^2 + t^2``, so that with ``m = sum_k p(k | x) mean_k``::

            v = -m + (t - (1 - t) std^2) / V (x - (1 - t) m)

        ``|x|^2`` is common to all ``log p(k | x)`` and left out: nothing large cancels. Finite for
        all t in [0, 1]: ``-x`` at t = 0 and ``x`` minus the mean of the data at t = 1. Samples are
        ``(B, D)``, times ``(B,)``; computed in float64, returned in the dtype of ``x``.
        """
        state, t = x.double(), time.double()[:, None]
        means, weights = self.means.to(state), self.weights.to(state)
        variance = (1 - t).square() * self.std**2 + t.square()
        nearness = (1 - t) * (state @ means.T) - (1 - t).square() * means.square().sum(1) / 2
        mean = torch.softmax(weights.log() + nearness / variance, dim=1) @ means
        slope = (t - (1 - t) * self.std**2) / variance
        return (slope * (state - (1 - t) * mean) - mean).to(x.dtype)

    def sample(self, num_samples: int, generator: torch.Generator) -> Tensor:
        """Data ``(num_samples, D)`` in the dtype of the means, drawn with a CPU generator."""
        component = torch.multinomial(
            self.weights.double().cpu(), num_samples, replacement=True, generator=generator
        )
        noise = torch.randn(
            num_samples, self.means.shape[1], generator=generator, dtype=torch.float64
        )
        return self.means[component.to(self.means.device)] + self.std * noise.to(self.means)


def toy_mixture(seed: int = 0) -> GaussianMixture:
    """128 equally likely Gaussians in 64 dimensions, float64, standard deviation 0.2.

    The means are standard Gaussian in a random plane of 4 dimensions, as data lie near few
    dimensions of their space. There they crowd: late on its way a path still has to decide between
    neighbours, which is what makes solvers err (apart from each other, means in all 64 dimensions
    would be decided between at once near the noise).
    """
    generator = torch.Generator().manual_seed(seed)
    places = torch.randn(128, 4, generator=generator, dtype=torch.float64)
    plane = torch.randn(4, 64, generator=generator, dtype=torch.float64) / 2
    return GaussianMixture(places @ plane, std=0.2, weights=torch.full((128,), 1 / 128).double())

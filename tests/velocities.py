"""Velocities with known solutions, and noise."""

from __future__ import annotations

import torch

from r3dpa.flow.interpolant import Interpolant


def still(x, time):
    return torch.zeros_like(x)


def growth(x, time):
    """Linear ODE whose solution is x(1) exp(-(1 - t)) going backwards."""
    return x


def gaussian_velocity(spread, path="linear", mean=0.0):
    """Exact velocity of data N(mean, spread^2)."""
    interpolant = Interpolant(path)

    def velocity(x, time):
        alpha, sigma, d_alpha, d_sigma = interpolant.coefficients(time[:, None])
        slope = alpha * d_alpha * spread**2 + sigma * d_sigma
        slope = slope / (alpha.square() * spread**2 + sigma.square())
        return slope * (x - mean * alpha) + mean * d_alpha

    return velocity


def standard_noise(*shape, seed=0, dtype=torch.float64):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)

"""Random Fourier features: values of a point as a vector whose inner product is a kernel."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

_BANDWIDTH = 2.0  # of the Gaussian kernel, in standard deviations


class KernelFeatures(nn.Module):
    """Frozen features of unit norm whose inner product is a Gaussian kernel of a point's values.

    The values are standardised with fixed constants and lifted to ``dim``::

        phi(x) = [cos(W x), sin(W x)] / sqrt(K / 2),    features = Q phi(x),    Q^T Q = I

    Source: Rahimi and Recht, "Random Features for Large-Scale Kernel Machines" (NeurIPS 2007).
    A subclass names itself and says in ``prepare`` which values a point has.

    Args:
        dim: Width D of the features, even.
        seed: Seed of W and Q.
        centres: Value that becomes 0, for each of the V values.
        spreads: Difference that becomes 1: the smaller, the more a value counts.
        width: Width K of phi, even: the kernel is met up to ``1 / sqrt(K)``.

    Raises:
        ValueError: If ``dim`` is odd or below 2.
    """

    prepare: Callable[..., Tensor]
    centres: Tensor
    spreads: Tensor
    frequencies: Tensor
    basis: Tensor

    def __init__(
        self,
        dim: int,
        seed: int,
        centres: Sequence[float],
        spreads: Sequence[float],
        width: int = 64,
    ) -> None:
        super().__init__()
        if dim < 2 or dim % 2:
            raise ValueError(f"dim must be even and at least 2, got {dim}.")
        self.dim = dim
        width = min(dim, width)
        generator = torch.Generator().manual_seed(seed)
        frequencies = torch.randn(len(centres), width // 2, generator=generator) / _BANDWIDTH
        basis = random_basis(dim, width, generator)
        for name, values in (
            ("centres", torch.tensor(centres)),
            ("spreads", torch.tensor(spreads)),
            ("frequencies", frequencies),
            ("basis", basis),
        ):
            self.register_buffer(name, values, persistent=False)

    def forward(self, *scan: Tensor) -> Tensor:
        """Features of unit norm.

        Args:
            scan: Arguments of ``prepare``: the points ``(P, 4)`` x, y, z in metres, intensity
                0..1, and where the features need them the labels.

        Returns:
            ``(P, dim)`` float32.
        """
        return self.lift(self.point_features([self.prepare(*scan)])[0])

    def point_features(self, prepared: Sequence[Tensor]) -> list[Tensor]:
        """Kernel features ``phi`` of unit norm of each scan, before the linear lift.

        Args:
            prepared: ``(P_i, V)`` values of each scan as ``prepare`` gives them.

        Returns:
            ``(P_i, min(dim, K))`` float32 each, on the device of the buffers.
        """
        return [self._kernel_features(values.to(self.basis.device)) for values in prepared]

    def _kernel_features(self, values: Tensor) -> Tensor:
        phase = ((values - self.centres) / self.spreads) @ self.frequencies
        return torch.cat([phase.cos(), phase.sin()], dim=1) / math.sqrt(phase.shape[1])

    def lift(self, values: Tensor) -> Tensor:
        """Linear, norm-preserving map of ``point_features``, or of means of them, to ``dim``."""
        return values @ self.basis.T


def random_basis(dim: int, width: int, generator: torch.Generator) -> Tensor:
    """Random ``(dim, width)`` float32 matrix with orthonormal columns, ``width <= dim``."""
    q, r = torch.linalg.qr(torch.randn(dim, width, generator=generator, dtype=torch.float64))
    return (q * r.diagonal().sign()).float()  # LAPACK libraries differ in the signs of Q

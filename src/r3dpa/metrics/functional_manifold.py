"""Precision, recall, density and coverage: each set as a manifold, balls around its samples.

Pure functions, computed in float64. Letters: N real and M generated samples, F feature width.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from r3dpa.metrics.functional import checked_pair

_BLOCK = 1024  # rows of a distance matrix held at once


@dataclass(frozen=True)
class PRDC:
    """How much of each set the other one covers.

    Args:
        precision: Share of generated samples inside the ball of some real sample.
        recall: Share of real samples inside the ball of some generated sample.
        density: Real balls around a generated sample, on average, divided by k; may exceed 1.
        coverage: Share of real samples whose ball holds a generated sample.
    """

    precision: float
    recall: float
    density: float
    coverage: float


@dataclass(frozen=True)
class SharedBalls:
    """Sample by sample, whether the balls of the other set hold it; means of this are PRDC.

    Args:
        in_real: ``(M,)`` int64, real balls that a generated sample is in.
        recalled: ``(N,)`` bool, whether a real sample is in the ball of a generated one.
        covered: ``(N,)`` bool, whether the ball of a real sample holds a generated one.
        num_neighbors: k of the balls.
    """

    in_real: Tensor
    recalled: Tensor
    covered: Tensor
    num_neighbors: int

    @property
    def precise(self) -> Tensor:
        """``(M,)`` bool, whether a generated sample is in a real ball."""
        return self.in_real > 0

    @property
    def density(self) -> Tensor:
        """``(M,)`` float64, real balls that a generated sample is in, divided by k."""
        return self.in_real.double() / self.num_neighbors


def precision_recall(real: Tensor, generated: Tensor, num_neighbors: int = 5) -> PRDC:
    """Precision, recall, density and coverage: the means of :func:`shared_balls`.

    Args:
        real: ``(N, F)``.
        generated: ``(M, F)``.
        num_neighbors: k, below N and M.

    Raises:
        ValueError: If a set has k samples or fewer or holds NaN, or if widths differ.
    """
    balls = shared_balls(real, generated, num_neighbors)
    return PRDC(
        precision=balls.precise.double().mean().item(),
        recall=balls.recalled.double().mean().item(),
        density=balls.density.mean().item(),
        coverage=balls.covered.double().mean().item(),
    )


def shared_balls(real: Tensor, generated: Tensor, num_neighbors: int = 5) -> SharedBalls:
    """Which samples lie in the balls of the other set, each up to the k-th neighbour in its own.

    A sample on the edge of a ball is outside. Distances are held 1024 rows at a time.

    Source: Kynkäänniemi et al., NeurIPS 2019; Naeem et al., ICML 2020 (strict inequality).
    Arguments and errors are those of :func:`precision_recall`.
    """
    real, generated = checked_pair(real, generated, num_neighbors + 1)
    centre = real.mean(dim=0)  # squared norms of features far from 0 would swamp the distances
    real, generated = real - centre, generated - centre
    norms = torch.cat([real, generated]).square().sum(dim=1)
    edge = 1e-12 * norms.max()  # as near to the edge as rounding is on it
    real_radius = _kth_neighbor(real, num_neighbors) - edge
    generated_radius = _kth_neighbor(generated, num_neighbors) - edge

    inside = []
    recalled = torch.zeros(len(real), dtype=torch.bool, device=real.device)
    covered = torch.zeros_like(recalled)
    for rows, squared in _squared_distances(generated, real):
        in_real = squared < real_radius
        inside.append(in_real.sum(dim=1))
        covered |= in_real.any(dim=0)
        recalled |= (squared < generated_radius[rows, None]).any(dim=0)
    return SharedBalls(torch.cat(inside), recalled, covered, num_neighbors)


def _squared_distances(x: Tensor, y: Tensor) -> Iterator[tuple[slice, Tensor]]:
    norms = y.square().sum(dim=1)
    for start in range(0, len(x), _BLOCK):
        rows = slice(start, start + _BLOCK)
        yield rows, x[rows].square().sum(dim=1, keepdim=True) + norms - 2 * x[rows] @ y.T


def _kth_neighbor(x: Tensor, k: int) -> Tensor:
    """Squared distance ``(N,)`` to the k-th neighbour, the sample itself not counted."""
    radii = []
    for rows, squared in _squared_distances(x, x):
        squared[:, rows].fill_diagonal_(torch.inf)
        radii.append(squared.kthvalue(k, dim=1).values)
    return torch.cat(radii)

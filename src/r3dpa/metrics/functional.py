"""Distances between two sets of feature vectors or two histograms: pure functions in float64.

Every function raises ValueError for input that it cannot judge (NaN, too few samples); nothing is
left out in silence. Letters: N samples, F feature width.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import reduce
from typing import Self

import numpy as np
import torch
from scipy.stats import linregress
from torch import Tensor

_SMALLEST_SHARE, _NUM_SIZES = 4, 8  # fd_infinity starts from a quarter of the samples
_LARGEST = 1e50  # the sixth power of it, in squared_mmd, is finite
_BLOCK = 1024  # rows of a distance matrix held at once


def checked_features(features: Tensor, name: str = "features", at_least: int = 1) -> Tensor:
    """Return features ``(N, F)`` as float64.

    Raises:
        ValueError: If one is not finite, or N is too small.
    """
    if features.ndim != 2:
        raise ValueError(
            f"{name}: expected (N, F), one row per sample, got {tuple(features.shape)}"
        )
    if len(features) < at_least:
        raise ValueError(f"{name}: {len(features)} samples, at least {at_least} are needed")
    features = features.double()
    broken = ~(features.abs() <= _LARGEST).all(dim=1)
    if broken.any():
        first = int(broken.nonzero()[0])
        raise ValueError(
            f"{name}: {int(broken.sum())} of {len(features)} rows hold NaN or values "
            f"beyond {_LARGEST:g}, the first is row {first}; check the scan it was extracted from"
        )
    return features


def checked_pair(real: Tensor, generated: Tensor, at_least: int = 1) -> tuple[Tensor, Tensor]:
    """Return both sets as :func:`checked_features`.

    Raises:
        ValueError: Also if their widths differ.
    """
    real = checked_features(real, "real features", at_least)
    generated = checked_features(generated, "generated features", at_least)
    if real.shape[1] != generated.shape[1]:
        raise ValueError(
            f"real features are {real.shape[1]} wide but generated ones {generated.shape[1]}; "
            "extract both with one network"
        )
    return real, generated


@dataclass(frozen=True)
class Moments:
    """Count, mean and scatter of feature vectors; two of them merge without loss of digits.

    The scatter is the sum of the outer products of the deviations from the mean::

        mean    = mean_a + (mean_b - mean_a) * n_b / n
        scatter = scatter_a + scatter_b + outer(mean_b - mean_a) * n_a * n_b / n

    Source: Chan, Golub, LeVeque, 1979.
    """

    count: Tensor  # () float64, number of samples N
    mean: Tensor  # (F,) float64
    scatter: Tensor  # (F, F) float64

    @classmethod
    def of(cls, features: Tensor, name: str = "features") -> Self:
        """Compute the moments of ``(N, F)`` features; raises as :func:`checked_features`."""
        features = checked_features(features, name)
        mean = features.mean(dim=0)
        centred = features - mean
        return cls(features.new_full((), len(features)), mean, centred.T @ centred)

    def merge(self, other: Self) -> Self:
        """Return the moments of both sets together; either may be empty."""
        if self.mean.shape != other.mean.shape:
            raise ValueError(
                f"moments of {len(self.mean)} and of {len(other.mean)} features do not merge"
            )
        count = self.count + other.count
        share = other.count / count.clamp(min=1)
        step = other.mean - self.mean
        between = torch.outer(step, step) * (self.count * share)
        return type(self)(count, self.mean + step * share, self.scatter + other.scatter + between)

    def covariance(self, name: str = "features") -> Tensor:
        """Return the covariance ``(F, F)`` with N - 1.

        Raises:
            ValueError: For fewer than two samples.
        """
        if self.count < 2:
            raise ValueError(f"{name}: {int(self.count)} samples, a covariance needs at least 2")
        return self.scatter / (self.count - 1)

    def pack(self) -> Tensor:
        """Return all numbers in one vector ``(1 + F + F * F,)``, for states and exchange."""
        return torch.cat([self.count.reshape(1), self.mean, self.scatter.flatten()])

    @classmethod
    def unpack(cls, packed: Tensor) -> Self:
        """Inverse of :meth:`pack`."""
        width = (math.isqrt(4 * len(packed) - 3) - 1) // 2
        return cls(packed[0], packed[1 : width + 1], packed[width + 1 :].view(width, width))


def merge_packed(packed: Tensor) -> Tensor:
    """Merge ``(K, 1 + F + F * F)`` packed moments in order, to one packed vector."""
    return reduce(Moments.merge, map(Moments.unpack, packed)).pack()


def frechet_distance(mean_a: Tensor, cov_a: Tensor, mean_b: Tensor, cov_b: Tensor) -> Tensor:
    """Squared Fréchet (2-Wasserstein) distance ``()`` float64 of two normal distributions.

    Means are ``(F,)``, covariances ``(F, F)`` symmetric and positive semi-definite::

        |mean_a - mean_b|^2 + tr(cov_a) + tr(cov_b) - 2 * sum(svdvals(cov_a^1/2 cov_b^1/2))

    Singular values keep singular covariances exact: roots of the eigenvalues of
    ``cov_a^1/2 cov_b cov_a^1/2`` would turn a rounding error of 1e-16 into one of 1e-8.

    Source: Dowson and Landau, 1982; as FID of Heusel et al., 2017.
    """
    mean_a, cov_a, mean_b, cov_b = (x.double() for x in (mean_a, cov_a, mean_b, cov_b))
    common = torch.linalg.svdvals(_root(cov_a) @ _root(cov_b)).sum()
    distance = (mean_a - mean_b).square().sum() + cov_a.trace() + cov_b.trace() - 2 * common
    return distance.clamp(min=0)


def frechet_of_draws(mean: Tensor, covariance: Tensor, rows: Tensor) -> Callable[[Tensor], float]:
    """Return a function of indices: the Fréchet distance of a normal distribution to those rows.

    As :func:`frechet_distance`, but the root of the covariance is taken once, and the root of the
    covariance of the rows ``(N, F)`` never: the rows themselves, centred, have the same singular
    values. For 4096 features that saves minutes per draw.
    """
    mean, rows = mean.double(), rows.double()
    rotated, variance = rows @ _root(covariance.double()), covariance.double().trace()

    def distance(drawn: Tensor) -> float:
        x, y = rows[drawn], rotated[drawn]
        centre, degrees = x.mean(dim=0), len(drawn) - 1
        common = torch.linalg.svdvals(y - y.mean(dim=0)).sum() / math.sqrt(degrees)
        spread = (x - centre).square().sum() / degrees
        squared = (mean - centre).square().sum() + variance + spread - 2 * common
        return max(squared.item(), 0.0)

    return distance


def _root(covariance: Tensor) -> Tensor:
    """Symmetric root of a covariance; eigenvalues that are rounding errors count as zero."""
    values, vectors = torch.linalg.eigh((covariance + covariance.T) / 2)
    noise = len(values) * torch.finfo(values.dtype).eps * values[-1].clamp(min=0)
    values = torch.where(values > noise, values, 0.0)
    return (vectors * values.sqrt()) @ vectors.T


def frechet_distance_of(real: Tensor, generated: Tensor) -> float:
    """Return the Fréchet distance of two sets of features ``(N, F)`` by means and covariances."""
    a, b = Moments.of(real, "real features"), Moments.of(generated, "generated features")
    return frechet_distance(
        a.mean, a.covariance("real features"), b.mean, b.covariance("generated features")
    ).item()


def fd_infinity(real: Tensor, generated: Tensor, generator: torch.Generator) -> tuple[float, float]:
    """Fréchet distance of ``(N, F)`` and ``(M, F)`` features, extrapolated to infinitely many.

    The distance of N samples is too large by about c / N. A line is fitted over 1/N to subsets of
    equal sizes, spaced evenly in 1/N from a quarter of the smaller set up to all of it. Returns
    its intercept, which may be slightly negative, and the standard error, which is too low as the
    subsets overlap.

    Source: Chong and Forsyth, "Effectively unbiased FID and Inception score", CVPR 2020.
    """
    real, generated = checked_pair(real, generated)
    width = real.shape[1]
    largest = min(len(real), len(generated))
    smallest = largest // _SMALLEST_SHARE
    if smallest <= width:
        raise ValueError(
            f"fd_infinity: {largest} samples of {width} features; at least "
            f"{_SMALLEST_SHARE * (width + 1)} are needed; polynomial_mmd has no bias with fewer"
        )
    inverse = torch.linspace(1 / smallest, 1 / largest, _NUM_SIZES, dtype=torch.float64)
    sizes = [round(1 / value) for value in inverse.tolist()]
    distances = []
    for size in sizes:
        real_rows = real[torch.randperm(len(real), generator=generator)[:size]]
        rows = generated[torch.randperm(len(generated), generator=generator)[:size]]
        distances.append(frechet_distance_of(real_rows, rows))
    line = linregress([1 / size for size in sizes], distances)
    error = float(np.nan_to_num(line.intercept_stderr))  # NaN for equal distances
    return float(line.intercept), error


def squared_mmd(real: Tensor, generated: Tensor) -> Tensor:
    """Unbiased squared maximum mean discrepancy under ``(x . y / F + 1) ** 3``.

    Takes ``(N, F)`` and ``(M, F)`` with at least 2 rows each, returns ``()`` float64, which may be
    negative: pairs of a sample with itself are left out.

    Source: Gretton et al., JMLR 2012, eq. 3; kernel of Binkowski et al. (KID), ICLR 2018.
    """
    x, y = checked_pair(real, generated, at_least=2)

    def within(a: Tensor) -> Tensor:
        values = _cubic_kernel(a, a)
        return (values.sum() - values.trace()) / (len(a) * (len(a) - 1))

    return within(x) + within(y) - 2 * _cubic_kernel(x, y).mean()


def squared_mmd_error(real: Tensor, generated: Tensor) -> float:
    """Standard error of :func:`squared_mmd` over draws of the generated samples, three or more.

    Jackknife: the discrepancy without sample j needs only the sums of the kernel from j to all
    others, which are computed once. The real samples are fixed.
    """
    x, y = checked_pair(real, generated, at_least=3)
    pairs, across = [], []
    for rows in y.split(_BLOCK):
        itself = (rows.square().sum(dim=1) / y.shape[1] + 1) ** 3
        pairs.append(_cubic_kernel(rows, y).sum(dim=1) - itself)
        across.append(_cubic_kernel(rows, x).mean(dim=1))
    to_generated, to_real, num = torch.cat(pairs), torch.cat(across), len(y)
    within = (to_generated.sum() - 2 * to_generated) / ((num - 1) * (num - 2))
    without_sample = within - 2 * (to_real.sum() - to_real) / (num - 1)
    return without_sample.std().item() * (num - 1) / math.sqrt(num)


def _cubic_kernel(x: Tensor, y: Tensor) -> Tensor:
    return (x @ y.T / x.shape[1] + 1) ** 3


def polynomial_mmd(
    real: Tensor,
    generated: Tensor,
    generator: torch.Generator,
    num_subsets: int = 100,
    subset_size: int = 1000,
) -> tuple[float, float]:
    """Kernel distance (KID): mean and deviation of :func:`squared_mmd` over random subsets.

    Subsets of ``subset_size`` rows are drawn without replacement from ``(N, F)`` and ``(M, F)``;
    as they overlap, the standard error of the mean is above ``std / sqrt(num_subsets)``.
    """
    smaller = min(len(real), len(generated))
    if not 2 <= subset_size <= smaller or num_subsets < 2:
        raise ValueError(
            f"polynomial_mmd: {num_subsets} subsets of {subset_size} out of {len(real)} real and "
            f"{len(generated)} generated samples; give 2 subsets or more of 2 to {smaller} samples"
        )
    real, generated = checked_pair(real, generated)

    def subset(features: Tensor) -> Tensor:
        return features[torch.randperm(len(features), generator=generator)[:subset_size]]

    values = [squared_mmd(subset(real), subset(generated)).item() for _ in range(num_subsets)]
    std, mean = torch.std_mean(torch.tensor(values, dtype=torch.float64))
    return mean.item(), std.item()


def shared_balls(real: Tensor, generated: Tensor, num_neighbors: int = 5) -> dict[str, Tensor]:
    """Find samples in balls of the other set; a ball reaches to the k-th neighbour in its set.

    A sample on the edge of a ball is outside.

    Source: Kynkäänniemi et al., NeurIPS 2019; Naeem et al., ICML 2020 (strict inequality).

    Returns:
        float64, of N real and M generated samples, in this order: ``precision`` ``(M,)``, 1 for a
        generated sample in a real ball; ``recall`` ``(N,)``, 1 for a real sample in a generated
        ball; ``density`` ``(M,)``, real balls around a generated sample divided by k; ``coverage``
        ``(N,)``, 1 for a real sample whose ball holds a generated one.
    """
    real, generated = checked_pair(real, generated, num_neighbors + 1)
    # Squared norms of features far from 0 would swamp the distances; one outlier moves a mean, but
    # no median.
    centre = real.median(dim=0).values
    real, generated = real - centre, generated - centre
    real_radius = _radius(real, num_neighbors)
    generated_radius = _radius(generated, num_neighbors)

    counts = []
    recalled = torch.zeros(len(real), dtype=torch.bool, device=real.device)
    covered = torch.zeros_like(recalled)
    for rows, squared in _squared_distances(generated, real):
        in_real = squared < real_radius
        counts.append(in_real.sum(dim=1))
        covered |= in_real.any(dim=0)
        recalled |= (squared < generated_radius[rows, None]).any(dim=0)
    num_real = torch.cat(counts)
    return {
        "precision": (num_real > 0).double(),
        "recall": recalled.double(),
        "density": num_real.double() / num_neighbors,
        "coverage": covered.double(),
    }


def _squared_distances(x: Tensor, y: Tensor) -> Iterator[tuple[slice, Tensor]]:
    norms = y.square().sum(dim=1)
    for start in range(0, len(x), _BLOCK):
        rows = slice(start, start + _BLOCK)
        yield rows, x[rows].square().sum(dim=1, keepdim=True) + norms - 2 * x[rows] @ y.T


def _radius(x: Tensor, k: int) -> Tensor:
    """Squared radius ``(N,)`` of the balls, to the k-th other sample, less what rounding adds."""
    radii = []
    for rows, squared in _squared_distances(x, x):
        squared[:, rows].fill_diagonal_(torch.inf)
        radii.append(squared.kthvalue(k, dim=1).values)
    radius = torch.cat(radii)
    return radius - 1e-12 * (radius + x.square().sum(dim=1))

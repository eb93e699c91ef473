"""Distances of feature sets, by hand and against plain loops."""

import math
from itertools import product

import numpy as np
import pytest
import torch
from draws import drawn
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import sqrtm

from r3dpa.metrics.functional import (
    Moments,
    fd_infinity,
    frechet_distance,
    frechet_distance_of,
    frechet_of_draws,
    merge_packed,
    polynomial_mmd,
    shared_balls,
    squared_mmd,
    squared_mmd_error,
)

FEW = settings(derandomize=True, max_examples=15, deadline=None, database=None)
DTYPES = [torch.float32, torch.bfloat16, torch.float16]


def draw(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


# Fréchet distance


def test_frechet_of_diagonal_covariances():
    """sum (m1 - m2)^2 + sum (s1 - s2)^2: 1 + 4 + (3 - 1)^2 + (2 - 5)^2 = 18."""
    a = torch.tensor([1.0, 0.0]), torch.diag(torch.tensor([9.0, 4.0]))
    b = torch.tensor([0.0, 2.0]), torch.diag(torch.tensor([1.0, 25.0]))
    assert frechet_distance(*a, *b).item() == pytest.approx(18, rel=1e-14)


def test_frechet_against_the_root_of_the_product():
    a, b = (factor @ factor.T for factor in (draw(12, 30), draw(12, 30, seed=1)))
    expected = (a.trace() + b.trace()).item() - 2 * np.trace(sqrtm((a @ b).numpy())).real
    zero = torch.zeros(12)
    assert frechet_distance(zero, a, zero, b).item() == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(("count", "width"), [(40, 12), (12, 40)])
def test_frechet_of_draws_is_that_of_their_moments(count, width):
    rows, real = draw(count, width), Moments.of(draw(60, width, seed=1))
    covariance = real.covariance("real")
    drawn = torch.arange(count)[::2]
    own = Moments.of(rows[drawn])
    expected = frechet_distance(real.mean, covariance, own.mean, own.covariance("drawn")).item()
    found = frechet_of_draws(real.mean, covariance, rows)(drawn)
    assert found == pytest.approx(expected, rel=1e-10)


# Moments


def test_one_sample_has_no_covariance():
    with pytest.raises(ValueError, match="real features: 1 samples, a covariance needs"):
        frechet_distance_of(torch.zeros(1, 2), torch.zeros(5, 2))
    with pytest.raises(ValueError, match=r"x: expected \(N, F\), one row per sample, got \(3,\)"):
        Moments.of(torch.zeros(3), "x")


# Extrapolation and kernel distance


def test_fd_infinity_of_a_shift():
    generator = torch.Generator().manual_seed(0)
    result = fd_infinity(draw(400, 5), draw(400, 5, seed=1) + 2, generator)
    assert result[0] == pytest.approx(5 * 2**2, abs=1.0)
    assert 0 < result[1] < 1
    assert fd_infinity(draw(400, 5), draw(400, 5, seed=1) + 2, generator.manual_seed(0)) == result
    with pytest.raises(ValueError, match="at least 68 are needed; polynomial_mmd has no bias"):
        fd_infinity(draw(16, 16), draw(16, 16, seed=1), generator)


def test_mmd_by_hand():
    """F = 1, k(x, y) = (x y + 1)^3: k(0, 2) = 1 within, k(1, 3) = 64, across 1, 1, 27, 343."""
    value = squared_mmd(torch.tensor([[0.0], [2.0]]), torch.tensor([[1.0], [3.0]]))
    assert value.item() == 1 + 64 - 2 * (1 + 1 + 27 + 343) / 4


def test_polynomial_mmd_over_subsets():
    x, y, generator = draw(40, 3), draw(30, 3, seed=1) + 1, torch.Generator().manual_seed(0)
    mean, std = polynomial_mmd(x, y, generator, num_subsets=200, subset_size=20)
    assert std > 0
    assert mean == pytest.approx(squared_mmd(x, y).item(), abs=4 * std / math.sqrt(200))
    with pytest.raises(ValueError, match=r"40 real and 30 generated .* 2 to 30 samples"):
        polynomial_mmd(x, y, generator, subset_size=31)


def test_error_of_squared_mmd_is_that_of_leaving_out_each_sample(monkeypatch):
    monkeypatch.setattr("r3dpa.metrics.functional._BLOCK", 7)
    real, made = draw(20, 3), draw(16, 3, seed=1) + 0.5
    kept = [torch.arange(16) != left_out for left_out in range(16)]
    values = torch.stack([squared_mmd(real, made[rows]) for rows in kept])
    expected = ((values - values.mean()).square().sum() * 15 / 16).sqrt().item()
    assert squared_mmd_error(real, made) == pytest.approx(expected, rel=1e-9)


# Precision, recall, density, coverage


def precision_recall(real, generated, k=5):
    return {name: s.mean().item() for name, s in shared_balls(real, generated, k).items()}


def prdc_by_loops(real, generated, k):
    def radius(points, i):
        return sorted((points[i] - points[j]).norm() for j in range(len(points)) if j != i)[k - 1]

    real_radius = [radius(real, i) for i in range(len(real))]
    generated_radius = [radius(generated, j) for j in range(len(generated))]
    pairs = list(product(range(len(real)), range(len(generated))))
    apart = {(i, j): (real[i] - generated[j]).norm() for i, j in pairs}
    inside = [(i, j) for i, j in pairs if apart[i, j] < real_radius[i]]
    return {
        "precision": len({j for _, j in inside}) / len(generated),
        "recall": len({i for i, j in pairs if apart[i, j] < generated_radius[j]}) / len(real),
        "density": len(inside) / (k * len(generated)),
        "coverage": len({i for i, _ in inside}) / len(real),
    }


@pytest.mark.parametrize("offset", [0.0, 1e7])
def test_prdc_against_loops(monkeypatch, offset):
    monkeypatch.setattr("r3dpa.metrics.functional._BLOCK", 7)  # several blocks, the last one short
    real, generated = draw(30, 3) + offset, 1.2 * draw(24, 3, seed=1) + 0.5 + offset
    result = precision_recall(real, generated, 3)
    assert result == pytest.approx(prdc_by_loops(real, generated, 3))
    assert 0 < result["precision"] < 1
    assert 0 < result["coverage"] < 1
    assert set(precision_recall(real, real).values()) == {1.0}  # density: itself and k - 1 others
    with pytest.raises(ValueError, match="generated features: 5 samples, at least 6"):
        precision_recall(real, generated[:5])


def test_prdc_with_one_far_outlier():
    """Only the ball of the outlier knows that it is there."""
    real, generated = draw(400, 8), draw(300, 8, seed=1)
    before = precision_recall(real, generated)
    real[0], generated[0] = -1e6, 1e6
    assert precision_recall(real, generated) == pytest.approx(before, abs=0.02)


@pytest.mark.parametrize(("far", "tolerance"), [(1e7, 1e-9), (1e9, 1e-9), (1e12, 0.03)])
def test_prdc_with_a_real_outlier_against_plain_distances(far, tolerance):
    """The outlier must not move the others so far from 0 that their distances are rounded away.

    At 1e12 the edge of its own ball, which holds 7 of 50 generated samples, is not known any more.
    """
    real, generated = draw(60, 3).double(), draw(50, 3, seed=1).double()
    real[0] = far
    plain = "donot_use_mm_for_euclid_dist"
    within, across = (torch.cdist(real, part, compute_mode=plain) for part in (real, generated))
    own = torch.cdist(generated, generated, compute_mode=plain)
    real_radius, radius = (part.kthvalue(6, dim=1).values for part in (within, own))
    in_real, in_generated = across < real_radius[:, None], across < radius
    expected = {
        "precision": in_real.any(dim=0).double().mean().item(),
        "recall": in_generated.any(dim=1).double().mean().item(),
        "density": in_real.sum().item() / (5 * 50),
        "coverage": in_real.any(dim=1).double().mean().item(),
    }
    assert precision_recall(real, generated) == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize(
    "compare",
    [
        precision_recall,
        squared_mmd,
        lambda a, b: polynomial_mmd(a, b, torch.Generator(), 2, 4),
        lambda a, b: fd_infinity(a, b, torch.Generator()),
        lambda a, b: Moments.of(a).merge(Moments.of(b)),
    ],
)
def test_features_of_other_widths_do_not_compare(compare):
    """Width 1 would stretch to any other without an error."""
    for first, second in ((3, 1), (1, 3), (2, 3)):
        with pytest.raises(ValueError, match=rf"{first}.* {second}\b"):
            compare(draw(60, first), draw(60, second, seed=1))


FINITE = st.floats(-100, 100, width=32)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("root of a singular covariance product")
def test_the_distance_of_few_samples_is_real_and_not_negative(dtype):
    """20 samples of 64 features: rank 19. Eigenvalues of the product itself are not real."""
    a, b = drawn(0, 20, 64).to(dtype), (2 * drawn(1, 20, 64) + 1).to(dtype)
    x, y = Moments.of(a), Moments.of(b)
    distance = frechet_distance_of(a, b)
    assert math.isfinite(distance)
    assert distance == pytest.approx(frechet_distance_of(b, a), rel=1e-12)
    assert 0 <= frechet_distance_of(a, a) < 1e-8
    as_if_symmetric = torch.linalg.eigvalsh((x.covariance() @ y.covariance()).float())
    assert as_if_symmetric.min() < -1e-3
    assert as_if_symmetric.sqrt().sum().isnan()


@pytest.mark.numerics("root of a singular covariance product")
def test_flat_and_empty_covariances():
    """By hand: |u|^2 + |v|^2 - 2 |u v| of two lines, the trace against a point, 0 of two points."""

    @FEW
    @given(u=st.lists(FINITE, min_size=5, max_size=5), v=st.lists(FINITE, min_size=5, max_size=5))
    def check(u, v):
        u, v, zero = torch.tensor(u).double(), torch.tensor(v).double(), torch.zeros(5).double()
        lines = torch.outer(u, u), torch.outer(v, v)
        size = float(u @ u + v @ v)
        expected = size - 2 * abs(float(u @ v))
        # A rank-one matrix has four eigenvalues of rounding errors only.
        found = frechet_distance(zero, lines[0], zero, lines[1]).item()
        assert found == pytest.approx(expected, abs=1e-6 * size + 1e-12)
        nothing = torch.zeros(5, 5)
        assert frechet_distance(zero, lines[0], zero, nothing).item() == pytest.approx(float(u @ u))
        assert frechet_distance(zero, nothing, zero, nothing) == 0

    check()
    line = torch.outer(*2 * [torch.arange(1.0, 6.0)])
    assert torch.linalg.eigvalsh(line).sqrt().isnan().any()


@pytest.mark.numerics("Frechet distance of few samples")
def test_extrapolation_and_kernel_tell_equal_distributions():
    """Both sets are of one distribution of 20 features, 400 samples each."""
    biased, limits, kernels = [], [], []
    for seed in range(0, 20, 2):
        a, b = drawn(seed, 400, 20), drawn(seed + 1, 400, 20)
        biased.append(frechet_distance_of(a, b))
        limits.append(fd_infinity(a, b, generator(seed))[0])
        kernels.append(squared_mmd(a, b).item())
    for values in (np.array(limits), np.array(kernels)):
        assert abs(values.mean()) < 2 * values.std(ddof=1) / math.sqrt(len(values))
    assert min(biased) > 0.3


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("accumulation of moments")
def test_any_partition_gives_the_moments_of_the_whole(dtype):
    """Mean 5, deviations down to 0.02, as of normalised features; parts of any sizes."""
    worst = []

    @FEW
    @given(
        sizes=st.lists(st.integers(1, 40), min_size=2, max_size=8),
        deviation=st.floats(0.02, 1.0),
        seed=st.integers(0, 100),
    )
    def check(sizes, deviation, seed):
        features = (5 + deviation * drawn(seed, sum(sizes), 3)).to(dtype)
        parts = [Moments.of(part).pack() for part in features.split(sizes)]
        merged, whole = Moments.unpack(merge_packed(torch.stack(parts))), Moments.of(features)
        assert merged.count == sum(sizes)
        torch.testing.assert_close(merged.mean, whole.mean, rtol=1e-13, atol=0)
        torch.testing.assert_close(merged.scatter, whole.scatter, rtol=1e-10, atol=1e-12)
        exact = np.cov(features.double().numpy().T)
        np.testing.assert_allclose(whole.covariance(), exact, rtol=1e-9, atol=1e-13)
        # As a streaming metric in the dtype of the features adds them up.
        total, products = torch.zeros(3, dtype=dtype), torch.zeros(3, 3, dtype=dtype)
        for one in features:
            total += one
            products += torch.outer(one, one)
        mean = total / len(features)
        off = products / len(features) - torch.outer(mean, mean)
        worst.append(np.abs(off.double().numpy() - exact).max() / exact.max())

    check()
    assert max(worst) > 0.01


@pytest.mark.numerics("accumulation of moments")
def test_a_shift_leaves_the_covariance():
    x = drawn(0, 500, 4).double()
    moments = Moments.of(x + 1e4)
    torch.testing.assert_close(moments.covariance(), x.T.cov(), rtol=1e-9, atol=1e-10)
    products = (x + 1e4).T @ (x + 1e4) - 500 * torch.outer(moments.mean, moments.mean)
    assert (products / 499 - x.T.cov()).abs().max() > 1e-9  # in float64


@pytest.mark.parametrize(
    ("value", "dtype"),
    [*product([torch.nan, torch.inf, -torch.inf], DTYPES), (1e60, torch.float64)],
)
@pytest.mark.numerics("constant and NaN features")
def test_a_broken_feature_is_named_by_its_row(value, dtype):
    good = drawn(0, 30, 4).to(dtype)
    broken = good.clone()
    broken[17, 2] = value
    message = r"1 of 30 rows hold NaN or values beyond 1e\+50, the first is row 17; check the scan"
    for compare in (
        frechet_distance_of,
        squared_mmd,
        shared_balls,
        lambda a, b: fd_infinity(a, b, generator()),
        lambda a, b: polynomial_mmd(a, b, generator(), 2, 10),
    ):
        with pytest.raises(ValueError, match=f"generated features: {message}"):
            compare(good, broken)
        with pytest.raises(ValueError, match=f"real features: {message}"):
            compare(broken, good)
    assert not broken.double().mean(0)[2].square().square().square().isfinite()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("constant and NaN features")
def test_constant_features_have_finite_distances(dtype):
    """A collapsed extractor: covariance 0, all distances between samples 0."""
    same, other = torch.full((30, 4), 0.7, dtype=dtype), torch.full((30, 4), 2.5, dtype=dtype)
    gap = (other - same).double().square().sum(1)[0].item()
    assert frechet_distance_of(same, same) == pytest.approx(0, abs=1e-12)
    assert frechet_distance_of(same, other) == pytest.approx(gap, rel=1e-2)
    assert squared_mmd(same, same).item() == pytest.approx(0, abs=1e-12)
    assert fd_infinity(same, other, generator())[0] == pytest.approx(gap, rel=1e-2)
    for made in (same, other):
        assert all(share.isfinite().all() for share in shared_balls(same, made).values())
    standardised = (same - same.mean(0)) / same.std(0)
    assert not standardised.isfinite().all()

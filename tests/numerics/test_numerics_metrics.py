"""Hard cases of the metrics."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import jensenshannon
from tiny import drawn

from r3dpa.metrics import BEVHistogramDistance, FrechetDistance, RangeHistogramDistance
from r3dpa.metrics.functional import (
    Moments,
    fd_infinity,
    frechet_distance,
    frechet_distance_of,
    merge_packed,
    polynomial_mmd,
    shared_balls,
    squared_mmd,
)
from r3dpa.metrics.functional_bev import BEVGrid, chamfer_squared, histogram_distance
from r3dpa.metrics.resampling import Resampling
from r3dpa.metrics.results import MetricResult

FEW = settings(derandomize=True, max_examples=15, deadline=None, database=None)
DTYPES = [torch.float32, torch.bfloat16, torch.float16]
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


@pytest.mark.numerics("Frechet distance of few samples")
def test_fewer_samples_than_features_are_refused():
    a, b = drawn(0, 16, 16), drawn(1, 16, 16)
    metric = FrechetDistance(16)
    metric.update(a, real=True)
    metric.update(b, real=False)
    with pytest.raises(ValueError, match="16 samples for 16 features, at least 17 are needed"):
        metric.compute()
    with pytest.raises(ValueError, match="at least 68 are needed; polynomial_mmd has no bias"):
        fd_infinity(a, b, generator())
    many = frechet_distance_of(drawn(0, 4000, 16), drawn(1, 4000, 16))
    assert frechet_distance_of(a, b) > 30 * many


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


@pytest.mark.parametrize("dtype", [torch.int32, *DTYPES])
@pytest.mark.numerics("Jensen-Shannon distance and empty counts")
def test_both_names_of_the_distance_and_no_value_of_nothing(dtype):
    """Disjoint counts: ln 2 and its root; bins that are empty in both do not matter."""
    a, b = torch.tensor([[4, 2, 0, 0], [0, 0, 0, 7]]).to(dtype)
    found = histogram_distance(a, b)
    assert found.jsd_divergence == pytest.approx(math.log(2), rel=1e-12)
    assert found.jsd_distance == pytest.approx(math.sqrt(math.log(2)), rel=1e-12)
    for name, empty in (("first", (0 * a, b)), ("second", (a, 0 * b))):
        with pytest.raises(ValueError, match=f"{name} histogram is empty"):
            histogram_distance(*empty)
    with np.errstate(invalid="ignore"):
        assert math.isnan(jensenshannon((0 * a).double(), b.double()))
    assert jensenshannon(a.double(), b.double()) - found.jsd_divergence > 0.1


@pytest.mark.numerics("Jensen-Shannon distance and empty counts")
def test_the_distance_of_any_counts_is_within_its_limits():
    negative = []

    @FEW
    @given(
        counts=st.lists(st.integers(0, 10**6), min_size=3, max_size=30).filter(any),
        scale=st.integers(1, 1000),
    )
    def check(counts, scale):
        a = torch.tensor(counts)
        for b in (scale * a, a.flip(0), a.roll(1)):
            found = histogram_distance(a, b)
            assert 0 <= found.jsd_distance <= math.sqrt(math.log(2)) + 1e-12
            assert found.jsd_distance == histogram_distance(b, a).jsd_distance
        assert histogram_distance(a, scale * a).jsd_distance < 1e-7
        p, q = (x.float() / x.sum() for x in (a, scale * a))
        middle = (p + q) / 2
        terms = [(x * (x / middle).log()).nansum() / 2 for x in (p, q)]
        negative.append(sum(terms).item())

    check()
    assert min(negative) < 0


@pytest.mark.numerics("floor of the Jensen-Shannon distance")
def test_a_difference_within_the_intervals_is_a_tie():
    """Two models that draw from the very distribution of the real scans: neither is better."""
    weights = torch.rand(2000, generator=generator())

    def clouds(seed):  # which of 2000 cells 60 clouds occupy
        return (torch.rand(60, 2000, generator=generator(seed)) < 0.3 * weights).double()

    real, models = clouds(0), (clouds(1), clouds(2))

    def distance(scenes):
        return histogram_distance(real.sum(0), scenes.sum(0)).jsd_distance

    resampling = Resampling(num_resamples=1000)

    def row_of(scenes):
        interval = resampling.interval(lambda drawn: distance(scenes[drawn]), 60)
        return MetricResult("JSD", distance(scenes), interval)

    one, other = map(row_of, models)
    assert one.ties_with(other)
    floor = distance(clouds(3))
    assert [one.value, other.value] == pytest.approx([floor, floor], rel=0.1)
    assert one.value != other.value
    assert min(one.value, other.value) > 0.05


@pytest.mark.numerics("empty cloud in a matching")
def test_an_empty_cloud_is_refused_by_name():
    """A missing scan must neither be the best match nor make the mean NaN."""
    cloud, empty = drawn(0, 30, 3), torch.zeros(0, 3)
    with pytest.raises(ValueError, match="generated cloud 1 has no point"):
        BEVHistogramDistance(BEVGrid(4.0, 1.0)).update([cloud, empty], real=False)
    for name, pair in (("points_a", (empty, cloud)), ("points_b", (cloud, empty))):
        with pytest.raises(ValueError, match=f"{name} has no point"):
            chamfer_squared(*pair)
    means = [torch.cdist(other, cloud).mean().item() for other in (cloud, empty)]
    assert math.isnan(min(reversed(means))) != math.isnan(min(means))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("padding in the Chamfer distance")
def test_clouds_of_unequal_size_need_no_padding(dtype):
    """Also far from the origin, where squared coordinates leave no digits for the distance."""
    worst = []

    @FEW
    @given(sizes=st.tuples(st.integers(1, 40), st.integers(1, 40)), shift=st.floats(0, 100))
    def check(sizes, shift):
        a, b = ((drawn(n, n, 3) + shift).to(dtype) for n in sizes)
        apart = (a.double()[:, None] - b.double()).square().sum(-1)
        exact = (apart.amin(1).mean() + apart.amin(0).mean()).item() / 2
        assert chamfer_squared(a, b) == pytest.approx(exact, rel=1e-9, abs=1e-12)
        long, short = sorted((a.float(), b.float()), key=len, reverse=True)
        padded = torch.cat([short, torch.full((len(long) - len(short), 3), 1e6)])
        squared = long.square().sum(1)[:, None] + padded.square().sum(1) - 2 * long @ padded.T
        found = (squared.amin(1).mean() + squared.amin(0).mean()).item() / 2
        worst.append(abs(found - exact) / max(exact, 1e-6))

    check()
    assert max(worst) > 1


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("sliced Wasserstein of unequal sizes")
def test_earth_movers_distance_of_sets_of_unequal_size(dtype):
    """There is no sliced distance: ranges are compared in one dimension, by shares."""
    few = torch.rand(2, 4, 8, generator=generator()).mul(50).to(dtype)
    many = few.repeat(3, 1, 1)  # the same distribution from more scans
    metric = RangeHistogramDistance(56.0)
    metric.update(few, real=True)
    metric.update(many, real=False)
    assert metric.compute()["W1 range"] == pytest.approx(0, abs=1e-12)
    metric.update(many + 2, real=False)  # half of the returns move by 2 m
    assert metric.compute()["W1 range"] == pytest.approx(1, abs=0.2)
    a, b = few.flatten().sort().values, many.flatten().sort().values
    with pytest.raises(RuntimeError, match="size of tensor"):
        a - b
    assert (a - b[: len(a)]).abs().float().mean() > 1


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
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
    assert not broken.double().mean(0)[2].isfinite()


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

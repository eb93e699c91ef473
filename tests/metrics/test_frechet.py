"""The streaming Fréchet metric: digits and refusals; two processes in test_distribution.py."""

from __future__ import annotations

import pytest
import torch

from r3dpa.metrics.frechet import FrechetDistance
from r3dpa.metrics.functional import Moments, frechet_distance_of


def draw(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator)


def fill(metric, real, generated, batch=7):
    for part in real.split(batch):
        metric.update(part, real=True)
    for part in generated.split(batch):
        metric.update(part, real=False)
    return metric


def test_stream_equals_whole():
    real, generated = draw(50, 6), draw(43, 6, seed=1) * 1.5 + 1
    metric = fill(FrechetDistance(6), real, generated)
    whole = frechet_distance_of(real, generated)
    assert metric.compute().item() == pytest.approx(whole, rel=1e-12)
    metric.reset()
    fill(metric, generated, real, batch=50)
    assert metric.compute().item() == pytest.approx(whole, rel=1e-12)


def stream_against_float64(num_samples, num_features):
    """Mean 5 and deviation 0.02 break sums of squares in float32 (numerics: 53 % off)."""
    generator = torch.Generator().manual_seed(0)
    factor = torch.randn(num_features, generator=generator).abs() + 0.1
    features = 5 + 0.02 * factor * torch.randn(num_samples, num_features, generator=generator)
    metric = FrechetDistance(num_features)
    for part in features.split(1000):
        metric.update(part, real=True)
        metric.update(part + 0.25, real=False)  # 0.25: sums with it are exact in float32
    exact = features.double()
    exact -= exact.mean(dim=0)
    covariance = Moments.unpack(metric.real_moments).covariance()
    expected = exact.T @ exact / (num_samples - 1)
    assert (covariance - expected).abs().max() < 1e-6 * expected.abs().max()
    return metric.compute().item()


@pytest.mark.numerics
def test_stream_of_float32():
    assert stream_against_float64(4000, 48) == pytest.approx(48 * 0.25**2, rel=1e-6)


@pytest.mark.slow
@pytest.mark.numerics
def test_stream_of_float32_full_size():
    assert stream_against_float64(80_000, 768) == pytest.approx(768 * 0.25**2, rel=1e-6)


def test_reference_in_place_of_real_features():
    real, generated = draw(50, 4), draw(40, 4, seed=1)
    moments = Moments.of(real)
    metric = FrechetDistance(4, reference=(moments.mean, moments.covariance()))
    metric.update(generated, real=False)
    expected = frechet_distance_of(real, generated)
    assert metric.compute().item() == pytest.approx(expected, rel=1e-12)
    with pytest.raises(ValueError, match="beside a reference"):
        metric.update(real, real=True)


def test_few_samples():
    metric = fill(FrechetDistance(6), draw(20, 6), draw(6, 6))
    with pytest.raises(ValueError, match="generated: 6 samples for 6 features, at least 7"):
        metric.compute()
    lenient = fill(FrechetDistance(6, allow_few_samples=True), draw(3, 6), draw(6, 6, seed=1))
    assert lenient.compute().isfinite()
    one = fill(FrechetDistance(6, allow_few_samples=True), draw(1, 6), draw(6, 6))
    with pytest.raises(ValueError, match=r"real: 1 samples .* at least 2"):
        one.compute()


def test_refused_features_leave_the_state():
    metric = FrechetDistance(3)
    broken = draw(5, 3)
    broken[4, 1] = torch.nan
    with pytest.raises(ValueError, match=r"generated features: 1 of 5 rows .* row 4"):
        metric.update(broken, real=False)
    with pytest.raises(ValueError, match=r"real features: expected \(N, 3\), got \(5, 4\)"):
        metric.update(draw(5, 4), real=True)
    assert not metric.generated_moments.any()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_gpu():
    real, generated = draw(50, 6), draw(43, 6, seed=1) + 1
    metric = fill(FrechetDistance(6).cuda(), real.cuda(), generated.cuda())
    expected = frechet_distance_of(real, generated)
    assert metric.compute().item() == pytest.approx(expected, rel=1e-10)

from __future__ import annotations

import math

import pytest
import torch

from r3dpa.flow.interpolant import Interpolant, sample_time
from r3dpa.flow.times import per_sample

PATHS = ["linear", "cosine"]


def draws(*, batch=5, dtype=torch.float64, low=0.0):
    generator = torch.Generator().manual_seed(0)
    data, noise = torch.randn(2, batch, 3, 4, generator=generator, dtype=dtype)
    return data, noise, low + (1 - low) * torch.rand(batch, generator=generator, dtype=dtype)


def gaussian_field(path, x, time, spread):
    """Exact velocity and score of data that are Gaussian with this standard deviation."""
    alpha, sigma, d_alpha, d_sigma = (c[:, None, None] for c in path.coefficients(time))
    variance = (alpha * spread).square() + sigma.square()
    velocity = (d_alpha * alpha * spread**2 + d_sigma * sigma) / variance * x
    return velocity, -x / variance


@pytest.mark.parametrize("path", PATHS)
def test_path_goes_from_data_to_noise(path):
    data, noise, _ = draws()
    path = Interpolant(path)
    zeros, ones = torch.zeros(5).double(), torch.ones(5).double()
    assert torch.equal(path.interpolate(data, noise, zeros), data)
    torch.testing.assert_close(path.interpolate(data, noise, ones), noise, atol=1e-14, rtol=0)


def test_paths_by_hand():
    data, noise, time = torch.tensor([4.0]), torch.tensor([8.0]), torch.tensor([0.25])
    assert Interpolant().interpolate(data, noise, time).item() == 5.0
    assert Interpolant().target(data, noise, time).item() == 4.0
    data, noise, time = torch.tensor([1.0]), torch.tensor([2.0]), torch.tensor([1 / 3])
    path = Interpolant("cosine")  # angle of 30 degrees
    middle = path.interpolate(data, noise, time).item()
    assert middle == pytest.approx(math.sqrt(3) / 2 + 2 * 0.5)
    target = path.target(data, noise, time).item()
    assert target == pytest.approx(math.pi / 2 * (-0.5 + 2 * math.sqrt(3) / 2))


@pytest.mark.parametrize("path", PATHS)
def test_target_is_the_time_derivative_of_the_path(path):
    data, noise, time = draws()
    path = Interpolant(path)
    derivative = torch.func.jvp(
        lambda t: path.interpolate(data, noise, t), (time,), (torch.ones_like(time),)
    )[1]
    torch.testing.assert_close(path.target(data, noise, time), derivative)


@pytest.mark.parametrize("path", PATHS)
def test_sde_drift_of_gaussian_data_is_exact(path):
    x, _, time = draws(low=0.05)
    path = Interpolant(path)
    velocity, score = gaussian_field(path, x, time, spread=0.3)
    expected = velocity - time[:, None, None] * score
    torch.testing.assert_close(path.sde_drift(velocity, x, time), expected)


def score_by_division(path, velocity, x, time):
    """Gradient of the log density as published, not finite at t = 0."""
    alpha, sigma, _, _ = path.coefficients(per_sample(time, x))
    if path.path == "linear":
        return (-alpha * velocity - x) / sigma
    return -(2 / math.pi) * (alpha / sigma) * velocity - x


@pytest.mark.numerics
@pytest.mark.parametrize("path", PATHS)
def test_sde_drift_equals_the_divided_form_and_is_finite_at_both_ends(path):
    velocity, x, _ = draws(batch=1000)
    time = torch.linspace(0.001, 1, 1000).double()
    path = Interpolant(path)
    divided = velocity - time[:, None, None] * score_by_division(path, velocity, x, time)
    drift = path.sde_drift(velocity, x, time)
    torch.testing.assert_close(drift, divided, atol=1e-12, rtol=1e-12)
    ends = torch.tensor([0, 1]).double()
    assert path.sde_drift(velocity[:2], x[:2], ends).isfinite().all()
    assert path.denoise(velocity[:2], x[:2], ends).isfinite().all()
    for dtype in (torch.float64, torch.float32, torch.bfloat16, torch.float16):
        answer = velocity[:2].to(dtype)  # what a network in this precision gives
        assert path.sde_drift(answer, x[:2].float(), ends.float()).isfinite().all()
        naive = answer - ends[:, None, None] * score_by_division(
            path, answer, x[:2].float(), ends.float()
        )
        assert not naive[0].isfinite().any()


def test_sde_drift_by_hand():
    velocity, x, time = torch.tensor([3.0, 3.0]), torch.tensor([1.0, 1.0]), torch.tensor([0.0, 1.0])
    assert Interpolant().sde_drift(velocity, x, time).tolist() == [7.0, 4.0]
    # t score tends to -(4 / pi^2) v at the data end of the cosine path.
    cosine = Interpolant("cosine").sde_drift(velocity, x, time)
    torch.testing.assert_close(cosine, torch.tensor([3 + 12 / math.pi**2, 4.0]))


def test_float32_time_keeps_half_precision_latents_apart():
    data, noise, _ = draws(batch=2)
    time = torch.tensor([0.5, 0.5009])  # one number in bfloat16
    noisy = Interpolant().interpolate(data[:1].bfloat16(), noise[:1].bfloat16(), time[:1])
    later = Interpolant().interpolate(data[:1].bfloat16(), noise[:1].bfloat16(), time[1:])
    assert noisy.dtype == torch.float32
    assert not torch.equal(noisy, later)


def test_unknown_path_and_wrong_times_are_refused():
    with pytest.raises(ValueError, match="'linear' or 'cosine', got 'straight'"):
        Interpolant("straight")
    data, noise, time = draws()
    with pytest.raises(ValueError, match=r"\(5,\), got \(4,\)"):
        Interpolant().interpolate(data, noise, time[:4])
    with pytest.raises(ValueError, match="got 'beta'"):
        sample_time(2, "beta")


def test_sampled_times_follow_their_distribution():
    generator = torch.Generator().manual_seed(0)
    uniform = sample_time(20_000, generator=generator)
    assert uniform.dtype == torch.float32
    assert 0 <= uniform.min() < 0.001
    assert 0.999 < uniform.max() <= 1
    assert uniform.mean().item() == pytest.approx(0.5, abs=0.01)  # 5 standard errors
    lognormal = sample_time(20_000, "lognormal", generator=generator)
    # A standard Gaussian lies below 1 with probability 0.8413.
    share = (lognormal < 1 / (1 + math.exp(-1))).float().mean().item()
    assert share == pytest.approx(0.8413, abs=0.013)
    assert lognormal.median().item() == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("kind", ["uniform", "lognormal"])
def test_sampled_times_repeat_with_the_generator(kind):
    first = sample_time(4, kind, generator=torch.Generator().manual_seed(3))
    assert torch.equal(first, sample_time(4, kind, generator=torch.Generator().manual_seed(3)))
    torch.manual_seed(3)
    assert torch.equal(first, sample_time(4, kind))


DTYPES = [torch.float32, torch.bfloat16, torch.float16]


def unit_roundoff(dtype):
    return torch.finfo(dtype).eps / 2


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("score near the data")
def test_rounding_of_the_velocity_is_not_divided_by_time(dtype):
    """With data d and noise n the score is -n / t exactly, and t score never needs the division."""
    generator = torch.Generator().manual_seed(0)
    data, noise = torch.randn(2, 8, 256, generator=generator, dtype=torch.float64)
    times = torch.logspace(0, -7, 8, dtype=torch.float64)
    path = Interpolant()
    x, velocity = path.interpolate(data, noise, times), path.target(data, noise, times)
    answer = velocity.to(dtype)  # what a network in this precision gives
    drift = path.sde_drift(answer, x.float(), times.float()).double()
    drift_error = (drift - path.sde_drift(velocity, x, times)).abs().amax(dim=1)
    bound = 2 * unit_roundoff(dtype) * velocity.abs().max() + 8 * unit_roundoff(torch.float32)
    assert (drift_error <= bound).all()
    assert path.sde_drift(answer[:1], x[:1].float(), torch.zeros(1)).isfinite().all()

    score = score_by_division(path, answer, x, times)
    score_error = (score + noise / times[:, None]).abs().amax(dim=1)
    assert score_error[-1] > 1e5 * drift_error.max()

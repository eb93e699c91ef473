from __future__ import annotations

import math

import pytest
import torch
from velocities import gaussian_velocity, growth, standard_noise, still

from r3dpa.flow.interpolant import Interpolant
from r3dpa.flow.sde import euler_maruyama
from r3dpa.flow.solvers import euler
from r3dpa.flow.times import sde_times


def test_sde_without_noise_follows_its_drift():
    times = torch.tensor([1.0, 0.6, 0.2, 0.0]).double()
    silence = torch.zeros(2, 1, 1).double()
    start = torch.ones(1, 1).double()
    # On the linear path the drift of velocity 0 is x itself.
    mean = euler_maruyama(still, start, times, silence, last="mean")
    assert mean.item() == pytest.approx((1 - 0.4) * (1 - 0.4) * (1 - 0.2))
    denoised = euler_maruyama(still, start, times, silence)
    assert denoised.item() == pytest.approx((1 - 0.4) * (1 - 0.4))
    # On the cosine path it is t x, and the expected data is cos(pi t / 2) x.
    cosine = euler_maruyama(still, start, times, silence, interpolant=Interpolant("cosine"))
    assert cosine.item() == pytest.approx((1 - 0.4) * (1 - 0.4 * 0.6) * math.cos(0.1 * math.pi))


def test_sde_adds_noise_of_variance_two_t_dt():
    def without_drift(x, time):
        return -x / (2 - time[:, None])

    times = torch.tensor([1.0, 0.6, 0.2, 0.0]).double()
    draws = [torch.full((1, 1), 3.0).double(), torch.full((1, 1), -1.0).double()]
    start = torch.zeros(1, 1).double()
    result = euler_maruyama(without_drift, start, times, draws, last="mean")
    assert result.item() == pytest.approx(3 * math.sqrt(2 * 0.4) - math.sqrt(2 * 0.6 * 0.4))


def test_sde_drift_is_changed_in_every_step_but_the_last():
    seen = []

    def change(drift, x, time):
        seen.append(time.item())
        return drift + 10

    times = torch.tensor([1.0, 0.5, 0.25, 0.0])
    draws = torch.zeros(2, 1, 1)
    result = euler_maruyama(still, torch.zeros(1, 1), times, draws, change_drift=change)
    assert seen == [1.0, 0.5]
    assert result.item() == pytest.approx((-5) - 0.25 * (-5 + 10))


def test_sde_noise_repeats_with_its_generator():
    generators = [torch.Generator().manual_seed(5) for _ in range(2)]
    one, same = (euler_maruyama(growth, standard_noise(2, 3), sde_times(4), g) for g in generators)
    assert torch.equal(one, same)


@pytest.mark.parametrize(
    ("times", "draws", "options", "message"),
    [
        ([1.0, 0.5, 0.0], 0, {}, r"1 draws of shape \(2, 3\) are needed, got 0 draws"),
        ([1.0, 0.5, 0.1], 1, {}, r"ends at t = 0, but the last time is 0\.1"),
        ([0.0, 0.5, 1.0], 1, {"last": "mean"}, "must decrease"),
        ([1.0, 1.0, 0.0], 1, {}, "all increase or all decrease"),
        ([1.0, 0.0], 0, {"last": "full"}, "'denoise' or 'mean', got 'full'"),
        ([1.0, 0.0], 0, {"eta": -0.5}, r"0 or above, got -0\.5"),
    ],
)
def test_sde_that_cannot_run_is_refused(times, draws, options, message):
    times = torch.tensor(times).double()
    with pytest.raises(ValueError, match=message):
        euler_maruyama(growth, torch.ones(2, 3), times, torch.zeros(draws, 2, 3), **options)
    with pytest.raises(ValueError, match=r"\(2, 3\) are needed, got a draw of shape \(3,\)"):
        euler_maruyama(growth, torch.ones(2, 3), sde_times(3), torch.zeros(2, 3))


@pytest.mark.numerics
def test_last_step_keeps_fine_detail():
    noise = standard_noise(20_000, 1)
    velocity = gaussian_velocity(0.1)

    def spread(times, last):
        generator = torch.Generator().manual_seed(1)
        return euler_maruyama(velocity, noise, times, generator, last=last).std().item()

    # 20 000 samples know a standard deviation to 0.5 %.
    assert spread(sde_times(256, last=0.005), "denoise") == pytest.approx(0.1, rel=0.02)
    assert spread(sde_times(256), "denoise") == pytest.approx(0.093, rel=0.02)
    assert spread(sde_times(256), "mean") == pytest.approx(0.077, rel=0.02)


@pytest.mark.numerics
def test_noise_per_sample_makes_a_sample_independent_of_its_batch():
    velocity, times = gaussian_velocity(0.3), sde_times(8)

    def draws(indices):
        generators = [torch.Generator().manual_seed(index) for index in indices]
        while True:
            yield torch.stack([torch.randn(4, generator=generator) for generator in generators])

    def sample(indices):
        noise = draws(indices)
        return euler_maruyama(velocity, next(noise), times, noise)

    together = sample(range(8))
    for index in range(8):
        assert torch.equal(sample([index])[0], together[index])

    def naive(batch):
        generator = torch.Generator().manual_seed(0)
        return euler_maruyama(velocity, torch.ones(batch, 4), times, generator)

    assert not torch.equal(naive(1)[0], naive(8)[0])


@pytest.mark.parametrize("options", [{}, {"last": "mean"}, {"eta": 0.5}])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
def test_one_evaluation_a_step_with_the_dtype_of_the_state(options, dtype):
    seen = []

    def velocity(x, time):
        seen.append((x.dtype, time.dtype, tuple(time.shape)))
        return x.bfloat16()

    x = torch.ones(2, 3, dtype=dtype)
    for steps in (1, 6):
        result = euler_maruyama(velocity, x, sde_times(steps), torch.Generator(), **options)
        assert result.dtype == dtype
    wide = torch.float64 if dtype == torch.float64 else torch.float32
    assert seen == 7 * [(dtype, wide, (2,))]


@pytest.mark.parametrize("last", ["denoise", "mean"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_sde_without_diffusion_is_euler_to_the_bit(last, dtype):
    x, times = standard_noise(4, 3, dtype=dtype), sde_times(9)
    velocity = gaussian_velocity(0.3)
    given = euler_maruyama(velocity, x, times, torch.Generator(), eta=0.0, last=last)
    assert torch.equal(given, euler(velocity, x, times))


def test_sde_step_scales_with_eta():
    # v = 0 on the linear path: score -x / t, so the drift is eta x and w = 2 eta t.
    times = torch.tensor([1.0, 0.6, 0.0]).double()
    draw, start = torch.full((1, 1, 1), 3.0).double(), torch.ones(1, 1).double()
    result = euler_maruyama(still, start, times, draw, eta=0.25, last="mean")
    after = 1 - 0.4 * 0.25 + math.sqrt(2 * 0.25 * 0.4) * 3
    assert result.item() == pytest.approx(after * (1 - 0.6 * 0.25))


@pytest.mark.parametrize("path", ["linear", "cosine"])
@pytest.mark.parametrize("eta", [0.25, 1.0])
def test_every_eta_has_the_marginals_of_the_data(eta, path):
    velocity, interpolant = gaussian_velocity(0.5, path, mean=2.0), Interpolant(path)
    generator = torch.Generator().manual_seed(4)
    noise = standard_noise(20_000, 1)
    times = sde_times(200, last=0.01)
    data = euler_maruyama(velocity, noise, times, generator, eta=eta, interpolant=interpolant)
    # 20 000 samples know the mean to 0.0035 and the deviation to 0.5 %; the steps err by 1 %.
    assert data.mean().item() == pytest.approx(2, abs=0.015)
    assert data.std().item() == pytest.approx(0.5, rel=0.025)

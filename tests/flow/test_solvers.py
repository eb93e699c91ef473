from __future__ import annotations

import math

import pytest
import torch

from r3dpa.flow.interpolant import Interpolant
from r3dpa.flow.solvers import (
    CountingVelocity,
    euler,
    euler_maruyama,
    heun,
    ode_times,
    sde_times,
)


def still(x, time):
    return torch.zeros_like(x)


def steady(x, time):
    return torch.ones_like(x)


def parabola(x, time):
    return 3 * time.square()[:, None].expand_as(x)


def growth(x, time):
    """Linear ODE whose solution is x(1) exp(-(1 - t)) going backwards."""
    return x


def gaussian_velocity(spread):
    """Exact velocity of Gaussian data on the linear path."""

    def velocity(x, time):
        t = time[:, None]
        return (t - (1 - t) * spread**2) / ((1 - t).square() * spread**2 + t.square()) * x

    return velocity


def standard_noise(*shape, seed=0, dtype=torch.float64):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_time_grids_by_hand():
    torch.testing.assert_close(ode_times(4), torch.tensor([1, 0.75, 0.5, 0.25, 0]).double())
    torch.testing.assert_close(ode_times(2, 0.0, 0.6), torch.tensor([0, 0.3, 0.6]).double())
    torch.testing.assert_close(sde_times(3, last=0.2), torch.tensor([1, 0.6, 0.2, 0]).double())
    assert sde_times(1).tolist() == [1.0, 0.0]
    assert sde_times(5)[-2] == 0.04
    assert ode_times(3).dtype == sde_times(3).dtype == torch.float64


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        (lambda: ode_times(0), "at least one step, got 0"),
        (lambda: ode_times(3, start=1.2), r"1\.2 and 0\.0"),
        (lambda: ode_times(3, start=0.0), r"0\.0 and 0\.0"),
        (lambda: sde_times(-1), "at least one step, got -1"),
        (lambda: sde_times(3, last=0.0), r"\(0, 1\), got 0\.0"),
        (lambda: euler(growth, torch.ones(1, 1), torch.ones(1)), r"got shape \(1,\)"),
    ],
)
def test_impossible_times_are_refused(grid, message):
    with pytest.raises(ValueError, match=message):
        grid()


def test_euler_of_a_parabola_is_the_left_sum():
    steps, start = 8, torch.full((2, 1), 5.0).double()
    expected = 5 - (steps + 1) * (2 * steps + 1) / (2 * steps**2)
    result = euler(parabola, start, ode_times(steps))
    torch.testing.assert_close(result, torch.full((2, 1), expected).double())


def test_heun_of_a_parabola_is_the_trapezoidal_sum_but_for_the_last_step():
    steps, start = 8, torch.full((2, 1), 5.0).double()
    width = 1 / steps
    trapezoids = (1 - width**3) + (steps - 1) * width**3 / 2
    expected = 5 - trapezoids - width * 3 * width**2
    result = heun(parabola, start, ode_times(steps))
    torch.testing.assert_close(result, torch.full((2, 1), expected).double())


@pytest.mark.parametrize(("solver", "order"), [(euler, 1), (heun, 2)])
@pytest.mark.parametrize("ends", [(1.0, 0.0), (0.0, 1.0)])
def test_halving_the_step_divides_the_error_by_two_to_the_order(solver, order, ends):
    start = torch.tensor([[2.0]]).double()
    exact = 2 * math.exp(ends[1] - ends[0])
    errors = [
        (solver(growth, start, ode_times(steps, *ends)) - exact).abs().item() for steps in (40, 80)
    ]
    assert errors[0] / errors[1] == pytest.approx(2**order, rel=0.15)


@pytest.mark.parametrize(
    ("solve", "nfe"),
    [
        (lambda v, x: euler(v, x, ode_times(6)), 6),
        (lambda v, x: heun(v, x, ode_times(6)), 11),
        (lambda v, x: heun(v, x, ode_times(1)), 1),
        (lambda v, x: euler_maruyama(v, x, sde_times(6), torch.Generator()), 6),
        (lambda v, x: euler_maruyama(v, x, sde_times(6), torch.Generator(), last="mean"), 6),
        (lambda v, x: euler_maruyama(v, x, sde_times(1), []), 1),
    ],
)
def test_network_evaluations_are_counted(solve, nfe):
    counted = CountingVelocity(growth)
    solve(counted, torch.ones(2, 3))
    assert counted.nfe == nfe


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
def test_state_keeps_its_dtype_and_times_are_at_least_float32(dtype):
    seen = []

    def velocity(x, time):
        seen.append((x.dtype, time.dtype, tuple(time.shape)))
        return x.bfloat16()

    x = torch.ones(2, 3, dtype=dtype)
    results = [solver(velocity, x, ode_times(3)) for solver in (euler, heun)]
    results += [
        euler_maruyama(velocity, x, sde_times(3), torch.Generator(), last=last)
        for last in ("denoise", "mean")
    ]
    assert all(result.dtype == dtype for result in results)
    wide = torch.float64 if dtype == torch.float64 else torch.float32
    assert set(seen) == {(dtype, wide, (2,))}


def test_solvers_keep_no_graph():
    weight = torch.ones(1, requires_grad=True)
    result = euler(lambda x, time: weight * x, torch.ones(1, 1), ode_times(2))
    assert not result.requires_grad


def test_heun_takes_its_second_slope_from_the_corrector():
    result = heun(steady, torch.zeros(1, 1), ode_times(2), corrector_velocity=still)
    assert result.item() == -0.5 * 0.5 - 0.5


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


def test_sde_noise_is_given_or_drawn_from_a_generator():
    x, times = standard_noise(2, 3), sde_times(4)
    generator = torch.Generator().manual_seed(5)
    draws = torch.randn(3, 2, 3, generator=generator, dtype=torch.float64)
    given = euler_maruyama(growth, x, times, draws)
    assert torch.equal(given, euler_maruyama(growth, x, times, list(draws)))
    one, same = (
        euler_maruyama(growth, x, times, torch.Generator().manual_seed(5)) for _ in range(2)
    )
    assert torch.equal(one, same)


@pytest.mark.parametrize(
    ("times", "draws", "options", "message"),
    [
        ([1.0, 0.5, 0.0], 0, {}, r"1 draws of shape \(2, 3\) are needed, got 0 draws"),
        ([1.0, 0.5, 0.1], 1, {}, r"ends at t = 0, but the last time is 0\.1"),
        ([0.0, 0.5, 1.0], 1, {"last": "mean"}, "must decrease"),
        ([1.0, 1.0, 0.0], 1, {}, "must decrease"),
        ([1.0, 0.0], 0, {"last": "full"}, "'denoise' or 'mean', got 'full'"),
    ],
)
def test_sde_that_cannot_run_is_refused(times, draws, options, message):
    times = torch.tensor(times).double()
    with pytest.raises(ValueError, match=message):
        euler_maruyama(growth, torch.ones(2, 3), times, torch.zeros(draws, 2, 3), **options)


def test_sde_refuses_draws_of_another_shape():
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


@pytest.mark.parametrize("solver", [euler, heun])
def test_ode_recovers_the_spread_of_gaussian_data(solver):
    noise = standard_noise(5, 7)
    data = solver(gaussian_velocity(0.5), noise, ode_times(400))
    torch.testing.assert_close(data, 0.5 * noise, atol=5e-3, rtol=5e-3)


@pytest.mark.numerics
def test_float32_state_is_close_to_float64():
    noise = standard_noise(64, 16)
    wide = euler(gaussian_velocity(0.3), noise, ode_times(256))

    def error(dtype):
        narrow = euler(gaussian_velocity(0.3), noise.to(dtype), ode_times(256))
        return (narrow.double() - wide).square().mean().sqrt()

    assert error(torch.float32) < 1e-4
    assert error(torch.bfloat16) > 1e-4


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

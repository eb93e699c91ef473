"""Diffusion as a path of the solvers, and its steps with noise."""

from __future__ import annotations

import math

import pytest
import torch

from r3dpa.baselines.diffusion import loss_weight, weighted_mean
from r3dpa.baselines.diffusion_paths import (
    DiffusionPath,
    StepPath,
    forward_step,
    inpaint,
    repaint,
)
from r3dpa.flow.interpolant import Interpolant
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.flow.sde import ancestral, ancestral_step
from r3dpa.flow.solvers import euler
from r3dpa.flow.times import ode_times

PATHS = [
    DiffusionPath(),
    DiffusionPath(schedule="linear"),
    DiffusionPath(shift=2 * math.log(0.5)),
]


@pytest.mark.parametrize("path", PATHS, ids=lambda path: f"{path.schedule}{path.shift:.1f}")
def test_coefficients_and_their_derivatives(path):
    """Near the data too, down to where the rate of the linear schedule is held."""
    time = torch.tensor([2e-4, 5e-4, 5e-3, *torch.linspace(0.02, 0.98, 25).tolist()]).double()
    time.requires_grad_()
    alpha, sigma, d_alpha, d_sigma = path.coefficients(time)
    torch.testing.assert_close(alpha.square() + sigma.square(), torch.ones_like(time))
    for value, derivative in ((alpha, d_alpha), (sigma, d_sigma)):
        (expected,) = torch.autograd.grad(value.sum(), time, retain_graph=True)
        torch.testing.assert_close(derivative, expected)


@pytest.mark.parametrize("path", PATHS, ids=lambda path: f"{path.schedule}{path.shift:.1f}")
def test_velocity_is_that_of_the_interpolant(path):
    data, noise = torch.randn(2, 6, 3, dtype=torch.float64, generator=torch.manual_seed(0))
    time = torch.linspace(0.05, 0.95, 6, dtype=torch.float64)
    noisy = path.interpolate(data, noise, time)
    velocity = path.velocity(data, noisy, time)
    torch.testing.assert_close(velocity, path.target(data, noise, time))
    torch.testing.assert_close(path.denoise(velocity, noisy, time), data)


@pytest.mark.parametrize(
    ("solver", "steps"),
    [
        ("heun", 60),
        ("ab3", 100),
        ("euler_maruyama", 150),
        ("ddpm", 150),
        ("dpmpp_2m", 20),  # the last step, to the end of the path, is of first order
        ("unipc", 20),
    ],
)
def test_solvers_reach_the_spread_of_gaussian_data(solver, steps):
    """Data N(0, 0.25): the expected data is ``alpha / (alpha^2 + 4 sigma^2) x``."""
    path, generator = DiffusionPath(), torch.Generator().manual_seed(0)

    def velocity(x, time):
        alpha, sigma, *_ = path.coefficients(time[:, None])
        data = 0.25 * alpha / (0.25 * alpha.square() + sigma.square()) * x
        return path.velocity(data, x, time)

    noise = torch.randn(5_000, 1, generator=generator, dtype=torch.float64)
    found = SamplerConfig(solver, steps).solve(velocity, noise, generator, path)
    # 5,000 draws: the standard error of the deviation is 1 %.
    assert found.std().item() == pytest.approx(0.5, rel=0.05)


def test_steps_without_noise_on_the_linear_path_are_euler_steps():
    x = torch.randn(4, 3, dtype=torch.float64, generator=torch.manual_seed(0))

    def velocity(x, time):
        return torch.sin(3 * x) + time[:, None]

    times = ode_times(7)
    found = ancestral(velocity, x, times, [], eta=0.0)
    torch.testing.assert_close(found, euler(velocity, x, times))


@pytest.mark.parametrize("path", [Interpolant(), DiffusionPath()], ids=["linear", "diffusion"])
def test_a_step_with_noise_draws_from_the_posterior(path):
    """Mean and deviation of q(x_s | x_t, data) by Bayes' rule for Gaussians."""
    data, x = torch.tensor([[0.3]]).double(), torch.tensor([[-0.8]]).double()
    here, there = torch.tensor([0.7]).double(), torch.tensor([0.4]).double()
    alpha_t, sigma_t, *_ = path.coefficients(here)
    alpha_s, sigma_s, *_ = path.coefficients(there)
    gain = alpha_t / alpha_s
    spread = sigma_t.square() - (gain * sigma_s).square()  # of x_t given x_s
    variance = 1 / (1 / sigma_s.square() + gain.square() / spread)
    mean = variance * (alpha_s * data / sigma_s.square() + gain * x / spread)
    for draw in (-1.0, 0.0, 2.0):
        noise = torch.full_like(x, draw)
        found = ancestral_step(data, x, here, there, noise, interpolant=path)
        torch.testing.assert_close(found, mean + variance.sqrt() * draw)


def test_eta_is_checked_and_counts_draws():
    x = torch.zeros(1, 1)
    with pytest.raises(ValueError, match=r"eta of ancestral steps must be in \[0, 1\], got 2"):
        ancestral(lambda x, t: x, x, ode_times(2), [], eta=2.0)
    with pytest.raises(ValueError, match="2 draws of shape"):
        ancestral(lambda x, t: x, x, ode_times(2), [x])


@pytest.mark.parametrize("counts", [(0, 1, 1), (4, 0, 1), (4, 1, 0)])
def test_repaint_refuses_no_steps(counts):
    steps, resamplings, jump = counts
    with pytest.raises(ValueError, match=f"at least 1, got {steps}, {resamplings} and {jump}"):
        repaint(
            *(lambda x, t: x, torch.zeros(1), torch.zeros(1), iter(()), DiffusionPath()), *counts
        )


def counted_draws(shape, taken):
    while True:
        taken.append(torch.randn(shape, dtype=torch.float64))
        yield taken[-1]


@pytest.mark.parametrize(
    ("steps", "resamplings", "jump", "num"), [(2, 2, 1, 8), (1, 3, 2, 5), (3, 1, 1, 7)]
)
def test_draws_of_repaint(steps, resamplings, jump, num):
    """The state; two for each small step; one for each step back, but none in the last interval."""
    taken, known = [], torch.zeros(1, 1, dtype=torch.float64)
    draws = counted_draws((1, 1), taken)
    repaint(lambda x, t: x, known, known, draws, DiffusionPath(), steps, resamplings, jump)
    assert (
        len(taken)
        == num
        == 1 + 2 * jump * (resamplings * (steps - 1) + 1) + jump * (resamplings - 1) * (steps - 1)
    )


@pytest.mark.parametrize("path", PATHS, ids=lambda path: f"{path.schedule}{path.shift:.1f}")
def test_a_step_forward_gives_the_signal_and_noise_of_the_later_time(path):
    here, there = torch.tensor([0.2, 0.5]).double(), torch.tensor([0.6, 0.9]).double()
    alpha_s, sigma_s, *_ = path.coefficients(here)
    alpha_t, sigma_t, *_ = path.coefficients(there)
    zero, one = torch.zeros(2, 1).double(), torch.ones(2, 1).double()
    of_data = forward_step(alpha_s[:, None] * one, here, there, zero, path)
    torch.testing.assert_close(of_data[:, 0], alpha_t)
    of_noise = forward_step(sigma_s[:, None] * one, here, there, zero, path)
    of_draw = forward_step(zero, here, there, one, path)
    torch.testing.assert_close((of_noise.square() + of_draw.square())[:, 0], sigma_t.square())


def test_known_parts_have_the_noise_of_the_time_that_the_network_is_asked_about():
    """One draw for each step, and no other noise."""
    path, taken, seen = DiffusionPath(), [], []
    known = torch.full((1, 2), 0.7, dtype=torch.float64)
    mask = torch.tensor([1.0, 0.0]).double()

    def velocity(x, time):
        seen.append((x[0, 0], time))
        return 0 * x

    draws = counted_draws((1, 2), taken)
    inpaint(velocity, torch.randn(1, 2).double(), known, mask, ode_times(3), draws, path)
    assert len(taken) == len(seen) == 3
    for (value, time), draw in zip(seen, taken, strict=True):
        torch.testing.assert_close(value, path.interpolate(known, draw, time.double())[0, 0])


@pytest.mark.parametrize("schedule", ["cosine", "linear"])
def test_the_shift_is_added_to_the_log_snr(schedule):
    time = torch.linspace(0.1, 0.9, 5).double()
    shifted = DiffusionPath(schedule=schedule, shift=-1.5).log_snr(time)
    torch.testing.assert_close(shifted, DiffusionPath(schedule=schedule).log_snr(time) - 1.5)


@pytest.mark.parametrize("path", PATHS, ids=lambda path: f"{path.schedule}{path.shift:.1f}")
def test_the_score_points_against_the_noise(path):
    data, noise = torch.randn(2, 4, 3, dtype=torch.float64, generator=torch.manual_seed(0))
    time = torch.linspace(0.2, 0.9, 4, dtype=torch.float64)
    noisy = path.interpolate(data, noise, time)
    sigma = path.coefficients(time)[1][:, None]
    score = path.score(path.velocity(data, noisy, time), noisy, time)
    torch.testing.assert_close(score, -noise / sigma)


class TestDiscreteSteps:
    path = StepPath()

    def test_roots_of_the_variances_rise_linearly(self):
        betas = self.path.betas
        assert (betas[0].item(), betas[-1].item()) == pytest.approx((0.0015, 0.0195))
        assert betas[499:501].sqrt().mean().item() == pytest.approx((0.0015**0.5 + 0.0195**0.5) / 2)

    def test_times_of_whole_steps_have_the_signal_of_these(self):
        """Times in float32, whose product with the number of steps is not whole."""
        steps = torch.arange(1000)
        time = steps / 1000
        assert torch.equal(self.path.step_of(time), steps.float())
        expected = self.path.signal.logit().float()
        torch.testing.assert_close(self.path.log_snr(time), expected)

    def test_between_two_steps_the_log_snr_is_straight(self):
        time = torch.tensor([0.0005, 0.5004, 0.9985]).double().requires_grad_()
        (slope,) = torch.autograd.grad(self.path.log_snr(time).sum(), time)
        alpha, sigma, d_alpha, d_sigma = self.path.coefficients(time)
        of_alpha, of_sigma = (
            torch.autograd.grad(value.sum(), time, retain_graph=True)[0] for value in (alpha, sigma)
        )
        assert (slope < 0).all()
        torch.testing.assert_close(d_alpha, of_alpha)
        torch.testing.assert_close(d_sigma, of_sigma)


def test_weights_bound_the_signal_to_noise_ratio():
    log_snr = torch.tensor([-3.0, 0.0, 4.0])
    snr = log_snr.exp()
    torch.testing.assert_close(loss_weight(log_snr, "x_0"), snr.clamp(max=5))
    torch.testing.assert_close(loss_weight(log_snr, "eps", None), torch.ones(3))
    # The error of v is that of the data times snr + 1.
    torch.testing.assert_close(loss_weight(log_snr, "v") * (snr + 1), snr.clamp(max=5))


def test_the_released_weighting_ignores_which_sample_an_error_is_of():
    errors, weights = torch.tensor([1.0, 3.0]), torch.tensor([0.0, 1.0])
    assert weighted_mean(errors, weights) == 1.5
    assert weighted_mean(errors, weights, official=True) == 1.0
    assert weighted_mean(errors.flip(0), weights, official=True) == 1.0

from __future__ import annotations

import math
from itertools import pairwise
from typing import get_args
from unittest.mock import Mock

import pytest
import torch
from velocities import gaussian_velocity, growth, standard_noise, still

from r3dpa.bench.problems import GaussianMixture
from r3dpa.flow.interpolant import Interpolant
from r3dpa.flow.sampler import SamplerConfig, Solver
from r3dpa.flow.solvers import (
    ODE_SOLVERS,
    ab2,
    ab3,
    euler,
    evaluations,
    heun,
    midpoint,
    ode_solver,
    steps_for,
    unipc,
)
from r3dpa.flow.times import ode_times

UNEVEN = torch.tensor([1.0, 0.9, 0.75, 0.7, 0.45, 0.2, 0.1, 0.0]).double()
INSIDE = torch.tensor([0.95, 0.9, 0.75, 0.7, 0.45, 0.2, 0.1, 0.05]).double()
DATA_PREDICTION = ("dpmpp_2m", "unipc")


def steady(x, time):
    return torch.ones_like(x)


def parabola(x, time):
    return 3 * time.square()[:, None].expand_as(x)


def wave(x, time):
    """Velocity without any structure of a path; its solution is C exp(sin(2 t))."""
    return 2 * torch.cos(2 * time)[:, None] * x


def test_euler_and_heun_of_a_parabola():
    """The left sum, and the trapezoidal sum but for the last step."""
    steps, start = 8, torch.full((2, 1), 5.0).double()
    left = (steps + 1) * (2 * steps + 1) / (2 * steps**2)
    result = euler(parabola, start, ode_times(steps))
    torch.testing.assert_close(result, start - left)
    width = 1 / steps
    trapezoids = (1 - width**3) + (steps - 1) * width**3 / 2
    result = heun(parabola, start, ode_times(steps))
    torch.testing.assert_close(result, start - trapezoids - width * 3 * width**2)


def test_solvers_keep_no_graph():
    weight = torch.ones(1, requires_grad=True)
    result = euler(lambda x, time: weight * x, torch.ones(1, 1), ode_times(2))
    assert not result.requires_grad


def test_heun_takes_its_second_slope_from_the_corrector():
    result = heun(steady, torch.zeros(1, 1), ode_times(2), corrector_velocity=still)
    assert result.item() == -0.5 * 0.5 - 0.5


ORDERS = {"euler": 1, "heun": 2, "midpoint": 2, "ab2": 2, "ab3": 3, "dpmpp_2m": 2, "unipc": 3}


@pytest.mark.parametrize(("solver", "order"), ORDERS.items())
@pytest.mark.parametrize(("ends", "shift"), [((0.9, 0.1), 2.0), ((0.1, 0.9), 1.0)])
def test_halving_the_step_divides_the_error_by_two_to_the_order(solver, order, ends, shift):
    start = torch.tensor([[2.0]]).double()
    exact = 2 * math.exp(math.sin(2 * ends[1]) - math.sin(2 * ends[0]))

    def error(steps):
        return abs(ODE_SOLVERS[solver](wave, start, ode_times(steps, *ends, shift)).item() - exact)

    assert math.log2(error(400) / error(800)) == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize(("solver", "order"), (ORDERS | {"unipc": 2}).items())
@pytest.mark.parametrize(
    ("ends", "path"),
    [((1.0, 0.0), "linear"), ((1.0, 0.0), "cosine"), ((0.0, 1.0), "cosine")],
)
def test_order_from_end_to_end(solver, order, ends, path):
    """From noise to data and back, where the log-SNR is infinite: the slope over three doublings.

    DPM-Solver++ loses a logarithm there. The midpoint rule gains an order on this ODE.
    """
    start, spread = torch.ones(1, 1).double(), 0.5
    exact = spread if ends[1] == 0 else 1 / spread
    solve, velocity = ode_solver(solver, Interpolant(path)), gaussian_velocity(spread, path)

    def error(steps):
        return abs(solve(velocity, start, ode_times(steps, *ends)).item() - exact)

    coarse, fine = error(80), error(640)
    slope = math.log2(coarse / fine) / 3
    assert slope > order - (0.4 if solver == "dpmpp_2m" else 0.25)
    assert fine < (5e-3 if order == 1 else 2e-4)


@pytest.mark.parametrize(("solver", "degree"), [(ab2, 1), (ab3, 2)])
@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.numerics("multistep solver on unequal steps")
def test_adams_bashforth_integrates_polynomials_on_uneven_grids(solver, degree, flip):
    """Once its history is full; what the first steps, of lower order, add is subtracted."""
    times = UNEVEN.flip(0) if flip else UNEVEN
    begin = times[degree]

    def power(x, time):
        return ((time - begin) ** degree)[:, None].expand_as(x)

    start = torch.zeros(1, 1).double()
    first = solver(power, start, times[: degree + 1])
    result = solver(power, start, times) - first
    assert result.item() == pytest.approx(
        ((times[-1] - begin) ** (degree + 1) / (degree + 1)).item()
    )


def published(velocity, x, times, interpolant, correct):
    """DPM-Solver++(2M) and UniPC-2 (B_2) as published: h, phi and the linear system of UniC.

    Independent of the code under test, for finite lambda only.
    """

    def at(time):
        alpha, sigma, _, _ = interpolant.coefficients(time)
        return alpha, sigma, (alpha / sigma).log()

    def data_of(x, time):
        batch = torch.full((len(x),), time.item()).double()
        return interpolant.denoise(velocity(x, batch), x, batch)

    nodes = [(at(times[0])[2], data_of(x, times[0]))]
    for index, (now, then) in enumerate(pairwise(times)):
        (_, sigma_s, lambda_s), (alpha_t, sigma_t, lambda_t) = at(now), at(then)
        h = lambda_t - lambda_s
        phi = torch.expm1(-h)
        base = sigma_t / sigma_s * x - alpha_t * phi * nodes[-1][1]
        differences, ratios = [], []
        if index:
            r = (nodes[-2][0] - lambda_s) / h
            ratios, differences = [r], [(nodes[-2][1] - nodes[-1][1]) / r]
        x = base - alpha_t * phi * sum(0.5 * difference for difference in differences)
        if index == len(times) - 2:
            return x
        new = data_of(x, then)
        if correct:
            phi_2 = phi / -h - 1
            phi_3 = phi_2 / -h - 1 / 2
            differences.append(new - nodes[-1][1])
            if index:
                matrix = torch.tensor([[1, 1], [ratios[0], 1]]).double()
                rho = torch.linalg.solve(matrix, torch.stack([phi_2, 2 * phi_3]) / phi)
            else:
                rho = [0.5]
            bend = sum(
                weight * difference for weight, difference in zip(rho, differences, strict=True)
            )
            x = base - alpha_t * phi * bend
        nodes.append((lambda_t, new))
    return x


@pytest.mark.parametrize("solver", DATA_PREDICTION)
@pytest.mark.parametrize("path", ["linear", "cosine"])
@pytest.mark.parametrize("times", [INSIDE, INSIDE.flip(0)])
def test_data_prediction_against_the_published_formulas(solver, path, times):
    interpolant = Interpolant(path)

    def velocity(x, time):
        return torch.sin(3 * x) + wave(x, time)

    x = standard_noise(5, 3)
    given = ode_solver(solver, interpolant)(velocity, x, times)
    expected = published(velocity, x, times, interpolant, correct=solver == "unipc")
    torch.testing.assert_close(given, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("solver", DATA_PREDICTION)
@pytest.mark.parametrize("path", ["linear", "cosine"])
def test_infinite_log_snr_is_the_limit_of_finite_ones(solver, path):
    """One step from almost pure noise, and the last one onto the data."""
    interpolant = Interpolant(path)
    solve, velocity, x = ode_solver(solver, interpolant), wave, standard_noise(2, 3)
    times = torch.tensor([1.0, 0.6]).double()
    near = solve(velocity, x, torch.tensor([1.0 - 1e-9, 0.6]).double())
    torch.testing.assert_close(solve(velocity, x, times), near, rtol=1e-6, atol=1e-6)
    state, at = near, torch.full((2,), 0.6).double()
    expected = interpolant.denoise(velocity(state, at), state, at)
    result = solve(velocity, near, torch.tensor([0.6, 0.0]).double())
    torch.testing.assert_close(result, expected)
    if path == "linear":
        torch.testing.assert_close(solve(velocity, x, times), euler(velocity, x, times))


def test_first_steps_of_unipc_by_hand():
    """Linear path from pure noise: Euler, then the mean of both expected data instead of one."""

    def velocity(x, time):
        return x * time[:, None] + 1

    x0 = 2.0
    v0 = x0 + 1
    x1 = x0 - 0.5 * v0
    data0, data1 = x0 - v0, x1 - 0.5 * (x1 * 0.5 + 1)
    corrected = 0.5 * (data0 + data1) / 2 + 0.5 * x0
    # Second and last step, to 0.25: first order from the corrected state, data1 kept.
    noise = (corrected - 0.5 * data1) / 0.5
    times = torch.tensor([1.0, 0.5, 0.25]).double()
    result = unipc(velocity, torch.full((1, 1), x0).double(), times)
    assert result.item() == pytest.approx(0.75 * data1 + 0.25 * noise)


@pytest.mark.parametrize("solver", DATA_PREDICTION)
def test_first_two_steps_from_the_data_are_of_first_order(solver):
    """The first is not corrected, the second has no finite step before it: Euler on this path."""
    x, times = standard_noise(2, 3), torch.tensor([0.0, 0.25, 0.5]).double()
    torch.testing.assert_close(ODE_SOLVERS[solver](wave, x, times), euler(wave, x, times))


@pytest.mark.parametrize("solver", ODE_SOLVERS)
@pytest.mark.parametrize("steps", [1, 2, 3, 6])
def test_network_evaluations_are_known_beforehand(solver, steps):
    counted = Mock(wraps=growth)
    ODE_SOLVERS[solver](counted, torch.ones(2, 3), ode_times(steps))
    assert counted.call_count == evaluations(solver, steps)
    assert steps_for(solver, counted.call_count) == steps
    assert steps_for(solver, counted.call_count + 2) > steps
    assert evaluations(solver, steps_for(solver, 16)) in (15, 16)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: evaluations("rk4", 3), "euler, heun, .*, unipc, got 'rk4'"),
        (lambda: evaluations("ab2", 0), "at least one step, got 0"),
        (lambda: steps_for("midpoint", 1), "midpoint cannot make a step with 1 network"),
        (lambda: steps_for("rk45", 9), "got 'rk45'"),
        (lambda: ode_solver("Euler"), "got 'Euler'"),
    ],
)
def test_unknown_solvers_and_counts_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("solver", ODE_SOLVERS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
@pytest.mark.numerics("state in half precision")
def test_state_keeps_its_dtype_and_times_are_at_least_float32(solver, dtype):
    seen = []

    def velocity(x, time):
        seen.append((x.dtype, time.dtype, tuple(time.shape)))
        return x.bfloat16()

    result = ODE_SOLVERS[solver](velocity, torch.ones(2, 3, dtype=dtype), ode_times(4))
    assert result.dtype == dtype
    wide = torch.float64 if dtype == torch.float64 else torch.float32
    assert set(seen) == {(dtype, wide, (2,))}


@pytest.mark.parametrize("solver", ODE_SOLVERS)
def test_samples_do_not_depend_on_their_batch(solver):
    velocity, x = gaussian_velocity(0.3), standard_noise(5, 3)
    together = ODE_SOLVERS[solver](velocity, x, UNEVEN)
    for index in range(len(x)):
        alone = ODE_SOLVERS[solver](velocity, x[index : index + 1], UNEVEN)
        assert torch.equal(alone[0], together[index])


@pytest.mark.parametrize("path", ["linear", "cosine"])
@pytest.mark.parametrize("solver", get_args(Solver))
def test_the_listed_times_are_those_of_the_evaluations(solver, path):
    sampler, seen = SamplerConfig(solver, 4), []

    def velocity(x, time, target=None):
        seen.append(time[0].item())
        return torch.zeros_like(x)

    noise = torch.zeros(1, 2, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    sampler.solve(velocity, noise, generator, Interpolant(path))
    assert sampler.times().tolist() == seen
    assert len(seen) == sampler.nfe


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.numerics("inversion to noise and back")
def test_midpoint_steps_invert_what_euler_steps_do_not(dtype):
    """The velocity is rounded to ``dtype`` as that of a network; the state is at least float32."""
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(8, 64, generator=generator, dtype=torch.float64)
    mixture = GaussianMixture(means, 0.2, torch.ones(8))
    place = torch.multinomial(torch.ones(8).double(), 64, replacement=True, generator=generator)
    noise = torch.randn(64, 64, generator=generator, dtype=torch.float64)
    data = (means[place] + 0.2 * noise).to(torch.promote_types(dtype, torch.float32))

    def velocity(x, time):
        return mixture.velocity(x, time).to(dtype)

    def round_trip(solver, steps):
        outward = ode_times(steps, start=0.0, stop=1.0)
        back = solver(velocity, solver(velocity, data, outward), outward.flip(0))
        return (back - data).square().mean().sqrt().item()

    assert round_trip(midpoint, 25) < 1e-2  # 50 evaluations each way
    euler_error = round_trip(euler, 50)
    assert euler_error > 0.1

"""Hard cases of the interpolant and the samplers."""

from __future__ import annotations

import math

import pytest
import torch

from r3dpa.bench.problems import GaussianMixture
from r3dpa.flow import Interpolant, ab2, euler, midpoint, ode_times
from r3dpa.flow.times import step_pairs

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

    score = path.score(answer, x, times)
    score_error = (score + noise / times[:, None]).abs().amax(dim=1)
    assert score_error[-1] > 1e5 * drift_error.max()


@pytest.mark.parametrize("lengths", [(1.0, 3.0), (4.0, 1.0), (1.0, 2.0, 5.0)])
@pytest.mark.numerics("multistep solver on unequal steps")
def test_halving_unequal_steps_quarters_the_error_of_ab2(lengths):
    start = torch.ones(1, 1, dtype=torch.float64)

    def times_of(repeats):
        steps = torch.tensor(lengths, dtype=torch.float64).repeat(repeats)
        return torch.cat([torch.ones(1), 1 - steps.cumsum(0) / steps.sum()])

    def equal_steps_ab2(velocity, x, times):
        last = None
        for now, then in step_pairs(times):
            slope = velocity(x, torch.full((1,), now))
            x = x + (then - now) * (slope if last is None else 1.5 * slope - 0.5 * last)
            last = slope
        return x

    def ratio(solver):
        errors = [
            abs(solver(lambda x, time: x, start, times_of(repeats)).item() - math.exp(-1))
            for repeats in (100, 200)
        ]
        return errors[0] / errors[1]

    assert ratio(ab2) == pytest.approx(4, rel=0.15)
    assert ratio(equal_steps_ab2) < 2.5


@pytest.mark.parametrize("dtype", [torch.float64, *DTYPES])
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


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("state in half precision")
def test_velocity_in_half_precision_on_a_float32_state(dtype):
    """Rounding errors of the velocity average out; those of the state grow with the steps."""
    mixture = GaussianMixture(torch.zeros(1, 16), 0.3, torch.ones(1))
    noise = torch.randn(64, 16, generator=torch.Generator().manual_seed(0))
    exact = euler(mixture.velocity, noise.double(), ode_times(256))

    def error(velocity_dtype, state_dtype):
        def velocity(x, time):
            return mixture.velocity(x.double(), time).to(velocity_dtype)

        state = euler(velocity, noise.to(state_dtype), ode_times(256))
        return (state.double() - exact).square().mean().sqrt().item()

    float32_state = error(dtype, torch.float32)
    assert float32_state < 2e-1 * unit_roundoff(dtype) + 1e-6
    half = torch.bfloat16 if dtype == torch.float32 else dtype
    assert error(half, half) > 3 * float32_state

from __future__ import annotations

from itertools import combinations, pairwise

import pytest
import torch

from r3dpa.flow import ode_times
from r3dpa.flow.mixture import toy_mixture
from r3dpa.flow.tuned import TunedSolver, multistep
from r3dpa.flow.tuning import (
    Pairs,
    best_shift,
    converged_pairs,
    optimal_times,
    search_solver,
    solver_error,
)

MIXTURE = toy_mixture().velocity


def standard_noise(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def growth(x, time):
    """Ends at x / e."""
    return x


@pytest.fixture(scope="module")
def pairs():
    """Training, held-out and test pairs of the toy mixture."""
    every = converged_pairs(MIXTURE, standard_noise(192, 64), 200, 192)
    parts = zip(every.noise.split(64), every.solution.split(64), strict=True)
    return [Pairs(*part, every.uncertainty) for part in parts]


def test_the_reference_certifies_itself():
    noise = standard_noise(4, 3)
    few, many = (converged_pairs(growth, noise, steps, 3) for steps in (20, 40))
    exact = noise * torch.exp(torch.tensor(-1.0))

    def true_error(pairs):
        return (pairs.solution - exact).square().mean().sqrt().item()

    assert true_error(many) < many.uncertainty < few.uncertainty / 3  # order 2: a quarter
    assert 2 < many.uncertainty / true_error(many) < 4  # the half errs four times as much
    with pytest.raises(ValueError, match="even"):
        converged_pairs(growth, noise, 5)


def test_errors_by_hand():
    """Euler in one step from x to x - v = 0, where the solution is 1, 1, 4."""
    solver = TunedSolver.from_adams(ode_times(1), 1)
    pairs = Pairs(torch.ones(3, 2), torch.tensor([1.0, 1.0, 4.0])[:, None].expand(3, 2))
    rmse, mean, median = solver_error(growth, solver, pairs, batch_size=2)
    assert (rmse, mean, median) == pytest.approx((6**0.5, 2.0, 1.0))


@pytest.mark.parametrize("num_steps", [1, 2, 3, 4, 9])
def test_dynamic_programming_finds_what_enumeration_finds(num_steps):
    """The cost is taken anew from stored states, step by step, for every choice of times."""
    noise, candidates, substeps = standard_noise(16, 64), 9, 3
    times = ode_times(candidates)
    fine = ode_times(candidates * substeps)
    states, slopes, x = [noise], [], noise
    for index, (now, then) in enumerate(pairwise(fine)):
        slope = MIXTURE(x, now.expand(16))
        if index % substeps == 0:
            slopes.append(slope)
        x = x + (then - now) * MIXTURE(x + (then - now) / 2 * slope, ((now + then) / 2).expand(16))
        if index % substeps == substeps - 1:
            states.append(x)

    def cost(path):
        total = 0.0
        for n in range(num_steps):
            step = times[path[n + 1]] - times[path[n]]
            slope = slopes[path[n]]
            if n > 0:
                change = slope - slopes[path[n - 1]]
                slope = slope + step / (2 * (times[path[n]] - times[path[n - 1]])) * change
            error = states[path[n]] + step * slope - states[path[n + 1]]
            total += error.square().mean().item()
        return total

    paths = [(0, *inner, 9) for inner in combinations(range(1, 9), num_steps - 1)]
    found = optimal_times(MIXTURE, noise, num_steps, num_candidates=candidates, substeps=substeps)
    torch.testing.assert_close(found, times[list(min(paths, key=cost))], rtol=0, atol=0)


def test_learned_times_beat_equidistant_ones(pairs):
    train, _, test = pairs
    learned, equidistant = (
        solver_error(MIXTURE, TunedSolver.from_adams(times, 2), test)
        for times in (optimal_times(MIXTURE, train.noise, 8), ode_times(8))
    )
    assert learned.rmse < 0.8 * equidistant.rmse
    with pytest.raises(ValueError, match="64 candidates, got 65"):
        optimal_times(MIXTURE, train.noise, 65)


def test_the_search_beats_ab2_on_noise_it_has_not_seen(pairs):
    train, held_out, test = pairs
    shifted = TunedSolver.from_adams(ode_times(8, shift=2.0), 2)
    searched = search_solver(MIXTURE, train, held_out, best_shift(MIXTURE, train, 8), iterations=60)
    before, after = (solver_error(MIXTURE, solver, test) for solver in (shifted, searched))
    assert after.median < before.median / 5, (before, after)
    assert after.mean < 0.7 * before.mean, (before, after)
    assert after.rmse < before.rmse, (before, after)


def test_the_search_is_reproducible_and_keeps_the_band(pairs):
    start = TunedSolver.from_adams(ode_times(5), 2)
    first, second = (
        search_solver(MIXTURE, *pairs[:2], start, iterations=5, batch_size=24, check_every=2)
        for _ in range(2)
    )
    assert torch.equal(first.times, second.times)
    assert torch.equal(first.coefficients, second.coefficients)
    assert not torch.equal(first.times, start.times)
    assert not first.coefficients.tril(-2).any()


def test_the_search_returns_its_start_when_it_finds_nothing_better(pairs):
    start = TunedSolver.from_adams(ode_times(5, shift=2.0), 2)
    found = search_solver(MIXTURE, *pairs[:2], start, iterations=2, learning_rate=30.0)
    assert found is start


def test_velocities_beyond_the_band_are_refused(pairs):
    start = TunedSolver.from_adams(ode_times(5), 3)
    with pytest.raises(ValueError, match="more than the last 2 velocities"):
        search_solver(MIXTURE, *pairs[:2], start)
    with pytest.raises(ValueError, match="at least 1"):
        search_solver(MIXTURE, *pairs[:2], start, iterations=0)


def test_the_search_leaves_a_network_alone(pairs):
    """Parameters get no gradient, and inference mode around the call does no harm."""
    network = torch.nn.Linear(64, 64).double()

    def velocity(x, time):
        return torch.tanh(network(x)) * (1 + time[:, None])

    train, held_out, _ = pairs
    start = TunedSolver.from_adams(ode_times(4), 2)
    own = [
        Pairs(part.noise, converged_pairs(velocity, part.noise, 50).solution)
        for part in (train, held_out)
    ]
    found = search_solver(velocity, *own, start, iterations=20)
    assert network.weight.grad is None
    assert solver_error(velocity, found, own[1]).mean < solver_error(velocity, start, own[1]).mean


def test_gradients_of_times_and_coefficients():
    noise = standard_noise(2, 64)
    start = TunedSolver.from_adams(ode_times(3, shift=2.0), 2)
    used = torch.ones(3, 3, dtype=torch.bool).tril()

    def end(times, coefficients):
        return multistep(MIXTURE, noise, times, coefficients, used)

    inner = (start.times.requires_grad_(), start.coefficients.requires_grad_())
    assert torch.autograd.gradcheck(end, inner, atol=1e-6)

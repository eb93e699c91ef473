from __future__ import annotations

import json

import pytest
import torch

from r3dpa.flow import CountingVelocity, ab2, ab3, euler, ode_times
from r3dpa.flow.mixture import toy_mixture
from r3dpa.flow.tuned import TunedSolver

UNEVEN = torch.tensor([1.0, 0.93, 0.6, 0.55, 0.2, 0.0], dtype=torch.float64)


def standard_noise(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_solver(num_steps, seed=0):
    """Any times, any lower triangle whose rows sum to 1."""
    steps = 0.1 + standard_noise(num_steps, seed=seed).abs()
    times = 1 - torch.cat([torch.zeros(1).double(), steps.cumsum(0) / steps.sum()])
    times[-1] = 0
    past = standard_noise(num_steps, num_steps, seed=seed + 1).tril(-1)
    return TunedSolver(times, past + torch.diag(1 - past.sum(1)), {"name": "random", "steps": 7})


def direct_ab2(velocity, x, times):
    """AB2 as in a textbook, the velocity extrapolated along the line through the last two."""
    before = None
    for now, then in zip(times[:-1].tolist(), times[1:].tolist(), strict=True):
        slope = velocity(x, torch.full((len(x),), now, dtype=x.dtype))
        middle = (now + then) / 2
        bend = 0.0 if before is None else (slope - before[1]) / (now - before[0]) * (middle - now)
        x = x + (then - now) * (slope + bend)
        before = now, slope
    return x


@pytest.mark.parametrize("times", [ode_times(6, shift=2.0), UNEVEN], ids=["shifted", "uneven"])
@pytest.mark.parametrize(("order", "solver"), [(1, euler), (2, ab2), (2, direct_ab2), (3, ab3)])
def test_adams_solvers_are_special_cases(order, solver, times):
    velocity, noise = toy_mixture().velocity, standard_noise(8, 64)
    expected = solver(velocity, noise, times)
    solved = TunedSolver.from_adams(times, order).solve(velocity, noise)
    torch.testing.assert_close(solved, expected, rtol=0, atol=1e-12)  # float64 rounding


def test_ab2_weights_by_hand():
    """Step 0.25 after a step of 0.5: h / (2 h0) = 1 / 4."""
    solver = TunedSolver.from_adams(torch.tensor([1, 0.5, 0.25, 0]), order=2)
    expected = torch.tensor([[1, 0, 0], [-0.25, 1.25, 0], [0, -0.5, 1.5]]).double()
    torch.testing.assert_close(solver.coefficients, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("num_steps", [1, 2, 7])
def test_a_constant_velocity_is_followed_exactly(num_steps):
    noise, constant = standard_noise(3, 5), standard_noise(3, 5, seed=9)
    solver = random_solver(num_steps)
    counted = CountingVelocity(lambda x, time: constant)
    torch.testing.assert_close(solver.solve(counted, noise), noise - constant, rtol=0, atol=1e-12)
    assert counted.nfe == solver.num_steps == num_steps


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_state_keeps_its_dtype_and_times_are_not_rounded_with_it(dtype):
    seen = []

    def velocity(x, time):
        seen.append(time)
        return x.double()

    assert random_solver(3).solve(velocity, torch.ones(2, 4, dtype=dtype)).dtype == dtype
    assert {time.dtype for time in seen} == {torch.float32}
    assert {tuple(time.shape) for time in seen} == {(2,)}


def test_json_round_trip_is_bit_exact(tmp_path):
    solver = random_solver(9)
    solver.save(tmp_path / "new" / "solver.json")
    loaded = TunedSolver.load(tmp_path / "new" / "solver.json")
    assert torch.equal(loaded.times, solver.times)
    assert torch.equal(loaded.coefficients, solver.coefficients)
    assert loaded.card == solver.card
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["solver.json"]


def test_a_card_that_json_cannot_hold_leaves_the_old_file(tmp_path):
    path = tmp_path / "solver.json"
    random_solver(2).save(path)
    before = path.read_bytes()
    broken = random_solver(2)
    with pytest.raises(ValueError, match="JSON compliant"):
        TunedSolver(broken.times, broken.coefficients, {"error": float("nan")}).save(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("format"), "field 'format'"),
        (lambda c: c.update(format="something else"), "field 'format'.*something else"),
        (lambda c: c.pop("times"), "field 'times'"),
        (lambda c: c["times"].__setitem__(1, "half"), "field 'times'"),
        (lambda c: c["times"].__setitem__(1, True), "field 'times'"),
        (lambda c: c["times"].__setitem__(1, float("nan")), "field 'times'"),
        (lambda c: c["times"].__setitem__(1, 1.5), "times must decrease"),
        (lambda c: c["times"].__setitem__(-1, 0.1), "times must go from 1 to 0"),
        (lambda c: c.update(coefficients=None), "field 'coefficients'"),
        (lambda c: c["coefficients"].pop(), "coefficients must be"),
        (lambda c: c["coefficients"][1].append(0.0), r"field 'coefficients\[1\]'.*2 numbers"),
        (lambda c: c["coefficients"].__setitem__(0, [1.1]), "row 0 sums to 1.1"),
        (lambda c: c.pop("card"), "field 'card'"),
    ],
)
def test_a_damaged_file_is_named_with_its_field(tmp_path, change, message):
    path = tmp_path / "solver.json"
    random_solver(4).save(path)
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message) as caught:
        TunedSolver.load(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "\x00\x01"])
def test_what_is_no_solver_at_all_is_refused(tmp_path, text):
    path = tmp_path / "solver.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=str(path)):
        TunedSolver.load(path)


def test_wrong_numbers_are_refused():
    times = ode_times(2)
    with pytest.raises(ValueError, match="lower triangular"):
        TunedSolver(times, torch.tensor([[0.5, 0.5], [0.0, 1.0]]))
    with pytest.raises(ValueError, match="finite"):
        TunedSolver(times, torch.tensor([[1.0, 0.0], [torch.nan, 1.0]]))
    with pytest.raises(ValueError, match="order must be 1, 2 or 3, got 4"):
        TunedSolver.from_adams(times, 4)

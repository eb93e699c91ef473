from __future__ import annotations

import pytest
import torch
from velocities import still

from r3dpa.editing.latents import (
    invert,
    noise_inside_mask,
    restore_outside_mask,
    slerp,
)
from r3dpa.flow.interpolant import Interpolant
from r3dpa.flow.solvers import ODE_SOLVERS, ode_solver
from r3dpa.flow.times import ode_times


def latents():
    return torch.randn(2, 3, 4, 6, generator=torch.Generator().manual_seed(0)).double()


def edit_mask():
    mask = torch.zeros(2, 1, 4, 6, dtype=torch.bool)
    mask[:, :, :, 2:4] = True
    return mask


def silence(num):
    return torch.zeros(num, 2, 3, 4, 6).double()


def growth(x, time):
    return x * (1 + time)[:, None, None, None]


class TestInvert:
    def test_euler_steps_by_hand(self):
        def velocity(x, time):
            return 2 * time[:, None, None, None].expand_as(x)

        way = invert(velocity, latents(), ode_times(3, start=0.6), "euler")
        # Left sums of 2 t over 0, 0.2, 0.4 in steps of 0.2, from data to noise.
        for state, moved in zip(way.states, [0.24, 0.08, 0.0, 0.0], strict=True):
            torch.testing.assert_close(state, latents() + moved)
        assert torch.equal(way.states[-1], latents())
        assert way.times.tolist() == ode_times(3, start=0.6).tolist()

    @pytest.mark.parametrize("solver", ODE_SOLVERS)
    def test_first_state_is_that_of_the_solver_on_the_mirrored_grid(self, solver):
        times = ode_times(6, shift=2.0)
        way = invert(growth, latents(), times, solver)
        assert torch.equal(way.states[0], ode_solver(solver)(growth, latents(), times.flip(0)))
        assert way.states.shape == (7, 2, 3, 4, 6)

    def test_path_reaches_the_solvers_that_use_it(self):
        cosine = Interpolant("cosine")
        way = invert(growth, latents(), ode_times(5), "unipc", interpolant=cosine)
        assert not torch.equal(way.states, invert(growth, latents(), ode_times(5), "unipc").states)

    def test_grids_and_solvers_that_do_not_exist_are_refused(self):
        with pytest.raises(ValueError, match="from noise to data; got"):
            invert(still, latents(), ode_times(3).flip(0))
        with pytest.raises(ValueError, match="got 'rk45'"):
            invert(still, latents(), ode_times(3), "rk45")


class TestKept:
    @pytest.mark.parametrize("start", [1.0, 0.6])
    @pytest.mark.parametrize("solver", ODE_SOLVERS)
    def test_latents_outside_the_mask_come_back_bit_by_bit(self, solver, start):
        """And at every time on the way they are those of the inversion, whatever the velocity."""
        way = invert(growth, latents(), ode_times(6, start=start), "euler")
        noise = latents().flip(0)
        put_back, seen = restore_outside_mask(way, edit_mask()), []

        def after_step(x, time, index):
            x = put_back(x, time, index)
            seen.append(torch.where(edit_mask(), way.states[index], x))
            return x

        def elsewhere(x, time):
            return 3 * torch.ones_like(x) - growth(x, time)

        begin = noise_inside_mask(way, edit_mask(), noise)
        end = ode_solver(solver, after_step=after_step)(elsewhere, begin, way.times)
        mask = edit_mask().expand_as(end)
        assert torch.equal(end[~mask], latents()[~mask])
        assert (end - latents())[mask].abs().min() > 0
        assert len(seen) == 6
        assert all(torch.equal(state, way.states[index]) for index, state in enumerate(seen, 1))

    @pytest.mark.parametrize("solver", ODE_SOLVERS)
    def test_without_other_influence_the_edited_part_is_a_plain_sample(self, solver):
        """The velocity of a pixel depends on that pixel alone."""
        way = invert(growth, latents(), ode_times(6), solver)
        begin = noise_inside_mask(way, edit_mask(), latents().flip(0))
        edited = ode_solver(solver, after_step=restore_outside_mask(way, edit_mask()))(
            growth, begin, way.times
        )
        plain = ode_solver(solver)(growth, begin, way.times)
        expected = torch.where(edit_mask(), plain, latents())
        assert torch.equal(edited, expected)

    def test_a_solver_on_another_grid_is_refused(self):
        way = invert(growth, latents(), ode_times(4), "euler")
        for times in (ode_times(5), ode_times(4, shift=2.0)):
            solve = ode_solver("euler", after_step=restore_outside_mask(way, edit_mask()))
            with pytest.raises(ValueError, match="step 1 of the solver ends at t = "):
                solve(growth, latents(), times)
        longer = [*ode_times(4).tolist(), -0.25]
        with pytest.raises(ValueError, match="step 5 of the solver"):
            solve(growth, latents(), torch.tensor(longer).double())

    def test_masks_and_noise_that_do_not_fit_are_refused(self):
        way = invert(growth, latents(), ode_times(2), "euler")
        for mask in (edit_mask().float(), edit_mask()[0], edit_mask()[..., :2]):
            with pytest.raises(ValueError, match=r"such as \(2, 1, 4, 6\); got torch"):
                restore_outside_mask(way, mask)
            with pytest.raises(ValueError, match=r"such as \(2, 1, 4, 6\); got torch"):
                noise_inside_mask(way, mask, latents())
        with pytest.raises(ValueError, match=r"shape \(2, 3, 4, 6\), got \(1, 3, 4, 6\)"):
            noise_inside_mask(way, edit_mask(), latents()[:1])


def test_all_of_the_noise_at_time_1_and_a_part_before():
    noise = latents().flip(0)
    for start, path in ((1.0, "linear"), (0.25, "linear"), (0.25, "cosine")):
        way = invert(growth, latents(), ode_times(3, start=start), "euler")
        state = noise_inside_mask(way, edit_mask(), noise, Interpolant(path))
        quarter = torch.tensor(torch.pi / 8).double()
        data, fresh = (1 - start, start) if path == "linear" else (quarter.cos(), quarter.sin())
        inside = data * latents() + fresh * noise
        torch.testing.assert_close(state, torch.where(edit_mask(), inside, way.states[0]))


class TestSphericalMean:
    def test_by_hand(self):
        east, north = torch.tensor([[2.0, 0.0]]), torch.tensor([[0.0, 2.0]])
        third = slerp(east, north, 1 / 3)
        torch.testing.assert_close(third, 2 * torch.tensor([[3**0.5 / 2, 0.5]]))

    def test_ends_and_equal_noises(self):
        first, second = latents(), latents().flip(0)
        torch.testing.assert_close(slerp(first, second, 0.0), first)
        torch.testing.assert_close(slerp(first, second, 1.0), second)
        torch.testing.assert_close(slerp(first, first, 0.3), first)
        opposite = slerp(first, -first, 0.5)
        assert opposite.abs().max() < 1e-12

    def test_impossible_means_are_refused(self):
        with pytest.raises(ValueError, match=r"share in \[0, 1\], got .* 1.5"):
            slerp(latents(), latents(), 1.5)
        with pytest.raises(ValueError, match="one shape"):
            slerp(latents(), latents()[:1], 0.5)

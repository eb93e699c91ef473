from __future__ import annotations

import pytest
import torch

from r3dpa.flow.times import ode_times, sde_times, step_pairs


def test_time_grids_by_hand():
    torch.testing.assert_close(ode_times(4), torch.tensor([1, 0.75, 0.5, 0.25, 0]).double())
    torch.testing.assert_close(ode_times(2, 0.0, 0.6), torch.tensor([0, 0.3, 0.6]).double())
    torch.testing.assert_close(sde_times(3, last=0.2), torch.tensor([1, 0.6, 0.2, 0]).double())
    assert sde_times(1).tolist() == [1.0, 0.0]
    assert sde_times(5)[-2] == 0.04
    assert ode_times(3).dtype == sde_times(3).dtype == torch.float64


def test_shift_by_hand():
    # s u / (1 + (s - 1) u) at u = 3/4, 1/2, 1/4 for s = 2
    expected = torch.tensor([1, 6 / 7, 2 / 3, 2 / 5, 0]).double()
    torch.testing.assert_close(ode_times(4, shift=2.0), expected)
    torch.testing.assert_close(ode_times(4, 0.0, 1.0, shift=2.0), expected.flip(0))
    # s and 1 / s mirror each other.
    torch.testing.assert_close(ode_times(4, shift=0.5), 1 - expected.flip(0))


def test_part_of_a_shifted_grid_lies_on_the_whole():
    whole = ode_times(8, shift=3.0)
    part = ode_times(5, start=whole[2].item(), stop=whole[7].item(), shift=3.0)
    torch.testing.assert_close(part, whole[2:8])
    for start in (0.1, 0.3, 0.6, 0.7, 0.9):  # to the bit, whatever the way there and back rounds
        ends = ode_times(5, start=start, stop=start / 3, shift=3.0)[[0, -1]]
        assert ends.tolist() == [start, start / 3]


@pytest.mark.parametrize(("start", "stop"), [(1.0, 0.0), (0.3, 0.9), (0.0, 0.7)])
def test_no_shift_is_linspace_to_the_bit(start, stop):
    linear = torch.linspace(start, stop, 8, dtype=torch.float64)
    assert torch.equal(ode_times(7, start, stop), linear)


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        (lambda: ode_times(0), "at least one step, got 0"),
        (lambda: ode_times(3, start=1.2), r"1\.2 and 0\.0"),
        (lambda: ode_times(3, start=0.0), r"0\.0 and 0\.0"),
        (lambda: ode_times(3, shift=0.0), r"above 0, got 0\.0"),
        (lambda: sde_times(-1), "at least one step, got -1"),
        (lambda: sde_times(3, last=0.0), r"\(0, 1\), got 0\.0"),
        (lambda: step_pairs(torch.ones(1)), r"got shape \(1,\)"),
        (lambda: step_pairs(torch.ones(2, 2)), r"got shape \(2, 2\)"),
        (lambda: step_pairs(torch.tensor([1.0, 0.5, 0.75])), "all increase or all decrease"),
        (lambda: step_pairs(torch.tensor([1.0, 0.5, 0.5])), "all increase or all decrease"),
        (lambda: step_pairs(torch.tensor([0.5, 0.5])), "all increase or all decrease"),
    ],
)
def test_impossible_times_are_refused(grid, message):
    with pytest.raises(ValueError, match=message):
        grid()

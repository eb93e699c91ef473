"""What is in front of a box moves into it; corrected states lie on the path of corrected data."""

from __future__ import annotations

import pytest
import torch

from r3dpa.editing.placement import correct_data, is_corrected, move_behind
from r3dpa.flow.interpolant import Interpolant

FRONT_M = torch.tensor([[8.0, 8.0, 8.0, 8.0, 8.0, 8.0, 0.0]])


def test_what_stands_in_front_of_a_box_moves_by_one_factor():
    """Factors to the near side: 2, 2, 2, 2 and 1.6, of which four in five are at most 2."""
    range_m = torch.tensor([[[4.0, 4.0, 4.0, 4.0, 5.0, 12.0, 3.0]]])
    expected = torch.tensor([[[8.0, 8.0, 8.0, 8.0, 10.0, 12.0, 3.0]]])
    torch.testing.assert_close(move_behind(range_m, FRONT_M), expected)


def test_pixels_that_the_factor_leaves_in_front_end_at_the_near_side():
    """Of factors 4 and five times 1.6 or so, the largest does not count."""
    range_m = torch.tensor([[[2.0, 5.0, 5.0, 5.0, 5.0, 5.0, 0.0]]])
    moved = move_behind(range_m, FRONT_M)
    torch.testing.assert_close(moved, torch.tensor([[[8.0, 8.0, 8.0, 8.0, 8.0, 8.0, 0.0]]]))


def test_images_without_anything_in_front_stay_bit_by_bit():
    """No return, a return in the box, one just before it, and one outside of its pixels."""
    range_m = torch.tensor([[[0.0, 9.0, 8.0, 7.9, 30.0, 8.1, 1.5]], [[4.0] * 7]])
    moved = move_behind(range_m, FRONT_M)
    assert moved[0].equal(range_m[0])
    assert not moved[1].equal(range_m[1])


@pytest.mark.parametrize("path", ["linear", "cosine"])
def test_a_corrected_state_has_the_corrected_data_and_the_same_noise(path):
    interpolant = Interpolant(path)
    data, noise = torch.randn(2, 3, generator=torch.Generator().manual_seed(0))[:, None]

    def velocity(x, time):
        return interpolant.target(data, noise, time)

    hook = correct_data(velocity, lambda estimate: 2 * estimate + 1, interpolant)
    for time, corrected in ((0.5, 2 * data + 1), (0.98, data), (0.1, data)):
        state = interpolant.interpolate(data, noise, torch.tensor([time]))
        expected = interpolant.interpolate(corrected, noise, torch.tensor([time]))
        torch.testing.assert_close(hook(state, time, 1), expected)
        assert is_corrected(time) == (time == 0.5)

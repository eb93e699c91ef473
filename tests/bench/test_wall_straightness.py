import math

import pytest
import torch
from wall_straightness import figures, residuals_m

from r3dpa.geometry import LidarSensor, SphericalProjection, unproject

PROJECTION = SphericalProjection(LidarSensor(beams=16, columns=1024))


def flat_wall(distance_m=10.0):
    """Ranges of a wall across the way ahead; the rays behind see nothing."""
    rays = unproject(torch.ones(16, 1024), PROJECTION)
    ahead = rays[..., 0] > 0.8
    return torch.where(ahead, distance_m / rays[..., 0].clamp(min=0.1), 0.0)


def test_a_flat_wall_is_straight():
    found = residuals_m(flat_wall(), PROJECTION)
    assert len(found) > 100
    assert found.max() < 1e-4


def test_the_residual_is_the_depth_of_a_wave():
    """Every second column 4 cm farther: 5 of 9 returns on one line and 4 on the other.

    The best line lies between them; the RMS distance of such a mixture is the step times
    sqrt(5/9 * 4/9) = 0.497, and the columns are nearly at right angles to the wall ahead.
    """
    wall = flat_wall()
    wall[:, ::2] += torch.where(wall[:, ::2] > 0, 0.04, 0.0)
    columns = wall[:, 500:524].contiguous()
    padded = torch.zeros_like(wall)
    padded[:, 500:524] = columns
    expected = 0.04 * math.sqrt(20 / 81)
    assert residuals_m(padded, PROJECTION).median().item() == pytest.approx(expected, rel=0.02)
    assert figures([padded], PROJECTION)["residual_cm"] == pytest.approx(100 * expected, rel=0.02)


def test_ground_far_returns_and_edges_are_no_walls():
    low = flat_wall()
    heights = unproject(low, PROJECTION)[..., 2]
    assert len(residuals_m(torch.where(heights > -0.8, 0.0, low), PROJECTION)) == 0
    assert len(residuals_m(flat_wall(40.0), PROJECTION)) == 0
    edges = flat_wall()
    edges[:, ::4] += 2.0
    assert len(residuals_m(edges, PROJECTION)) == 0

import math
import pickle

import numpy as np
import pytest
import torch

from r3dpa.features import Masking, ScanGrid, prepare_scan
from r3dpa.features.voxels import NUM_TARGETS

GRID = ScanGrid((-8.0, -8.0, -2.0), (8.0, 8.0, 4.0), cell_m=0.5, voxel_m=0.1, num_neighbors=4)
LOCAL = 8  # descriptors of the point itself; then 8 of each window, of which:
LOW, HIGH, COUNT, INTENSITY = 0, 1, 2, 7


@pytest.fixture
def points():
    """A point per cell on the ground, and five above that at (2.25, 2.25), up to 2 m."""
    centres = torch.arange(-5.75, 6, 0.5)
    ground = torch.cartesian_prod(centres, centres, torch.tensor([-1.7]))
    pole = torch.tensor([[2.25, 2.25, -1.7 + 0.4 * step] for step in range(1, 6)])
    intensity = torch.cat([torch.full((len(ground), 1), 0.2), torch.full((5, 1), 0.8)])
    return torch.cat([torch.cat([ground, pole]), intensity], dim=1)


def draw(points, seed=0, **options):
    return Masking(GRID, **options)(points, np.random.default_rng(seed))


def test_a_scan_out_of_view_has_nothing_to_hide(points):
    assert draw(points + 100).hidden.shape == (0,)


def test_surroundings_by_hand(points):
    scan = prepare_scan(points, GRID)
    targets = Masking(GRID).describe(points, scan)
    assert targets.shape == (len(points), NUM_TARGETS)
    top = scan.features[:, 3].argmax()
    own, near, far = targets[top, LOCAL:].unflatten(0, (3, 8))
    # Squares of 1, 3 and 9 cells, each with a point on the ground, and the five of the pole.
    for window, cells in ((own, 1), (near, 9), (far, 81)):
        assert window[LOW].item() == pytest.approx(2.0, abs=1e-5)
        assert window[HIGH].item() == 0
        assert window[COUNT].item() == pytest.approx(math.log(cells + 5), abs=1e-4)
        mean = (0.2 * cells + 0.8 * 5) / (cells + 5)
        assert window[INTENSITY].item() == pytest.approx(mean, abs=1e-4)
    corner = scan.features[:, 1:3].sum(dim=1).argmin()  # a quarter of its square has points
    near = targets[corner, LOCAL:].unflatten(0, (3, 8))[1]
    assert near[COUNT].item() == pytest.approx(math.log(4), abs=1e-4)


def test_views_are_drawn_and_nothing_but_the_generator_counts(points):
    one, same, other = draw(points, 1), draw(points, 1), draw(points, 2)
    assert torch.equal(one.scan.features, same.scan.features)
    assert torch.equal(one.hidden, same.hidden)
    assert not torch.equal(one.scan.features, other.scan.features)
    before = points.clone()
    draw(points, 3)
    assert torch.equal(points, before)
    masking = Masking(GRID)
    again = pickle.loads(pickle.dumps(masking))(points, np.random.default_rng(1))  # noqa: S301
    assert torch.equal(again.hidden, one.hidden)


def test_a_view_is_a_rotation_or_a_mirror_image(points):
    sides = set()
    for seed in range(8):
        scan = draw(points, seed).scan
        seen, before = scan.features[:, 1:4].double(), points[scan.kept].double()
        assert torch.equal(seen[:, 2], before[:, 2])
        map_, *_ = torch.linalg.lstsq(before[:, :2], seen[:, :2])
        assert torch.allclose(map_ @ map_.T, torch.eye(2).double(), atol=1e-6)
        sides.add(round(torch.linalg.det(map_).item()))
    assert sides == {-1, 1}


def test_hidden_blocks_follow_the_rays():
    """A wall seen from the sensor: neighbours within a block of rays share their fate."""
    y, z = torch.meshgrid(torch.arange(-3, 3, 0.15), torch.arange(-1.5, 1.5, 0.15), indexing="ij")
    wall = torch.stack([torch.full_like(y, 5.0), y, z, torch.zeros_like(y)], -1).reshape(-1, 4)
    shares = []
    for seed in range(20):
        masked = draw(wall, seed, max_hidden=0.6)
        shares.append(masked.hidden.float().mean().item())
        image = torch.zeros(len(wall), dtype=torch.bool)
        image[masked.scan.kept] = masked.hidden
        changes = (image.reshape(y.shape).diff(dim=0)).float().mean().item()
        assert changes < 0.35  # single points, hidden by a coin, would give up to 0.5
    assert min(shares) < 0.15
    assert 0.2 < np.mean(shares) < 0.4  # half of max_hidden
    assert not draw(wall, max_hidden=0.0).hidden.any()
    with pytest.raises(ValueError, match=r"max_hidden must be .* got 1\.0"):
        Masking(GRID, max_hidden=1.0)

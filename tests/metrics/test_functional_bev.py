"""Distances of occupancy histograms and point clouds, by hand and against plain loops."""

import math

import numpy as np
import pytest
import torch
from draws import drawn
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import jensenshannon

from r3dpa.metrics.functional_bev import (
    BEVGrid,
    chamfer_squared,
    histogram_distance,
    minimum_matching,
)

FEW = settings(derandomize=True, max_examples=15, deadline=None, database=None)
DTYPES = [torch.float32, torch.bfloat16, torch.float16]
GRID = BEVGrid(4.0, 1.0)


def cloud(*xy):
    return torch.tensor([[x, y, 0.0] for x, y in xy])


def test_cells_of_a_grid():
    """Index 0 is the lower limit, borders belong to the upper cell, limits are outside."""
    points = cloud((-3.9, -3.9), (0.0, 0.5), (0.9, 0.0), (3.9, -1e-6), (4.0, 0.0), (-4.0, 0.0))
    assert GRID.cells(points).tolist() == [0, 4 * 8 + 4, 7 * 8 + 3]
    assert len(GRID.points_inside(points)) == 4
    assert GRID.side == 8
    assert BEVGrid(4.0, 0.7).cells(cloud((-3.9, -3.9), (3.9, 3.9))).tolist() == [0, 10 * 12 + 10]


def test_every_point_of_the_published_grid_has_a_cell():
    """The largest float32 below 50 m falls in the last cell and not beyond."""
    edge = torch.nextafter(torch.tensor(50.0), torch.tensor(0.0)).item()
    cells = BEVGrid().cells(cloud((edge, edge), (-edge, -edge)))
    assert cells.tolist() == [0, 2000 * 2000 - 1]


def test_histogram_distances_by_hand():
    """Shares (1, 0) and (1/2, 1/2): m = (3/4, 1/4), (ln 4/3 + ln 2/3 / 2 + ln 2 / 2) / 2."""
    result = histogram_distance(torch.tensor([2, 0, 0]), torch.tensor([3, 3, 0]))
    expected = (math.log(4 / 3) + math.log(2 / 3) / 2 + math.log(2) / 2) / 2
    assert result.jsd_divergence == pytest.approx(expected, rel=1e-14)
    assert result.jsd_distance == pytest.approx(math.sqrt(expected), rel=1e-14)
    assert (result.l1, result.total_variation) == (1, 0.5)
    same = histogram_distance(torch.tensor([1, 2]), torch.tensor([2, 4]))
    assert set(same) == {0}


def test_chamfer_by_hand():
    """(0 + 4) / 2 one way, 0 the other: half of 2; a fourth column does not count."""
    a = torch.tensor([[0.0, 0, 0, 7], [0, 0, 2, 9]])
    assert chamfer_squared(a, torch.zeros(1, 3)) == 1
    assert chamfer_squared(torch.zeros(1, 3), a) == 1
    for name, empty in (("points_a", (torch.zeros(0, 3), a)), ("points_b", (a, torch.zeros(0, 3)))):
        with pytest.raises(ValueError, match=f"{name} has no point"):
            chamfer_squared(*empty)


def chamfer_cells(cells_a, cells_b, grid):
    """Chamfer distance of :func:`minimum_matching` for one pair, all cells against all."""
    side = grid.side
    a, b = (torch.stack([c // side, c % side], dim=1).double() for c in (cells_a, cells_b))
    squared = torch.cdist(a, b).square().round()
    return (squared.amin(1).mean() + squared.amin(0).mean()).item() / (2 * side**2)


def test_matching_by_hand():
    """On 8 x 8 cells: 3 and 4 cells apart are 25 / 64; the nearer sample is 1 / 64 away."""
    reference = GRID.cells(cloud((0.5, 0.5)))
    far, near = GRID.cells(cloud((3.5, -3.5))), GRID.cells(cloud((0.5, 1.5)))
    assert chamfer_cells(reference, far, GRID) == 25 / 64
    result = minimum_matching([reference], [far, near], GRID)
    assert result.squared_normalised.tolist() == [1 / 64]
    assert result.nearest.tolist() == [1]


def random_cells(grid, num_clouds, seed):
    generator = torch.Generator().manual_seed(seed)
    for _ in range(num_clouds):
        centre = torch.rand(1, 3, generator=generator) - 0.5
        points = centre + 0.2 * torch.randn(150, 3, generator=generator)
        yield grid.cells((2 * grid.half_m * points)[points.abs().amax(dim=1) < 0.5])


@pytest.mark.parametrize("threads", [1, 2])
def test_matching_equals_all_against_all(threads):
    """Pairs are left out where a lower bound exceeds the best distance."""
    grid = BEVGrid(cell_m=1.0)
    references, samples = list(random_cells(grid, 12, 0)), list(random_cells(grid, 15, 1))
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        result = minimum_matching(references, samples, grid)
    finally:
        torch.set_num_threads(before)
    pairs = torch.tensor([[chamfer_cells(x, y, grid) for y in samples] for x in references])
    best = pairs.double().min(dim=1)
    torch.testing.assert_close(result.squared_normalised, best.values, rtol=1e-6, atol=0)
    assert torch.equal(result.nearest, best.indices)


@pytest.mark.parametrize("dtype", [torch.int32, *DTYPES])
@pytest.mark.numerics("Jensen-Shannon distance and empty counts")
def test_disjoint_histograms_are_ln_2_apart_and_empty_ones_are_refused(dtype):
    """Bins that are empty in both do not matter."""
    a, b = torch.tensor([[4, 2, 0, 0], [0, 0, 0, 7]]).to(dtype)
    found = histogram_distance(a, b)
    assert found.jsd_divergence == pytest.approx(math.log(2), rel=1e-12)
    assert found.jsd_distance == pytest.approx(math.sqrt(math.log(2)), rel=1e-12)
    assert (found.l1, found.total_variation) == (2, 1)
    for name, empty in (("first", (0 * a, b)), ("second", (a, 0 * b))):
        with pytest.raises(ValueError, match=f"{name} histogram is empty"):
            histogram_distance(*empty)
    with np.errstate(invalid="ignore"):
        assert math.isnan(jensenshannon((0 * a).double(), b.double()))
    assert jensenshannon(a.double(), b.double()) - found.jsd_divergence > 0.1


@pytest.mark.numerics("Jensen-Shannon distance and empty counts")
def test_the_distance_of_any_counts_is_within_its_limits():
    negative = []

    @FEW
    @given(
        counts=st.lists(st.integers(0, 10**6), min_size=3, max_size=30).filter(any),
        scale=st.integers(1, 1000),
    )
    def check(counts, scale):
        a = torch.tensor(counts)
        for b in (scale * a, a.flip(0), a.roll(1)):
            found = histogram_distance(a, b)
            assert 0 <= found.jsd_distance <= math.sqrt(math.log(2)) + 1e-12
            assert found.jsd_distance == histogram_distance(b, a).jsd_distance
        assert histogram_distance(a, scale * a).jsd_distance < 1e-7
        p, q = (x.float() / x.sum() for x in (a, scale * a))
        middle = (p + q) / 2
        terms = [(x * (x / middle).log()).nansum() / 2 for x in (p, q)]
        negative.append(sum(terms).item())

    check()
    assert min(negative) < 0


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("padding in the Chamfer distance")
def test_clouds_of_unequal_size_need_no_padding(dtype):
    """Also far from the origin, where squared coordinates leave no digits for the distance."""
    worst = []

    @FEW
    @given(sizes=st.tuples(st.integers(1, 40), st.integers(1, 40)), shift=st.floats(0, 100))
    def check(sizes, shift):
        a, b = ((drawn(n, n, 3) + shift).to(dtype) for n in sizes)
        apart = (a.double()[:, None] - b.double()).square().sum(-1)
        exact = (apart.amin(1).mean() + apart.amin(0).mean()).item() / 2
        assert chamfer_squared(a, b) == pytest.approx(exact, rel=1e-9, abs=1e-12)
        long, short = sorted((a.float(), b.float()), key=len, reverse=True)
        padded = torch.cat([short, torch.full((len(long) - len(short), 3), 1e6)])
        squared = long.square().sum(1)[:, None] + padded.square().sum(1) - 2 * long @ padded.T
        found = (squared.amin(1).mean() + squared.amin(0).mean()).item() / 2
        worst.append(abs(found - exact) / max(exact, 1e-6))

    check()
    assert max(worst) > 1

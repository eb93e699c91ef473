"""Distances of feature sets and clouds, by hand and against plain loops."""

import math
from itertools import product

import numpy as np
import pytest
import torch
from scipy.linalg import sqrtm

from r3dpa.metrics import functional_bev
from r3dpa.metrics.functional import (
    Moments,
    fd_infinity,
    frechet_distance,
    frechet_distance_of,
    frechet_of_draws,
    polynomial_mmd,
    shared_balls,
    squared_mmd,
    squared_mmd_error,
)
from r3dpa.metrics.functional_bev import (
    BEVGrid,
    chamfer_squared,
    histogram_distance,
    minimum_matching,
)


def draw(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


# Fréchet distance


def test_frechet_of_diagonal_covariances():
    """sum (m1 - m2)^2 + sum (s1 - s2)^2: 1 + 4 + (3 - 1)^2 + (2 - 5)^2 = 18."""
    a = torch.tensor([1.0, 0.0]), torch.diag(torch.tensor([9.0, 4.0]))
    b = torch.tensor([0.0, 2.0]), torch.diag(torch.tensor([1.0, 25.0]))
    assert frechet_distance(*a, *b).item() == pytest.approx(18, rel=1e-14)


def test_frechet_against_the_root_of_the_product():
    a, b = (factor @ factor.T for factor in (draw(12, 30), draw(12, 30, seed=1)))
    expected = (a.trace() + b.trace()).item() - 2 * np.trace(sqrtm((a @ b).numpy())).real
    zero = torch.zeros(12)
    assert frechet_distance(zero, a, zero, b).item() == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(("count", "width"), [(40, 12), (12, 40)])
def test_frechet_of_draws_is_that_of_their_moments(count, width):
    rows, real = draw(count, width), Moments.of(draw(60, width, seed=1))
    covariance = real.covariance("real")
    drawn = torch.arange(count)[::2]
    own = Moments.of(rows[drawn])
    expected = frechet_distance(real.mean, covariance, own.mean, own.covariance("drawn")).item()
    found = frechet_of_draws(real.mean, covariance, rows)(drawn)
    assert found == pytest.approx(expected, rel=1e-10)


# Moments


def test_one_sample_has_no_covariance():
    with pytest.raises(ValueError, match="real features: 1 samples, a covariance needs"):
        frechet_distance_of(torch.zeros(1, 2), torch.zeros(5, 2))
    with pytest.raises(ValueError, match=r"x: expected \(N, F\), one row per sample, got \(3,\)"):
        Moments.of(torch.zeros(3), "x")


# Extrapolation and kernel distance


def test_fd_infinity_of_a_shift():
    generator = torch.Generator().manual_seed(0)
    result = fd_infinity(draw(400, 5), draw(400, 5, seed=1) + 2, generator)
    assert result[0] == pytest.approx(5 * 2**2, abs=1.0)
    assert 0 < result[1] < 1
    assert fd_infinity(draw(400, 5), draw(400, 5, seed=1) + 2, generator.manual_seed(0)) == result


def test_mmd_by_hand():
    """F = 1, k(x, y) = (x y + 1)^3: k(0, 2) = 1 within, k(1, 3) = 64, across 1, 1, 27, 343."""
    value = squared_mmd(torch.tensor([[0.0], [2.0]]), torch.tensor([[1.0], [3.0]]))
    assert value.item() == 1 + 64 - 2 * (1 + 1 + 27 + 343) / 4


def test_polynomial_mmd_over_subsets():
    x, y, generator = draw(40, 3), draw(30, 3, seed=1) + 1, torch.Generator().manual_seed(0)
    mean, std = polynomial_mmd(x, y, generator, num_subsets=200, subset_size=20)
    assert std > 0
    assert mean == pytest.approx(squared_mmd(x, y).item(), abs=4 * std / math.sqrt(200))
    with pytest.raises(ValueError, match=r"40 real and 30 generated .* 2 to 30 samples"):
        polynomial_mmd(x, y, generator, subset_size=31)


def test_error_of_squared_mmd_is_that_of_leaving_out_each_sample(monkeypatch):
    monkeypatch.setattr("r3dpa.metrics.functional._BLOCK", 7)
    real, made = draw(20, 3), draw(16, 3, seed=1) + 0.5
    kept = [torch.arange(16) != left_out for left_out in range(16)]
    values = torch.stack([squared_mmd(real, made[rows]) for rows in kept])
    expected = ((values - values.mean()).square().sum() * 15 / 16).sqrt().item()
    assert squared_mmd_error(real, made) == pytest.approx(expected, rel=1e-9)


# Precision, recall, density, coverage


def precision_recall(real, generated, k=5):
    return {name: s.mean().item() for name, s in shared_balls(real, generated, k).items()}


def prdc_by_loops(real, generated, k):
    def radius(points, i):
        return sorted((points[i] - points[j]).norm() for j in range(len(points)) if j != i)[k - 1]

    real_radius = [radius(real, i) for i in range(len(real))]
    generated_radius = [radius(generated, j) for j in range(len(generated))]
    pairs = list(product(range(len(real)), range(len(generated))))
    apart = {(i, j): (real[i] - generated[j]).norm() for i, j in pairs}
    inside = [(i, j) for i, j in pairs if apart[i, j] < real_radius[i]]
    return {
        "precision": len({j for _, j in inside}) / len(generated),
        "recall": len({i for i, j in pairs if apart[i, j] < generated_radius[j]}) / len(real),
        "density": len(inside) / (k * len(generated)),
        "coverage": len({i for i, _ in inside}) / len(real),
    }


@pytest.mark.parametrize("offset", [0.0, 1e7])
def test_prdc_against_loops(monkeypatch, offset):
    monkeypatch.setattr("r3dpa.metrics.functional._BLOCK", 7)  # several blocks, the last one short
    real, generated = draw(30, 3) + offset, 1.2 * draw(24, 3, seed=1) + 0.5 + offset
    result = precision_recall(real, generated, 3)
    assert result == pytest.approx(prdc_by_loops(real, generated, 3))
    assert 0 < result["precision"] < 1
    assert 0 < result["coverage"] < 1
    assert set(precision_recall(real, real).values()) == {1.0}  # density: itself and k - 1 others
    with pytest.raises(ValueError, match="generated features: 5 samples, at least 6"):
        precision_recall(real, generated[:5])


def test_prdc_with_one_far_outlier():
    """Only the ball of the outlier knows that it is there."""
    real, generated = draw(400, 8), draw(300, 8, seed=1)
    before = precision_recall(real, generated)
    real[0], generated[0] = -1e6, 1e6
    assert precision_recall(real, generated) == pytest.approx(before, abs=0.02)


@pytest.mark.parametrize(("far", "tolerance"), [(1e7, 1e-9), (1e9, 1e-9), (1e12, 0.03)])
def test_prdc_with_a_real_outlier_against_plain_distances(far, tolerance):
    """The outlier must not move the others so far from 0 that their distances are rounded away.

    At 1e12 the edge of its own ball, which holds 7 of 50 generated samples, is not known any more.
    """
    real, generated = draw(60, 3).double(), draw(50, 3, seed=1).double()
    real[0] = far
    plain = "donot_use_mm_for_euclid_dist"
    within, across = (torch.cdist(real, part, compute_mode=plain) for part in (real, generated))
    own = torch.cdist(generated, generated, compute_mode=plain)
    real_radius, radius = (part.kthvalue(6, dim=1).values for part in (within, own))
    in_real, in_generated = across < real_radius[:, None], across < radius
    expected = {
        "precision": in_real.any(dim=0).double().mean().item(),
        "recall": in_generated.any(dim=1).double().mean().item(),
        "density": in_real.sum().item() / (5 * 50),
        "coverage": in_real.any(dim=1).double().mean().item(),
    }
    assert precision_recall(real, generated) == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize("function", [squared_mmd, precision_recall])
def test_values_whose_powers_overflow_are_refused(function):
    x = draw(30, 3)
    x[4] = 1e60
    with pytest.raises(ValueError, match=r"1 of 30 rows .* beyond 1e\+50, the first is row 4"):
        function(x, x)


# Bird's-eye view

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
    apart = histogram_distance(torch.tensor([1, 0]), torch.tensor([0, 5]))
    assert apart.jsd_distance == pytest.approx(math.sqrt(math.log(2)))
    assert (apart.l1, apart.total_variation) == (2, 1)
    same = histogram_distance(torch.tensor([1, 2]), torch.tensor([2, 4]))
    assert set(same) == {0}
    with pytest.raises(ValueError, match="second histogram is empty"):
        histogram_distance(torch.ones(2), torch.zeros(2))


def test_chamfer_by_hand():
    """(0 + 4) / 2 one way, 0 the other: half of 2; a fourth column does not count."""
    a = torch.tensor([[0.0, 0, 0, 7], [0, 0, 2, 9]])
    assert chamfer_squared(a, torch.zeros(1, 3)) == 1
    assert chamfer_squared(torch.zeros(1, 3), a) == 1
    with pytest.raises(ValueError, match="points_b has no point"):
        chamfer_squared(a, torch.zeros(0, 3))


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
def test_matching_equals_all_against_all(threads, monkeypatch):
    """Though most pairs are never measured: their lower bounds exceed the best distance."""
    measured, measure = [], functional_bev._mean_squared

    def counted(tree, places):
        measured.append(None)
        return measure(tree, places)

    monkeypatch.setattr(functional_bev, "_mean_squared", counted)
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
    assert len(measured) < 0.5 * len(references) * len(samples)


@pytest.mark.parametrize(
    "compare",
    [
        precision_recall,
        squared_mmd,
        lambda a, b: polynomial_mmd(a, b, torch.Generator(), 2, 4),
        lambda a, b: fd_infinity(a, b, torch.Generator()),
        lambda a, b: Moments.of(a).merge(Moments.of(b)),
    ],
)
def test_features_of_other_widths_do_not_compare(compare):
    """Width 1 would stretch to any other without an error."""
    for first, second in ((3, 1), (1, 3), (2, 3)):
        with pytest.raises(ValueError, match=rf"{first}.* {second}\b"):
            compare(draw(60, first), draw(60, second, seed=1))

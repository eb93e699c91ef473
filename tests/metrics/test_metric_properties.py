"""What holds for every metric, whatever the data: identity, symmetry, order, scale, batches."""

from __future__ import annotations

import pytest
import torch

from r3dpa.metrics.functional import (
    Moments,
    fd_infinity,
    frechet_distance_of,
    polynomial_mmd,
    precision_recall,
    squared_mmd,
)
from r3dpa.metrics.functional_bev import (
    BEVGrid,
    chamfer_squared,
    histogram_distance,
    minimum_matching,
)
from r3dpa.nn.backbones.sparse import pool_voxels

SEEDS = range(2)
GRID = BEVGrid(10.0, 0.5)


def drawn(seed, *shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def feature_sets(seed):
    """Two sets of unequal sizes, means and covariances."""
    real = drawn(seed, 60, 5) @ drawn(seed + 50, 5, 5)
    return real, 1.5 * drawn(seed + 100, 45, 5) + drawn(seed + 150, 5)


def clouds(seed, count):
    return [3 * drawn(1000 * seed + i, 20 + 5 * i, 3) for i in range(count)]


def cells(part):
    return [GRID.cells(cloud) for cloud in part]


def jsd(a, b):
    return histogram_distance(GRID.histogram(a), GRID.histogram(b)).jsd_distance


def total_variation(a, b):
    return histogram_distance(GRID.histogram(a), GRID.histogram(b)).total_variation


def matching(a, b):
    return minimum_matching(cells(a), cells(b), GRID).squared_normalised.mean().item()


def of_clouds(distance):
    return lambda seed: (distance, clouds(seed, 7), clouds(seed + 20, 6))


def of_features(distance):
    return lambda seed: (distance, *feature_sets(seed))


def of_points(distance):
    return lambda seed: (distance, *clouds(seed, 2))


DISTANCES = {
    "frechet": of_features(frechet_distance_of),
    "kernel": of_features(lambda a, b: squared_mmd(a, b).item()),
    "chamfer": of_points(chamfer_squared),
    "jsd": of_clouds(jsd),
    "tv": of_clouds(total_variation),
    "mmd": of_clouds(matching),
}


def shuffled(samples, seed):
    order = torch.randperm(len(samples), generator=torch.Generator().manual_seed(seed)).tolist()
    return [samples[i] for i in order] if isinstance(samples, list) else samples[order]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("case", DISTANCES)
def test_order_does_not_count_and_other_samples_do(case, seed):
    distance, a, b = DISTANCES[case](seed)
    apart = pytest.approx(distance(a, b), rel=1e-9)
    assert distance(shuffled(a, seed), shuffled(b, seed + 1)) == apart
    assert distance(a, b[:-5]) != pytest.approx(distance(a, b), rel=1e-6)
    if case != "mmd":
        assert distance(b, a) == apart
    if case != "kernel":  # unbiased: below 0 for a set with itself
        assert distance(a, shuffled(a, seed)) == pytest.approx(0, abs=1e-9)
        assert distance(a, b) > 1e-3


@pytest.mark.parametrize("seed", SEEDS)
def test_scale_and_motion(seed):
    """Twice as large: squared distances fourfold; a common motion: none changes."""
    a, b = feature_sets(seed)
    apart = frechet_distance_of(a, b)
    assert frechet_distance_of(2 * a, 2 * b) == pytest.approx(4 * apart, rel=1e-9)
    turn = torch.linalg.qr(drawn(seed, 5, 5).double()).Q
    moved = [x.double() @ turn + 3 for x in (a, b)]
    assert frechet_distance_of(*moved) == pytest.approx(apart, rel=1e-9)
    assert precision_recall(*moved) == precision_recall(a, b) == precision_recall(2 * a, 2 * b)
    x, y = clouds(seed, 2)
    assert chamfer_squared(2 * x, 2 * y) == pytest.approx(4 * chamfer_squared(x, y), rel=1e-6)


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
            compare(drawn(0, 60, first), drawn(1, 60, second))


def test_pooled_features_do_not_depend_on_the_order_of_voxels():
    """The mean of the coordinates is exact, so that no voxel changes its ring."""
    generator = torch.Generator().manual_seed(0)
    xyz = torch.randint(2000, (20_000, 3), generator=generator)
    coordinates = torch.cat([xyz, torch.randint(2, (20_000, 1), generator=generator)], dim=1)
    features = drawn(1, 20_000, 2)
    pooled = pool_voxels(features, coordinates, 2)
    order = torch.randperm(20_000, generator=generator)
    again = pool_voxels(features[order], coordinates[order], 2)
    torch.testing.assert_close(again, pooled, rtol=0, atol=1e-7)
    moved = coordinates + torch.tensor([30_000, -30_000, 11, 0])  # float32 sums would round by 0.1
    torch.testing.assert_close(pool_voxels(features, moved, 2), pooled, rtol=0, atol=1e-6)

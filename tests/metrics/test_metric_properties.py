"""What holds for every metric, whatever the data: identity, symmetry, order, scale, batches."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch

from r3dpa.geometry import LidarSensor
from r3dpa.metrics.feature_distances import (
    metrics_of,
    scene_metrics,
    update_with,
    with_features,
)
from r3dpa.metrics.functional import (
    Moments,
    fd_infinity,
    frechet_distance_of,
    polynomial_mmd,
    precision_recall,
    shared_balls,
    squared_mmd,
    wasserstein_1_of_values,
)
from r3dpa.metrics.functional_bev import (
    BEVGrid,
    chamfer_squared,
    histogram_distance,
    minimum_matching,
)
from r3dpa.metrics.scene import DEFAULT, EvaluationScene, usable_scenes
from r3dpa.metrics.scene_features import scene_features
from r3dpa.nn.backbones.sparse import pool_voxels

SEEDS = range(4)
GRID = BEVGrid((-10.0, 10.0), (-10.0, 10.0), 0.5)


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
    return minimum_matching(cells(a), cells(b), GRID).mmd_squared_normalised


def of_clouds(distance):
    return lambda seed: (distance, clouds(seed, 7), clouds(seed + 20, 6))


def of_features(distance):
    return lambda seed: (distance, *feature_sets(seed))


def of_values(distance):
    return lambda seed: (distance, drawn(seed, 50), 2 * drawn(seed + 1, 31) + 1)


def of_points(distance):
    return lambda seed: (distance, *clouds(seed, 2))


SYMMETRIC = {
    "frechet": of_features(frechet_distance_of),
    "kernel": of_features(lambda a, b: squared_mmd(a, b).item()),
    "w1": of_values(wasserstein_1_of_values),
    "chamfer": of_points(chamfer_squared),
    "jsd": of_clouds(jsd),
    "tv": of_clouds(total_variation),
}
DISTANCES = SYMMETRIC | {"mmd": of_clouds(matching)}


def shuffled(samples, seed):
    order = torch.randperm(len(samples), generator=torch.Generator().manual_seed(seed)).tolist()
    return [samples[i] for i in order] if isinstance(samples, list) else samples[order]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("case", SYMMETRIC)
def test_distances_are_symmetric(case, seed):
    distance, a, b = SYMMETRIC[case](seed)
    assert distance(a, b) == pytest.approx(distance(b, a), rel=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("case", DISTANCES)
def test_order_does_not_count_and_other_samples_do(case, seed):
    distance, a, b = DISTANCES[case](seed)
    assert distance(shuffled(a, seed), shuffled(b, seed + 1)) == pytest.approx(
        distance(a, b), rel=1e-9
    )
    assert distance(a, b[:-5]) != pytest.approx(distance(a, b), rel=1e-6)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("case", [name for name in DISTANCES if name != "kernel"])
def test_a_set_is_at_no_distance_from_itself_and_from_others_it_is(case, seed):
    distance, a, b = DISTANCES[case](seed)
    assert distance(a, shuffled(a, seed)) == pytest.approx(0, abs=1e-9)
    assert distance(a, b) > 1e-3


@pytest.mark.parametrize("case", ["jsd", "tv"])
def test_histogram_distances_hold_the_triangle_inequality(case):
    sets = [clouds(seed, 5) for seed in range(6)]
    distance = {"jsd": jsd, "tv": total_variation}[case]
    for a, b in pairwise(sets):
        for c in sets:
            assert distance(a, b) <= distance(a, c) + distance(c, b) + 1e-12


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
    values = drawn(seed, 40), drawn(seed + 9, 33)
    assert wasserstein_1_of_values(*(2 * v for v in values)) == pytest.approx(
        2 * wasserstein_1_of_values(*values), rel=1e-6
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_more_samples_match_no_worse(seed):
    references, samples = cells(clouds(seed, 5)), cells(clouds(seed + 20, 9))
    few = minimum_matching(references, samples[:4], GRID)
    many = minimum_matching(references, samples, GRID)
    assert (many.squared_normalised <= few.squared_normalised).all()
    assert (many.squared_normalised < few.squared_normalised).any()


@pytest.mark.parametrize("seed", SEEDS)
def test_precision_of_one_is_recall_of_the_other(seed):
    a, b = feature_sets(seed)
    assert precision_recall(a, b).precision == precision_recall(b, a).recall
    balls, shares = shared_balls(a, b), precision_recall(a, b)
    assert (len(balls.in_real), len(balls.recalled)) == (len(b), len(a))
    assert shares.precision == balls.precise.double().mean().item()
    assert 0 < shares.precision <= 1
    assert shares.density * balls.num_neighbors >= shares.precision  # a ball at least, where in one


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


def test_batches_change_nothing():
    """Of one scene, of 3 or of all 7: the same histograms, and moments to rounding."""
    protocol = DEFAULT.with_sensor(LidarSensor(beams=16, columns=64))
    images = [
        3 + 40 * torch.rand(16, 64, generator=torch.Generator().manual_seed(i)) for i in SEEDS
    ]
    scenes = [EvaluationScene(f"{i}", None, image) for i, image in enumerate(2 * images)][:7]
    space = scene_features("fgeo", None, protocol)
    sets = []
    for batch_size in (1, 3, 7):
        metrics = scene_metrics(
            protocol, {"fgeo": ("FGEO", space.dim)}, 2, max_rows=(None, 5), max_images=(None, 4)
        )
        for batch, features in with_features(usable_scenes(scenes, protocol), [space], batch_size):
            update_with(metrics, batch, features, real=False)
        sets.append(metrics_of(metrics))
    for one, other in pairwise(sets):
        for name in ("cells", "ranges"):
            assert torch.equal(one[name].generated_bins, other[name].generated_bins)
        for a, b in zip(
            *(part["matching"].kept("generated") for part in (one, other)), strict=True
        ):
            assert torch.equal(a, b)
        rows = [part["fgeo_kid"].rows("generated") for part in (one, other)]
        torch.testing.assert_close(*rows, rtol=1.3e-6, atol=1e-5)
        for key in ("count", "mean", "scatter"):
            values = [
                getattr(part["fgeo_frechet"].moments("generated"), key) for part in (one, other)
            ]
            torch.testing.assert_close(*values, rtol=1e-6, atol=1e-9)


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


def test_distances_have_their_largest_values_on_disjoint_sets():
    near, far = [torch.tensor([[-9.0, -9.0, 0.0]])], [torch.tensor([[9.0, 9.0, 0.0]])]
    assert jsd(near, far) == pytest.approx(math.sqrt(math.log(2)))
    assert total_variation(near, far) == 1
    assert matching(near, far) == pytest.approx(2 * (18 / 20) ** 2)

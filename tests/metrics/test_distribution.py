"""Metrics are what their functions are, in one process or in two with uneven shares."""

from __future__ import annotations

import pytest
import torch
import torch.distributed as dist

from r3dpa.metrics.distribution import (
    BEVHistogramDistance,
    MinimumMatchingDistance,
    PolynomialMMD,
    PrecisionRecall,
)
from r3dpa.metrics.frechet import FrechetDistance
from r3dpa.metrics.functional import frechet_distance_of, polynomial_mmd
from r3dpa.metrics.functional_bev import BEVGrid, histogram_distance, minimum_matching
from r3dpa.metrics.functional_manifold import precision_recall

GRID = BEVGrid((-8.0, 8.0), (-8.0, 8.0), 0.25)


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def clouds(count, seed):
    """Clouds of different sizes; one point of each lies outside the grid."""
    scale = torch.tensor([2.0, 3.0, 0.5])
    outside = torch.tensor([[20.0, 0.0, 0.0]])
    return [
        torch.cat([scale * draw(30 + 3 * i, 3, seed=100 * seed + i).clamp(-2, 2), outside])
        for i in range(count)
    ]


def metrics():
    return {
        "kid": PolynomialMMD(num_subsets=5, subset_size=10),
        "prdc": PrecisionRecall(num_neighbors=3),
        "bev": BEVHistogramDistance(GRID),
        "mmd": MinimumMatchingDistance(GRID),
    }


def data(name, real):
    if name in ("kid", "prdc"):
        return draw(23, 4) if real else draw(21, 4, seed=1) + 0.5
    return clouds(7, seed=1) if real else clouds(5, seed=2)


def expected(name):
    real, generated = data(name, True), data(name, False)
    if name == "kid":
        generator = torch.Generator().manual_seed(0)
        mean, std = polynomial_mmd(real, generated, generator, 5, 10)
        return {"kid_mean": mean, "kid_std": std}
    if name == "prdc":
        return vars(precision_recall(real, generated, 3))
    outside = {
        f"{which}_outside_share": len(part) / sum(map(len, part))
        for which, part in (("real", real), ("generated", generated))
    }
    if name == "bev":
        return vars(histogram_distance(GRID.histogram(real), GRID.histogram(generated))) | outside
    cells = [[GRID.cells(cloud) for cloud in part] for part in (real, generated)]
    value = minimum_matching(*cells, GRID).mmd_squared_normalised
    return {"mmd_squared_normalised": value, "mmd_m2": value * 16**2} | outside


@pytest.mark.parametrize("name", ["kid", "prdc", "bev", "mmd"])
def test_batches_give_what_the_function_gives(name):
    metric = metrics()[name]
    for real in (True, False):
        samples = data(name, real)
        metric.update(samples[:3], real=real)
        metric.update(samples[3:], real=real)
    result = metric.compute()
    assert result == pytest.approx(expected(name))
    metric.reset()
    metric.update(data(name, True), real=True)
    metric.update(data(name, False), real=False)
    assert metric.compute() == pytest.approx(result)


@pytest.mark.parametrize("name", ["kid", "prdc", "bev", "mmd"])
def test_one_set_alone_is_refused(name):
    metric = metrics()[name]
    metric.update(data(name, True), real=True)
    with pytest.raises(ValueError, match=r"generated"):
        metric.compute()


@pytest.mark.parametrize("name", ["bev", "mmd"])
@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (torch.zeros(0, 3), "real cloud 1 has no point"),
        (torch.full((2, 3), torch.nan), "real cloud 1: 2 of 2 points"),
        (torch.full((2, 3), 8.0), "real cloud 1: none of 2 points"),
    ],
)
def test_a_refused_cloud_leaves_the_state(name, cloud, message):
    metric, good = metrics()[name], clouds(2, seed=1)
    with pytest.raises(ValueError, match=message):
        metric.update([good[0], cloud], real=True)
    metric.update(clouds(7, seed=1), real=True)
    metric.update(clouds(5, seed=2), real=False)
    assert metric.compute() == pytest.approx(expected(name))


def test_refused_features():
    metric = PrecisionRecall()
    with pytest.raises(ValueError, match="real features: 1 of 2 rows"):
        metric.update(torch.tensor([[1.0], [torch.inf]]), real=True)


def frechet_features():
    return draw(101, 8), draw(101, 8, seed=1) + 1


def run_process(rank, folder):
    dist.init_process_group("gloo", f"file://{folder}/rendezvous", rank=rank, world_size=2)
    results = {}
    for name, metric in metrics().items():
        for real in (True, False):
            samples = data(name, real)
            metric.update(samples[:2] if rank == 0 else samples[2:], real=real)
        results[name] = metric.compute()
    frechet, part = FrechetDistance(8), slice(0, 37) if rank == 0 else slice(37, 101)
    for real, features in zip((True, False), frechet_features(), strict=True):
        for batch in features[part].split(10 + rank):
            frechet.update(batch, real=real)
    results["frechet"] = {"distance": frechet.compute().item()}
    assert frechet.real_moments[0] == (37, 64)[rank]  # after compute, its own part again
    torch.save(results, f"{folder}/{rank}.pt")
    dist.destroy_process_group()


@pytest.mark.ddp
def test_two_processes_are_one(tmp_path):
    torch.multiprocessing.spawn(run_process, (str(tmp_path),), nprocs=2)
    for rank in range(2):
        results = torch.load(tmp_path / f"{rank}.pt")
        distance = frechet_distance_of(*frechet_features())
        assert results.pop("frechet") == {"distance": pytest.approx(distance, rel=1e-12)}
        for name, result in results.items():
            assert result == pytest.approx(expected(name)), name


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("name", ["kid", "prdc", "bev", "mmd"])
def test_on_a_gpu(name):
    metric = metrics()[name].cuda()
    for real in (True, False):
        samples = data(name, real)
        on_gpu = [s.cuda() for s in samples] if isinstance(samples, list) else samples.cuda()
        metric.update(on_gpu, real=real)
    assert metric.compute() == pytest.approx(expected(name), rel=1e-6)

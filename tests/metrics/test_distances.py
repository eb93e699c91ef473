"""Metrics are what their functions are, in batches, merged, or in two uneven processes."""

from dataclasses import replace

import pytest
import torch
import torch.distributed as dist
from one_device import OneDevice
from scipy.stats import wasserstein_distance

from r3dpa.geometry import LidarSensor, points_of
from r3dpa.metrics import functional
from r3dpa.metrics.collection import metrics_by_name, scene_metrics
from r3dpa.metrics.distances import (
    BaselineDistances,
    BEVHistogramDistance,
    MinimumMatchingDistance,
    RangeHistogramDistance,
)
from r3dpa.metrics.feature_distances import (
    FrechetDistance,
    FrechetInfinity,
    PolynomialMMD,
    PrecisionRecall,
)
from r3dpa.metrics.functional import (
    fd_infinity,
    frechet_distance_of,
    polynomial_mmd,
    shared_balls,
)
from r3dpa.metrics.functional_bev import (
    BEVGrid,
    chamfer_squared,
    histogram_distance,
    kernel_mmd,
    minimum_matching,
    point_histogram,
)
from r3dpa.metrics.resampling import Resampling
from r3dpa.metrics.scene import DEFAULT

PROTOCOL = replace(DEFAULT, sensor=LidarSensor(beams=8, columns=32), voxel_m=1.0)
GRID = PROTOCOL.grid
NAMES = ["bev", "ranges", "mmd", "baselines", "frechet", "inf", "kid", "prdc"]


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


KINDS = {
    "frechet": FrechetDistance,
    "inf": FrechetInfinity,
    "kid": PolynomialMMD,
    "prdc": PrecisionRecall,
}


def metric_of(name, **options):
    if name == "bev":
        return BEVHistogramDistance(GRID, **options)
    if name == "ranges":
        return RangeHistogramDistance(56.0, **options)
    if name == "mmd":
        return MinimumMatchingDistance(PROTOCOL, **options)
    if name == "baselines":
        return BaselineDistances(PROTOCOL, **options)
    return KINDS[name](4, "X", **options)


def images(real):
    """Range images on whole and half decimetres, so that bins and values have one distance."""
    count, seed = (7, 1) if real else (5, 2)
    decimetres = torch.randint(
        20, 480, (count, 8, 32), generator=torch.Generator().manual_seed(seed)
    )
    range_m = (decimetres + 0.5) / 10
    range_m[:, 5, ::3] = -1
    range_m[:, 0, 0] = 55.0  # straight back and up: beyond the grid
    return range_m


def clouds(real):
    return [points_of(image, PROTOCOL.projection) for image in images(real)]


def data(name, real):
    if name in ("ranges", "mmd", "baselines"):
        return images(real)
    if name == "bev":
        return clouds(real)
    return draw(23, 4) if real else draw(21, 4, seed=1) + 0.5


def expected(name):
    real, made = data(name, True), data(name, False)
    generator = torch.Generator().manual_seed(0)
    if name == "frechet":
        return {"X": frechet_distance_of(real, made)}
    if name == "inf":
        return {"X inf": fd_infinity(real, made, generator)[0]}
    if name == "kid":
        return {"X KID": polynomial_mmd(real, made, generator, 100, 10)[0]}
    if name == "prdc":
        return {f"X {name}": s.mean().item() for name, s in shared_balls(real, made).items()}
    if name == "ranges":
        return {"W1 range": wasserstein_distance(real[real > 0].numpy(), made[made > 0].numpy())}
    if name == "bev":
        found = histogram_distance(GRID.histogram(real), GRID.histogram(made))
        return {"JSD": found.jsd_distance, "TV": found.total_variation}
    parts = [clouds(real) for real in (True, False)]
    if name == "baselines":
        a, b = (torch.stack([point_histogram(c).flatten() for c in part]) for part in parts)
        grid = BEVGrid(cell_m=0.5)
        found = minimum_matching(*([grid.cells(c) for c in part] for part in parts), grid)
        return {
            "JSD points": histogram_distance(a.sum(dim=0), b.sum(dim=0)).jsd_distance,
            "MMD kernel": kernel_mmd(*(p.double() / p.sum(dim=1, keepdim=True) for p in (a, b))),
            "MMD 0.5 m": found.squared_normalised.mean().item(),
        }
    found = minimum_matching(*([GRID.cells(c) for c in part] for part in parts), GRID)
    pairs = zip(parts[0], found.nearest, strict=True)
    chamfer = torch.tensor([chamfer_squared(c, parts[1][i]) for c, i in pairs])
    return {"MMD": found.squared_normalised.mean().item(), "CD 3D": chamfer.double().mean().item()}


def updated(metric, name, part=slice(None), sides=(True, False)):
    for real in sides:
        metric.update(data(name, real)[part], real=real)
    return metric


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.numerics("sliced Wasserstein of unequal sizes")
def test_batches_give_what_the_function_gives(name):
    metric = updated(updated(metric_of(name), name, slice(3)), name, slice(3, None))
    assert metric.compute() == pytest.approx(expected(name), rel=1e-6)
    metric.reset()
    with pytest.raises(ValueError, match=r"one side has none yet|generated: 0 samples"):
        updated(metric, name, sides=(True,)).compute()
    metric.reset()
    assert updated(metric, name).compute() == pytest.approx(expected(name), rel=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_merged_states_give_what_one_gives(name):
    parts = [updated(metric_of(name), name, part) for part in (slice(2), slice(2, None))]
    parts[1].merge_state(parts[0])  # torchmetrics puts what comes in first
    assert parts[1].compute() == pytest.approx(expected(name), rel=1e-6)
    adopting = updated(metric_of(name), name, sides=(False,))
    halves = [updated(metric_of(name), name, part, (True,)) for part in (slice(2), slice(2, None))]
    adopting.adopt_real(*halves)
    assert adopting.compute() == pytest.approx(expected(name), rel=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_results_have_intervals_around_the_value(name):
    options = {"num_groups": 5} if name in ("bev", "ranges") else {}
    rows = updated(metric_of(name, **options), name).results(Resampling(num_resamples=60))
    assert {row.name: row.value for row in rows} == pytest.approx(expected(name), rel=1e-6)
    assert rows[0].interval[0] < rows[0].interval[1]
    for row in rows:
        assert row.interval[0] <= row.interval[1], row.name
        assert (row.num_samples, row.num_references) == tuple(
            len(data(name, real)) for real in (False, True)
        )


def test_chamfer_is_the_mean_over_200_real_scans():
    """One generated scene; real scans at other distances from it, the last ones far away."""
    image = torch.full((8, 32), 10.0)
    metric = metric_of("mmd")
    metric.update(image[None], real=False)
    offsets_m = torch.cat([torch.linspace(0, 3, 200), torch.full((50,), 30.0)])
    metric.update(image + offsets_m[:, None, None], real=True)
    generated = points_of(image, PROTOCOL.projection)
    expected = [
        chamfer_squared(points_of(image + offset, PROTOCOL.projection), generated)
        for offset in offsets_m[:200]
    ]
    row = metric.results(Resampling(num_resamples=0))[1]
    assert (row.name, row.num_references) == ("CD 3D", 200)
    assert row.value == pytest.approx(sum(expected) / 200)


def test_chamfer_does_not_depend_on_the_order_of_the_real_scans():
    """One drive is near the generated scene, the other far away: both count, in either order."""
    image = torch.full((8, 32), 10.0)
    drives = {f"drive_{number}": image + 20.0 * number for number in range(2)}
    values = []
    for order in (sorted(drives), sorted(drives, reverse=True)):
        metric = metric_of("mmd")
        metric.update(image[None], real=False)
        for drive in order:
            names = [f"{drive}/{frame}" for frame in range(210)]
            metric.update(drives[drive].expand(210, -1, -1), real=True, names=names)
        values.append(metric.results(Resampling(num_resamples=0))[1].value)
    far = points_of(drives["drive_1"], PROTOCOL.projection)
    both = chamfer_squared(far, points_of(image, PROTOCOL.projection)) / 2
    assert values[0] == values[1] == pytest.approx(both, rel=0.2)


def test_means_over_real_scans_note_what_their_interval_covers():
    """Means over real scans do not know how other generated scenes would differ."""
    rows = [
        row
        for name in NAMES
        for row in updated(metric_of(name), name).results(Resampling())
        if row.note.startswith("interval over draws of the real scans, generated scenes fixed")
    ]
    names = {"MMD", "CD 3D", "MMD 0.5 m", "X recall", "X coverage"}
    assert {row.name for row in rows} == names


@pytest.mark.parametrize("name", ["mmd", "kid"])
def test_kept_scenes_depend_on_names_alone(name):
    """Those with the lowest hashes stay, whatever the order and the batches; values in order."""
    values = images(True) if name == "mmd" else draw(7, 4)
    values = values.repeat(30, *([1] * (values.ndim - 1))) + torch.arange(210.0).view(
        -1, *([1] * (values.ndim - 1))
    )
    names = [f"drive/{i:03d}" for i in range(210)]
    kept = []
    for order in (torch.arange(210), torch.randperm(210, generator=torch.Generator())):
        metric = metric_of(name, max_real=9)
        for part in order.split(4):
            metric.update(values[part], real=True, names=[names[i] for i in part])
        places, stored = metric.subset("real")
        assert len(places) == 9
        assert (places.diff() > 0).all()
        assert torch.equal(stored, values[order[places]])
        assert metric.count("real") == 210
        kept.append(set(order[places].tolist()))
    assert kept[0] == kept[1]
    assert kept[0] != set(range(9))


@pytest.mark.parametrize("name", ["inf", "kid"])
def test_drawn_subsets_depend_on_names_alone(name):
    """Both are means over random subsets of the scenes; rounding alone may follow the order."""
    values, names = draw(40, 4), [f"drive/{i:03d}" for i in range(40)]
    results = []
    for order in (torch.arange(40), torch.randperm(40, generator=torch.Generator())):
        metric = metric_of(name)
        for side in (True, False):
            shifted = values[order] + 0.5 * side
            metric.update(shifted, real=side, names=[names[i] for i in order])
        results.append(metric.results(Resampling())[0])
    assert results[0].value == pytest.approx(results[1].value, rel=1e-9)
    assert results[0].interval == pytest.approx(results[1].interval, rel=1e-9)


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (torch.zeros(0, 3), "real cloud 1 has no point"),
        (torch.zeros(4, 2), r"real cloud 1: expected points \(P, 3 or more\), got \(4, 2\)"),
        (torch.full((2, 3), torch.nan), "real cloud 1: 2 of 2 points"),
        (torch.full((2, 3), 60.0), "real cloud 1: none of 2 points"),
    ],
)
@pytest.mark.numerics("empty cloud in a matching")
def test_a_refused_cloud_leaves_the_state(cloud, message):
    metric = metric_of("bev")
    with pytest.raises(ValueError, match=message):
        metric.update([clouds(True)[0], cloud], real=True)
    assert updated(metric, "bev").compute() == pytest.approx(expected("bev"))


def test_refused_features_leave_the_state():
    metric, broken = FrechetDistance(3), draw(5, 3)
    broken[4, 1] = torch.nan
    with pytest.raises(ValueError, match=r"generated features: 1 of 5 rows .* row 4"):
        metric.update(broken, real=False)
    with pytest.raises(ValueError, match="moments of 3 and of 4 features do not merge"):
        metric.update(draw(5, 4), real=True)
    assert not metric.generated_moments.any()
    assert metric.count("generated") == len(metric.subset("generated")[0]) == 0


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
@pytest.mark.parametrize("real", [True, False])
@pytest.mark.parametrize("name", ["ranges", "mmd", "baselines"])
def test_broken_ranges_are_refused_with_the_results(name, real, value):
    metric, broken = updated(metric_of(name), name), images(real)
    broken[1, 2, :3] = value
    metric.update(broken, real=real)
    with pytest.raises(ValueError, match="range images hold 3 NaN or infinite values"):
        metric.compute()
    metric.reset()
    assert updated(metric, name).compute() == pytest.approx(expected(name))


@pytest.mark.parametrize("name", ["frechet", "mmd"])
def test_names_that_are_not_one_per_scene_leave_the_state(name):
    metric, scenes = metric_of(name), data(name, True)
    with pytest.raises(ValueError, match=f"{len(scenes)} scenes need as many names, got 2"):
        metric.update(scenes, real=True, names=["a", "b"])
    assert updated(metric, name).compute() == pytest.approx(expected(name))


@pytest.mark.parametrize(("num_real", "message"), [(20, "generated: 6 samples"), (3, "real: 3 ")])
@pytest.mark.numerics("Frechet distance of few samples")
def test_too_few_samples_for_the_features_are_refused_or_noted(num_real, message):
    metric = FrechetDistance(6, "X")
    metric.update(draw(num_real, 6), real=True)
    metric.update(draw(6, 6, seed=1), real=False)
    with pytest.raises(ValueError, match=rf"{message}.* for 6 features, at least 7"):
        metric.compute()
    row = metric.results(Resampling(num_resamples=0))[0]
    assert "scenes for 6 features: dominated by their small number" in row.note


def run_process(rank, folder):
    dist.init_process_group("gloo", f"file://{folder}/rendezvous", rank=rank, world_size=2)
    results = {}
    for name in NAMES:
        part = slice(2) if rank == 0 else slice(2, None)
        metric = updated(metric_of(name), name, part)
        results[name] = metric.compute()
        # After compute, its own part again.
        assert metric.count("real") == len(data(name, True)[part])
        alone = metric_of(name) if rank == 0 else updated(metric_of(name), name)
        results[f"{name}, one without scenes"] = alone.compute()
    torch.save(results, f"{folder}/{rank}.pt")
    dist.destroy_process_group()


@pytest.mark.ddp
@pytest.mark.filterwarnings("ignore:The ``compute`` method")
def test_two_processes_are_one(tmp_path):
    torch.multiprocessing.start_processes(
        run_process, (str(tmp_path),), nprocs=2, start_method="fork"
    )
    for rank in range(2):
        results = torch.load(tmp_path / f"{rank}.pt")
        assert len(results) == 2 * len(NAMES)
        for name, result in results.items():
            wanted = expected(name.partition(",")[0])
            assert result == pytest.approx(wanted, rel=1e-6), name


def test_metrics_by_name_a_space_share_one_state():
    metrics = scene_metrics(PROTOCOL, {"x": 4})
    for real in (True, False):
        metrics.update(
            clouds=clouds(real),
            range_m=images(real),
            features={"x": data("kid", real)[: len(images(real))]},
            names=[str(i) for i in range(len(images(real)))],
            real=real,
        )
    found = metrics_by_name(metrics)
    of_scenes = ["cells", "ranges", "matching", "baselines"]
    assert list(found) == [*of_scenes, "x_frechet", "x_inf", "x_kid", "x_shares"]
    assert found["baselines"].compute() == pytest.approx(expected("baselines"))
    assert found["x_kid"].real_moments is found["x_frechet"].real_moments
    assert found["x_shares"].count("real") == 7
    assert found["cells"].compute() == pytest.approx(expected("bev"))


@pytest.mark.parametrize("name", [name for name in NAMES if name != "bev"])
def test_updates_stay_on_the_device(monkeypatch, name):
    """No update waits for a GPU or mixes devices, see ``one_device``.

    Left out: the checks of values that come from outside, and the histogram of bird's eye view
    cells, whose number of occupied cells is known only after a synchronisation.
    """
    monkeypatch.setattr(functional, "checked_features", lambda x, *_: x.double())
    options = {"mmd": {"max_real": 1, "max_generated": 1}, "ranges": {"num_groups": 3}}
    metric = metric_of(name, **options.get(name, {})).to("meta")
    shape = (2, 8, 32) if name in ("mmd", "ranges") else (2, 4)
    num = 40 if name == "mmd" else 2  # so many are thinned out
    with OneDevice():
        for real in [True] * num + [False] * num:
            metric.update(torch.zeros(shape, device="meta"), real=real)
    for state in metric._defaults:
        value = getattr(metric, state)
        for part in value if isinstance(value, list) else [value]:
            assert part.device.type == "meta", state


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("name", NAMES)
def test_distances_on_a_gpu_are_those_of_a_cpu(name):
    metric = metric_of(name).cuda()
    for real in (True, False):
        samples = data(name, real)
        on_gpu = [s.cuda() for s in samples] if isinstance(samples, list) else samples.cuda()
        metric.update(on_gpu, real=real)
    assert metric.compute() == pytest.approx(expected(name), rel=1e-6)

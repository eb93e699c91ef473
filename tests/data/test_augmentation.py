from itertools import chain

import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.utils.data import default_collate

from lidarsim import Simulator, simulate
from lidarsim.weather import WeatherPrior
from r3dpa.data import Augmentation, LidarDataModule, PointDataModule, find_scans, read_scan
from r3dpa.data.augmentation import View
from r3dpa.features import GeometricFeatures
from r3dpa.geometry import (
    BeamProjection,
    LidarSensor,
    SphericalProjection,
    pool_cells,
    range_image,
)

GRID = (8, 64)
PROJECTION = SphericalProjection(LidarSensor())
VIEWS = [View(8, False, 64), View(0, True, 64), View(8, True, 64)]
FEW_PIXELS = 40  # of 65,536: whose return lies at the border of two columns; up to 32 in real scans


@pytest.fixture(scope="module")
def simulated_scans(tmp_path_factory):
    root = tmp_path_factory.mktemp("simulated")
    simulate(root, scans=2)
    return [torch.from_numpy(read_scan(scan.path)) for scan in find_scans(root)]


@pytest.fixture(scope="module")
def real_scans(real_scans_dir):
    return [torch.from_numpy(read_scan(scan.path)) for scan in find_scans(real_scans_dir)[::12]]


@pytest.fixture(scope="module")
def extractor():
    return GeometricFeatures(dim=64)


def seen_from(view, points):
    """Points of a scan mirrored, then rotated, by hand in float64."""
    angle = -2 * np.pi * view.columns / view.grid_columns
    x, y = points[:, 0].double(), points[:, 1].double() * (-1 if view.mirrored else 1)
    result = points.clone()
    result[:, 0] = np.cos(angle) * x - np.sin(angle) * y
    result[:, 1] = np.sin(angle) * x + np.cos(angle) * y
    return result


def grid_of(points, extractor, projection=PROJECTION):
    return pool_cells(points[:, :3], extractor(points), projection, GRID)[0]


def far_from_borders(points):
    """Points that rounding moves to no other pixel, neither of the images nor of the extractor."""
    x, y, z = points[:, :3].double().T
    column = torch.atan2(y, x) * (1024 / (2 * np.pi))
    inclination_deg = torch.atan2(z, torch.hypot(x, y)).rad2deg()
    places = [column, (3 - inclination_deg) * 64 / 28, (15 - inclination_deg) * 96 / 40]
    return points[torch.stack([(p - p.round()).abs() > 1e-4 for p in places]).all(0)]


def test_images_and_grids_by_hand():
    image = torch.arange(8)[None]  # 2 pixels to a cell
    assert View(1, False, 4).image(image).tolist() == [[6, 7, 0, 1, 2, 3, 4, 5]]
    assert View(1, True, 4).image(image).tolist() == [[1, 0, 7, 6, 5, 4, 3, 2]]
    grid = torch.arange(8)[:, None]  # 2 x 4 cells of width 1
    assert View(1, False, 4).grid(grid).flatten().tolist() == [3, 0, 1, 2, 7, 4, 5, 6]
    assert View(1, True, 4).grid(grid).flatten().tolist() == [0, 3, 2, 1, 4, 7, 6, 5]


@pytest.mark.parametrize(
    "source", ["simulated_scans", pytest.param("real_scans", marks=pytest.mark.data)]
)
@pytest.mark.parametrize("view", VIEWS, ids=str)
def test_reordering_equals_projecting_anew(source, view, request):
    for points in request.getfixturevalue(source):
        image = view.image(range_image(points[:, :3], PROJECTION)[0])
        expected, _ = range_image(seen_from(view, points)[:, :3], PROJECTION)
        assert ((image - expected).abs() > 1e-4).sum() <= FEW_PIXELS
        inner = far_from_borders(points)
        assert len(inner) > 0.998 * len(points)
        image = view.image(range_image(inner[:, :3], PROJECTION)[0])
        expected, _ = range_image(seen_from(view, inner)[:, :3], PROJECTION)
        assert (image - expected).abs().max() < 1e-5  # rounding of coordinates up to 56 m


def test_mirrored_beams_that_are_turned_against_each_other():
    """Those of an Ouster are, by nearly half a column; its optical centres are on the axis."""
    projection = BeamProjection.for_networks("os1_128")
    assert projection.mirrored_columns().unique().tolist() == [-1, 1]
    points = torch.from_numpy(Simulator(seed=0, sensor="os1_128").scan(0).points)
    view = View(8, True, 64)
    image = view.image(range_image(points[:, :3], projection)[0], projection)
    expected, _ = range_image(seen_from(view, points)[:, :3], projection)
    assert ((image - expected).abs() > 1e-3).float().mean() < 0.01


def test_a_view_of_a_grid_equals_extracting_from_the_view(extractor, simulated_scans):
    """Features of unit norm, equal up to rounding of coordinates.

    Where neighbours lie on a line their normal is undefined, and rounding decides. In a simulated
    scan such neighbours are frequent: rotating it there and back, which moves points by 4 um,
    changes a few of them too.
    """
    view = View(8, True, 64)  # both: mirrored first
    for points in map(far_from_borders, simulated_scans):
        actual = view.grid(grid_of(points, extractor))
        expected = grid_of(seen_from(view, points), extractor)
        error = (actual - expected).abs()
        assert (error > 1e-2).float().mean() < 2e-3
        assert error.median() < 1e-4
        filled = expected.norm(dim=-1) > 0
        assert filled.float().mean() > 0.5
        assert torch.cosine_similarity(actual[filled], expected[filled]).min() > 0.99


BOTH = Augmentation(rotate=True, flip=True, approximate_grids=True)


@pytest.fixture
def augmented(data, scaled_points):
    def build(augmentation=BOTH, **options):
        return data(augmentation=augmentation, **{"extractor": scaled_points()} | options)

    return build


def assert_same_batches(actual, expected):
    assert len(actual) == len(expected) > 0
    for one, other in zip(actual, expected, strict=True):
        assert one["name"] == other["name"]
        for key in ("range_image", "valid_mask", "feature_grid", "index"):
            assert torch.equal(one[key], other[key])


def test_image_mask_and_grid_of_a_sample_get_the_view_that_was_drawn(augmented, fit):
    module = augmented(seed=5)
    batches = fit(module, 15).trained  # 3 epochs of 5 batches
    views = set()
    for number, batch in enumerate(batches):
        for place, index in enumerate(batch["index"].tolist()):
            view = BOTH.draw(5, number // 5, index, 4)
            views.add(view)
            plain = module.train_set[index]
            for key, seen in (("range_image", view.image), ("valid_mask", view.image)):
                assert torch.equal(batch[key][place], seen(plain[key]))
            assert torch.equal(batch["feature_grid"][place], view.grid(plain["feature_grid"]))
    assert views == {View(k, mirrored, 4) for k in range(4) for mirrored in (False, True)}


def test_augmentation_is_off_by_default_and_then_changes_nothing(augmented, fit):
    assert Augmentation() == LidarDataModule("*.bin").augmentation
    module = augmented(Augmentation())
    batches = fit(module, 10).trained
    orders = [np.random.default_rng((0, epoch)).permutation(10).tolist() for epoch in (0, 1)]
    plain = [module.train_set[index] for index in chain(*orders)]
    assert_same_batches(batches, [default_collate(plain[i : i + 2]) for i in range(0, 20, 2)])


def test_draws_depend_on_seed_epoch_and_scan():
    drawn = {
        BOTH.draw(seed, epoch, index, 10**6)
        for seed in range(2)
        for epoch in range(2)
        for index in range(50)
    }
    assert len(drawn) == 200
    views = [BOTH.draw(0, 0, index, 64) for index in range(6400)]
    counts = np.bincount([view.columns for view in views], minlength=64)
    assert 60 < counts.min() <= counts.max() < 140  # 100 each, deviation 10
    assert sum(view.mirrored for view in views) == pytest.approx(3200, abs=160)  # 4 deviations


@pytest.mark.parametrize("augmentation", [Augmentation(rotate=True), Augmentation(flip=True)])
def test_rotation_and_mirroring_are_drawn_independently(augmentation):
    for index in range(20):
        both, one = BOTH.draw(0, 0, index, 64), augmentation.draw(0, 0, index, 64)
        assert one.columns == (both.columns if augmentation.rotate else 0)
        assert one.mirrored == (both.mirrored and augmentation.flip)


@pytest.mark.numerics("seeds of loader processes")
def test_resume_goes_on_with_the_same_draws(tmp_path, augmented, fit):
    """Within an epoch; loader processes draw what this process would."""
    whole = fit(augmented(), 9).trained
    saver = ModelCheckpoint(tmp_path / "c", every_n_train_steps=7, filename="{step}")
    first = fit(augmented(num_workers=2), 7, saver)
    assert_same_batches(first.trained, whole[:7])
    # Lightning counts an epoch as complete when it saves after the fit; its rest keeps its draws.
    first.trainer.save_checkpoint(tmp_path / "c/after.ckpt")
    for name in ("step=7", "after"):
        second = fit(augmented(), 9, ckpt_path=tmp_path / f"c/{name}.ckpt").trained
        assert_same_batches(second, whole[7:])


def test_held_out_predicted_and_overfitted_scans_are_never_augmented(augmented, fit):
    module, plain = augmented(), augmented(Augmentation())
    seen = fit(module, 5).validated
    assert_same_batches(seen, fit(plain, 5).validated)
    for loader in ("val_dataloader", "test_dataloader", "predict_dataloader"):
        assert_same_batches(list(getattr(module, loader)()), list(getattr(plain, loader)()))
    batch = fit(module, 1, overfit_batches=1).trained[0]
    assert torch.equal(batch["range_image"][0], module.train_set[0]["range_image"])


def test_grids_that_do_not_follow_are_refused(tmp_path, augmented):
    for augmentation in (Augmentation(rotate=True), Augmentation(flip=True)):
        with pytest.raises(ValueError, match=r"features of 'scaled' are not known to"):
            augmented(augmentation)
        with pytest.raises(ValueError, match="of an unknown extractor"):
            augmented(augmentation, extractor=None, features_dir=str(tmp_path / "grids"))
        augmented(augmentation, extractor=None)  # no grids, nothing to differ
    geometric = GeometricFeatures(dim=16)
    augmented(Augmentation(rotate=True, flip=True), extractor=geometric)
    wide = LidarSensor(beams=8, columns=36)  # a sixth of a turn is no whole column of 1024
    options = {"sensor": wide, "grid_size": (2, 6), "extractor": geometric}
    with pytest.raises(ValueError, match=r"augmentation\.rotate: .* by a 6th of a turn"):
        LidarDataModule(str(tmp_path), augmentation=Augmentation(rotate=True), **options)


STORMY = WeatherPrior(probability=0.8, visibility_m=(20, 100))


def test_weather_of_each_scan_and_epoch_and_resumed(tmp_path, data, fit):
    whole = fit(data(weather=STORMY, seed=5), 9).trained
    module = data(weather=STORMY, seed=5)
    saver = ModelCheckpoint(tmp_path / "c", every_n_train_steps=7, filename="{step}")
    fit(module, 7, saver)
    resumed = fit(data(weather=STORMY, seed=5), 9, ckpt_path=tmp_path / "c/step=7.ckpt").trained
    assert_same_images(resumed, whole[7:])
    clear = 0
    for number, batch in enumerate(whole):
        for place, index in enumerate(batch["index"].tolist()):
            points = read_scan(module.train_set.scans[index].path)
            there = STORMY.points(points, (5, number // 5, index, 2))
            clear += there is points
            image = range_image(torch.from_numpy(there[:, :3]), module.projection)[0]
            expected = module.codec.to_image(image)
            assert torch.equal(batch["range_image"][place], expected)
    assert 0 < clear < 10
    plain = data().weather_prior
    assert plain is None
    for one, other in zip(fit(module, 5).validated, fit(data(), 5).validated, strict=True):
        assert torch.equal(one["range_image"], other["range_image"])


def assert_same_images(actual, expected):
    assert len(actual) == len(expected) > 0
    for one, other in zip(actual, expected, strict=True):
        assert torch.equal(one["range_image"], other["range_image"])


def test_weather_of_points_to_prepare(data):
    source = data(weather=None)
    module = PointDataModule(source, lambda points, generator: points, weather=STORMY)
    module.setup("fit")
    drawn = [module.train_set[epoch, 0] for epoch in range(8)]
    assert len({len(points) for points in drawn} | {points.sum().item() for points in drawn}) > 4
    assert torch.equal(drawn[3], module.train_set[3, 0])
    held_out = PointDataModule(source, lambda points, generator: points)
    held_out.setup("fit")
    assert torch.equal(module.val_set[0], held_out.val_set[0])


def test_weather_of_points_does_not_say_how_they_are_turned(data):
    """Both are drawn for an item; with one stream of numbers bad weather would turn to the left."""
    source = data(weather=None)
    sizes = {}
    for weather in (None, STORMY):
        module = PointDataModule(source, lambda p, g: (len(p), g.random()), weather=weather)
        module.setup("fit")
        sizes[weather] = [module.train_set[epoch, 0] for epoch in range(40)]
    clear, drawn = sizes[None][0][0], sizes[STORMY]
    assert sizes[None] == [(clear, turn) for _, turn in drawn]
    turns = [turn for size, turn in drawn if size != clear]
    assert min(turns) < 0.15
    assert max(turns) > 0.85  # bad weather has the numbers below its probability of 0.8


def test_weather_is_refused_where_something_would_not_follow(data, scaled_points):
    with pytest.raises(ValueError, match="weather: the feature grids belong to the clear"):
        data(weather=STORMY, extractor=scaled_points())
    data(weather=STORMY, extractor=scaled_points(), augmentation=BOTH)
    with pytest.raises(ValueError, match="no order of rings: use projection: spherical"):
        data(weather=STORMY, projection="rings")
    with pytest.raises(ValueError, match="weather: cached posteriors belong to the clear"):
        data(weather=STORMY).use_posteriors(None)

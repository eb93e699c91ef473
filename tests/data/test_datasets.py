from contextlib import nullcontext
from functools import partial

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from lidarsim.scan_files import ScanError
from lidarsim.weather import WeatherPrior
from r3dpa.data import Augmentation, FeatureGrids, LidarDataModule, LidarDataset, find_scans
from r3dpa.data.augmentation import View
from r3dpa.data.datasets import WEATHER_STREAM, DrawnPoints
from r3dpa.data.feature_grids import write_feature_grids
from r3dpa.data.store import CachedTensors, tensor_cache
from r3dpa.geometry import NUM_CLASSES, SEMANTIC_CLASSES, LidarSensor, RangeCodec, RingProjection


def write(folder, points):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "000000.bin").write_bytes(np.array(points, "<f4").tobytes())
    return find_scans(folder)


def test_one_point_falls_into_its_pixel_with_its_range(tmp_path, projection):
    # 14 m straight ahead: centre column; inclination 0 is 3 of 28 degrees below the top: row 0.
    (sample,) = LidarDataset(write(tmp_path, [[14, 0, 0, 1]]), projection, RangeCodec())
    assert sample["range_image"].shape == (1, 8, 32)
    assert sample["valid_mask"].nonzero().tolist() == [[0, 0, 16]]
    assert sample["range_image"][0, 0, 16].item() == pytest.approx(2 * 14 / 56 - 1)
    assert sample["range_image"].sum().item() == pytest.approx(-255 - 0.5)
    assert (sample["index"], sample["name"]) == (0, f"{tmp_path.name}/000000")


def test_batches_with_grids(tmp_path, make_scans, projection, scaled_points):
    scans = find_scans(make_scans(tmp_path / "scans", 5))
    write_feature_grids(scans, scaled_points(), projection, [(2, 4)], tmp_path / "grids")
    grids = FeatureGrids(tmp_path / "grids", scans, projection, (2, 4))
    dataset = LidarDataset(scans, projection, RangeCodec("log2"), grids)
    single = [dataset[index] for index in range(5)]
    batches = list(DataLoader(dataset, batch_size=3, num_workers=2))
    for key in ("range_image", "valid_mask", "feature_grid"):
        joined = torch.cat([batch[key] for batch in batches])
        assert torch.equal(joined, torch.stack([sample[key] for sample in single]))
    assert batches[1]["index"].tolist() == [3, 4]
    assert batches[1]["name"] == ["scans/0000000003", "scans/0000000004"]
    assert batches[0]["feature_grid"].shape == (3, 8, 4)


def test_bad_scan_is_named_from_a_loader_process(tmp_path, make_scans, projection):
    folder = make_scans(tmp_path / "scans", 3)
    (folder / "0000000001.bin").write_bytes(b"12345")
    dataset = LidarDataset(find_scans(folder), projection, RangeCodec())
    with pytest.raises(ScanError, match=r"0000000001\.bin: has 5 bytes") as caught:
        list(DataLoader(dataset, num_workers=1))
    assert "\n" not in str(caught.value)  # nor the traceback of a loader process


def test_scan_in_no_ring_order_is_named(tmp_path, make_scans):
    sensor = LidarSensor(beams=4, columns=32)
    scans = find_scans(make_scans(tmp_path / "scans", 1))
    rings = RingProjection(sensor, (0.0, -5.0, -10.0, -15.0))
    with pytest.raises(ScanError, match=r"0000000000\.bin: cannot be projected: .*ring"):
        LidarDataset(scans, rings, RangeCodec())[0]


def test_a_scan_out_of_range_is_named(tmp_path, projection):
    scans = write(tmp_path, [[0, 0, 0.5, 1], [90, 0, 0, 1]])
    with pytest.raises(ScanError, match=r"000000\.bin: has no point within .* 1\.\.56 m"):
        LidarDataset(scans, projection, RangeCodec())[0]


def test_weather_that_leaves_no_point_is_blamed_and_not_the_file(tmp_path, projection):
    """A wall at 50 m in fog that ends before; and at 90 m, out of range in clear air too."""
    wall = np.full((30, 4), 0.1, "f4")
    wall[:, 0], wall[:, 1] = 50, np.arange(30)
    fog = WeatherPrior(probability=1, visibility_m=(1, 1.5))
    epoch = next(
        n
        for n in range(40)
        if fog.draw(np.random.default_rng((0, n, 0, WEATHER_STREAM))).visibility_m < 2
    )
    scans = write(tmp_path, wall)
    points = DrawnPoints(
        scans, projection.sensor, lambda points, generator: points, seed=0, weather=fog
    )
    images = LidarDataset(scans, projection, RangeCodec())
    in_fog = partial(fog.points, seed=(0, epoch, 0, WEATHER_STREAM))
    for sample in (lambda: points[epoch, 0], lambda: images.sample(0, in_fog)):
        with pytest.raises(ScanError, match=r"no point .* in the weather drawn for it: give the"):
            sample()
    wall[:, 0] = 90
    write(tmp_path, wall)
    for sample in (lambda: points[epoch, 0], lambda: images.sample(0, in_fog)):
        with pytest.raises(ScanError, match=r"no point within the sensor's range 1\.\.56 m$"):
            sample()


def test_labels_of_semantic_kitti_are_a_channel_that_turns_with_the_scan(tmp_path, projection):
    points = [[14, 0, 0, 0.25], [28, 0, 0, 0.5], [0, 20, 0, 0.75]]  # the second is hidden
    scans = write(tmp_path / "velodyne", points)
    codec = RangeCodec(return_channel=True, intensity_channel=True, num_classes=NUM_CLASSES)
    dataset = LidarDataset(scans, projection, codec)
    with pytest.raises(ScanError, match=r"000000\.bin has no labels"):
        dataset[0]
    (tmp_path / "labels").mkdir()
    labels = np.array([252, 40, 0], "<u4")  # a car that moves, road, nothing
    (tmp_path / "labels" / "000000.label").write_bytes(labels.tobytes())
    sample = dataset[0]
    car = [semantic.name for semantic in SEMANTIC_CLASSES].index("car")
    assert sample["range_image"][2:, 0, 16].tolist() == [-0.5, car]
    assert sample["range_image"][2:, 0, 8].tolist() == [0.5, -1.0]
    assert sample["range_image"][:, 0, 0].tolist() == [-1.0] * 4
    assert sample["valid_mask"].sum() == 2
    turned = View(columns=1, mirrored=False, grid_columns=8).sample(sample, projection)
    assert turned["range_image"][3, 0, 20] == car


@pytest.mark.parametrize("channel", ["intensity_channel", "reflectance"])
def test_a_scan_without_intensities_is_refused_where_images_have_them(
    tmp_path, projection, channel
):
    np.save(tmp_path / "000000.npy", np.array([[14, 0, 0], [0, 20, 0]], np.float32))
    codec = RangeCodec("log2", return_channel=channel == "intensity_channel", **{channel: True})
    with pytest.raises(ScanError, match=r"000000\.npy: has no intensities"):
        LidarDataset(find_scans(tmp_path), projection, codec)[0]


def test_labels_do_not_follow_the_points_of_a_weather(tmp_path):
    codec = RangeCodec(return_channel=True, num_classes=NUM_CLASSES)
    with pytest.raises(ValueError, match=r"weather: the labels of codec\.num_classes"):
        LidarDataModule(str(tmp_path), codec=codec, weather=WeatherPrior())


def test_posteriors_turn_with_the_scan(tmp_path, make_scans, projection):
    scans = find_scans(make_scans(tmp_path / "scans", 5))
    cache = tensor_cache(tmp_path / "c", "posterior", {"vae": "abc"}, (4, 2, 16))
    moments = torch.randn(5, 4, 2, 16, generator=torch.Generator().manual_seed(3))
    with cache.writer() as writer:
        writer.add([scan.cache_key for scan in scans], moments)
    posteriors = CachedTensors(cache, scans)
    sample = LidarDataset(scans, projection, RangeCodec(), posteriors=posteriors)[1]
    seen = View(columns=3, mirrored=False, grid_columns=8).sample(sample, projection)
    assert torch.equal(seen["posterior_moments"], moments[1].roll(6, -1))
    assert (seen["index"], seen["name"]) == (1, scans[1].name)


@pytest.mark.parametrize(
    ("augmentation", "latent_columns", "message"),
    [
        (Augmentation(flip=True), 16, "flip: .*mirroring.*--model.init_args.cache_latents false"),
        (Augmentation(rotate=True), 4, "rotate: 8 grid columns do not divide the 4 columns"),
        (Augmentation(rotate=True), 16, None),
        (Augmentation(), 4, None),
    ],
)
def test_augmentation_that_latents_follow_or_not(augmentation, latent_columns, message):
    refused = nullcontext() if message is None else pytest.raises(ValueError, match=message)
    with refused:
        augmentation.check_latents(latent_columns, 8)

from __future__ import annotations

import shutil
from importlib.resources import files

import pytest
import torch
from torch import nn

from lidarsim import Simulator, load_sensor
from r3dpa.data import (
    LabelledPointDataModule,
    PointDataModule,
    SimulatedDataModule,
    SimulatedImageDataModule,
)
from r3dpa.data.store import StoreError
from r3dpa.features import Masking, ScanGrid
from r3dpa.geometry import (
    NUM_CLASSES,
    LidarSensor,
    RangeCodec,
    SphericalProjection,
    classes_of,
    range_image,
)

SENSORS = files("lidarsim.sensors") / "presets"
SMALL = LidarSensor(beams=16, columns=64)
CODEC = RangeCodec("log2", return_channel=True)
LABELLED = RangeCodec("log2", return_channel=True, intensity_channel=True, num_classes=NUM_CLASSES)


def module(root, **settings):
    given = {"sensor": SMALL, "codec": CODEC, "grid_size": (4, 8), "num_scans": 10, "every": 3}
    given |= {"simulation_sensor": "vlp16"}  # a quarter of the beams of the default
    return SimulatedImageDataModule(str(root), **(given | settings))


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    module(folder).prepare_data()
    return folder


@pytest.fixture(scope="module")
def labelled_root(tmp_path_factory):
    """Four labelled images, which no test changes."""
    folder = tmp_path_factory.mktemp("labelled")
    module(folder, codec=LABELLED, num_scans=4).prepare_data()
    return folder


def simulated(item):
    """The scan of a cached image, simulated again."""
    return Simulator(0, int(item.drive), sensor=load_sensor("vlp16")).scan(item.number)


def test_cached_images_are_those_of_the_simulated_scans(root):
    data = module(root)
    data.setup("fit")
    assert (len(data.train_set), len(data.val_set)) == (8, 2)
    index = next(i for i, item in enumerate(data.train_set.scans) if item.number == 3)
    item = data.train_set.scans[index]
    points = torch.from_numpy(simulated(item).points)
    range_m, _ = range_image(points[:, :3], SphericalProjection(SMALL))
    sample = data.train_set[index]
    found = CODEC.ranges_of(sample["range_image"], SMALL)
    torch.testing.assert_close(found, range_m, rtol=2**-11, atol=1e-4)
    assert torch.equal(sample["valid_mask"][0], range_m > 0)


def test_only_what_is_missing_is_simulated(root, monkeypatch):
    made = []
    scan = Simulator.scan
    monkeypatch.setattr(Simulator, "scan", lambda *a: (made.append(a[1]), scan(*a))[1])
    module(root).prepare_data()
    assert made == []
    module(root, num_scans=11).prepare_data()
    assert len(made) == 1
    module(root, simulation_seed=1, num_scans=2).prepare_data()  # another cache beside it
    assert len(made) == 3


def test_images_of_another_request_are_not_mixed_up(root):
    one, other = module(root), module(root, simulation_seed=1)
    keys = [{item.cache_key for part in data.split() for item in part} for data in (one, other)]
    assert not keys[0] & keys[1]


def test_another_sensor_in_the_same_file_is_another_request(tmp_path):
    file = tmp_path / "mine.yaml"
    requests = []
    for name in ("vlp16", "hdl32e", "hdl32e"):
        file.write_text((SENSORS / f"{name}.yaml").read_text())
        requests.append(module(tmp_path, simulation_sensor=str(file)).split()[0][0].request)
    assert requests[0] != requests[1] == requests[2]


def test_rings_need_points(tmp_path):
    with pytest.raises(ValueError, match="projection must not be rings"):
        module(tmp_path, projection="rings")


def test_intensity_and_class_are_those_of_the_nearest_points(labelled_root):
    data = module(labelled_root, codec=LABELLED, num_scans=4)
    data.setup("fit")
    scan = simulated(data.train_set.scans[0])
    points, labels = torch.from_numpy(scan.points), torch.from_numpy(scan.labels.astype("int64"))
    values = torch.stack([points[:, 3], 1.0 + classes_of(labels & 0xFFFF)], dim=1)
    range_m, values = range_image(points[:, :3], SphericalProjection(SMALL), values)
    found = LABELLED.pixels_of(data.train_set[0]["range_image"], SMALL)
    torch.testing.assert_close(found.range_m, range_m, rtol=2**-11, atol=1e-3)
    torch.testing.assert_close(found.intensity, values[0], rtol=0, atol=1e-6)
    assert torch.equal(found.classes, values[1].long() - 1)
    assert len(found.classes.unique()) > 4
    (row,) = labelled_root.glob("labelled_image_*/shard_00000.rows")
    assert row.stat().st_size == 4 * 3 * 16 * 64  # four scans, three bytes a pixel


def test_images_of_reflectance_are_cached_with_it(labelled_root):
    data = module(labelled_root, codec=RangeCodec("log2", reflectance=True), num_scans=4)
    data.setup("fit")
    labelled = module(labelled_root, codec=LABELLED, num_scans=4)
    labelled.setup("fit")
    reflectance = data.train_set[0]["range_image"][1]
    assert len(reflectance.unique()) > 5
    assert torch.equal(reflectance, labelled.train_set[0]["range_image"][2])


def test_cached_images_and_files_of_the_same_scans_agree(labelled_root, tmp_path):
    settings = {"sensor": SMALL, "codec": LABELLED, "grid_size": (4, 8), "num_scans": 2}
    settings |= {"simulation_sensor": "vlp16"}
    files = SimulatedDataModule(str(tmp_path / "files"), **settings)
    images = module(labelled_root, codec=LABELLED, num_scans=4)
    samples = []
    for data in (files, images):
        data.prepare_data()
        data.setup("fit")
        samples.append(data.train_set[0])
    assert [s["name"] for s in samples] == [
        "2013_05_28_drive_0003_sync/0000000000",
        "0003/0000000000",
    ]
    read, cached = (sample["range_image"] for sample in samples)
    torch.testing.assert_close(cached, read, rtol=0, atol=2e-4)
    assert torch.equal(cached[3], read[3])


class _Intensities(nn.Module):
    """Extractor whose features are range and intensity."""

    def __init__(self):
        super().__init__()
        self.name, self.dim, self.settings = "intensities", 2, {}

    @staticmethod
    def prepare(points):
        return torch.stack([points[:, :3].norm(dim=1), points[:, 3]], dim=1)

    def point_features(self, prepared):
        return list(prepared)


def test_grids_of_labelled_images_are_made_of_their_pixels_without_simulating(
    labelled_root, tmp_path, monkeypatch
):
    shutil.copytree(labelled_root, tmp_path, dirs_exist_ok=True)
    monkeypatch.delattr(Simulator, "scan")
    data = module(tmp_path, codec=LABELLED, num_scans=4, extractor=_Intensities())
    data.prepare_data()
    data.setup("fit")
    for index, item in enumerate(data.train_set.scans):
        pixels = data.images.read(item)
        filled = (pixels.range_m > 0).unflatten(0, (4, 4)).unflatten(2, (8, 8))
        count = filled.sum(dim=(1, 3)).flatten()
        grid = data.train_set[index]["feature_grid"]
        for channel, values in enumerate((pixels.range_m, pixels.intensity)):
            blocks = values.unflatten(0, (4, 4)).unflatten(2, (8, 8))
            sums = torch.where(filled, blocks, 0.0).sum(dim=(1, 3)).flatten()
            expected = sums / count.clamp(min=1)
            torch.testing.assert_close(grid[:, channel], expected, rtol=2e-3, atol=1e-3)


def test_grids_of_another_extractor_are_refused(labelled_root, tmp_path):
    shutil.copytree(labelled_root, tmp_path, dirs_exist_ok=True)
    module(tmp_path, codec=LABELLED, num_scans=4, extractor=_Intensities()).prepare_data()
    (grids,) = (tmp_path / "feature_grids").rglob("*.rows")
    before = grids.read_bytes()
    other = _Intensities()
    other.settings = {"weights": "others"}
    with pytest.raises(StoreError, match="were made with extractor"):
        module(tmp_path, codec=LABELLED, num_scans=5, extractor=other).prepare_data()
    assert grids.read_bytes() == before


def test_ranges_alone_give_no_features(tmp_path):
    with pytest.raises(ValueError, match="ranges alone are cached"):
        module(tmp_path, extractor=_Intensities())


def test_points_and_classes_of_a_labelled_image_train_a_network_on_points(labelled_root):
    source = module(labelled_root, codec=LABELLED, num_scans=4)
    grid = ScanGrid((-57.6, -57.6, -4.8), (57.6, 57.6, 7.2), 2.4, 0.01, 4)  # keeps all points
    data = LabelledPointDataModule(source, Masking(grid))
    data.prepare_data()
    data.setup("fit")
    masked = data.train_set[(0, 0)]
    pixels = source.images.read(data.train_set.scans[0])
    seen = pixels.range_m > 0
    kept = masked.scan.kept
    assert torch.equal(masked.classes, pixels.classes[seen][kept])
    # A rotation keeps ranges.
    torch.testing.assert_close(masked.scan.features[:, 4], pixels.range_m[seen][kept])
    mean, std = grid.intensity_mean, grid.intensity_std
    torch.testing.assert_close(
        masked.scan.features[:, 0] * std + mean, pixels.intensity[seen][kept]
    )


def test_points_of_cached_images_lie_along_the_beams_of_a_named_sensor(tmp_path):
    settings = {"sensor": "vlp16", "image_columns": 128, "codec": LABELLED, "num_scans": 2}
    settings |= {"simulation_sensor": "hdl64e"}
    source = module(tmp_path, **settings, extractor=None)
    source.prepare_data()
    data = PointDataModule(source, lambda points, generator: points)
    data.setup("fit")
    points = torch.as_tensor(data.train_set[0])
    torch.testing.assert_close(points[:, :3], source.points(data.train_set.scans[0]))
    inclination = torch.asin(points[:, 2] / points[:, :3].norm(dim=1)).rad2deg()
    steps = inclination[points[:, :3].norm(dim=1) > 20] % 2  # of VLP-16: odd degrees
    assert (steps - 1).abs().max() < 0.2


def test_networks_on_points_need_images_with_intensity(root):
    data = LabelledPointDataModule(module(root), Masking())
    data.prepare_data()
    with pytest.raises(ValueError, match="intensity_channel to true"):
        data.setup("fit")

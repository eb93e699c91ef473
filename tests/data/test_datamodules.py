import math
import re
import shutil
from itertools import chain
from pathlib import Path

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from lidarsim import Simulator, load_sensor
from r3dpa.data import (
    KITTI360DataModule,
    LidarDataModule,
    SimulatedDataModule,
    StoreError,
    check,
    write_bin,
)
from r3dpa.data.feature_grids import default_features_dir
from r3dpa.data.scans import KITTI360_DRIVES
from r3dpa.geometry import BeamProjection, LidarSensor, RangeCodec, SphericalProjection, share_kept


# 10 training scans and batches of 2: an epoch has 5 batches. Stops: within the first epoch, at its
# end, and within the second; then of epochs of 3 batches; then of 2 batches a step.
@pytest.mark.parametrize(
    ("workers", "stop", "total", "options"),
    [
        (2, 3, 12, {}),
        (0, 5, 12, {}),
        (0, 7, 12, {}),
        (0, 2, 8, {"limit_train_batches": 3}),
        (0, 3, 8, {"limit_train_batches": 3}),
        (0, 2, 6, {"accumulate_grad_batches": 2, "val_check_interval": 2}),
    ],
)
def test_resume_goes_on_with_the_next_batch(tmp_path, data, workers, stop, total, options, fit):
    whole = fit(data(num_workers=workers), total, **options).seen
    saver = ModelCheckpoint(tmp_path / "c", every_n_train_steps=stop, filename="{step}")
    first = fit(data(num_workers=workers), stop, saver, **options).seen
    path = tmp_path / f"c/step={stop}.ckpt"
    second = fit(data(num_workers=workers), total, ckpt_path=path, **options).seen
    assert len(first) == stop * options.get("accumulate_grad_batches", 1)
    assert first + second == whole
    per_epoch = options.get("limit_train_batches", 5)
    epochs = whole[:per_epoch], whole[per_epoch : 2 * per_epoch]
    assert epochs[0] != epochs[1]
    for epoch in epochs:
        assert len(set(chain(*epoch))) == 2 * per_epoch


def test_the_order_depends_on_the_seed(data, fit):
    assert fit(data(seed=1), 5).seen != fit(data(), 5).seen


def test_overfit_batches_takes_the_first_scans_again_and_again(data, fit):
    module = fit(data(), 4, overfit_batches=2)
    assert module.seen == [[0, 1], [2, 3], [0, 1], [2, 3]]


def test_the_share_of_points_in_the_images_is_printed_once_before_training(
    data, caplog, fit, tmp_path
):
    further = shutil.copytree(data().scans, tmp_path / "further")
    with caplog.at_level("INFO"):
        module = data(further_scans=str(further))
        fit(module, 2)
    shares = re.findall(r"\S+% of the points of 1 scan within the range limits.*", caplog.text)
    scan = module.val_set.scans[0].read(module.sensor)[:, :3]
    share = share_kept(torch.from_numpy(scan), module.projection)
    assert shares == [
        f"{share:.1%} of the points of 1 scan within the range limits come back from the range "
        "image of 8 x 32"
    ]
    caplog.clear()
    module.setup("predict")
    assert "range image" not in caplog.text


def test_missing_grids_are_made_once_and_need_their_extractor(
    tmp_path, data, scaled_points, caplog, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    extractor = scaled_points()
    module = data(extractor=extractor)
    for _ in range(2):
        with caplog.at_level("INFO"):
            module.prepare_data()
        module.setup("fit")
    assert "feature grids: 11 made, in " in caplog.text
    assert extractor.calls == 11
    assert module.feature_dim == 4
    batch = next(iter(module.train_dataloader()))
    assert batch["feature_grid"].shape == (2, 8, 4)
    folder = module.features_dir
    assert folder.parts[:2] == ("runs", "feature_grids")
    assert not (tmp_path / "scans/feature_grids").exists()
    stored = data(features_dir=str(folder))
    assert (stored.feature_dim, stored.feature_source) == (4, "scaled")
    with pytest.raises(StoreError, match="no feature grid"):
        data(features_dir=str(tmp_path / "none")).setup("fit")
    data(features_dir=str(tmp_path / "none")).setup("predict")
    assert data().feature_source is None
    with pytest.raises(StoreError, match="no feature grids in"):
        _ = data(features_dir=str(tmp_path / "none")).feature_source


def test_grids_beside_the_scans_are_used_and_go_there_where_the_folder_says_so(
    tmp_path, data, scaled_points, make_scans
):
    """Earlier versions made them there; folders of one name have different places."""
    beside = tmp_path / "scans/feature_grids/scaled"
    beside.mkdir(parents=True)
    assert data(extractor=scaled_points()).features_dir == beside
    assert data(extractor=scaled_points(), features_dir="here").features_dir == Path("here")
    other = default_features_dir(str(tmp_path / "a/scans"), "scaled")
    assert other.parent.name.startswith("scans-")
    assert other != default_features_dir(str(tmp_path / "b/scans"), "scaled")
    simulated = SimulatedDataModule(str(tmp_path / "sim"), extractor=scaled_points())
    assert simulated.features_dir == tmp_path / "sim/feature_grids/scaled"


def test_a_small_folder_makes_smaller_batches(tmp_path, make_scans, sensor, fit, caplog):
    """Six scans, one of them held out, for a batch of eight."""
    data = LidarDataModule(str(make_scans(tmp_path / "few", 6)), sensor=sensor, grid_size=(2, 4))
    with caplog.at_level("INFO"):
        module = fit(data, 2)
    assert [sorted(batch) for batch in module.seen] == [[0, 1, 2, 3, 4]] * 2
    assert "only 5 training scans: batch_size 5 in place of 8" in caplog.text


def test_held_out_folders_and_limit(tmp_path, make_scans, sensor):
    for seed, drive in enumerate(["city/a", "city/b", "hill"]):
        make_scans(tmp_path / "scans" / drive, 4, seed)
    module = LidarDataModule(str(tmp_path / "scans"), sensor=sensor, val_drives=["city/b"])
    train, val = module.split()
    assert {scan.drive for scan in train} == {"city/a", "hill"}
    assert {scan.drive for scan in val} == {"city/b"}
    limited = LidarDataModule(str(tmp_path / "scans"), sensor=sensor, val_every=None, limit=3)
    with pytest.raises(AttributeError, match=r"no val_set; .*setup\('fit'\) first"):
        limited.val_dataloader()
    limited.setup("fit")
    assert [scan.name[-12:] for scan in limited.train_set.scans] == [
        "a/0000000000",
        "b/0000000000",
        "l/0000000000",
    ]
    assert limited.val_dataloader() == []
    with pytest.raises(ValueError, match=r"city/c.*city/a"):
        LidarDataModule(str(tmp_path / "scans"), val_drives=["city/c"]).split()


def test_the_official_split_names_its_drives(tmp_path, make_scans, sensor):
    extra = "2013_05_28_drive_0008_sync"  # recorded for a benchmark, part of no split
    for seed, drive in enumerate([*KITTI360_DRIVES["train"], *KITTI360_DRIVES["val"], extra]):
        make_scans(tmp_path / "data_3d_raw" / drive / "velodyne_points/data", 2, seed)
    train, val = KITTI360DataModule(str(tmp_path), sensor=sensor).split()
    numbers = [sorted({int(scan.drive[17:21]) for scan in part}) for part in (train, val)]
    assert numbers == [[3, 4, 5, 6, 7, 9, 10], [0, 2]]
    assert (len(train), len(val)) == (14, 4)


def write_rings(folder, heights_deg):
    """One scan for each row, with rings at these inclinations, stored ring after ring."""
    folder.mkdir(parents=True)
    azimuth = torch.linspace(0.05, 6.2, 64)
    for frame, rows in enumerate(heights_deg):
        rings = [
            torch.stack([azimuth.cos(), azimuth.sin(), tan.expand(64)], 1) * 10
            for tan in torch.tensor(rows).deg2rad().tan()
        ]
        write_bin(folder / f"{frame:06d}.bin", torch.cat(rings)[:, :3])


def test_only_kitti360_itself_is_the_data_set_of_published_numbers(tmp_path):
    assert KITTI360DataModule(str(tmp_path)).dataset == "KITTI-360"
    assert LidarDataModule(str(tmp_path)).dataset is None
    (tmp_path / "simulation.json").touch()
    assert KITTI360DataModule(str(tmp_path)).dataset is None


def test_rings_do_not_depend_on_the_limit(tmp_path):
    generator = torch.Generator().manual_seed(0)
    tilt = torch.randn(12, 1, generator=generator) / 4
    write_rings(tmp_path / "s", (torch.tensor([2.0, -4, -10, -16]) + tilt).tolist())
    options = {"sensor": LidarSensor(beams=4, columns=64), "projection": "rings"}
    fitted = []
    for limit in (None, 1, 3):
        data = LidarDataModule(str(tmp_path / "s"), limit=limit, val_every=4, **options)
        data.setup("predict")
        fitted.append(data.projection.ring_inclinations_deg)
    assert fitted[0] == fitted[1] == fitted[2]
    held_out = LidarDataModule(
        str(tmp_path / "s"), val_every=None, val_drives=["s"], limit=1, **options
    )
    held_out.setup("predict")  # no scan to train on: measured in the others
    assert held_out.projection.ring_inclinations_deg == pytest.approx(fitted[0], abs=1)


@pytest.mark.parametrize("part", ["train", "val"])
def test_a_split_can_be_loaded_alone(tmp_path, make_scans, sensor, part, fit, trainer, recorder):
    """KITTI-360 with drives of one split: usable but for the stage that needs the other one."""
    drive = KITTI360_DRIVES[part][0]
    make_scans(tmp_path / "data_3d_raw" / drive / "velodyne_points/data", 4)
    data = KITTI360DataModule(str(tmp_path), sensor=sensor, batch_size=2)
    data.setup("predict")
    assert sum(len(batch["name"]) for batch in data.predict_dataloader()) == 4
    if part == "train":
        assert len(fit(data, 2).seen) == 2
        with pytest.raises(ValueError, match=r"no held-out scan in .*missing drives"):
            trainer(1).validate(recorder(), data, verbose=False)
    else:
        trainer(1).validate(recorder(), data, verbose=False)
        with pytest.raises(ValueError, match=r"no scan to train on in .*missing drives"):
            fit(data, 1)


def test_prediction_makes_no_grids(tmp_path, data, scaled_points, trainer, recorder):
    extractor = scaled_points()
    module = data(extractor=extractor)
    batches = trainer(1).predict(recorder(), module)
    assert sum(len(batch["name"]) for batch in batches) == 11
    assert not any("feature_grid" in batch for batch in batches)
    assert extractor.calls == 0
    assert not module.features_dir.exists()


def test_grids_of_a_single_file_need_a_folder(tmp_path, data, sensor, scaled_points):
    data()
    file = str(tmp_path / "scans/0000000000.bin")
    with pytest.raises(ValueError, match="features_dir is needed"):
        LidarDataModule(file, sensor=sensor, extractor=scaled_points())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0}, "batch_size must be at least 1, got 0"),
        ({"val_every": 1}, "val_every must be at least 2"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"repeats": 3}, "repeats 3 counts beside further_scans, of which there are none"),
    ],
)
def test_bad_arguments_are_refused(data, options, message):
    with pytest.raises(ValueError, match=message):
        data(**options)


def test_simulated_data_are_made_once_and_feed_a_fit(tmp_path, scaled_points, fit):
    extractor = scaled_points()
    for _ in range(2):
        data = SimulatedDataModule(
            str(tmp_path / "sim"),
            num_scans=4,
            simulation_seed=3,
            extractor=extractor,
            batch_size=1,
            projection="rings",
        )
        module = fit(data, 2)
        assert len(module.seen) == 2
    assert extractor.calls == 4
    assert check(tmp_path / "sim")[1]
    assert {scan.drive for scan in data.val_set.scans} <= set(KITTI360_DRIVES["val"])
    assert len(data.train_set) == 3
    filled = torch.stack([sample["valid_mask"] for sample in data.train_set]).float().mean()
    assert 0.5 < filled < 1
    smaller = SimulatedDataModule(str(tmp_path / "sim"), num_scans=2, simulation_seed=3)
    smaller.prepare_data()
    smaller.setup("fit")
    assert [len(smaller.train_set), len(smaller.val_set)] == [1, 1]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Scans of a VLP-16 in two folders."""
    root = tmp_path_factory.mktemp("vlp16")
    for folder, num_scans in (("own", 4), ("simulated", 3)):
        simulator = Simulator(seed=num_scans, sensor=load_sensor("vlp16", shots=600))
        for number in range(num_scans):
            write_bin(root / folder / f"{number}.bin", simulator.scan(number).points)
    return root


class TestNamedSensors:
    def test_a_preset_gives_a_row_per_beam_and_its_range(self, folders):
        codec = RangeCodec("log2", return_channel=True)
        module = LidarDataModule(
            str(folders / "own"), sensor="vlp16", image_columns=512, codec=codec
        )
        module.setup("fit")
        assert module.projection == BeamProjection.of("vlp16", 512)
        assert module.geometry.codec.scale == pytest.approx(math.log2(101), abs=1e-4)
        image = module.train_set[0]["range_image"]
        assert image.shape == (2, 16, 512)
        assert (image[1] > 0).any(dim=1).sum() >= 15

    def test_a_scan_that_is_given_twice_is_refused(self, folders):
        """It could be held out, and trained on all the same."""
        module = LidarDataModule(str(folders / "own"), further_scans=str(folders), val_every=2)
        with pytest.raises(ValueError, match=r"further_scans names .*\.bin, which is one of scans"):
            module.split()

    def test_further_scans_are_trained_on_and_never_held_out(self, folders):
        module = LidarDataModule(
            str(folders / "own"),
            sensor="vlp16",
            val_every=2,
            further_scans=str(folders / "simulated"),
            repeats=3,
        )
        train, val = module.split()
        assert len(train) == 3 * 2 + 3
        assert {scan.path.parent.name for scan in val} == {"own"}
        assert not {scan.path for scan in train} & {scan.path for scan in val}
        module.setup("predict")  # each scan once
        assert module.all_set.scans == sorted({*train, *val})

    def test_scans_of_two_data_sets_may_have_the_same_names(self, tmp_path, folders):
        for name in ("real", "simulated"):
            shutil.copytree(folders / "simulated", tmp_path / name / "drive")
        module = LidarDataModule(
            str(tmp_path / "real"), val_every=None, further_scans=str(tmp_path / "simulated")
        )
        module.setup("predict")
        paths = [scan.path for scan in module.all_set.scans]
        assert sorted(paths) == sorted(tmp_path.glob("*/drive/*.bin"))

    def test_settings_of_an_image_keep_their_projection_and_codec(self, folders):
        module = LidarDataModule(str(folders / "own"), sensor=LidarSensor(16, 512))
        module.setup("fit")
        assert module.projection == SphericalProjection(LidarSensor(16, 512))
        assert module.codec == RangeCodec()

    @pytest.mark.parametrize("options", [{"image_columns": 512}, {"projection": "beams"}])
    def test_beams_need_a_named_sensor(self, options):
        with pytest.raises(ValueError, match="need a sensor given as a preset"):
            LidarDataModule("scans", sensor=LidarSensor(), **options)

from itertools import chain

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from r3dpa.data import (
    FeatureGridError,
    KITTI360DataModule,
    LidarDataModule,
    SimulatedDataModule,
    check,
)
from r3dpa.data.scans import KITTI360_DRIVES


class Recorder(LightningModule):
    """Keeps the indices of every batch it is trained on."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen = []

    def training_step(self, batch, batch_idx):
        self.seen.append(batch["index"].tolist())
        return (self.weight - torch.rand(())) ** 2

    def validation_step(self, batch, batch_idx):
        torch.rand(())

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def trainer(tmp_path, max_steps, *callbacks, **options):
    return Trainer(
        default_root_dir=tmp_path,
        max_steps=max_steps,
        accelerator="cpu",
        logger=False,
        enable_checkpointing=any(isinstance(c, ModelCheckpoint) for c in callbacks),
        enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=list(callbacks),
        **options,
    )


@pytest.fixture
def data(tmp_path, make_scans, sensor):
    folder = make_scans(tmp_path / "scans", 11)

    def build(**options):
        defaults = {"batch_size": 2, "val_every": 11, "grid_size": (2, 4)}
        return LidarDataModule(str(folder), sensor=sensor, **defaults | options)

    return build


def record(tmp_path, data, max_steps, *callbacks, ckpt_path=None, **options):
    module, run = Recorder(), trainer(tmp_path, max_steps, *callbacks, **options)
    run.fit(module, data, ckpt_path=ckpt_path)
    return module, run


# 10 training scans and batches of 2: an epoch has 5 batches. Stops: within the first epoch, at its
# end, within the second, and at the end of the second.
@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("stop", [3, 5, 7, 10])
def test_resume_goes_on_with_the_next_batch(tmp_path, data, workers, stop):
    whole, _ = record(tmp_path, data(num_workers=workers), 12)
    saver = ModelCheckpoint(tmp_path / "c", every_n_train_steps=stop, filename="{step}")
    first, _ = record(tmp_path, data(num_workers=workers), stop, saver)
    second, _ = record(
        tmp_path, data(num_workers=workers), 12, ckpt_path=tmp_path / f"c/step={stop}.ckpt"
    )
    assert first.seen == whole.seen[:stop]
    assert second.seen == whole.seen[stop:]
    assert len(whole.seen) == 12
    for epoch in (whole.seen[:5], whole.seen[5:10]):
        assert sorted(chain(*epoch)) == list(range(10))
    assert whole.seen[:5] != whole.seen[5:10]


@pytest.mark.parametrize("stop", [3, 5, 7])
def test_resume_from_a_checkpoint_saved_after_the_fit(tmp_path, data, stop):
    whole, _ = record(tmp_path, data(), 12)
    _, run = record(tmp_path, data(), stop)
    run.save_checkpoint(tmp_path / "after.ckpt")
    second, run = record(tmp_path, data(), 9, ckpt_path=tmp_path / "after.ckpt")
    run.save_checkpoint(tmp_path / "again.ckpt")
    third, _ = record(tmp_path, data(), 12, ckpt_path=tmp_path / "again.ckpt")
    assert second.seen + third.seen == whole.seen[stop:]


@pytest.mark.parametrize("stop", [2, 3, 4])
def test_resume_under_limited_epochs(tmp_path, data, stop):
    options = {"limit_train_batches": 3}
    whole, _ = record(tmp_path, data(), 8, **options)
    saver = ModelCheckpoint(tmp_path / "c", every_n_train_steps=stop, filename="{step}")
    record(tmp_path, data(), stop, saver, **options)
    path = tmp_path / f"c/step={stop}.ckpt"
    second, _ = record(tmp_path, data(), 8, ckpt_path=path, **options)
    assert second.seen == whole.seen[stop:]
    assert whole.seen[3:5] != whole.seen[:2]


def test_resume_with_accumulation_and_validation_within_the_epoch(tmp_path, data):
    options = {"accumulate_grad_batches": 2, "val_check_interval": 2}
    whole, _ = record(tmp_path, data(), 6, **options)
    saver = ModelCheckpoint(tmp_path / "c", every_n_train_steps=2, filename="{step}")
    record(tmp_path, data(), 2, saver, **options)
    second, _ = record(tmp_path, data(), 6, ckpt_path=tmp_path / "c/step=2.ckpt", **options)
    assert second.seen == whole.seen[4:]


def test_order_does_not_depend_on_workers_but_on_the_seed(tmp_path, data):
    orders = [record(tmp_path, data(num_workers=w), 6)[0].seen for w in (0, 1, 2)]
    assert orders[0] == orders[1] == orders[2]
    assert record(tmp_path, data(seed=1), 6)[0].seen != orders[0]


def test_fit_twice_in_one_process_starts_over(tmp_path, data):
    module = data()
    assert record(tmp_path, module, 3)[0].seen == record(tmp_path, module, 3)[0].seen


def test_overfit_batches_takes_the_first_scans_again_and_again(tmp_path, data):
    module, _ = record(tmp_path, data(), 4, overfit_batches=2)
    assert module.seen == [[0, 1], [2, 3], [0, 1], [2, 3]]


def test_batches_and_attributes(data, sensor):
    module = data()
    module.prepare_data()
    module.setup("fit")
    batch = next(iter(module.train_dataloader()))
    assert batch["range_image"].shape == batch["valid_mask"].shape == (2, 1, 8, 32)
    assert batch["range_image"].dtype == torch.float32
    assert batch["valid_mask"].dtype == torch.bool
    assert "feature_grid" not in batch
    assert module.sensor == sensor
    assert module.grid_size == (2, 4)
    assert module.projection_kind == "spherical"
    assert module.feature_dim == 768
    names = [name for batch in module.predict_dataloader() for name in batch["name"]]
    assert names == [f"scans/{frame:010d}" for frame in range(11)]
    assert [n for b in module.test_dataloader() for n in b["name"]] == ["scans/0000000000"]


def test_missing_grids_are_made_once_and_need_their_extractor(tmp_path, data, scaled_points):
    extractor = scaled_points()
    module = data(extractor=extractor)
    for _ in range(2):
        module.prepare_data()
        module.setup("fit")
    assert extractor.calls == 11
    assert module.feature_dim == 4
    batch = next(iter(module.train_dataloader()))
    assert batch["feature_grid"].shape == (2, 8, 4)
    folder = tmp_path / "scans/feature_grids/scaled_2x4"
    assert data(features_dir=str(folder)).feature_dim == 4
    with pytest.raises(FeatureGridError, match="No feature grid"):
        data(features_dir=str(tmp_path / "none")).setup("fit")
    data(features_dir=str(tmp_path / "none")).setup("predict")


def test_held_out_folders_and_limit(tmp_path, make_scans, sensor):
    for seed, drive in enumerate(["city/a", "city/b", "hill"]):
        make_scans(tmp_path / "scans" / drive, 4, seed)
    module = LidarDataModule(str(tmp_path / "scans"), sensor=sensor, val_drives=["city/b"])
    train, val = module.split()
    assert {scan.drive for scan in train} == {"city/a", "hill"}
    assert {scan.drive for scan in val} == {"city/b"}
    limited = LidarDataModule(str(tmp_path / "scans"), sensor=sensor, val_every=None, limit=3)
    limited.setup("fit")
    assert [scan.name[-12:] for scan in limited.train_set.scans] == [
        "a/0000000000",
        "b/0000000000",
        "l/0000000000",
    ]
    assert limited.val_dataloader() == []
    with pytest.raises(ValueError, match=r"city/c.*city/a"):
        LidarDataModule(str(tmp_path / "scans"), val_drives=["city/c"]).split()


def test_training_without_validation_scans(tmp_path, data):
    assert len(record(tmp_path, data(val_every=None), 2)[0].seen) == 2


def test_official_split(tmp_path, make_scans, sensor):
    extra = "2013_05_28_drive_0008_sync"  # recorded for a benchmark, part of no split
    for seed, drive in enumerate([*KITTI360_DRIVES["train"], *KITTI360_DRIVES["val"], extra]):
        make_scans(tmp_path / "data_3d_raw" / drive / "velodyne_points/data", 2, seed)
    train, val = KITTI360DataModule(str(tmp_path), sensor=sensor).split()
    numbers = [sorted({int(scan.drive[17:21]) for scan in part}) for part in (train, val)]
    assert numbers == [[3, 4, 5, 6, 7, 9, 10], [0, 2]]
    assert (len(train), len(val)) == (14, 4)


def test_other_rings_than_those_of_the_checkpoint_are_refused(data):
    rings = [2.0 - 3 * row for row in range(8)]
    module = data(projection="rings", ring_inclinations_deg=rings)
    module.setup("predict")
    state = module.state_dict()
    module.load_state_dict(state)
    other = data(projection="rings", ring_inclinations_deg=[r - 0.5 for r in rings])
    other.setup("predict")
    with pytest.raises(ValueError, match="ring_inclinations_deg"):
        other.load_state_dict(state)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0}, "batch_size must be at least 1, got 0"),
        ({"projection": "cubic"}, "'spherical' or 'rings', got 'cubic'"),
        ({"val_every": 1}, "val_every must be at least 2"),
        ({"seed": -1}, "seed must be at least 0"),
    ],
)
def test_bad_arguments(data, options, message):
    with pytest.raises(ValueError, match=message):
        data(**options)


def test_a_batch_larger_than_the_data_is_refused(data):
    module = data(batch_size=11)
    module.setup("fit")
    with pytest.raises(ValueError, match="10 training scans do not fill one batch of 11"):
        module.train_dataloader()


def test_simulated_data_are_made_once_and_feed_a_fit(tmp_path, scaled_points):
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
        module, _ = record(tmp_path, data, 2)
        assert len(module.seen) == 2
    assert extractor.calls == 4
    assert check(tmp_path / "sim").ok
    assert {scan.drive for scan in data.val_set.scans} <= set(KITTI360_DRIVES["val"])
    assert len(data.train_set) == 3
    filled = torch.stack([sample["valid_mask"] for sample in data.train_set]).float().mean()
    assert 0.5 < filled < 1

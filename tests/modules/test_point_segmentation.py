import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lightning import Trainer
from point_clouds import GRID, cloud
from tiny_stages import SILENT

from r3dpa.data import LabelledPointDataModule, LidarDataModule, write_bin
from r3dpa.data.labels import write_labels
from r3dpa.features import Masking, WaffleIron, WaffleIronS, WaffleIronS2
from r3dpa.modules import PointSegmentation
from r3dpa.modules.point_segmentation import class_loss

ROAD, CAR = (7, 0), (26, 11)  # KITTI-360 label, number of the class


@pytest.fixture
def data(tmp_path):
    """Four random scans, those from the second on with labels: cars above z = 0, road below."""
    folder = tmp_path / "scans" / "velodyne_points"
    for seed in range(4):
        points = cloud(seed)
        write_bin(folder / "data" / f"{seed}.bin", points)
        if seed:
            labels = torch.where(points[:, 2] > 0, CAR[0] + (5 << 16), ROAD[0])
            labels[0] = 0
            write_labels(folder / "labels" / f"{seed}.label", labels)
    source = LidarDataModule(str(tmp_path / "scans"), val_every=None)
    return LabelledPointDataModule(source, Masking(GRID), batch_size=2)


def test_classes_are_those_of_the_kept_points(data):
    data.setup("fit")
    masked = data.train_set[(3, 1)]
    heights = masked.scan.features[:, 3]  # as rotation and mirroring leave them
    labelled = masked.classes >= 0
    assert torch.equal(
        masked.classes[labelled], torch.where(heights > 0, CAR[1], ROAD[1])[labelled]
    )
    assert (~labelled).sum() == (masked.scan.kept == 0).sum()
    assert (data.train_set[(3, 0)].classes == -1).all()


def test_rare_classes_count_more_and_unknown_ones_not():
    """Four points of one class and one of another count as 2 to 1; an unknown one not at all."""
    logits = torch.zeros(6, 3)
    logits[:5, 0] = 1.0
    logits[5, 2] = 100.0
    classes = torch.tensor([0, 0, 0, 0, 1, -1])
    total = math.log(math.e + 2)
    expected = (2 * (total - 1) + 1 * total) / 3
    assert class_loss(logits, classes).item() == pytest.approx(expected)


def test_a_scan_without_labels_trains_on_its_geometry_alone(data):
    data.setup("fit")
    module = PointSegmentation(WaffleIron(16, 3, GRID.cells))
    module.edges.copy_(torch.linspace(-1, 1, 7).expand_as(module.edges))
    losses = module.losses([data.train_set[(0, 0)]])
    assert losses["classes"].item() == 0
    losses["loss"].backward()
    assert not module.class_head.weight.grad.any()
    assert module.head.weight.grad.any()
    assert all(p.grad.isfinite().all() for p in module.parameters() if p.grad is not None)


def test_without_geometry_no_target_is_computed_and_every_parameter_learns(
    tmp_path, data, monkeypatch
):
    data.prepare = Masking(GRID, geometry=False)
    monkeypatch.setattr(Masking, "describe", None)
    module = PointSegmentation(WaffleIron(16, 3, GRID.cells), geometry_weight=0)
    trainer = Trainer(max_steps=1, num_sanity_val_steps=0, default_root_dir=tmp_path, **SILENT)
    trainer.fit(module, data)
    assert all(buffer.isfinite().all() for buffer in module.buffers())  # else StepGuard stops it
    module.losses([data.train_set[(1, 0)]])["loss"].backward()
    assert all(p.grad is not None for p in module.parameters() if p.requires_grad)
    with pytest.raises(ValueError, match=r"geometry_weight 1 needs the targets .* geometry false"):
        trainer.fit(PointSegmentation(WaffleIron(16, 3, GRID.cells)), data)


def test_overfit_batches_takes_the_first_scans_again_and_again(tmp_path, data):
    module = PointSegmentation(WaffleIron(16, 3, GRID.cells))
    trainer = Trainer(max_steps=2, overfit_batches=1, default_root_dir=tmp_path, **SILENT)
    trainer.fit(module, data)
    assert trainer.global_step == 2


def test_training_learns_classes_and_goes_on_from_its_weights(tmp_path, data):
    torch.manual_seed(0)
    module = PointSegmentation(WaffleIron(16, 3, GRID.cells), lr=1e-2, warmup=2)
    trainer = Trainer(max_steps=40, num_sanity_val_steps=0, default_root_dir=tmp_path, **SILENT)
    trainer.fit(module, data)
    assert trainer.callback_metrics["train/classes"] < 0.5  # 0.69 for a guess of two classes
    file = tmp_path / "waffleiron_s_2.safetensors"
    further = PointSegmentation(WaffleIron(16, 3, GRID.cells), start=file)
    for key, value in module.network.state_dict().items():
        rounded = value.half().to(value.dtype)  # the file is in half precision
        assert torch.equal(further.network.state_dict()[key], rounded), key
    assert torch.equal(further.norm.running_mean, module.norm.running_mean.half().float())
    source, points = WaffleIronS2(file, dim=16), cloud(9)
    assert source(points).isfinite().all()
    expected = torch.where(points[:, 2] > 0, CAR[1], ROAD[1])
    assert (source.classes(points) == expected).float().mean() > 0.8
    assert (source.classes(points + 1000) == -1).all()  # out of its field of view
    with pytest.raises(ValueError, match="know no classes: take waffleiron-s-2"):
        WaffleIronS().classes(points)


def test_scans_without_classes_are_refused():
    module = PointSegmentation(WaffleIron(16, 3, GRID.cells))
    module.edges.copy_(torch.linspace(-1, 1, 7).expand_as(module.edges))
    module._trainer = SimpleNamespace(world_size=1)
    with pytest.raises(ValueError, match=r"use r3dpa\.data\.LabelledPointDataModule"):
        module.losses([Masking(GRID)(cloud(), np.random.default_rng(0))])

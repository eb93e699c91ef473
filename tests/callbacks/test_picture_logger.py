"""Pictures of a validation."""

from types import SimpleNamespace

import pytest
import torch

from r3dpa.callbacks import PictureLogger, ReconstructionWriter
from r3dpa.data import read_scan
from r3dpa.geometry import LidarSensor, SphericalProjection, points_of


def test_a_failed_picture_does_not_end_training(monkeypatch):
    def fail(*_):
        raise OSError("no space left")

    monkeypatch.setattr(PictureLogger, "_draw", fail)
    trainer = SimpleNamespace(sanity_checking=False, global_step=7)
    with pytest.warns(UserWarning, match="no pictures at step 7: no space left"):
        PictureLogger().on_validation_end(trainer, None)


def test_a_reconstruction_of_a_scan_of_nuscenes_is_read_as_it_was_written(tmp_path):
    """A file .pcd.bin would be five columns."""
    projection = SphericalProjection(LidarSensor(4, 32))
    module = SimpleNamespace(scan_geometry=SimpleNamespace(projection=projection))
    trainer, range_m = SimpleNamespace(default_root_dir=tmp_path), torch.full((1, 4, 32), 10.0)
    batch = {"name": ["drive/a.pcd"]}
    ReconstructionWriter().on_predict_batch_end(trainer, module, range_m, batch, 0)
    (path,) = tmp_path.rglob("*.bin")
    points = torch.from_numpy(read_scan(path))
    assert points[:, :3].equal(points_of(range_m[0], projection))


def test_scans_of_equal_names_are_not_written_to_one_file():
    scans = [SimpleNamespace(name="0000/3"), SimpleNamespace(name="0000/3")]
    data = SimpleNamespace(all_set=SimpleNamespace(scans=scans))
    with pytest.raises(ValueError, match=r"2 scans would be .* 0000/3\.bin: predict each data set"):
        ReconstructionWriter().on_predict_start(SimpleNamespace(datamodule=data), None)
    del scans[1]
    ReconstructionWriter().on_predict_start(SimpleNamespace(datamodule=data), None)

"""Pictures of a validation."""

from types import SimpleNamespace

import pytest

from r3dpa.callbacks import PictureLogger, ReconstructionWriter


def test_a_failed_picture_does_not_end_training(monkeypatch):
    def fail(*_):
        raise OSError("no space left")

    monkeypatch.setattr(PictureLogger, "_draw", fail)
    trainer = SimpleNamespace(sanity_checking=False, global_step=7)
    with pytest.warns(UserWarning, match="no pictures at step 7: no space left"):
        PictureLogger().on_validation_end(trainer, None)


def test_scans_of_equal_names_are_not_written_to_one_file():
    scans = [SimpleNamespace(name="0000/3"), SimpleNamespace(name="0000/3")]
    data = SimpleNamespace(all_set=SimpleNamespace(scans=scans))
    with pytest.raises(ValueError, match="2 scans have the name 0000/3: predict each data set"):
        ReconstructionWriter().on_predict_start(SimpleNamespace(datamodule=data), None)
    del scans[1]
    ReconstructionWriter().on_predict_start(SimpleNamespace(datamodule=data), None)

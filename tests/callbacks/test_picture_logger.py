"""Pictures of a validation."""

from types import SimpleNamespace

import pytest

from r3dpa.callbacks import PictureLogger


def test_a_failed_picture_does_not_end_training(monkeypatch):
    def fail(*_):
        raise OSError("no space left")

    monkeypatch.setattr(PictureLogger, "_draw", fail)
    trainer = SimpleNamespace(sanity_checking=False, global_step=7)
    with pytest.warns(UserWarning, match="no pictures at step 7: no space left"):
        PictureLogger().on_validation_end(trainer, None)

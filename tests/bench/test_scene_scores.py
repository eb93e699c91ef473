import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scene_scores import main

from r3dpa.geometry import LidarSensor, Pixels, SphericalProjection

SENSOR = LidarSensor(beams=16, columns=128)


def walls(count, seed):
    """Rounded walls of random depth on level ground."""
    generator = torch.Generator().manual_seed(seed)
    depth = 5 + 40 * torch.rand(count, 1, 128, generator=generator)
    smooth = torch.nn.functional.avg_pool1d(depth, 9, 1, 4, count_include_pad=False)
    return smooth.expand(count, 16, 128) + 0.05 * torch.rand(count, 16, 128, generator=generator)


def test_copies_of_training_scans_are_memorised(tmp_path, monkeypatch):
    train, held_out = walls(12, 0), walls(8, 1)
    data = SimpleNamespace(
        setup=lambda stage: None,
        projection=SphericalProjection(SENSOR),
        train_set=SimpleNamespace(scans=list(train)),
        val_set=SimpleNamespace(scans=list(held_out)),
        images=SimpleNamespace(read=Pixels),
    )
    monkeypatch.setattr("scene_scores.read_data", lambda path: data)
    (tmp_path / "copies").mkdir()
    np.save(tmp_path / "copies" / "range_m.npy", train[:6].numpy())
    words = ["--scenes", tmp_path / "copies", "--data", "data.yaml", "--num", 4, "--compared", 4]
    main([*map(str, words), "--out", str(tmp_path / "scores.json")])
    text = (tmp_path / "scores.json").read_text()
    sets = json.loads(text)["sets"]
    assert sets["copies"]["scenes"] == 4
    assert sets["copies"]["nearest"] == pytest.approx(0, abs=1e-3)
    assert sets["training scans"]["nearest"] == pytest.approx(0, abs=1e-3)
    assert sets["held-out scans"]["nearest"] > 0.05
    assert 0 <= sets["copies"]["classifier"] <= 1
    assert str(tmp_path) not in text

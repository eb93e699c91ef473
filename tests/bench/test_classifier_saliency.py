import json
from types import SimpleNamespace

import numpy as np
import torch
from classifier_saliency import PARTS, RANGE_M, layout, main, returns_alone, texture, without_gaps

from r3dpa.geometry import LidarSensor, Pixels, SphericalProjection

# Two blocks of 4 x 8 pixels: ranges 4 and 16 m in turn, and 9 m; a gap of two pixels in row 1.
IMAGE = torch.tensor([4.0, 16.0] * 4 + [9.0] * 8).expand(1, 4, 16).clone()
IMAGE[0, 1, 9:11] = -1.0


def test_returns_alone_keep_only_where_there_is_one():
    alone = returns_alone(IMAGE)
    assert torch.equal(alone > 0, IMAGE > 0)
    assert set(alone.unique().tolist()) == {-1.0, RANGE_M}


def test_gaps_take_the_return_before_them_around_the_turn():
    assert torch.equal(without_gaps(IMAGE)[0, 1], IMAGE[0, 0])
    first = IMAGE.clone()
    first[0, 2, :2] = -1.0
    assert without_gaps(first)[0, 2, :2].tolist() == [9.0, 9.0]  # the last return of the ring


def test_layout_and_texture_are_the_mean_of_a_block_and_what_differs_from_it():
    coarse, fine = layout(IMAGE), texture(IMAGE)
    torch.testing.assert_close(coarse[..., :8], torch.full((1, 4, 8), 8.0))  # sqrt(4 * 16)
    torch.testing.assert_close(coarse[..., 8:], torch.full((1, 4, 8), 9.0))
    torch.testing.assert_close(coarse * fine / RANGE_M, without_gaps(IMAGE))


def test_each_part_is_judged_and_the_evidence_drawn(tmp_path, monkeypatch):
    generator = torch.Generator().manual_seed(0)
    scans, scenes = (5 + 40 * torch.rand(2, 8, 16, 64, generator=generator)).unbind()
    data = SimpleNamespace(
        setup=lambda stage: None,
        projection=SphericalProjection(LidarSensor(beams=16, columns=64)),
        val_set=SimpleNamespace(scans=list(scans)),
        images=SimpleNamespace(read=Pixels),
    )
    monkeypatch.setattr("classifier_saliency.read_data", lambda path: data)
    np.save(tmp_path / "range_m.npy", scenes.numpy())
    words = [
        "--scenes",
        tmp_path,
        "--data",
        "data.yaml",
        "--num",
        8,
        "--out",
        tmp_path / "out.json",
    ]
    main([*map(str, words), "--picture", str(tmp_path / "out.png")])
    report = json.loads((tmp_path / "out.json").read_text())
    assert report["accuracy"].keys() == PARTS.keys()
    assert [len(rows) for rows in report["evidence"].values()] == [1, 1]  # a cell is 16 rows high
    assert (tmp_path / "out.png").stat().st_size > 1000

"""Checkpoints with intensity and class: scenes, their files, and scans to latents and back."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tiny_networks import VAE_ARGS, tiny_checkpoint

from r3dpa.cli import main
from r3dpa.data import read_scan
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import (
    NUM_CLASSES,
    SEMANTIC_CLASSES,
    LidarSensor,
    RangeCodec,
    ScanGeometry,
    SphericalProjection,
)
from r3dpa.scene_vae import SceneVAE

SENSOR = LidarSensor(beams=16, columns=64)
CODEC = RangeCodec(return_channel=True, intensity_channel=True, num_classes=NUM_CLASSES)
PLAIN = RangeCodec(return_channel=True)
LABELS = {0, *(semantic.label for semantic in SEMANTIC_CLASSES)}
TWO_STEPS = SamplerConfig(solver="euler", steps=2)


def checkpoint(folder, codec):
    further = {"intensity": codec.intensity_channel, "num_classes": codec.num_classes}
    geometry = ScanGeometry(SphericalProjection(SENSOR), codec, (2, 8))
    path = folder / f"{codec.channels}.safetensors"
    return tiny_checkpoint(path, geometry, vae_args=VAE_ARGS | {"in_channels": 2} | further)


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    return checkpoint(tmp_path_factory.mktemp("labelled"), CODEC)


def test_scenes_have_intensity_and_labels_at_their_returns(labelled):
    scenes = SceneGenerator.from_checkpoint(labelled, TWO_STEPS, device="cpu").generate(2)
    returns = scenes.range_m > 0
    assert 0 < returns.sum() < returns.numel()
    assert scenes.labels.shape == scenes.intensity.shape == scenes.range_m.shape
    assert torch.equal(scenes.labels > 0, returns)
    assert set(scenes.labels.unique().tolist()) <= LABELS
    assert len(scenes.labels[returns].unique()) > 2
    assert scenes.intensity.min() == 0
    assert scenes.intensity.max() <= 1
    assert len(scenes.intensity[returns].unique()) > 100
    for index in range(2):
        kept = returns[index]
        assert torch.equal(scenes.point_labels(index), scenes.labels[index][kept])
        assert torch.equal(scenes.point_intensity(index), scenes.intensity[index][kept])
        assert len(scenes.points(index)) == kept.sum()


def test_scenes_without_them_say_so(tmp_path):
    plain = checkpoint(tmp_path, PLAIN)
    scenes = SceneGenerator.from_checkpoint(plain, TWO_STEPS, device="cpu").generate(1)
    assert scenes.labels is None
    assert scenes.intensity is None
    with pytest.raises(ValueError, match="these scenes have no labels"):
        scenes.point_labels(0)


def test_sample_writes_labels_and_intensity(labelled, tmp_path):
    words = ["sample", "--ckpt", labelled, "--out", tmp_path / "out", "--num", 2, "--steps", 2]
    main(
        [
            *map(str, words),
            "--solver",
            "euler",
            "--shift",
            "1",
            "--pictures",
            "1",
            "--device",
            "cpu",
        ]
    )
    scenes = SceneGenerator.from_checkpoint(labelled, TWO_STEPS, device="cpu").generate(2)
    for index in range(2):
        points = read_scan(tmp_path / "out" / "bin" / f"{index:06d}.bin")
        labels = np.fromfile(tmp_path / "out" / "labels" / f"{index:06d}.label", "<u4")
        assert np.array_equal(labels, scenes.point_labels(index).numpy())
        np.testing.assert_allclose(points[:, 3], scenes.point_intensity(index), atol=1e-5)
    assert (tmp_path / "out" / "scenes.html").exists()


def test_a_scan_and_its_labels_become_latents_and_a_labelled_scene(labelled):
    vae = SceneVAE.from_checkpoint(labelled, device="cpu")
    torch.nn.init.normal_(vae.vae.encoder.further_in.weight)  # as a training makes it
    generator = torch.Generator().manual_seed(0)
    points = torch.cat([torch.randn(500, 3) * 10, torch.rand(500, 1, generator=generator)], dim=1)
    labels = torch.full((500,), 26)
    latents = vae.encode(points, labels)
    assert not torch.equal(latents, vae.encode(points, labels + 1))  # trucks, not cars
    assert torch.equal(latents, vae.encode(points.numpy(), (labels | 5 << 16).numpy()))
    scenes = vae.decode(latents)
    assert torch.equal(scenes.labels > 0, scenes.range_m > 0)
    assert scenes.intensity.shape == (1, 16, 64)
    with pytest.raises(ValueError, match="needs scans with an intensity"):
        vae.encode(points[:, :3], labels)

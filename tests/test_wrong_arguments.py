"""Arguments of the Python interface that are wrong: each is refused by name, with the remedy."""

import numpy as np
import pytest
import torch
from tiny_networks import tiny_checkpoint

from r3dpa import SceneGenerator, SceneVAE, Simulator
from r3dpa.data import LidarDataModule
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection


@pytest.fixture(scope="module")
def ckpt(tmp_path_factory):
    projection = SphericalProjection(LidarSensor(beams=16, columns=64))
    geometry = ScanGeometry(projection, RangeCodec(), (2, 8))
    return tiny_checkpoint(tmp_path_factory.mktemp("wrong") / "tiny.safetensors", geometry)


@pytest.fixture(scope="module")
def vae(ckpt):
    return SceneVAE.from_checkpoint(ckpt, "cpu")


@pytest.fixture(scope="module")
def generator(ckpt):
    return SceneGenerator.from_checkpoint(ckpt, "draft", device="cpu")


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform(-20, 20, (100, 4)).astype(np.float32)


def test_points_that_are_no_scan_in_metres(vae, points):
    nan = points.copy()
    nan[3, 1] = np.nan
    for wrong, message in (
        ("scan.bin", "got str; r3dpa.data.read_scan reads them from a file"),
        (nan, "points must be finite"),
        (points[:0], "none of 0 points lies 1 to"),
        (points * 1000, "none of 100 points .*; coordinates must be in metres"),
        (points[:, :2], r"must be \(P, 3\) or \(P, 4\), got shape \(100, 2\)"),
    ):
        with pytest.raises(ValueError, match=message):
            vae.encode(wrong)


def test_latents_of_numpy_are_taken_and_of_another_shape_refused(vae, points):
    latents = vae.encode(points)
    decoded = [vae.decode(given).range_m for given in (latents, latents.numpy())]
    assert torch.equal(*decoded)
    with pytest.raises(ValueError, match=r"latents must have shape \(B, \*\(4, 4, 16\)\), got"):
        vae.decode(latents[:, :3])


@pytest.mark.parametrize("number", ["3", 1.5, True])
def test_numbers_of_scenes_that_are_none(generator, number):
    with pytest.raises(ValueError, match="give a number of scenes or their indices, got "):
        generator.generate(number)


def test_a_sampler_by_its_name(generator):
    with pytest.raises(ValueError, match="sampler must be a SamplerConfig, got 'euler'"):
        generator.with_sampler("euler")


def test_weather_and_sensor_of_another_kind():
    with pytest.raises(ValueError, match=r"an object such as Weather\(rain_mm_h=3\), got a dict"):
        Simulator(weather={"rain_mm_h": 3})
    with pytest.raises(ValueError, match=r"sensor must be a LidarSensor .* got 'hdl32e'"):
        LidarDataModule(scans="scans", sensor="hdl32e")

"""From points to latents and back by the VAE of a checkpoint; wrong points and latents."""

import numpy as np
import pytest
import torch
from tiny_labelled import labelled_checkpoint
from tiny_networks import GEOMETRY, tiny_checkpoint

from r3dpa import SceneVAE
from r3dpa.geometry import points_of, range_image


@pytest.fixture(scope="module")
def vae(tmp_path_factory):
    path = tiny_checkpoint(tmp_path_factory.mktemp("vae") / "tiny.safetensors")
    return SceneVAE.from_checkpoint(path, "cpu")


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform(-20, 20, (100, 4)).astype(np.float32)


def test_points_that_are_no_scan_in_metres(vae, points):
    nan = points.copy()
    nan[3, 1] = np.nan
    for wrong, message in (
        (nan, "has NaN or infinite values"),
        (points[:0], r"no point within 1\.\.56 m"),
        (points * 1000, r"no point within 1\.\.56 m; coordinates must be metres"),
        (points[:, :2], r"points \(P, 3\) or \(P, 4\), .* got shape \(100, 2\)"),
    ):
        with pytest.raises(ValueError, match=message):
            vae.encode(wrong)
    with pytest.warns(UserWarning, match="above or below the field of view"):
        vae.encode(points)


def test_latents_of_numpy_are_taken_and_of_another_shape_refused(vae, points):
    latents = vae.encode(points)
    expected = vae.decode(latents).range_m
    for given in (latents.numpy(), latents.double().numpy(), latents.double()):
        assert vae.decode(given).range_m.equal(expected)
    with pytest.raises(ValueError, match=r"latents must have shape \(B, 4, 4, 16\), got"):
        vae.decode(latents[:, :3])
    both = vae.decode(torch.cat([latents, torch.full_like(latents, np.nan)]))
    torch.testing.assert_close(both.range_m[0], expected[0], rtol=1e-3, atol=0)
    assert both.range_m[1].isnan().all()


def test_a_scan_becomes_the_posterior_mean_and_points_on_the_rays(vae):
    """From points to the posterior mean, and back to points on the rays of the pixels."""
    points = 10 * torch.nn.functional.normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1, 1, 0.1])
    )
    latents = vae.encode(torch.cat([points, torch.ones(500, 1)], dim=1).numpy())
    image = GEOMETRY.codec.encode(range_image(points, GEOMETRY.projection)[0])
    assert torch.equal(latents, vae.vae.encode(image[None, None]).mean)
    scene = vae.decode(latents)
    assert scene.range_m.shape == (1, 16, 64)
    assert len(scene.points(0)) == (scene.range_m > 0).sum()


def test_a_vae_says_what_it_is_and_moves(vae, tmp_path):
    assert repr(vae) == "SceneVAE(16 x 64 pixels, latents 4 x 4 x 16, cpu)"
    path = tiny_checkpoint(tmp_path / "tiny.safetensors")
    assert SceneVAE.from_checkpoint(path, "cpu").to("meta").device.type == "meta"


def test_a_scan_and_its_labels_become_latents_and_a_labelled_scene(tmp_path):
    vae = SceneVAE.from_checkpoint(labelled_checkpoint(tmp_path), device="cpu")
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
    dark = points * torch.tensor([1.0, 1, 1, 0])
    assert vae.encode(points[:, :3], labels).equal(vae.encode(dark, labels))
    with pytest.raises(ValueError, match=r"intensities up to 2.*; the model needs 0\.\.1"):
        vae.encode(points * torch.tensor([1.0, 1, 1, 255]), labels)


def test_a_single_bright_return_counts_as_full_scale(tmp_path):
    """As in training: sensors report more than their full scale here and there."""
    vae = SceneVAE.from_checkpoint(labelled_checkpoint(tmp_path), device="cpu")
    torch.nn.init.normal_(vae.vae.encoder.further_in.weight)
    points = points_of(torch.full((16, 64), 10.0), vae.geometry.projection)
    points = torch.cat([points, torch.full((1024, 1), 0.5)], dim=1)
    points[100, 3] = 1.0
    bright = points.clone()
    bright[100, 3] = 1.3
    assert vae.encode(bright).equal(vae.encode(points))
    bright[101, 3] = 1.3  # two of 1024 are more than 0.1 %
    with pytest.raises(ValueError, match=r"intensities up to 1\.3; the model needs 0\.\.1"):
        vae.encode(bright)


def test_an_encoder_of_range_and_return_needs_no_intensity(tmp_path):
    vae = SceneVAE.from_checkpoint(labelled_checkpoint(tmp_path, encode_further=False), "cpu")
    points = 10 * torch.randn(500, 4, generator=torch.Generator().manual_seed(0))
    points[:, 3] = 0.5
    latents = vae.encode(points, torch.full((500,), 26))
    assert torch.equal(latents, vae.encode(points[:, :3]))
    assert torch.equal(latents, vae.encode(points * torch.tensor([1.0, 1, 1, 255])))
    scenes = vae.decode(latents)
    assert torch.equal(scenes.labels > 0, scenes.range_m > 0)
    assert scenes.intensity[scenes.range_m > 0].unique().numel() > 20

"""Stem, return channel and range mixture of the VAE."""

from __future__ import annotations

import math

import pytest
import torch

from r3dpa.geometry import NUM_CLASSES, SEMANTIC_CLASSES, LidarSensor, RangeCodec
from r3dpa.nn import VAE
from r3dpa.nn.pixel_outputs import (
    RangeMixture,
    clean_image,
    without_flying_pixels,
    without_ripples,
)

STEM = {"in_channels": 2, "latent_channels": 4, "stem": (4, 8), "channels": 32}
STEM |= {"channel_multipliers": (1, 2), "strides": ((2, 2),), "num_res_blocks": 1, "modes": 2}


def test_a_stem_multiplies_the_stride_and_keeps_the_size():
    vae = VAE(**STEM)
    image = torch.randn(2, 2, 16, 64)
    latents = vae.encode(image).mean
    assert latents.shape == (2, 4, *vae.latent_size((16, 64))) == (2, 4, 2, 4)
    assert vae.predict(latents).shape == (2, 6, 16, 64)
    assert vae.decode(latents).shape == image.shape
    with pytest.raises(ValueError, match=r"multiple of \(8, 16\)"):
        vae.encode(image[..., :60])


@pytest.mark.numerics("interpolation at the seam")
def test_rotation_by_a_latent_column_rotates_the_result():
    torch.manual_seed(0)
    vae = VAE(**STEM).double().eval()
    image = torch.randn(1, 2, 16, 128, dtype=torch.float64)
    plain, rotated = (vae.decode(vae.encode(x).mean) for x in (image, image.roll(16, -1)))
    torch.testing.assert_close(rotated, plain.roll(16, -1))


def test_two_modes_need_a_return_channel():
    with pytest.raises(ValueError, match="in_channels 2"):
        VAE(modes=2)


def mixture(first, second, scale_1, scale_2, logit):
    raw = [math.log(math.expm1(math.log(scale) + 6)) - 6 for scale in (scale_1, scale_2)]
    return RangeMixture(torch.tensor([first, second, *raw, logit]).view(1, 5, 1, 1), math.exp(-6))


def test_likelihood_of_a_mixture_by_hand():
    found = mixture(-0.5, 0.5, 0.1, 0.2, 0.0).nll(torch.full((1, 1, 1, 1), -0.4))
    density = 0.5 * math.exp(-1) / 0.2 + 0.5 * math.exp(-4.5) / 0.4
    torch.testing.assert_close(found.item(), -math.log(density), rtol=1e-5, atol=0)


def test_the_mode_of_the_higher_density_is_decoded_never_a_mean():
    assert mixture(-0.5, 0.5, 0.1, 0.1, 0.1).mode().item() == -0.5
    assert mixture(-0.5, 0.5, 0.1, 0.1, -0.1).mode().item() == 0.5
    assert mixture(-0.5, 0.5, 0.3, 0.1, 0.1).mode().item() == 0.5  # narrower


def test_errors_below_the_least_scale_count_by_their_size():
    prediction = torch.tensor([0.0, 0.0, -9.0, -9.0, 0.0, 1.0]).view(1, 6, 1, 1)
    distribution = VAE(**STEM | {"least_scale": 0.1}).mixture_of(prediction)
    torch.testing.assert_close(
        distribution.log_scales.exp(), torch.full((1, 2, 1, 1), 0.1), rtol=1e-2, atol=0
    )
    errors = torch.tensor([0.0, 0.03, 0.06]).view(3, 1, 1, 1)
    rises = distribution.nll(errors).flatten().diff()
    torch.testing.assert_close(rises, torch.full((2,), 0.3), rtol=1e-2, atol=0)
    with pytest.raises(ValueError, match="least_scale must be above 0, got 0"):
        VAE(**STEM | {"least_scale": 0})


@pytest.mark.parametrize(
    ("row", "result"),
    [
        ([0.0, 0.0, 0.3, 0.8, 0.8, 0.8], [0.0, 0.0, 0.0, 0.8, 0.8, 0.8]),
        ([0.0, 0.0, 0.5, 0.8, 0.8, 0.8], [0.0, 0.0, 0.8, 0.8, 0.8, 0.8]),
        ([0.0, 0.2, 0.5, 0.8, 0.8, 0.0], [0.0, 0.0, 0.8, 0.8, 0.8, 0.0]),  # a wider ramp
        ([0.0, 0.0, 0.05, 0.15, 0.5, 0.8, 0.8], [0.0, 0.0, 0.0, 0.0, 0.8, 0.8, 0.8]),  # two passes
        ([0.5, 0.8, 0.8, 0.8, 0.0, 0.0], [0.8, 0.8, 0.8, 0.8, 0.0, 0.0]),  # columns wrap around
        ([0.8, 0.8, 0.2, 0.8, 0.8, 0.8], [0.8, 0.8, 0.2, 0.8, 0.8, 0.8]),  # a thin pole
        ([0.0, 0.0, 0.005, 0.8, 0.8, 0.8], [0.0, 0.0, 0.005, 0.8, 0.8, 0.8]),  # part of a surface
        ([0.0, 0.03, 0.06, 0.09, 0.8, 0.8], [0.03, 0.03, 0.06, 0.06, 0.8, 0.8]),  # ends of a wall
        ([0.0, 0.03, 0.06, 0.09, 0.12, 0.15], [0.0, 0.03, 0.06, 0.09, 0.12, 0.15]),  # a grazing one
    ],
)
def test_flying_pixels_move_to_the_nearer_surface(row, result):
    image = torch.tensor([row, [1.0] * len(row)]).view(1, 2, 1, -1)
    found = without_flying_pixels(image)
    assert found[0, 0, 0].tolist() == pytest.approx(result)
    assert torch.equal(found[:, 1], image[:, 1])
    image[0, 1, 0, ::2] = -1.0  # neighbours without a return
    found = without_flying_pixels(image)
    assert torch.equal(found[..., 1::2], image[..., 1::2])


def test_ripples_are_smoothed_and_edges_stay():
    generator = torch.Generator().manual_seed(0)
    surfaces = torch.zeros(1, 1, 3, 64)
    surfaces[..., 1, 20:23] = -0.4  # a pole
    surfaces[..., 2, 32:] = 0.4  # a corner
    ranges = surfaces + 0.005 * torch.randn(surfaces.shape, generator=generator)
    logit = torch.ones_like(ranges)
    found = without_ripples(torch.cat([ranges, logit], dim=1))
    assert torch.equal(found[:, 1:], logit)
    error = (found[:, :1] - surfaces)[0, 0]
    assert error.std() < 0.4 * 0.005
    assert error.abs().max() < 2 * 0.005  # not one pixel of the pole or the corner has moved
    slope = (0.001 * torch.arange(64.0)).expand(1, 1, 1, 64)  # both sides count alike
    found = without_ripples(torch.cat([slope, torch.ones_like(slope)], dim=1))
    torch.testing.assert_close(found[0, 0, 0, 12:-12], slope[0, 0, 0, 12:-12])
    # What has no return has no part in the mean.
    logit[..., 1:9] = -1.0
    ranges[..., 1:9] = 0.02
    missing = torch.cat([ranges, logit], dim=1)
    found = without_ripples(missing)
    assert torch.equal(found[..., 1:9], missing[..., 1:9])
    assert found[0, 0, 0, 0].abs() < 0.005


def test_walls_are_smoothed_twice_and_other_classes_once():
    ranges = 0.005 * torch.randn(1, 1, 2, 64, generator=torch.Generator().manual_seed(0))
    image = torch.cat([ranges, torch.ones_like(ranges)], dim=1)
    classes = torch.zeros(1, NUM_CLASSES, 2, 64)
    names = [known.name for known in SEMANTIC_CLASSES]
    classes[:, names.index("building"), :, :32] = 50.0
    classes[:, names.index("vegetation"), :, 32:] = 50.0
    once = without_ripples(without_flying_pixels(image))
    classes.requires_grad_()
    found = clean_image(image, classes)
    assert not found.requires_grad
    torch.testing.assert_close(found[..., :32], without_ripples(once)[..., :32])
    torch.testing.assert_close(found[..., 32:], once[..., 32:])
    assert torch.equal(clean_image(image, classes[:, :3]), once)  # of other classes


def test_decoding_leaves_few_flying_pixels_and_ripples_to_two_modes():
    prediction = torch.randn(2, 6, 16, 64, generator=torch.Generator().manual_seed(0))
    chosen = VAE(**STEM).mixture_of(prediction).mode()
    chosen = torch.cat([chosen, prediction[:, -1:]], dim=1)
    image = VAE(**STEM).image_of(prediction)
    assert not torch.equal(image, chosen)
    torch.testing.assert_close(image, without_ripples(without_flying_pixels(chosen)))
    one = prediction[:, :2]
    assert torch.equal(VAE(**STEM | {"modes": 1}).image_of(one), one)


@pytest.mark.parametrize("modes", [1, 2])
def test_a_discriminator_sees_images_with_the_values_of_scans(modes):
    torch.manual_seed(0)
    vae = VAE(**STEM | {"modes": modes})
    latents = vae.encode(torch.randn(2, 2, 16, 64)).mean
    prediction = (3 * vae.predict(latents)).detach().requires_grad_()
    image, scan = vae.image_of(prediction), vae.scan_of(prediction)
    seen = image[:, 1] > 0
    assert 0 < seen.sum() < seen.numel()
    torch.testing.assert_close(scan[:, 1], torch.where(seen, 1.0, -1.0))
    torch.testing.assert_close(scan[:, 0], torch.where(seen, image[:, 0], -1.0))
    scan[:, 1].sum().backward()
    assert (prediction.grad[:, -1] > 0).all()


def test_likelihood_is_finite_for_any_output():
    outputs = torch.tensor([0.0, 0.0, -1e4, 1e4, 1e4]).view(1, 5, 1, 1).requires_grad_()
    loss = RangeMixture(outputs, 0.01).nll(torch.zeros(1, 1, 1, 1)).sum()
    loss.backward()
    assert loss.isfinite()
    assert outputs.grad.isfinite().all()


def test_a_return_channel_survives_the_round_trip():
    sensor, codec = LidarSensor(beams=2, columns=4), RangeCodec("log2", return_channel=True)
    range_m = torch.tensor([[2.0, -1.0, 30.0, 5.5], [-1.0, 1.5, 55.0, -1.0]])
    image = codec.to_image(range_m)
    assert image.shape == (codec.channels, 2, 4)
    assert torch.equal(codec.returns_of(image)[0], range_m > 0)
    torch.testing.assert_close(codec.ranges_of(image, sensor), range_m)
    image[1] = -0.01  # the second channel decides, whatever the first holds
    assert (codec.ranges_of(image, sensor) == -1).all()


LABELLED = STEM | {"intensity": True, "num_classes": 3}


def labelled_image():
    torch.manual_seed(1)
    image = torch.randn(2, 4, 16, 64)
    image[:, 3] = torch.randint(-1, 3, (2, 16, 64))
    return image


@pytest.mark.parametrize("modes", [1, 2])
def test_intensity_and_likeliest_class_follow_range_and_return(modes):
    torch.manual_seed(0)
    vae, image = VAE(**LABELLED | {"modes": modes}), labelled_image()
    prediction = vae.predict(vae.encode(image).mean)
    assert prediction.shape[1] == {1: 1, 2: 5}[modes] + 1 + 1 + 3
    outputs, found = vae.outputs_of(prediction), vae.image_of(prediction)
    assert found.shape == image.shape == (2, vae.image_channels, 16, 64)
    assert torch.equal(found[:, 1:2], outputs.returns)
    assert torch.equal(found[:, 2:3], outputs.intensity)
    assert torch.equal(found[:, 3], prediction[:, -3:].argmax(dim=1).float())
    assert set(found[:, 3].unique().tolist()) == {0, 1, 2}
    without = VAE(**STEM | {"modes": modes})
    assert torch.equal(found[:, :2], without.image_of(prediction[:, :-4]))
    assert torch.equal(vae.scan_of(prediction), without.scan_of(prediction[:, :-4]))


def test_the_encoder_starts_as_one_without_intensity_and_class_and_can_learn_them():
    vae, without, image = VAE(**LABELLED), VAE(**STEM), labelled_image()
    unknown = vae.load_state_dict(without.state_dict(), strict=False)
    assert {name.rpartition(".")[0] for name in unknown.missing_keys} == {
        "encoder.further_in",
        "decoder.further_out",
    }
    latents = vae.encode(image).mean
    assert torch.equal(latents, without.encode(image[:, :2]).mean)
    latents.sum().backward()
    inputs = vae.encoder.further_in.weight.grad.view(32, 4, 32)  # intensity, three classes
    assert (inputs.abs().amax(dim=(0, 2)) > 0).all()


def test_a_class_is_seen_as_a_name_not_as_a_number():
    vae, image = VAE(**LABELLED), labelled_image()
    image[:, 2] = 0.0
    with torch.no_grad():  # only the channel of class 1
        vae.encoder.further_in.weight.view(32, 4, 32)[:, 2].fill_(0.1)
    latents = []
    for number in (-1, 0, 1, 2):
        image[:, 3] = number
        latents.append(vae.encode(image).mean)
    assert torch.equal(latents[0], latents[1])
    assert torch.equal(latents[0], latents[3])
    assert not torch.equal(latents[0], latents[2])


def test_in_half_precision_outputs_stay_wide():
    vae = VAE(**LABELLED).eval().decoder_to_bfloat16_()
    prediction = vae.predict(torch.zeros(1, 4, 2, 4))
    assert prediction.dtype == torch.float32
    assert vae.decoder.further_out.weight.dtype == torch.float32
    assert vae.decoder.mid.block_1.conv1.weight.dtype == torch.bfloat16


def test_classes_need_range_and_return():
    with pytest.raises(ValueError, match="intensity and num_classes need in_channels 2"):
        VAE(in_channels=1, num_classes=3)

from __future__ import annotations

import copy

import pytest
import torch
from draws import drawn
from torch import nn
from torch.distributions import Normal, kl_divergence

from r3dpa.nn import PatchDiscriminator
from r3dpa.nn.vae import VAE, Posterior

SMALL = {"latent_channels": 4, "channels": 32, "channel_multipliers": (1, 1, 2, 2)}


@pytest.fixture
def vae():
    torch.manual_seed(0)
    return VAE(**SMALL, num_res_blocks=1, attention_levels=(2,))


def test_every_parameter_learns(vae):
    image = torch.randn(2, 1, 8, 64)
    posterior = vae.encode(image)
    assert posterior.std.shape == (2, vae.latent_channels, *vae.latent_size((8, 64)))
    reconstruction = vae.decode(posterior.sample(torch.randn_like(posterior.mean)))
    ((reconstruction - image).abs().mean() + 1e-3 * posterior.kl().mean()).backward()
    without = [name for name, weight in vae.named_parameters() if not weight.grad.abs().sum() > 0]
    # A constant added to all keys of an attention cancels in its softmax: rounding decides.
    assert not [name for name in without if not name.endswith(".k.bias")]


def test_impossible_layouts_and_images_are_refused(vae):
    for call, message in (
        (lambda: VAE(strides=((1, 2),)), "4 channel_multipliers need 3 strides"),
        (lambda: VAE(strides=((1, 2), (2, 2), (3, 3))), r"stride .* got \(3, 3\)"),
        (lambda: VAE(attention_levels=(4,)), r"among 0\.\.3, got \(4,\)"),
        (lambda: VAE(channels=48), "multiple of 32"),
        (lambda: vae.encode(torch.randn(2, 1, 8, 60)), r"multiple of \(4, 8\), got \(8, 60\)"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_posterior_agrees_with_torch_distributions():
    moments, latents = torch.randn(2, 6, 2, 4, requires_grad=True), torch.randn(2, 3, 2, 4)
    posterior = Posterior(moments)
    normal = Normal(moments[:, :3], (0.5 * moments[:, 3:]).exp())
    expected = kl_divergence(normal, Normal(0.0, 1.0)).sum(dim=(1, 2, 3))
    torch.testing.assert_close(posterior.kl(), expected)
    gradients = [torch.autograd.grad(kl.sum(), moments)[0] for kl in (posterior.kl(), expected)]
    torch.testing.assert_close(*gradients)
    torch.testing.assert_close(posterior.sample(latents), normal.mean + normal.stddev * latents)


@pytest.mark.numerics
def test_kl_of_half_precision_moments_is_finite():
    moments = torch.full((1, 4, 2, 2), 18.0, dtype=torch.float16)
    divergence = Posterior(moments).kl()
    assert divergence.dtype == torch.float32
    assert divergence.isfinite()
    assert moments.exp().isinf().all()


@pytest.mark.numerics
def test_empty_scan_and_far_latents_are_finite_in_bf16(vae):
    image = torch.full((1, 1, 8, 64), -1.0)
    torch.nn.init.zeros_(vae.encoder.conv_in.weight)  # the bias alone: constant channels
    hidden = vae.encoder.conv_in(image).flatten(2)
    assert ((hidden - hidden.mean(2, keepdim=True)) / hidden.std(2, keepdim=True)).isnan().any()
    with torch.autocast("cpu", torch.bfloat16):
        posterior = vae.encode(image)
        decoded = vae.decode(10 * torch.randn(1, 4, 2, 8))
    assert posterior.mean.dtype == posterior.kl().dtype == torch.float32
    (posterior.kl().sum() + decoded.float().square().mean()).backward()
    assert decoded.isfinite().all()
    assert all(weight.grad.isfinite().all() for weight in vae.parameters())


def test_half_decoder_leaves_float32_ends(vae):
    """The image is not rounded to bfloat16, in which neighbours of 0.9 are 0.004 apart."""
    latents = torch.randn(2, vae.latent_channels, 4, 8, generator=torch.Generator().manual_seed(0))
    half = copy.deepcopy(vae).decoder_to_bfloat16_()
    narrow = {name for name, p in half.named_parameters() if p.dtype == torch.bfloat16}
    assert all(name.startswith("decoder.") for name in narrow)
    assert not any("norm" in name or "conv_out" in name for name in narrow)
    with torch.no_grad():
        expected, found = vae.decode(latents), half.decode(latents)
        with torch.autocast("cpu", torch.bfloat16):
            mixed = vae.decode(latents)
    assert found.dtype == mixed.dtype == torch.float32
    assert not torch.equal(found, found.bfloat16().float())
    for image in (found, mixed):
        assert 0 < (image - expected).abs().max() < 0.05 * expected.abs().max()


def test_logits_of_the_discriminator_are_those_of_patches():
    """Of 34 x 34 pixels at the default depth."""
    for num_layers in (1, 2, 3):
        logits = PatchDiscriminator(1, 4, num_layers)(torch.randn(2, 1, 32, 64))
        assert logits.shape == (2, 1, 32 // 2**num_layers - 2, 64 // 2**num_layers - 2)
    with pytest.raises(ValueError, match="at least 1, got 0"):
        PatchDiscriminator(num_layers=0)
    image = torch.randn(1, 1, 64, 96, requires_grad=True)
    PatchDiscriminator(channels=4).eval()(image)[0, 0, 7, 11].backward()
    for places in image.grad[0, 0].nonzero(as_tuple=True):
        assert places.max() - places.min() + 1 == 34


def test_fresh_weights_follow_pix2pix():
    torch.manual_seed(0)
    network = PatchDiscriminator()
    for module in network.modules():
        if isinstance(module, torch.nn.Conv2d):
            # Five standard errors of a standard deviation from n draws, 0.02 / sqrt(2 n).
            tolerance = 5 * 0.02 / (2 * module.weight.numel()) ** 0.5
            assert abs(module.weight.std().item() - 0.02) < tolerance
        elif isinstance(module, torch.nn.BatchNorm2d):
            assert abs(module.weight.mean().item() - 1.0) < 0.02


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize(("start", "weight"), [(25.0, 1e-6), (-35.0, 1.0)])
@pytest.mark.numerics("log variance beyond its clamp")
def test_the_divergence_pulls_an_escaped_log_variance_back(start, weight, dtype):
    """In steps of at most 0.5, as clipping to 1 with rate 0.5 makes them."""

    def after_50_steps(divergence):
        moments = torch.zeros(1, 2, 1, 1, dtype=dtype)
        moments[0, 1] = start
        moments.requires_grad_()
        optimiser = torch.optim.SGD([moments], lr=0.5)
        for _ in range(50):
            optimiser.zero_grad()
            (weight * divergence(moments)).sum().backward()
            nn.utils.clip_grad_norm_(moments, 1.0)
            optimiser.step()
        return moments[0, 1].item()

    def with_plain_clamp(moments):
        mean, logvar = moments.float().chunk(2, dim=1)
        logvar = logvar.clamp(-30.0, 20.0)
        return 0.5 * (mean.square() + logvar.exp() - 1 - logvar).sum()

    assert -30 < after_50_steps(lambda moments: Posterior(moments).kl()) < 20
    assert after_50_steps(with_plain_clamp) == start


@pytest.mark.parametrize("how", ["float32", "weights", "autocast"])
@pytest.mark.numerics("decoding in half precision")
def test_far_latents_decode_to_finite_images(how, vae):
    """Latents of 10 deviations through layers that, as trained ones do, enlarge them."""
    with torch.no_grad():
        vae.decoder.conv_in.weight *= 2e4
    latents = 10 * drawn(0, 2, 4, 4, 8)
    with torch.no_grad():
        expected = vae.decode(latents)
        ours = copy.deepcopy(vae)
        if how == "weights":
            ours.decoder_to_bfloat16_()
        with torch.autocast("cpu", torch.bfloat16, enabled=how == "autocast"):
            decoded = ours.decode(latents)
        with torch.autocast("cpu", torch.float16):
            broken = vae.decode(latents)
    assert decoded.dtype == torch.float32
    assert decoded.isfinite().all()
    error = (decoded - expected).norm() / expected.norm()
    assert error < (1e-6 if how == "float32" else 0.05)
    assert (~broken.isfinite()).float().mean() > 0.5


def test_images_without_the_channels_that_an_encoder_sees_are_refused():
    vae = VAE(in_channels=2, channels=32, channel_multipliers=(1,), strides=(), intensity=True)
    with pytest.raises(ValueError, match="needs images of 3 channels, got 2"):
        vae.encode(torch.zeros(1, 2, 8, 16))

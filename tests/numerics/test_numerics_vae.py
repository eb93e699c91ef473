"""Hard cases of the VAE and of its adversarial loss."""

from __future__ import annotations

import copy
from itertools import product

import pytest
import torch
from tiny import TinyData, batch_of, drawn, module, trainer, vae, vae_losses
from torch import nn

from r3dpa.modules import LossWeights, OptimizerConfig
from r3dpa.nn import Posterior
from r3dpa.nn.layers import GroupNorm, SyncedBatchNorm2d

pytestmark = pytest.mark.filterwarnings("ignore:Attribute '.*' is an instance of `nn.Module`")
HALF = (torch.bfloat16, torch.float16)


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


class Broken(nn.Module):
    """A network whose numbers are NaN, or which must not be called at all."""

    def __init__(self, may_be_called):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(()))
        self.may_be_called = may_be_called

    def forward(self, image):
        assert self.may_be_called, "a network whose losses have weight 0 was called"
        return torch.nan * self.weight * image


@pytest.mark.numerics("loss of weight zero")
def test_networks_of_losses_with_weight_zero_are_not_called():
    made = module(weights=LossWeights(adversarial=0.0, discriminator=0.0))
    made.discriminator = Broken(may_be_called=False)
    image = batch_of(0)["range_image"]
    reconstruction, parts = vae_losses(made, image)
    parts |= made.discriminator_losses(image, reconstruction)
    assert sum(parts.values()).isfinite()
    total = sum(parts.values()) + 0.0 * Broken(may_be_called=True)(reconstruction).mean()
    assert total.isnan()


@pytest.mark.numerics("discriminator loss that is scaled down")
def test_the_weight_of_the_discriminator_is_a_factor_of_its_loss_alone():
    """The other losses keep their size, so the factor is no balance between networks."""
    image = batch_of(0)["range_image"]

    def gradients(weight):
        made = module(weights=LossWeights(discriminator=weight))
        reconstruction, parts = vae_losses(made, image)
        parts |= made.discriminator_losses(image, reconstruction)
        sum(parts.values()).backward()
        networks = made.vae, made.discriminator
        return [torch.cat([p.grad.flatten() for p in n.parameters()]) for n in networks]

    (vae_whole, whole), (vae_official, official) = gradients(1.0), gradients(1e-3)
    torch.testing.assert_close(vae_official, vae_whole, rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(official, 1e-3 * whole, rtol=1e-4, atol=1e-9)
    small = 100 * OptimizerConfig().eps  # below it Adam's steps are shorter by 1 % and more
    shares = [(g.abs() < small).float().mean().item() for g in (official, whole)]
    assert shares[0] > 5 * shares[1]


@pytest.mark.numerics("batch norm on real and fake batches")
def test_the_discriminator_is_asked_in_training_mode_only():
    """Running statistics are a mixture of scans and reconstructions, and describe neither."""
    made = module()
    network = made.discriminator.train()
    real, fake = 0.5 + 0.1 * drawn(0, 4, 1, 8, 16), -0.5 + 0.4 * drawn(1, 4, 1, 8, 16)
    for _ in range(50):
        trained = network(real), network(fake)
    evaluated = network.eval()(real), network(fake)
    pairs = zip(trained, evaluated, strict=True)
    assert max((a - b).abs().mean() / a.std() for a, b in pairs) > 0.5

    made.discriminator = Broken(may_be_called=False)
    data = TinyData([batch_of(0)])
    data.test_dataloader = data.val_dataloader
    for run in ("validate", "test"):
        found = getattr(trainer(1, limit_val_batches=None), run)(made, data, verbose=False)
        assert found


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("value", [torch.inf, torch.nan])
@pytest.mark.numerics("batch norm on real and fake batches")
def test_a_broken_reconstruction_leaves_the_running_statistics_alone(value, dtype):
    ours, plain = SyncedBatchNorm2d(3), nn.BatchNorm2d(3)
    good, broken = drawn(0, 2, 3, 4, 6).to(dtype), drawn(1, 2, 3, 4, 6).to(dtype)
    broken[0, 1, 2, 3] = value
    for layer in (ours, plain):
        layer(good)
    before = copy.deepcopy(ours.state_dict())
    assert not ours(broken).isfinite().all()  # the loss tells, and the step is dropped
    torch.testing.assert_close(ours.state_dict(), before, atol=0, rtol=0)
    plain(broken)
    plain(good)
    assert not plain.running_var.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, *HALF])
@pytest.mark.numerics("group norm of a constant image")
def test_group_norm_of_any_constant_is_finite_both_ways(dtype):
    """A scan of no or of few returns is constant in every layer, but for as many pixels."""
    broken = 0
    for constant, returns in product((-1.0, 0.7, 3.3, 31.1, 300.7, 6e4), (0, 1, 15, 100)):
        image = torch.full((1, 32, 6, 20), constant, dtype=dtype)
        image.flatten(2)[..., :returns] *= 1.01
        values = image[0, 0].clone()
        image.requires_grad_()
        result = GroupNorm(32).to(dtype)(image)
        result.square().sum().backward()
        assert result.dtype == dtype
        assert result.isfinite().all()
        assert image.grad.isfinite().all()
        variance = values.square().mean() - values.mean().square()
        broken += not torch.rsqrt(variance + 1e-6).isfinite()
    assert broken


@pytest.mark.parametrize("how", ["float32", "weights", "autocast"])
@pytest.mark.numerics("decoding in half precision")
def test_far_latents_decode_to_finite_images(how):
    """Latents of 10 deviations through layers that, as trained ones do, enlarge them."""
    torch.manual_seed(0)
    network = vae()
    with torch.no_grad():
        network.decoder.conv_in.weight *= 2e4
    latents = 10 * drawn(0, 2, 4, 4, 8)
    with torch.no_grad():
        expected = network.decode(latents)
        ours = copy.deepcopy(network)
        if how == "weights":
            ours.decoder_to_bfloat16_()
        with torch.autocast("cpu", torch.bfloat16, enabled=how == "autocast"):
            decoded = ours.decode(latents)
        with torch.autocast("cpu", torch.float16):
            broken = network.decode(latents)
    assert decoded.dtype == torch.float32
    assert decoded.isfinite().all()
    error = (decoded - expected).norm() / expected.norm()
    assert error < (1e-6 if how == "float32" else 0.05)
    assert (~broken.isfinite()).float().mean() > 0.5

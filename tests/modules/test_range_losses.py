"""Stages on images of range and return; end of the alignment; learning rate by step."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tiny_stages import QUIET, SENSOR, STAGES, TinyData, stage_module, tiny_sit, train

from r3dpa.geometry import RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.losses import centred_features, masked_mean, return_loss
from r3dpa.modules import LossWeights, OptimizerConfig
from r3dpa.nn import VAE, PatchDiscriminator

pytestmark = QUIET


class RangeData(TinyData):
    """Images of two channels; the scan of index 1 has no return at all."""

    codec = RangeCodec("log2", return_channel=True)
    geometry = ScanGeometry(SphericalProjection(SENSOR), codec, (2, 4))

    def __init__(self, steps):
        super().__init__([False] * steps)
        for batch in self.batches:
            range_m = 50 * torch.rand(2, 8, 16, generator=torch.Generator().manual_seed(1)) - 5
            range_m[1] = -1
            batch["range_image"] = self.codec.to_image(range_m)


def range_module(modes, discriminator=None, train_encoder=True, **kwargs):
    torch.manual_seed(0)
    vae = VAE(2, 4, 32, (1,), (), 1, stem=(2, 2), modes=modes)
    weights = LossWeights(vae_alignment=0.0, **kwargs)
    settings = {"weights": weights, "optimizer": OptimizerConfig(lr=3e-3)}
    settings |= {"discriminator": discriminator, "train_encoder": train_encoder}
    return STAGES["vae_alignment"](vae=vae, sit=tiny_sit(), **settings)


@pytest.mark.parametrize("modes", [1, 2])
def test_ranges_and_returns_are_learned_without_discriminator(modes):
    module = train(range_module(modes), RangeData(30))
    assert set(module.parts[0]) == {"reconstruction", "returns", "kl"}
    for name in ("reconstruction", "returns"):
        assert module.parts[-1][name] < module.parts[0][name] - 0.01, name


def test_a_decoder_is_trained_on_for_the_latents_of_a_fixed_encoder():
    module = range_module(2, train_encoder=False)
    before = {name: value.clone() for name, value in module.vae.state_dict().items()}
    train(module, RangeData(2))
    changed = {
        n for n, value in module.vae.state_dict().items() if not torch.equal(value, before[n])
    }
    assert changed == {n for n in before if n.startswith(("decoder.", "post_quant_conv."))}


@pytest.mark.parametrize("modes", [1, 2])
def test_a_discriminator_never_sees_the_logit_of_a_return(modes):
    discriminator, seen = PatchDiscriminator(2, channels=4, num_layers=1), []
    discriminator.register_forward_pre_hook(lambda _, images: seen.append(images[0].detach()))
    module = range_module(modes, discriminator, adversarial=1.0)
    module.separates_losses = True
    train(module, RangeData(1))
    assert len(seen) == 3  # for the decoder, and for the discriminator a scan and a reconstruction
    for images in seen:
        torch.testing.assert_close(images[:, 1].abs(), torch.ones(2, 8, 16))
    outputs = module.reached[0]["adversarial"]["vae.decoder.conv_out.bias"]
    outputs = outputs.view(-1, 4)  # of each output, those of 2 x 2 pixels
    assert outputs[0].count_nonzero()  # ranges
    assert outputs[-1].count_nonzero()  # returns


def test_a_range_without_return_gets_no_gradient():
    module = range_module(1)
    image = RangeData(1).batches[0]["range_image"]
    prediction = torch.zeros_like(image, requires_grad=True)
    module._range_losses(image, prediction)["reconstruction"].sum().backward()
    returns = image[:, 1] > 0
    assert torch.equal(prediction.grad[:, 0] != 0, returns)


def test_means_and_cross_entropy_by_hand():
    values, mask = (
        torch.tensor([[1.0, 5.0], [2.0, 3.0]]),
        torch.tensor([[True, False], [False] * 2]),
    )
    assert masked_mean(values, mask).tolist() == [1.0, 0.0]
    certain = torch.tensor([[50.0, -50.0]])
    assert return_loss(certain, torch.tensor([[True, False]])).item() == pytest.approx(0.0)
    assert return_loss(certain, torch.tensor([[False, False]])).item() == pytest.approx(25.0)


def test_centred_features_have_no_mean_and_keep_empty_cells():
    grid = torch.tensor([[[1.0, 2.0], [3.0, 6.0], [0.0, 0.0]]])
    assert centred_features(grid).tolist() == [[[-1.0, -2.0], [1.0, 2.0], [0.0, 0.0]]]


def test_alignment_of_the_sit_stops():
    weights = LossWeights(alignment_stop=2)
    module = train(stage_module("joint", weights=weights), TinyData([False] * 3))
    aligned = [parts["sit_alignment"].item() for parts in module.parts]
    assert aligned[0] != 0
    assert aligned[1] != 0
    assert aligned[2] == 0
    assert "vae_alignment" in module.parts[2]


def test_rate_rises_stays_and_falls_by_step_alone():
    config = OptimizerConfig(lr=1.0, warmup_steps=3, decay_steps=4)
    rates = [config.rate(step, 10) for step in range(11)]
    assert rates == [0.25, 0.5, 0.75, 1.0, 1.0, 1.0, 1.0, 0.75, 0.5, 0.25, 0.0]
    assert OptimizerConfig(lr=2.0).rate(5, 10) == 2.0
    cosine = OptimizerConfig(lr=2.0, warmup_steps=2, cosine=True)
    assert [cosine.rate(step, 10) for step in (2, 6, 10)] == pytest.approx([2.0, 1.0, 0.0])
    config = replace(config, discriminator_rate=0.5, thin_decoder_rate=2.0)
    joint = stage_module("joint", optimizer=config, weights=LossWeights(adversarial_ratio=0.5))
    expected = {"vae": 0.25, "discriminator": 0.125, "sit": 0.25}
    few_step = stage_module("few_step", optimizer=config)
    for module, wanted in ((joint, expected), (few_step, {"sit": 0.25, "thin_decoder": 0.5})):
        train(module, TinyData([False] * 5))
        rates = {group["name"]: group["lr"] for group in module.optimizers().param_groups}
        assert rates == wanted

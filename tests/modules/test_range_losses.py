"""Losses of images of range, return, intensity and class; noise on latents; learning rate."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_stages import QUIET, SENSOR, STAGES, TinyData, stage_module, tiny_sit, train

from r3dpa.checkpoints import (
    Checkpoint,
    NetworkState,
    load_into,
    read_checkpoint,
    save_checkpoint,
    with_further_channels,
    without_further_channels,
)
from r3dpa.geometry import (
    NUM_CLASSES,
    UNKNOWN_CLASS,
    RangeCodec,
    ScanGeometry,
    SphericalProjection,
)
from r3dpa.losses import centred_features, class_errors, masked_mean, return_loss
from r3dpa.modules import LossWeights, OptimizerConfig, VAEAlignment
from r3dpa.modules.base import check_image
from r3dpa.modules.stage import PathDraws
from r3dpa.nn import VAE, PatchDiscriminator, SiT

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
            batch["range_image"] = RangeData.codec.to_image(range_m)


class LabelledData(RangeData):
    """The same with intensity and class; a third of the returns has no label."""

    codec = replace(RangeData.codec, intensity_channel=True, num_classes=NUM_CLASSES)
    geometry = ScanGeometry(SphericalProjection(SENSOR), codec, (2, 4))

    def __init__(self, steps):
        super().__init__(steps)
        generator = torch.Generator().manual_seed(2)
        intensity = torch.rand(2, 8, 16, generator=generator)
        classes = torch.randint(3, (2, 8, 16), generator=generator) - 1
        for batch in self.batches:
            range_m = self.codec.ranges_of(batch["range_image"], SENSOR)
            batch["range_image"] = self.codec.to_image(range_m, intensity, classes)


def range_module(modes, discriminator=None, labelled=False, refinement=0, **kwargs):
    torch.manual_seed(0)
    further = {"intensity": True, "num_classes": NUM_CLASSES} if labelled else {}
    further |= {"refinement": refinement}
    vae = VAE(2, 4, 32, (1,), (), 1, stem=(2, 2), modes=modes, **further)
    names = {"latent_noise", "further_dropout", "init_networks", "train_encoder"}
    given = names & kwargs.keys()
    settings = {name: kwargs.pop(name) for name in given}
    weights = LossWeights(vae_alignment=0.0, **kwargs)
    settings |= {"weights": weights, "optimizer": OptimizerConfig(lr=3e-3)}
    settings |= {"discriminator": discriminator}
    return STAGES["vae_alignment"](vae=vae, sit=tiny_sit(), **settings)


@pytest.mark.parametrize("modes", [1, 2])
def test_ranges_and_returns_are_learned_without_discriminator(modes):
    module = train(range_module(modes), RangeData(12))
    assert set(module.parts[0]) == {"reconstruction", "returns", "kl"}
    for name in ("reconstruction", "returns"):
        assert module.parts[-1][name] < module.parts[0][name] - 0.01, name


@pytest.mark.parametrize(("modes", "refinement"), [(1, 0), (2, 4)])
def test_intensity_and_class_are_learned_beside_them(modes, refinement):
    """And a refinement with the decoder."""
    module = train(range_module(modes, labelled=True, refinement=refinement), LabelledData(20))
    names = {"reconstruction", "returns", "intensity", "classes"}
    assert set(module.parts[0]) == names | {"kl"}
    for name in names:
        assert module.parts[-1][name] < module.parts[0][name] - 0.01, name
    if refinement:
        assert module.vae.decoder.further_refinement.conv_out.weight.count_nonzero()


def test_intensity_and_class_count_where_there_is_a_return_and_a_label():
    module, image = range_module(1, labelled=True), LabelledData(1).batches[0]["range_image"]
    prediction = torch.zeros(2, 3 + NUM_CLASSES, 8, 16, requires_grad=True)
    parts = module._range_losses(image, prediction)
    returns, labelled = image[:, 1] > 0, image[:, 3] >= 0
    assert 0 < labelled.sum() < returns.sum()
    assert parts["classes"].tolist() == pytest.approx([math.log(NUM_CLASSES), 0.0])
    error = image[:, 2].abs()[returns].mean()
    torch.testing.assert_close(parts["intensity"], torch.stack([error, torch.tensor(0.0)]))
    (parts["intensity"] + parts["classes"]).sum().backward()
    assert torch.equal(prediction.grad[:, 2] != 0, returns)
    assert torch.equal(prediction.grad[:, 3] != 0, labelled)
    assert not prediction.grad[:, :2].any()


def test_a_discriminator_sees_neither_intensity_nor_class():
    discriminator = PatchDiscriminator(2, channels=4, num_layers=1)
    module = range_module(2, discriminator, labelled=True, adversarial=1.0)
    assert "discriminator" in train(module, LabelledData(1)).parts[0]


def test_noise_replaces_a_share_of_the_latents_by_their_own_spread():
    module = range_module(2, latent_noise=0.5)
    latents, noise = torch.randn(2, 4, 4, 8), torch.randn(2, 4, 4, 8)
    draws = PathDraws(noise, torch.zeros(2), noise, torch.tensor([0.0, 0.4]))
    module.latent_norm.running_mean.fill_(2.0)
    module.latent_norm.running_var.fill_(9.0)
    found = module.decoder_latents(latents, draws)
    assert torch.equal(found[0], latents[0])
    expected = 0.8 * latents[1] + 0.2 * (2.0 + 3.0 * noise[1])
    torch.testing.assert_close(found[1], expected, rtol=1e-4, atol=1e-4)
    module.latent_noise = 0.0
    assert module.decoder_latents(latents, draws) is latents
    with pytest.raises(ValueError, match=r"latent_noise must lie in \[0, 1\], got 1.5"):
        range_module(2, latent_noise=1.5)


def test_the_encoder_sees_some_samples_without_intensity_and_some_without_classes():
    module = range_module(2, labelled=True, further_dropout=0.5)
    image = LabelledData(1).batches[0]["range_image"]
    before = image.clone()
    noise = torch.zeros(2, 4, 4, 8)
    shares = torch.tensor([[0.4, 0.5], [0.5, 0.4]])
    draws = PathDraws(noise, torch.zeros(2), noise, torch.zeros(2), shares)
    no_intensity, no_classes = module.encoder_images(image, draws)
    assert torch.equal(no_intensity[[0, 1, 3]], before[0, [0, 1, 3]])
    assert torch.equal(no_classes[:3], before[1, :3])
    assert torch.equal(no_intensity[2], torch.full((8, 16), -1.0))
    assert torch.equal(no_classes[3], torch.full((8, 16), float(UNKNOWN_CLASS)))
    assert torch.equal(image, before)
    module.further_dropout = 0.0
    assert module.encoder_images(image, draws) is image
    with pytest.raises(ValueError, match=r"further_dropout must lie in \[0, 1\], got -1"):
        range_module(2, further_dropout=-1)


@pytest.mark.parametrize("stage", ["vae_alignment", "joint"])
def test_stages_that_train_the_encoder_hide_intensity_and_classes_from_it(stage):
    vae = VAE(2, 4, 32, (1,), (), 1, stem=(2, 2), intensity=True, num_classes=NUM_CLASSES)
    weights = LossWeights(vae_alignment=0.0, sit_alignment=0.0)
    module = STAGES[stage](vae=vae, sit=tiny_sit(), weights=weights, further_dropout=1.0)
    seen, encode = [], vae.encode
    vae.encode = lambda image: seen.append(image) or encode(image)
    train(module, LabelledData(1))
    assert (seen[0][:, 2:] == -1).all()
    assert (seen[0][:, :2] != -1).any()


def test_the_decoder_learns_what_the_encoder_did_not_see():
    module = train(range_module(2, labelled=True, further_dropout=1.0), LabelledData(20))
    for name in ("intensity", "classes"):
        assert 0.01 < module.parts[-1][name] < module.parts[0][name] - 0.01, name


def test_only_the_decoder_sees_noisy_latents():
    modules = [train(range_module(2, latent_noise=noise), RangeData(1)) for noise in (0.0, 0.9)]
    clean, noisy = (module.parts[0] for module in modules)
    assert clean["kl"] == noisy["kl"]
    assert clean["reconstruction"] != noisy["reconstruction"]
    means = [module.latent_norm.running_mean for module in modules]
    assert torch.equal(*means)


LABELS = {"intensity": True, "num_classes": NUM_CLASSES}
DECODED = LABELS | {"encode_further": False}


def vae_checkpoint(vae, arguments, codec):
    geometry = ScanGeometry(SphericalProjection(SENSOR), codec, (2, 4)).to_dict()
    networks = {"vae": NetworkState.of(vae, arguments)}
    return Checkpoint(Path("before"), "vae_alignment", networks, geometry=geometry)


@pytest.mark.parametrize(
    ("there", "here"),
    [({}, LABELS), (DECODED, LABELS), (DECODED, {})],
    ids=["ranges to labels", "labels to the encoder too", "labels to ranges"],
)
def test_a_vae_with_other_channels_keeps_latents_ranges_and_returns(there, here):
    arguments = {"in_channels": 2, "channels": 32, "channel_multipliers": (1,), "strides": ()}
    before, after = (VAE(**arguments, **further) for further in (there, here))
    codecs = [LabelledData.codec if further else RangeData.codec for further in (there, here)]
    given = vae_checkpoint(before, arguments | there, codecs[0])
    change = with_further_channels if here else without_further_channels
    found = change(given, after)
    load_into({"vae": after}, found, stage="joint")
    assert ScanGeometry.from_dict(found.geometry).codec == codecs[1]
    assert found.network("vae").build().image_channels == after.image_channels
    image = torch.rand(1, 4, 8, 16)
    with torch.no_grad():
        latents = after.encode(image).mean
        assert torch.equal(latents, before.encode(image).mean)
        assert torch.equal(after.predict(latents)[:, :2], before.predict(latents)[:, :2])


@pytest.mark.parametrize("change", [with_further_channels, without_further_channels])
def test_a_vae_starts_with_and_without_the_refinement_of_another(change):
    arguments = {"in_channels": 2, "channels": 32, "channel_multipliers": (1,), "strides": ()}
    arguments |= {"stem": (2, 2), "modes": 2} | DECODED
    refined = {"refinement": 4}
    there, here = ({}, refined) if change is with_further_channels else (refined, {})
    before, after = (VAE(**arguments, **further) for further in (there, here))
    found = change(vae_checkpoint(before, arguments | there, LabelledData.codec), after)
    load_into({"vae": after}, found, stage="joint")
    assert ScanGeometry.from_dict(found.geometry).codec == LabelledData.codec
    assert found.network("vae").build().refinement == after.refinement
    image = torch.rand(1, 4, 8, 16)
    with torch.no_grad():  # a refinement starts at 0
        latents = after.encode(image[:, :2]).mean
        assert torch.equal(latents, before.encode(image[:, :2]).mean)
        assert torch.equal(after.predict(latents), before.predict(latents))


def test_a_run_of_ranges_starts_from_a_checkpoint_whose_decoder_has_labels(tmp_path):
    arguments = {"in_channels": 2, "channels": 32, "channel_multipliers": (1,), "strides": ()}
    before = VAE(**arguments, **DECODED)
    given = vae_checkpoint(before, arguments | DECODED, LabelledData.codec)
    path = save_checkpoint(given, tmp_path / "labels.safetensors")
    module = VAEAlignment(VAE(**arguments), tiny_sit(), init_from=str(path), init_networks=["vae"])
    module.load_previous_stage()
    expected = before.state_dict()
    assert all(torch.equal(value, expected[key]) for key, value in module.vae.state_dict().items())


@pytest.mark.parametrize(
    ("there", "here"),
    [(LABELS, {}), (LABELS, DECODED), (LABELS | {"intensity": False}, {})],
    ids=["labels to ranges", "labels to the decoder alone", "classes to ranges"],
)
def test_an_encoder_without_intensity_and_class_gives_the_latents_of_unknown_ones(there, here):
    arguments = {"in_channels": 2, "channels": 32, "channel_multipliers": (1,), "strides": ()}
    arguments["stem"] = (2, 2)
    before, after = (VAE(**arguments, **further) for further in (there, here))
    for values in before.encoder.further_in.parameters():
        torch.nn.init.normal_(values)
    given = vae_checkpoint(before, arguments | there, LabelledData.codec)
    load_into({"vae": after}, without_further_channels(given, after), stage="joint")
    image = torch.rand(1, 4, 8, 16)
    image[:, 2], image[:, 3] = -1, UNKNOWN_CLASS
    seen = image if there["intensity"] else image[:, [0, 1, 3]]
    with torch.no_grad():
        expected = before.encode(seen).mean
        torch.testing.assert_close(after.encode(image[:, :2]).mean, expected)
        if here:
            assert torch.equal(after.predict(expected), before.predict(expected))


@pytest.mark.parametrize("further", [LABELS, {}], ids=["labels", "ranges"])
def test_the_shipped_weights_start_a_vae_with_and_without_intensity_and_class(further):
    shipped = read_checkpoint("r3dpa-s")
    before = shipped.network("vae").build()
    arguments = shipped.network("ema").arguments
    del arguments["average_blocks"]
    sit = SiT(**{**arguments, "depth": 6})
    before.decoder.further_refinement = None
    plain = {"intensity": False, "num_classes": 0, "encode_further": True, "refinement": 0}
    module = VAEAlignment(
        VAE(**{**shipped.network("vae").arguments, **plain, **further}),
        sit,
        init_from="r3dpa-s",
        init_networks=["vae", "latent_norm"],
    )
    module.load_previous_stage()
    recorded = ScanGeometry.from_dict(module._previous_geometry)
    assert recorded.codec == (LabelledData if further else RangeData).codec
    assert module.latent_norm.fitted
    image = torch.rand(1, 4, 16, 64)
    if not further:
        image[:, 2], image[:, 3] = -1, UNKNOWN_CLASS
    with torch.no_grad():
        latents = before.encode(image).mean
        found = module.vae.encode(image[:, : 4 if further else 2]).mean
        torch.testing.assert_close(found, latents)
        assert torch.equal(module.vae.predict(latents)[:, :6], before.predict(latents)[:, :6])


def test_images_of_another_codec_are_refused():
    vae = range_module(2, labelled=True).vae
    check_image(vae, LabelledData.codec)
    with pytest.raises(ValueError, match=r"num_classes 15, but --data.* gives channels 2"):
        check_image(vae, RangeData.codec)


def test_a_decoder_is_trained_on_for_the_latents_of_a_fixed_encoder():
    module = range_module(2, train_encoder=False)
    before = {name: value.clone() for name, value in module.vae.state_dict().items()}
    train(module, RangeData(2))
    changed = {
        n for n, value in module.vae.state_dict().items() if not torch.equal(value, before[n])
    }
    assert changed == {n for n in before if n.startswith(("decoder.", "post_quant_conv."))}


@pytest.mark.parametrize("taken_over", [["vae"], ["vae", "latent_norm"]], ids="+".join)
def test_statistics_of_a_fixed_encoder_that_were_taken_over_stay(taken_over):
    """Else a flow that was trained with them would see shifted latents."""
    module = range_module(2, train_encoder=False, init_networks=taken_over)
    train(module, RangeData(2))
    assert module.latent_norm.num_batches_tracked == (0 if "latent_norm" in taken_over else 2)


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


def test_cross_entropy_of_classes_by_hand():
    logits = torch.tensor([1.0, 2.0, 0.5]).log().view(1, 3, 1, 1).expand(1, 3, 1, 4)
    classes = torch.tensor([0, 1, 2, -1]).view(1, 1, 1, 4)
    expected = [math.log(3.5), math.log(3.5 / 2), math.log(7), 0.0]
    assert class_errors(logits, classes).flatten().tolist() == pytest.approx(expected)


def test_centred_features_have_no_mean_and_keep_empty_cells():
    grid = torch.tensor([[[1.0, 2.0], [3.0, 6.0], [0.0, 0.0]]])
    assert centred_features(grid).tolist() == [[[-1.0, -2.0], [1.0, 2.0], [0.0, 0.0]]]


def test_a_balanced_adversarial_loss_is_logged_without_a_weight():
    weights = LossWeights(adversarial_ratio=0.5)
    module = train(stage_module("joint", weights=weights), TinyData([False]))
    assert module.logged_losses["adversarial"] == module.parts[0]["adversarial"]


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


@pytest.mark.parametrize("option", [{"decay_steps": 4}, {"cosine": True}])
def test_a_rate_that_falls_needs_the_last_step(option):
    with pytest.raises(ValueError, match=r"need the last step: set --trainer\.max_steps"):
        OptimizerConfig(**option).rate(0, -1)
    assert OptimizerConfig(lr=2.0).rate(0, -1) == 2.0

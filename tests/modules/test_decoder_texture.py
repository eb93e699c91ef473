"""Stage of the texture of a decoder."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from test_range_losses import LabelledData, vae_checkpoint
from tiny_stages import QUIET, Observed, tiny_sit, train

from r3dpa.checkpoints import load_into, with_further_channels, without_further_channels
from r3dpa.geometry import NUM_CLASSES
from r3dpa.modules import DecoderTexture, OptimizerConfig
from r3dpa.modules.decoder_texture import masks_of, views_of
from r3dpa.nn import VAE

pytestmark = QUIET
VAE_ARGS = {"in_channels": 2, "channels": 32, "channel_multipliers": (1,), "strides": ()}
VAE_ARGS |= {"latent_channels": 4, "num_res_blocks": 1, "stem": (2, 2), "modes": 2}
VAE_ARGS |= {"intensity": True, "num_classes": NUM_CLASSES, "encode_further": False}


ObservedTexture = type("ObservedTexture", (Observed, DecoderTexture), {})


def texture_module(**kwargs):
    torch.manual_seed(0)
    vae = VAE(**VAE_ARGS, texture=4)
    settings = {"optimizer": OptimizerConfig(lr=3e-3)} | kwargs
    return ObservedTexture(vae=vae, sit=tiny_sit(), **settings)


def test_the_texture_alone_is_trained():
    module = texture_module(latent_noise=0.2)
    before = {key: value.clone() for key, value in module.state_dict().items()}
    module = train(module, LabelledData(6))
    changed = {key for key, value in module.state_dict().items() if not value.equal(before[key])}
    assert changed
    assert all(key.startswith("vae.decoder.further_texture.") for key in changed)
    assert set(module.parts[0]) == {"texture"}
    assert module.parts[-1]["texture"] < module.parts[0]["texture"]


def test_both_draws_of_a_sample_are_the_same_on_any_number_of_processes(trainer):
    """Of a batch of four, two processes draw for the first and third, second and fourth."""
    image, module = torch.zeros(4, 4, 8, 16), texture_module()
    module.trainer = trainer(1, 0)
    whole = module._noise(image)
    assert not torch.equal(*whole)
    for rank in (0, 1):
        module.trainer = trainer(2, rank)
        for part, noise in zip(module._noise(image[:2]), whole, strict=True):
            assert torch.equal(part, noise[rank::2])


@pytest.fixture
def trainer():
    def of_process(world_size, rank):
        loop = SimpleNamespace(epoch_loop=SimpleNamespace(total_batch_idx=3))
        return SimpleNamespace(world_size=world_size, global_rank=rank, fit_loop=loop)

    return of_process


def test_held_out_scores_are_a_function_of_the_scan():
    module, batch = texture_module().eval(), LabelledData(1).batches[0]
    prediction = torch.randn(2, 7 + NUM_CLASSES, 8, 16, generator=torch.Generator().manual_seed(0))
    both = module.held_out_errors(batch | {"index": torch.tensor([5, 3])}, prediction, None, None)
    assert both["texture"].shape == (2,)
    last = {"range_image": batch["range_image"][1:], "index": torch.tensor([3])}
    alone = module.held_out_errors(last, prediction[1:], None, None)
    torch.testing.assert_close(alone["texture"], both["texture"][1:])


def test_views_of_a_scan_count_where_it_has_returns():
    """Whatever is drawn elsewhere, ranges and intensities have the same score."""
    image = LabelledData(1).batches[0]["range_image"]
    returns = image[:, 1:2] > 0
    likelier, masks = torch.zeros(2, 1, 8, 16), masks_of(returns)
    other = torch.where(returns, image, 0.3 * torch.ones_like(image))
    other[:, 1] = image[:, 1]
    views, changed = (views_of(each, likelier, returns) for each in (image, other))
    for name, view in views.items():
        assert torch.equal(view[masks[name]], changed[name][masks[name]]), name
    assert masks["ranges"].sum() == returns.sum()
    assert not masks["across_rings_1"][:, :, 0].any()
    assert masks["returns"].all()


@pytest.mark.parametrize("change", [with_further_channels, without_further_channels])
def test_a_vae_starts_with_and_without_the_texture_of_another(change):
    there, here = {}, {"texture": 4}
    if change is without_further_channels:
        there, here = here, there
    before, after = VAE(**VAE_ARGS, **there), VAE(**VAE_ARGS, **here)
    found = change(vae_checkpoint(before, VAE_ARGS | there, LabelledData.codec), after)
    load_into({"vae": after}, found, stage="joint")
    assert found.network("vae").build().texture == after.texture
    latents = torch.randn(1, 4, 4, 8)
    with torch.no_grad():
        assert torch.equal(after.predict(latents), before.predict(latents))


def test_without_a_texture_there_is_nothing_to_train():
    with pytest.raises(ValueError, match=r"no texture to train: set --model\.init_args\.vae"):
        DecoderTexture(VAE(**VAE_ARGS), tiny_sit())

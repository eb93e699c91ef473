"""Weights for images of another sensor: what is kept, resized and dropped."""

from dataclasses import replace

import pytest
import torch

from r3dpa.checkpoints import load_into, read_checkpoint
from r3dpa.checkpoints.image_size import resize_to
from r3dpa.nn import VAE, LatentNorm, SiT


@pytest.fixture(scope="module")
def shipped():
    return read_checkpoint("r3dpa-s")


def networks_for(shipped, stem, input_size):
    vae, sit = shipped.network("vae").arguments, dict(shipped.network("ema").arguments)
    for name in ("average_blocks", "guidance_block", "guidance_scale"):
        sit.pop(name, None)
    return {
        "vae": VAE(**{**vae, "stem": stem}),
        "sit": SiT(**{**sit, "input_size": input_size}),
        "latent_norm": LatentNorm(8),
    }


def results(rows):
    return {row.group: row.result for row in rows if row.result != "kept"}


def test_the_same_size_keeps_everything(shipped):
    networks = networks_for(shipped, (4, 8), (8, 64))
    before, rows = resize_to(networks, _without_average(shipped), shipped)
    assert results(rows) == {"sit: average": "dropped"}
    load_into(networks, before, "test")
    weights = shipped.network("vae").state_dict
    assert all(torch.equal(v, weights[k]) for k, v in networks["vae"].state_dict().items())


def test_a_stage_may_have_made_its_flow_of_the_averages(shipped):
    before = _without_average(shipped)
    networks = dict(before.networks)
    made = replace(before, networks=networks | {"sit": networks.pop("ema")})
    before, rows = resize_to(networks_for(shipped, (4, 8), (8, 64)), made, shipped)
    assert results(rows) == {"sit: average": "dropped"}


def test_a_stem_of_fewer_rows_makes_the_same_latents_of_a_coarser_image(shipped):
    networks = networks_for(shipped, (2, 8), (8, 64))
    before, rows = resize_to(networks, _without_average(shipped), shipped)
    layers = "vae: encoder.conv_in, encoder.further_in, decoder.conv_out, decoder.further_out"
    layers += ", decoder.further_refinement.features"
    assert results(rows) == {layers: "resized", "sit: average": "dropped"}
    load_into(networks, before, "test")
    full = shipped.network("vae").build()
    smooth = torch.linspace(-0.2, 0.4, 64)[:, None].expand(64, 1024)
    returns, intensity, classes = (torch.full((64, 1024), value) for value in (1.0, -0.5, 3.0))
    image = torch.stack([smooth, returns, intensity, classes])[None]
    coarse = image.view(1, 4, 32, 2, 1024).mean(dim=3)
    with torch.no_grad():
        latents = full.encode(image).mean
        theirs = networks["vae"].encode(coarse).mean
        decoded = networks["vae"].decode(latents)[:, :1]
        expected = full.decode(latents)[:, :1].view(1, 1, 32, 2, 1024).mean(dim=3)
    assert (latents - theirs).abs().mean() < 0.1 * latents.abs().mean()
    # Of an image in [-1, 1]; in a few pixels another of the two modes is the likelier one.
    assert (decoded - expected).abs().mean() < 0.03


def test_positions_of_another_grid(shipped):
    networks = networks_for(shipped, (4, 8), (4, 128))
    own = networks["sit"].pos_embed.clone()
    before, rows = resize_to(networks, _without_average(shipped), shipped)
    assert results(rows) == {"sit: pos_embed": "resized", "sit: average": "dropped"}
    load_into(networks, before, "test")
    assert torch.equal(networks["sit"].pos_embed, own)
    assert torch.equal(
        networks["sit"].x_embedder.proj.weight,
        shipped.network("ema").state_dict["x_embedder.proj.weight"],
    )


def _without_average(checkpoint):
    networks = {}
    for name, state in checkpoint.networks.items():
        kept = {k: v for k, v in state.state_dict.items() if not k.startswith("average.")}
        networks[name] = replace(state, state_dict=kept)
    return replace(checkpoint, networks=networks)

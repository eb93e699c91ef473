"""Refinement of decoded ranges at full resolution."""

from __future__ import annotations

import pytest
import torch

from r3dpa.geometry.semantics import NUM_CLASSES, SEMANTIC_CLASSES
from r3dpa.nn import VAE
from r3dpa.nn.pixel_outputs import RangeMixture
from r3dpa.nn.refinement import Refinement

STEM = {"in_channels": 2, "latent_channels": 4, "stem": (4, 8), "channels": 32, "modes": 2}
STEM |= {"channel_multipliers": (1, 2), "strides": ((2, 2),), "num_res_blocks": 1}
STEM |= {"intensity": True, "num_classes": NUM_CLASSES}
NUM_RANGE_OUTPUTS = RangeMixture.num_outputs + 1  # with the logit of a return
LEAST_SCALE = 0.01
NAMES = [known.name for known in SEMANTIC_CLASSES]


def refined_vae(everywhere=None, **arguments):
    """VAE whose refinement is not 0, and whose decoder sees one class everywhere, if named."""
    torch.manual_seed(0)
    vae = VAE(**STEM | arguments, refinement=4)
    refinement = vae.decoder.further_refinement
    for layer in (refinement.conv_out, *(block.conv2 for block in refinement.blocks)):
        torch.nn.init.normal_(layer.weight, std=0.1)
    if everywhere is not None:
        classes = vae.decoder.further_out.bias.data.view(1 + NUM_CLASSES, 4 * 8)
        classes[1 + NAMES.index(everywhere)] = 100.0
    return vae


def without_refinement(vae):
    plain = VAE(**STEM)
    unknown = plain.load_state_dict(vae.state_dict(), strict=False)
    assert not unknown.missing_keys
    return plain


def test_it_starts_as_the_decoder_without():
    torch.manual_seed(0)
    vae = VAE(**STEM, refinement=4)
    latents = torch.randn(2, 4, 2, 4)
    assert torch.equal(vae.predict(latents), without_refinement(vae).predict(latents))


@pytest.mark.numerics("interpolation at the seam")
def test_rotation_by_a_latent_column_rotates_the_result():
    vae = refined_vae().double()
    latents = torch.randn(1, 4, 2, 8, dtype=torch.float64)
    plain, rotated = vae.predict(latents), vae.predict(latents.roll(1, -1))
    torch.testing.assert_close(rotated, plain.roll(16, -1))
    assert not torch.equal(plain, without_refinement(vae.float()).double().predict(latents))


@pytest.mark.parametrize("everywhere", ["vegetation", "road"])
def test_leaves_are_corrected_in_training_alone(everywhere):
    vae, latents = refined_vae(everywhere), torch.randn(2, 4, 2, 4)
    before = without_refinement(vae).predict(latents)
    for training in (True, False):
        found = vae.train(training).predict(latents)
        as_before = torch.equal(found[:, :NUM_RANGE_OUTPUTS], before[:, :NUM_RANGE_OUTPUTS])
        assert as_before == (everywhere == "vegetation" and not training)
        assert torch.equal(found[:, NUM_RANGE_OUTPUTS:], before[:, NUM_RANGE_OUTPUTS:])


def test_it_learns_to_smooth_ripples():
    torch.manual_seed(0)
    refinement = Refinement(32, 8, (4, 8), LEAST_SCALE)
    wall = torch.linspace(-0.2, 0.2, 64).expand(4, 1, 16, 64)
    rippled = torch.cat([wall, wall, torch.zeros(4, 4, 16, 64)], dim=1)
    rippled = rippled + 0.02 * torch.randn(4, 1, 16, 64)
    features = torch.randn(4, 32, 4, 8)
    optimizer = torch.optim.Adam(refinement.parameters(), lr=0.01)
    errors = []
    for _ in range(40):
        outputs = rippled + refinement(features, rippled)
        error = (outputs[:, :1] - wall).abs().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        errors.append(error.item())
    assert errors[-1] < 0.6 * errors[0]


def test_in_half_precision_ranges_stay_wide():
    vae, latents = refined_vae(), torch.randn(2, 4, 2, 4)
    wide = vae.predict(latents)
    narrow = vae.decoder_to_bfloat16_().predict(latents)
    assert narrow.dtype == torch.float32
    assert vae.decoder.further_refinement.features.weight.dtype == torch.bfloat16
    spread = wide[:, :2].std()
    assert (narrow[:, :2] - wide[:, :2]).abs().mean() < 0.05 * spread


@pytest.mark.parametrize("changes", [{"modes": 1}, {"num_classes": 0}, {"num_classes": 3}])
def test_it_needs_two_modes_and_the_classes(changes):
    with pytest.raises(ValueError, match="refinement needs modes 2 and num_classes 15, got"):
        VAE(**STEM | changes, refinement=4)

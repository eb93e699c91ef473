"""Random detail of decoded images: its noise, what it may change, and what it learns."""

from __future__ import annotations

import pytest
import torch

from r3dpa.geometry.semantics import NUM_CLASSES
from r3dpa.losses import energy_score
from r3dpa.nn import VAE
from r3dpa.nn.texture import Texture

SIZE = (16, 64)
VAE_ARGS = {"in_channels": 2, "latent_channels": 4, "stem": (4, 8), "channels": 32, "modes": 2}
VAE_ARGS |= {"channel_multipliers": (1,), "strides": (), "num_res_blocks": 1}
VAE_ARGS |= {"intensity": True, "num_classes": NUM_CLASSES}


@pytest.fixture
def vae():
    torch.manual_seed(0)
    return VAE(**VAE_ARGS, texture=8).eval()


@pytest.fixture
def latents():
    return torch.randn(2, 4, 4, 8, generator=torch.Generator().manual_seed(1))


def noise_of(vae, seed, num=2):
    return torch.randn(num, vae.noise_size(SIZE), generator=torch.Generator().manual_seed(seed))


def test_the_noise_of_an_image_by_hand():
    """4 channels of pixels twice, 8 of blocks of 2 x 4, 4 of 4 x 8 blocks, rounded up."""
    assert Texture(8, 16).noise_size((16, 64)) == 8 * 16 * 64 + 8 * 8 * 16 + 4 * 2 * 2
    assert Texture(8, 16).noise_size((20, 36)) == 8 * 20 * 36 + 8 * 10 * 9 + 4 * 3 * 2
    with pytest.raises(ValueError, match=r"multiple of \(2, 4\) pixels, got \(16, 30\)"):
        Texture(8, 16).noise_size((16, 30))


@torch.no_grad()
def test_an_image_is_a_function_of_latents_and_noise(vae, latents):
    drawn = vae.draw(latents, noise_of(vae, 2))
    assert drawn.shape == (2, 4, *SIZE)
    assert torch.equal(vae.draw(latents, noise_of(vae, 2)), drawn)
    other, plain = vae.draw(latents, noise_of(vae, 3)), vae.draw(latents, None)
    assert torch.equal(plain, vae.decode(latents))
    for image in (other, plain):
        assert ((image - drawn)[:, :3].flatten(2).abs().amax(dim=2) > 1e-6).all()
        assert torch.equal(image[:, 3], drawn[:, 3])  # classes
    alone = vae.draw(latents[1:], noise_of(vae, 2)[1:])
    torch.testing.assert_close(alone[0], drawn[1], atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_an_image_turns_with_its_latents_and_its_noise(vae, latents):
    """By a latent column, two columns of blocks: noise of coarse blocks is 0 here."""
    size = [(4, *SIZE), (4, *SIZE), (8, 8, 16)]
    parts = [torch.randn(2, *shape, generator=torch.Generator().manual_seed(4)) for shape in size]
    coarse = torch.zeros(2, 4 * 2 * 2)

    def noise(columns):
        turned = [part.roll(columns * part.shape[-1] // 8, -1).flatten(1) for part in parts]
        return torch.cat([*turned, coarse], dim=1)

    expected = vae.draw(latents, noise(0)).roll(8, -1)
    found = vae.draw(latents.roll(1, -1), noise(1))
    torch.testing.assert_close(found[:, :3], expected[:, :3], atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_half_of_the_bits_draw_nearly_the_same(vae, latents):
    expected = vae.draw(latents, noise_of(vae, 2))
    found = vae.decoder_to_bfloat16_().draw(latents, noise_of(vae, 2))
    assert vae.decoder.further_texture.conv_in.weight.dtype == torch.bfloat16
    assert found.dtype == torch.float32
    assert (found - expected)[:, :3].abs().median() < 0.01


def test_it_learns_how_ranges_are_spread():
    """Normal around what the decoder says: .001 in the left half, .004 in the right one."""
    torch.manual_seed(0)
    texture, spread = Texture(8, 16), torch.tensor([0.001, 0.004]).repeat_interleave(32)
    outputs, ranges = torch.zeros(2, 7 + NUM_CLASSES, 16, 64), torch.zeros(2, 1, 16, 64)
    outputs[:, 7, :, 32:] = 3.0  # the right half is of another class
    optimizer = torch.optim.Adam(texture.parameters(), lr=0.01)
    everywhere = torch.ones_like(ranges, dtype=torch.bool)
    noise = (2, texture.noise_size((16, 64)))
    for _ in range(150):
        scan = spread * torch.randn(2, 1, 16, 64)
        first, second = (texture(outputs, ranges, torch.randn(noise))[:, :1] for _ in range(2))
        loss = energy_score(1000 * first, 1000 * second, 1000 * scan, everywhere).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        drawn = texture(outputs, ranges, torch.randn(noise))[:, 0]
    assert drawn[..., 4:28].std().item() == pytest.approx(0.001, rel=0.25)
    assert drawn[..., 36:60].std().item() == pytest.approx(0.004, rel=0.25)


@pytest.mark.parametrize("changes", [{"modes": 1}, {"num_classes": 3}, {"intensity": False}])
def test_a_texture_needs_what_it_draws(changes):
    with pytest.raises(ValueError, match="texture needs modes 2, intensity true and num_classes"):
        VAE(**VAE_ARGS | changes, texture=8)


def test_a_vae_without_texture_draws_nothing(latents):
    with pytest.raises(ValueError, match="has no texture"):
        VAE(**VAE_ARGS).draw(latents, torch.zeros(2, 1))

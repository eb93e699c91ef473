"""Sizes of LiDM's first stage: of images, and of codes unlike what surrounds them."""

import pytest
import torch

from r3dpa.baselines.lidm_first_stage import LiDMFirstStage
from r3dpa.baselines.lidm_networks import VQAutoencoder
from r3dpa.baselines.lidm_reader import from_lidm
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.nn import PatchDiscriminator


@pytest.mark.filterwarnings("ignore:Attribute '.*' is an instance of `nn.Module`")
def test_images_without_a_patch_of_the_discriminator_are_refused():
    network = VQAutoencoder(
        num_codes=8, channels=32, channel_multipliers=[1, 1, 1, 1], num_res_blocks=1
    )
    stage = LiDMFirstStage(network, PatchDiscriminator(channels=4, num_layers=3))
    stage.geometry = ScanGeometry(
        SphericalProjection(LidarSensor(beams=16, columns=64)), RangeCodec(), (2, 8)
    )
    with pytest.raises(ValueError, match=r"images of 16 x 64 pixels are smaller .* 24 rows and"):
        stage.image_shape()


def test_a_weight_of_the_mask_needs_a_mask():
    network = VQAutoencoder(
        num_codes=8, channels=32, channel_multipliers=[1, 1, 1, 1], num_res_blocks=1
    )
    with pytest.raises(ValueError, match=r"mask_factor 0\.5 needs a network with mask"):
        LiDMFirstStage(network, PatchDiscriminator(channels=4, num_layers=3), mask_factor=0.5)


@pytest.mark.parametrize("num_layers", [1, 2, 3])
def test_images_of_the_least_size_hold_one_patch(num_layers):
    discriminator = PatchDiscriminator(channels=4, num_layers=num_layers)
    least = discriminator.least_size
    assert discriminator(torch.zeros(2, 1, least, least)).shape == (2, 1, 1, 1)
    with pytest.raises(RuntimeError, match=r"smaller than|Kernel size"):
        discriminator(torch.zeros(2, 1, least - 1, least))


def test_codes_of_another_width_than_the_encoder_gives(tmp_path):
    """LiDM's ``embed_dim`` is the width of latents and codes, ``z_channels`` that around them."""
    torch.manual_seed(0)
    sizes = {"num_codes": 8, "channels": 32, "channel_multipliers": (1, 1), "num_res_blocks": 1}
    network = VQAutoencoder(**sizes, strides=((2, 2),), latent_channels=3, z_channels=5)
    weights = network.state_dict()
    assert weights["encoder.conv_out.weight"].shape[0] == 5
    assert weights["quant_conv.weight"].shape[:2] == (3, 5)
    assert weights["quantize.embedding.weight"].shape == (8, 3)
    assert weights["post_quant_conv.weight"].shape[:2] == (5, 3)
    assert weights["decoder.conv_in.weight"].shape[1] == 5
    image = torch.rand(1, 1, 16, 32)
    latents = network.encode(image).mean
    assert latents.shape == (1, 3, 8, 16)
    checkpoint = from_lidm({"state_dict": weights}, tmp_path / "model.ckpt")
    read = checkpoint.network("network").build()
    assert read.latent_channels == 3
    with torch.no_grad():
        assert torch.equal(read.decode(latents), network.decode(latents))


def test_a_file_of_lidm_without_an_average_says_so(tmp_path):
    sizes = {"num_codes": 8, "channels": 32, "channel_multipliers": (1, 1), "num_res_blocks": 1}
    network = VQAutoencoder(**sizes, strides=((2, 2),))
    weights = {f"first_stage_model.{key}": value for key, value in network.state_dict().items()}
    weights["model.diffusion_model.out.2.weight"] = torch.zeros(1)
    with pytest.raises(ValueError, match=r"holds no averaged weights \(model_ema\.\*\) of LiDM"):
        from_lidm({"state_dict": weights}, tmp_path / "model.ckpt")

"""Images that LiDM's first stage can be trained on."""

import pytest
import torch

from r3dpa.baselines.lidm_first_stage import LiDMFirstStage
from r3dpa.baselines.lidm_networks import VQAutoencoder
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


@pytest.mark.parametrize("num_layers", [1, 2, 3])
def test_images_of_the_least_size_hold_one_patch(num_layers):
    discriminator = PatchDiscriminator(channels=4, num_layers=num_layers)
    least = discriminator.least_size
    assert discriminator(torch.zeros(2, 1, least, least)).shape == (2, 1, 1, 1)
    with pytest.raises(RuntimeError, match=r"smaller than|Kernel size"):
        discriminator(torch.zeros(2, 1, least - 1, least))

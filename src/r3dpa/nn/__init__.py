"""Networks: range-image VAE, flow transformer, discriminator, latent statistics."""

from r3dpa.nn.average_velocity import AverageVelocitySiT
from r3dpa.nn.discriminator import PatchDiscriminator
from r3dpa.nn.ema import EMA
from r3dpa.nn.image_vae import ImageVAE
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.sit import SiT
from r3dpa.nn.unet import UNet
from r3dpa.nn.vae import VAE, Posterior, ThinDecoder
from r3dpa.nn.velocity_network import VelocityNetwork, VelocityOutput

__all__ = [
    "EMA",
    "VAE",
    "AverageVelocitySiT",
    "ImageVAE",
    "LatentNorm",
    "PatchDiscriminator",
    "Posterior",
    "SiT",
    "ThinDecoder",
    "UNet",
    "VelocityNetwork",
    "VelocityOutput",
]

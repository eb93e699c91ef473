"""Networks: range-image VAE, flow transformer, discriminator, latent statistics."""

from r3dpa.nn.discriminator import PatchDiscriminator
from r3dpa.nn.ema import EMA
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.sit import SiT, SiTOutput
from r3dpa.nn.vae import VAE, Posterior

__all__ = ["EMA", "VAE", "LatentNorm", "PatchDiscriminator", "Posterior", "SiT", "SiTOutput"]

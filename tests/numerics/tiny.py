"""Networks, data and a training run of a second, for tests of whole training steps."""

from __future__ import annotations

import lightning as L
import tiny_stages
import torch
from tiny_stages import ARGUMENTS, FEATURE_DIM, SILENT, tiny_sit
from torch import nn
from torch.utils.data import DataLoader

from r3dpa.data import LidarDataModule
from r3dpa.modules import JointAlignment, VAEAlignment
from r3dpa.nn import VAE, LatentNorm, PatchDiscriminator

LATENT_CHANNELS = 4
STAGES = {"joint": JointAlignment, "vae_alignment": VAEAlignment}


def drawn(seed, *shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def batch_of(seed, size=2):
    return {
        "range_image": drawn(seed, size, 1, 8, 16).tanh(),
        "valid_mask": torch.ones(size, 1, 8, 16, dtype=torch.bool),
        "feature_grid": drawn(seed + 1, size, 8, FEATURE_DIM),
        "index": torch.arange(size),
    }


class TinyData(LidarDataModule):
    """Given batches in place of scans."""

    feature_source = "random"
    feature_dim = FEATURE_DIM
    geometry = tiny_stages.TinyData.geometry

    def __init__(self, batches):
        L.LightningDataModule.__init__(self)
        self.features_dir = "random"
        self.batches = batches

    def prepare_data(self):
        pass

    def setup(self, stage):
        pass

    def train_dataloader(self):
        return DataLoader(self.batches, batch_size=None)

    def val_dataloader(self):
        return self.train_dataloader()

    def state_dict(self):
        return {}


def vae():
    return VAE(**ARGUMENTS["vae"])


def vae_losses(made, image):
    """Reconstruction of an image, and the losses of the VAE."""
    posterior = made.vae.encode(image)
    reconstruction = made.vae.decode(posterior.mean)
    return reconstruction, made.vae_losses(image, posterior, reconstruction)


def module(stage="joint", **kwargs):
    """A training module of ``STAGES``, without a stage before it."""
    torch.manual_seed(0)
    sit = tiny_sit()
    for parameter in sit.parameters():  # a fresh one has zero gates: no gradient would pass
        nn.init.normal_(parameter, std=0.3)
    discriminator = PatchDiscriminator(**ARGUMENTS["discriminator"])
    networks = {"vae": vae(), "sit": sit, "discriminator": discriminator}
    made = STAGES[stage](**networks, latent_norm=LatentNorm(LATENT_CHANNELS), **kwargs)
    made.load_previous_stage = lambda: None
    return made


def trainer(num_steps, **kwargs):
    options = {"devices": 1, "limit_val_batches": 0, "max_steps": num_steps}
    return L.Trainer(**SILENT | options | kwargs)


def fit(made, batches, **kwargs):
    """The module after one step per batch."""
    trainer(len(batches), **kwargs).fit(made, datamodule=TinyData(batches))
    return made

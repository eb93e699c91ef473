"""Stages on RGB images: their base, and a small image VAE where Stable Diffusion's is too large."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from r3dpa.data.image_datamodule import ImageBatch, ImageDataModule
from r3dpa.losses import reconstruction_errors, reconstruction_loss
from r3dpa.modules.settings import LossWeights, OptimizerConfig
from r3dpa.modules.stage import Stage, networks_as_settings
from r3dpa.nn import ImageVAE


class ImageStage(Stage):
    """Base class of the stages trained on RGB images; their checkpoints record the image source."""

    vae: ImageVAE

    @property
    def images(self) -> ImageDataModule:
        """Data module, whose images are of a size that the VAE can encode."""
        datamodule = getattr(self.trainer, "datamodule", None)
        if not isinstance(datamodule, ImageDataModule):
            raise ValueError(
                f"{type(self).__name__} needs an ImageDataModule, got {type(datamodule).__name__}"
            )
        self.vae.latent_size((datamodule.image_size, datamodule.image_size))
        return datamodule

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the images that it was trained with."""
        super().on_save_checkpoint(checkpoint)
        checkpoint["r3dpa"]["images"] = self.images.settings


class ImageVAETraining(ImageStage):
    """Trains an image VAE by reconstruction and KL alone.

    Without discriminator and perceptual loss its latent space suffices for stage 0, but not for
    fine pictures.

    Args:
        vae: Image autoencoder.
        weights: Loss weights; ``reconstruction`` and ``kl`` count.
        optimizer: Optimiser settings.
        seed: Key of the training draws.
    """

    stage = "image_vae"

    def __init__(
        self,
        vae: ImageVAE,
        weights: LossWeights = LossWeights(),
        optimizer: OptimizerConfig = OptimizerConfig(),
        seed: int = 0,
    ) -> None:
        super().__init__(optimizer, seed)
        with networks_as_settings():
            self.save_hyperparameters()
        self.vae = vae
        self.weights = weights

    def setup(self, stage: str) -> None:
        """Check trainer and data against the VAE."""
        self.check_trainer(self.trainer, fits=stage == "fit")
        size = self.images.image_size
        self.latent_shape = (self.vae.latent_channels, *self.vae.latent_size((size, size)))

    def trainable(self) -> dict[str, nn.Module]:
        """The VAE alone."""
        return {"vae": self.vae}

    def training_step(self, batch: ImageBatch, batch_idx: int) -> Tensor:
        """One step on images ``(B, 3, S, S)``."""
        image, weights = batch["image"], self.weights
        posterior = self.vae.encode(image)
        latents = posterior.sample(self.draw_path(len(image)).posterior_noise)
        reconstruction = self.vae.decode(latents)
        error = reconstruction_loss(reconstruction, image, weights.reconstruction_norm)
        losses = {
            "reconstruction": weights.reconstruction * error,
            "kl": weights.kl * posterior.kl().mean(),
        }
        return self.weigh_and_log(losses)

    def validation_step(self, batch: ImageBatch, batch_idx: int) -> None:
        """Held-out images: the reconstruction error of the posterior mean, and the KL."""
        image = batch["image"]
        posterior = self.vae.encode(image)
        reconstruction = self.vae.decode(posterior.mean)
        errors = reconstruction_errors(reconstruction, image, self.weights.reconstruction_norm)
        self.held_out.update(batch["index"], reconstruction=errors, kl=posterior.kl())

    test_step = validation_step

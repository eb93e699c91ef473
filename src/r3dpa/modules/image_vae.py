"""Training of a small image VAE, where Stable Diffusion's is not at hand or too large."""

from __future__ import annotations

from typing import Any

import lightning as L
import torch
from torch import Tensor

from r3dpa.data.image_datamodule import ImageBatch
from r3dpa.losses import reconstruction_loss
from r3dpa.modules import steps
from r3dpa.modules.checks import check_trainer, image_datamodule
from r3dpa.modules.settings import LossWeights, OptimizerConfig
from r3dpa.nn import ImageVAE


class ImageVAETraining(L.LightningModule):
    """An image VAE by reconstruction and KL alone.

    No discriminator and no perceptual loss: good enough a latent space for stage 0, not for fine
    pictures.

    Args:
        vae: Image autoencoder.
        weights: Loss weights; those of reconstruction and KL count.
        optimizer: Optimiser settings.
        seed: Key of the training draws.
    """

    stage = "image_vae"
    time_sampling = "uniform"

    def __init__(
        self,
        vae: ImageVAE,
        weights: LossWeights = LossWeights(),
        optimizer: OptimizerConfig = OptimizerConfig(),
        seed: int = 0,
    ) -> None:
        super().__init__()
        with steps.networks_as_settings():
            self.save_hyperparameters()
        self.vae = vae
        self.held_out = steps.HeldOutMeans()
        self.weights, self.optimizer_config, self.seed = weights, optimizer, seed

    def setup(self, stage: str) -> None:
        """Checks trainer and data against the VAE."""
        check_trainer(self.trainer)
        size = image_datamodule(self, self.vae).image_size
        self.latent_shape = (self.vae.latent_channels, *self.vae.latent_size((size, size)))

    def training_step(self, batch: ImageBatch, batch_idx: int) -> Tensor:
        """One step on images ``(B, 3, S, S)``."""
        image, weights = batch["image"], self.weights
        posterior = self.vae.encode(image)
        latents = posterior.sample(steps.draw_path(self, len(image)).posterior_noise)
        reconstruction = self.vae.decode(latents)
        error = reconstruction_loss(reconstruction, image, weights.reconstruction_norm)
        losses = {
            "reconstruction": weights.reconstruction * error,
            "kl": weights.kl * posterior.kl().mean(),
        }
        return steps.weigh_and_log(self, losses)

    def validation_step(self, batch: ImageBatch, batch_idx: int) -> None:
        """Held-out images: the reconstruction error of the posterior mean, and the KL."""
        image = batch["image"]
        posterior = self.vae.encode(image)
        reconstruction = self.vae.decode(posterior.mean)
        error = steps.each_reconstruction_loss(reconstruction, image, self.weights)
        self.held_out.update(batch["index"], reconstruction=error, kl=posterior.kl())

    test_step = validation_step
    on_validation_epoch_end = on_test_epoch_end = steps.log_held_out

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """AdamW of the VAE."""
        return steps.adamw(self, {"vae": self.vae}, self.optimizer_config)

    configure_gradient_clipping = steps.clip_per_network
    on_before_optimizer_step = steps.set_learning_rate
    on_train_start = steps.fit_optimizer

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds the stage and the images that it was trained with."""
        steps.describe_stage(checkpoint, self.stage, "linear")
        checkpoint["r3dpa"]["images"] = image_datamodule(self, self.vae).settings

    on_load_checkpoint = steps.check_stage

"""Training of a small image VAE, where Stable Diffusion's is not at hand or too large."""

from __future__ import annotations

from torch import Tensor, nn

from r3dpa import losses
from r3dpa.data.images import ImageBatch
from r3dpa.modules.image_stage import ImageStage
from r3dpa.modules.settings import GuardConfig, LossWeights, OptimizerConfig
from r3dpa.modules.step_losses import PathDraws
from r3dpa.nn import ImageVAE

__all__ = ["ImageVAETraining"]

_GUARDS = GuardConfig()


class ImageVAETraining(ImageStage):
    """An image VAE by reconstruction and KL alone.

    No discriminator and no perceptual loss: good enough a latent space for stage 0, not for fine
    pictures.

    Args:
        vae: Image autoencoder.
        weights: Loss weights; those of reconstruction and KL count.
        optimizer: Optimiser settings.
        seed: Key of the training draws.
        guards: When a step is dropped, and when training stops; None trains without.
    """

    stage = "image_vae"

    def __init__(
        self,
        vae: ImageVAE,
        weights: LossWeights = LossWeights(),
        optimizer: OptimizerConfig = OptimizerConfig(),
        seed: int = 0,
        guards: GuardConfig | None = _GUARDS,
    ) -> None:
        super().__init__(vae, weights, optimizer, "uniform", seed, guards)

    def trainable(self) -> dict[str, nn.Module]:
        """The VAE."""
        return {"vae": self.vae}

    def step_losses(self, batch: ImageBatch, draws: PathDraws) -> dict[str, Tensor]:
        """Reconstruction error and KL of images ``(B, 3, S, S)``."""
        image = batch["image"]
        posterior = self.vae.encode(image)
        reconstruction = self.vae.decode(posterior.sample(draws.posterior_noise))
        return self.vae_losses(image, posterior, reconstruction)

    def evaluate(self, batch: ImageBatch, batch_idx: int) -> dict[str, Tensor]:
        """Reconstruction error of the posterior mean, and KL."""
        image = batch["image"]
        posterior = self.vae.encode(image)
        error = losses.reconstruction_loss(
            self.vae.decode(posterior.mean), image, self.weights.reconstruction_norm
        )
        return {"reconstruction": error, "kl": posterior.kl().mean()}

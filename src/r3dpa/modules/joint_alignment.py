"""Stage 2: VAE and SiT trained together, both aligned with 3D features (REPA-E)."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from r3dpa.data.datasets import LidarBatch
from r3dpa.modules.base import GenerativeModule
from r3dpa.modules.stage import frozen
from r3dpa.nn import VAE, PatchDiscriminator, VelocityNetwork


class JointAlignment(GenerativeModule):
    """Joint training: the VAE by L_AE + lambda1 L_align, the SiT by L_denoise + lambda2 L_align.

    Both see the same latents, times and noise. The alignment loss reaches the VAE through a frozen
    SiT with running latent statistics; the SiT sees detached latents, normalised with batch
    statistics.

    Source: R3DPA (ICRA 2026), section "End-to-end training"; REPA-E.

    Args:
        vae: Range-image autoencoder.
        sit: Velocity network, :class:`r3dpa.nn.SiT` or :class:`r3dpa.nn.UNet`.
        discriminator: Patch discriminator; without it, no adversarial term.
        **kwargs: See :class:`GenerativeModule`; without ``init_from`` training starts from scratch.
    """

    stage = "joint"
    default_init = ("vae", "discriminator", "sit", "latent_norm")

    def __init__(
        self,
        vae: VAE,
        sit: VelocityNetwork,
        discriminator: PatchDiscriminator | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(vae, sit, discriminator, **kwargs)
        self.sit.projector.requires_grad_(self.weights.sit_alignment != 0)

    def trainable(self) -> dict[str, nn.Module]:
        """All networks."""
        networks: dict[str, nn.Module] = {"vae": self.vae}
        if self.discriminator is not None:
            networks["discriminator"] = self.discriminator
        return networks | {"sit": self.sit}

    def training_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """One step on range images ``(B, C, H, W)`` and feature grids ``(B, N, D)``."""
        image, features = batch["range_image"], batch.get("feature_grid")
        draws = self.draw_path(len(image))
        posterior = self.vae.encode(self.encoder_images(image, draws))
        latents = posterior.sample(draws.posterior_noise)
        prediction = self.vae.predict(self.decoder_latents(latents, draws))

        losses = self.vae_losses(image, posterior, prediction)
        with frozen(self.sit):
            losses |= self.vae_alignment_losses(latents, features, draws)
        losses |= self.discriminator_losses(image, prediction)
        normalised = self.latent_norm.update(latents.detach())
        losses |= self.flow_losses(normalised, features, draws)
        return self.weigh_and_log(losses)

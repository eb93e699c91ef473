"""Stages 1 and 2: a VAE aligned through a frozen SiT, then VAE and SiT together (REPA-E)."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from r3dpa.data.datasets import LidarBatch
from r3dpa.modules.base import GenerativeModule
from r3dpa.modules.steps import frozen
from r3dpa.nn import VAE, PatchDiscriminator, VelocityNetwork


class VAEAlignment(GenerativeModule):
    """VAE alignment: L_AE + lambda1 L_align through a frozen transformer.

    Trained are the VAE, the discriminator, the projection head and the patch embedding; the
    transformer's blocks keep their RGB-pretrained values. With ``weights.vae_alignment`` 0 this is
    the plain VAE of the ablations and the SiT takes no part. The latent statistics follow the VAE,
    so that the frozen blocks see unit variance and the joint stage starts from fitted statistics
    (the official code leaves them at mean 0, variance 1).

    Source: R3DPA (ICRA 2026), section "VAE Alignment for RGB Image Priors".

    Args:
        vae: Range-image autoencoder, trained from scratch.
        sit: Velocity network, frozen but for projector and input layer (patch embedding).
        discriminator: Patch discriminator.
        train_patch_embed: Train the patch embedding (paper); False freezes it (official code).
        keep_projector: Keep the RGB model's projection head where its shape fits, as officially.
        **kwargs: See :class:`GenerativeModule`.
    """

    stage = "vae_alignment"
    default_init = ("vae",)
    trains_velocity = False

    def __init__(
        self,
        vae: VAE,
        sit: VelocityNetwork,
        discriminator: PatchDiscriminator,
        train_patch_embed: bool = True,
        keep_projector: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(vae, sit, discriminator, keep_projector=keep_projector, **kwargs)
        self.sit.requires_grad_(False)
        if self.weights.vae_alignment != 0:
            self.sit.projector.requires_grad_(True)
            self.sit.input_layer.requires_grad_(train_patch_embed)

    def needs_features(self) -> bool:
        """Only lambda1 counts: the velocity is not trained in this stage."""
        return self.weights.vae_alignment != 0

    def trainable(self) -> dict[str, nn.Module]:
        """VAE, discriminator and, when aligning, what is not frozen of the SiT."""
        networks: dict[str, nn.Module] = {
            "vae": self.vae,
            "discriminator": self.get_submodule("discriminator"),
        }
        return networks | ({"sit": self.sit} if self.needs_features() else {})

    def training_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """One step on range images ``(B, 1, H, W)`` and feature grids ``(B, N, D)``."""
        image, features = batch["range_image"], batch.get("feature_grid")
        draws = self.draw_path(len(image))
        posterior = self.vae.encode(image)
        latents = posterior.sample(draws.posterior_noise)
        reconstruction = self.vae.decode(latents)

        losses = self.vae_losses(image, posterior, reconstruction)
        losses |= self.vae_alignment_losses(latents, features, draws)
        losses |= self.discriminator_losses(image, reconstruction)
        self.latent_norm.update(latents.detach())
        return self.weigh_and_log(losses)


class JointAlignment(GenerativeModule):
    """Joint training: the VAE by L_AE + lambda1 L_align, the SiT by L_denoise + lambda2 L_align.

    Both see the same latents, times and noise. The alignment loss reaches the VAE through a frozen
    SiT with running latent statistics; the SiT sees detached latents, normalised with batch
    statistics.

    Source: R3DPA (ICRA 2026), section "End-to-end training"; REPA-E.

    Args:
        vae: Range-image autoencoder.
        sit: Velocity network, :class:`r3dpa.nn.SiT` or :class:`r3dpa.nn.UNet`.
        discriminator: Patch discriminator.
        **kwargs: See :class:`GenerativeModule`; without ``init_from`` training starts from scratch.
    """

    stage = "joint"
    default_init = ("vae", "discriminator", "sit", "latent_norm")

    def __init__(
        self, vae: VAE, sit: VelocityNetwork, discriminator: PatchDiscriminator, **kwargs: Any
    ) -> None:
        super().__init__(vae, sit, discriminator, **kwargs)
        self.sit.projector.requires_grad_(self.weights.sit_alignment != 0)

    def trainable(self) -> dict[str, nn.Module]:
        """All three networks."""
        return {
            "vae": self.vae,
            "discriminator": self.get_submodule("discriminator"),
            "sit": self.sit,
        }

    def training_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """One step on range images ``(B, 1, H, W)`` and feature grids ``(B, N, D)``."""
        image, features = batch["range_image"], batch.get("feature_grid")
        draws = self.draw_path(len(image))
        posterior = self.vae.encode(image)
        latents = posterior.sample(draws.posterior_noise)
        reconstruction = self.vae.decode(latents)

        losses = self.vae_losses(image, posterior, reconstruction)
        with frozen(self.sit):
            losses |= self.vae_alignment_losses(latents, features, draws)
        losses |= self.discriminator_losses(image, reconstruction)
        normalised = self.latent_norm.update(latents.detach())
        losses |= self.flow_losses(normalised, features, draws)
        return self.weigh_and_log(losses)

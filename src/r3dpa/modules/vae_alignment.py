"""Stage 1: a VAE trained against a frozen, RGB-pretrained SiT."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from r3dpa.checkpoints import Checkpoint, with_further_channels
from r3dpa.data.datasets import LidarBatch
from r3dpa.modules.base import GenerativeModule
from r3dpa.nn import VAE, PatchDiscriminator, VelocityNetwork


class VAEAlignment(GenerativeModule):
    """VAE alignment: L_AE + lambda1 L_align through a frozen transformer.

    Trains the VAE, discriminator, projection head and patch embedding; the
    transformer's blocks keep their RGB-pretrained values. With ``weights.vae_alignment`` 0 this is
    the plain VAE of the ablations and the SiT takes no part. The latent statistics follow the VAE,
    so that the frozen blocks see unit variance and the joint stage starts from fitted statistics
    (the official code leaves them at mean 0, variance 1).

    A VAE with channels of intensity or class, or with a refinement, may start from one without.

    Source: R3DPA (ICRA 2026), section "VAE Alignment for RGB Image Priors".

    Args:
        vae: Range-image autoencoder, trained from scratch.
        sit: Velocity network, frozen but for projector and input layer (patch embedding).
        discriminator: Patch discriminator; without it, no adversarial term.
        train_encoder: False freezes the encoder, so that an existing flow stays valid, and
            fine-tunes the decoder. Latent statistics that ``init_networks`` takes over stay too.
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
        discriminator: PatchDiscriminator | None = None,
        train_encoder: bool = True,
        train_patch_embed: bool = True,
        keep_projector: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(vae, sit, discriminator, keep_projector=keep_projector, **kwargs)
        for part in (self.vae.encoder, self.vae.quant_conv):
            part.requires_grad_(train_encoder)
        self.keeps_statistics = not train_encoder and "latent_norm" in self.init_networks
        self.sit.requires_grad_(False)
        if self.weights.vae_alignment != 0:
            self.sit.projector.requires_grad_(True)
            self.sit.input_layer.requires_grad_(train_patch_embed)

    def needs_features(self) -> bool:
        """Only lambda1 counts: the velocity is not trained in this stage."""
        return self.weights.vae_alignment != 0

    def trainable(self) -> dict[str, nn.Module]:
        """VAE, discriminator and, when aligning, what is not frozen of the SiT."""
        networks: dict[str, nn.Module] = {"vae": self.vae}
        if self.discriminator is not None:
            networks["discriminator"] = self.discriminator
        return networks | ({"sit": self.sit} if self.needs_features() else {})

    def previous_networks(self, before: Checkpoint) -> Checkpoint:
        """Checkpoint of the stage before, its VAE with the channels of this one."""
        before = super().previous_networks(before)
        has_vae = "vae" in before.networks and "vae" in self.init_networks
        return with_further_channels(before, self.vae) if has_vae else before

    def training_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """One step on range images ``(B, C, H, W)`` and feature grids ``(B, N, D)``."""
        image, features = batch["range_image"], batch.get("feature_grid")
        draws = self.draw_path(len(image))
        posterior = self.vae.encode(self.encoder_images(image, draws))
        latents = posterior.sample(draws.posterior_noise)
        prediction = self.vae.predict(self.decoder_latents(latents, draws))

        losses = self.vae_losses(image, posterior, prediction)
        losses |= self.vae_alignment_losses(latents, features, draws)
        losses |= self.discriminator_losses(image, prediction)
        if not self.keeps_statistics:
            self.latent_norm.update(latents.detach())
        return self.weigh_and_log(losses)

"""Baseline: flow matching on the latents of a frozen VAE."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from r3dpa.data.datasets import LidarBatch
from r3dpa.modules.base import GenerativeModule
from r3dpa.modules.settings import LossWeights
from r3dpa.nn import VAE, SiT

__all__ = ["FlowMatching"]


class FlowMatching(GenerativeModule):
    """FM baseline: the SiT by L_denoise (+ lambda2 L_align) on a frozen, trained VAE.

    ``weights.sit_alignment`` 0, the default here, is the row "no alignment" of the paper's
    table III; 0.5 is "vanilla".

    Source: R3DPA (ICRA 2026), section "LiDAR Scene Generation with Flow Matching".

    Args:
        vae: Range-image autoencoder; its weights come from ``init_from`` and stay fixed.
        sit: Flow transformer.
        weights: Loss weights; those of the VAE are not used here.
        **kwargs: See :class:`GenerativeModule`. ``init_from`` is needed to fit; to continue from
            the VAE-alignment stage let ``init_networks`` name ``sit`` and ``latent_norm`` too.
    """

    stage = "flow_matching"
    default_init = ("vae",)

    def __init__(
        self,
        vae: VAE,
        sit: SiT,
        weights: LossWeights = LossWeights(sit_alignment=0.0),
        **kwargs: Any,
    ) -> None:
        super().__init__(vae, sit, weights=weights, **kwargs)
        self.vae.requires_grad_(False)
        self.sit.projector.requires_grad_(self.weights.sit_alignment != 0)

    def needs_features(self) -> bool:
        """Only lambda2 counts: the VAE is frozen."""
        return self.weights.sit_alignment != 0

    def load_previous_stage(self) -> None:
        """Loads the trained VAE; refuses to start without one."""
        if self.init_from is None:
            raise ValueError(
                "stage flow_matching trains on the latents of a trained VAE: give "
                "model.init_from a checkpoint of stage vae_alignment or joint"
            )
        super().load_previous_stage()

    def trainable(self) -> dict[str, nn.Module]:
        """The SiT alone."""
        return {"sit": self.sit}

    def training_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """One step on a batch of range images ``(B, 1, H, W)`` and feature grids ``(B, N, D)``."""
        image = batch["range_image"]
        draws = self.draw_path(image, self.batch_number)
        with torch.no_grad():
            latents = self.vae.encode(image).sample(draws.posterior_noise)
        return self.weigh_and_log(self.flow_losses(latents, batch.get("feature_grid"), draws))

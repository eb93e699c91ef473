"""Loss weights and optimiser of a stage, as its YAML gives them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

PathName = Literal["linear", "cosine"]
TimeSampling = Literal["uniform", "lognormal"]


@dataclass(frozen=True)
class LossWeights:
    """Weights of the training losses.

    A loss of weight 0 is not computed, nor an adversarial one before its start.

    Args:
        reconstruction: Weight of the reconstruction error.
        reconstruction_norm: ``l1`` (official code) or ``l2`` (paper).
        kl: Weight of the Kullback-Leibler term, summed per sample.
        adversarial: Weight of the generator's adversarial loss (official 0.3 x 0.001).
        discriminator: Factor of the discriminator's hinge loss.
        adversarial_start: First step at which both adversarial losses count.
        vae_alignment: lambda1, weight of the alignment loss that reaches the VAE.
        denoising: Weight of the velocity error.
        sit_alignment: lambda2, weight of the alignment loss that reaches the SiT.
        skip_empty_cells: Leave empty grid cells out of the mean of the alignment loss.
    """

    reconstruction: float = 1.0
    reconstruction_norm: Literal["l1", "l2"] = "l1"
    kl: float = 1e-6
    adversarial: float = 3e-4
    discriminator: float = 1e-3
    adversarial_start: int = 0
    vae_alignment: float = 1.5
    denoising: float = 1.0
    sit_alignment: float = 0.5
    skip_empty_cells: bool = False


@dataclass(frozen=True)
class OptimizerConfig:
    """AdamW, one parameter group per network, constant rate.

    Args:
        lr: Learning rate.
        betas: Decay of the first and second moments.
        weight_decay: Applied to every trained parameter, as officially.
        eps: Added to the root of the second moment.
    """

    lr: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = 0.03
    eps: float = 1e-8

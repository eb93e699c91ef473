"""Loss weights and optimiser of a stage, as its YAML gives them."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

PathName = Literal["linear", "cosine"]
TimeSampling = Literal["uniform", "lognormal", "u_shaped"]


@dataclass(frozen=True)
class LossWeights:
    """Weights of the training losses.

    A loss of weight 0 has no gradient, nor has an adversarial one before its start or an alignment
    after its end. AdamW still counts these steps, as officially, and the weight decay of a network
    that only they train goes on. ``returns``, ``intensity`` and ``classes`` count only if
    ``reconstruction`` is not 0.

    Args:
        reconstruction: Weight of the reconstruction error: of all pixels, or, where images have a
            return channel, of those with a return (of two modes, the negative log-likelihood).
        reconstruction_norm: ``l1`` (official code) or ``l2`` (paper); of one mode only.
        returns: Weight of the cross-entropy of the return channel, where images have one.
        intensity: Weight of the absolute error of the encoded intensity at returns, likewise.
        classes: Weight of the cross-entropy of the class of labelled returns, likewise.
        kl: Weight of the Kullback-Leibler term, summed per sample.
        perceptual: Weight of the distance between what a network on points sees in reconstruction
            and scan, see :class:`r3dpa.modules.perceptual.PerceptualLoss`.
        adversarial: Weight of the generator's adversarial loss (official 0.3 x 0.001).
        adversarial_ratio: Target ratio of adversarial to L1 gradient norm at the image (adaptive
            weight of VQGAN), in place of ``adversarial`` where that is not 0. Default: fixed
            weight, at which the discriminator dominates.
        discriminator: Factor of the discriminator's hinge loss. AdamW is invariant to this scale;
            it only affects clipping and logs.
        adversarial_start: First step at which both adversarial losses count.
        vae_alignment: lambda1, weight of the alignment loss that reaches the VAE.
        denoising: Weight of the velocity error.
        sit_alignment: lambda2, weight of the alignment loss that reaches the SiT.
        skip_empty_cells: Leave empty grid cells out of the mean of the alignment loss.
        centre_features: Align with the difference of each cell from the mean of its scan, which
            keeps the spatial structure (iREPA). Edits guide by features as they are, not centred.
        alignment_stop: First step without ``sit_alignment``, which helps early and may hold back
            later (HASTE); None: never.
        alignment_release: End ``sit_alignment`` once the fast average of its residual is less than
            this share below the slow one (RARE); None for never.
        alignment_decays: Decays of the two averages. The slow one should reach over a twelfth of
            all steps, the fast one over enough to even out the noise of batches.

    Raises:
        ValueError: If ``alignment_decays`` are not 0 <= fast < slow < 1.
    """

    reconstruction: float = 1.0
    reconstruction_norm: Literal["l1", "l2"] = "l1"
    returns: float = 0.2
    intensity: float = 1.0
    classes: float = 0.2
    kl: float = 1e-6
    perceptual: float = 0.0
    adversarial: float = 3e-4
    adversarial_ratio: float | None = None
    discriminator: float = 1e-3
    adversarial_start: int = 0
    vae_alignment: float = 1.5
    denoising: float = 1.0
    sit_alignment: float = 0.5
    skip_empty_cells: bool = False
    centre_features: bool = False
    alignment_stop: int | None = None
    alignment_release: float | None = None
    alignment_decays: tuple[float, float] = (0.99, 0.999)

    def __post_init__(self) -> None:
        fast, slow = self.alignment_decays
        if not 0 <= fast < slow < 1:
            raise ValueError(
                "alignment_decays must be 0 or more and below 1, the smaller one first, got "
                f"{fast:g} and {slow:g}"
            )


@dataclass(frozen=True)
class OptimizerConfig:
    """AdamW, one parameter group per network; constant rate with an optional decay to 0.

    Args:
        lr: Learning rate.
        betas: Decay of the first and second moments.
        weight_decay: Applied to every trained parameter, as officially.
        eps: Added to the root of the second moment.
        discriminator_rate: Rate of the discriminator, relative to ``lr``.
        thin_decoder_rate: Rate of the thin decoder, which starts untrained, relative to ``lr``.
        warmup_steps: First steps, over which the rate rises linearly.
        decay_steps: Last steps before ``trainer.max_steps``, over which the rate falls linearly to
            0. A run that goes on to more steps starts from a checkpoint before the decay.
        cosine: Let the rate fall by a half cosine from the end of the warm-up to
            ``trainer.max_steps`` instead.
    """

    lr: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = 0.03
    eps: float = 1e-8
    discriminator_rate: float = 1.0
    thin_decoder_rate: float = 1.0
    warmup_steps: int = 0
    decay_steps: int = 0
    cosine: bool = False

    def adamw(self) -> dict[str, Any]:
        """Arguments of AdamW."""
        values = asdict(self)
        return {name: values[name] for name in ("lr", "betas", "weight_decay", "eps")}

    def check_last_step(self, max_steps: int) -> None:
        """Refuse a rate that falls towards the last step where ``max_steps`` is not set."""
        if max_steps < 1 and (self.decay_steps or self.cosine):
            raise ValueError(
                "optimizer.decay_steps and optimizer.cosine need the last step: set "
                "--trainer.max_steps, or leave both out"
            )

    def rate(self, step: int, max_steps: int) -> float:
        """Learning rate of the step after ``step`` optimiser steps, out of ``max_steps``.

        Raises:
            ValueError: If the rate falls, but ``max_steps`` is not set.
        """
        self.check_last_step(max_steps)
        rising = (step + 1) / (self.warmup_steps + 1)
        falling = (max_steps - step) / self.decay_steps if self.decay_steps else 1.0
        if self.cosine:
            done = (step - self.warmup_steps) / max(1, max_steps - self.warmup_steps)
            falling = (1 + math.cos(math.pi * min(1.0, max(0.0, done)))) / 2
        return self.lr * max(0.0, min(1.0, rising, falling))

"""Draws and losses of one training step."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import lightning as L
import numpy as np
import torch
from torch import Tensor, nn

from r3dpa import losses
from r3dpa.flow import Interpolant, sample_time
from r3dpa.modules.guards import StepGuard
from r3dpa.modules.settings import LossWeights, TimeSampling
from r3dpa.nn import VAE, LatentNorm, PatchDiscriminator, Posterior, VelocityNetwork

__all__ = ["PathDraws", "StepLosses", "frozen"]


class PathDraws(NamedTuple):
    """Random numbers of one training step.

    ``posterior_noise`` and ``noise`` are ``(B, C, h, w)`` standard normal, ``time`` is ``(B,)``.
    """

    posterior_noise: Tensor
    time: Tensor
    noise: Tensor


@contextmanager
def frozen(*networks: nn.Module) -> Iterator[None]:
    """Records the forward pass inside without gradients to the networks' own parameters.

    Gradients still flow through the networks to their inputs.
    """
    parameters = [p for network in networks for p in network.parameters() if p.requires_grad]
    for parameter in parameters:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)


def _nothing_of(network: nn.Module) -> Tensor:
    """A loss of exactly 0 that gives each trained parameter a gradient of 0.

    Nothing is computed for it: it is the sum of no element of each parameter.
    """
    empty = [p.flatten()[:0].sum() for p in network.parameters() if p.requires_grad]
    return torch.stack(empty).sum()


class StepLosses(L.LightningModule):
    """The losses of the paper, each a method; a stage adds up those that it trains with."""

    stage: str
    vae: VAE
    sit: VelocityNetwork
    discriminator: PatchDiscriminator | None
    latent_norm: LatentNorm
    weights: LossWeights
    interpolant: Interpolant
    time_sampling: TimeSampling
    seed: int
    guard: StepGuard | None

    def step_losses(self, batch: Any, draws: PathDraws) -> dict[str, Tensor]:
        """Weighted losses of one step, by the names of their weights in :class:`LossWeights`.

        Args:
            batch: A :class:`r3dpa.data.LidarBatch`.
            draws: Random numbers of the step for its scans.
        """
        raise NotImplementedError

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        """One step on a batch of range images or posteriors, and feature grids ``(B, N, D)``."""
        scans = batch["posterior_moments" if "posterior_moments" in batch else "range_image"]
        draws = self.draw_path(len(scans), self.batch_number)
        return self.weigh_and_log(self.step_losses(batch, draws))

    @property
    def latent_size(self) -> tuple[int, int]:
        """Rows and columns ``(h, w)`` of the latents."""
        return self.sit.input_size

    def draw_path(self, num_scans: int, batch_number: int, stream: int = 0) -> PathDraws:
        """Posterior noise, times and path noise for this process's part of a global batch.

        Args:
            num_scans: Scans B of the batch on this process.
            batch_number: Number of the batch since the start of training, or of the split.
            stream: Separates training (0) from evaluation draws.
        """
        world, rank = self.trainer.world_size, self.trainer.global_rank
        key = np.random.SeedSequence([self.seed, stream, batch_number]).generate_state(1)
        generator = torch.Generator(self.device).manual_seed(int(key[0]))
        total = num_scans * world
        shape = (total, self.vae.latent_channels, *self.latent_size)
        drawn = PathDraws(
            torch.randn(shape, generator=generator, device=self.device),
            sample_time(total, self.time_sampling, generator=generator),
            torch.randn(shape, generator=generator, device=self.device),
        )
        return PathDraws(*(values[rank::world] for values in drawn))

    @property
    def batch_number(self) -> int:
        """Training batches before this one, over all epochs and resumed runs."""
        return self.trainer.fit_loop.epoch_loop.total_batch_idx

    def vae_losses(
        self, image: Tensor, posterior: Posterior, reconstruction: Tensor
    ) -> dict[str, Tensor]:
        """L_AE: reconstruction, KL and the adversarial term; the discriminator stays untouched."""
        weights, parts = self.weights, {}
        if weights.reconstruction != 0:
            error = losses.reconstruction_loss(reconstruction, image, weights.reconstruction_norm)
            parts["reconstruction"] = weights.reconstruction * error
        if weights.kl != 0:
            parts["kl"] = weights.kl * posterior.kl().mean()
        if self.discriminator is not None and weights.adversarial != 0 and self._adversarial:
            with frozen(self.discriminator):
                logits = self.discriminator(reconstruction)
            parts["adversarial"] = weights.adversarial * losses.generator_loss(logits)
        if not parts.keys() & {"reconstruction", "adversarial"}:
            parts["reconstruction"] = _nothing_of(self.vae)
        return parts

    @property
    def _adversarial(self) -> bool:
        """Whether the adversarial losses count yet."""
        return self.global_step >= self.weights.adversarial_start

    def discriminator_losses(self, image: Tensor, reconstruction: Tensor) -> dict[str, Tensor]:
        """Hinge loss on scans and detached reconstructions; a plain 0 before its start.

        Before it, the discriminator gets gradients of 0, as if the loss were computed and had
        factor 0: under DDP each trained network must take part in each step.
        """
        if self.discriminator is None:
            return {}
        if self.weights.discriminator == 0 or not self._adversarial:
            return {"discriminator": _nothing_of(self.discriminator)}
        real = self.discriminator(image)
        fake = self.discriminator(reconstruction.detach())
        loss = losses.discriminator_loss(real, fake)
        return {"discriminator": self.weights.discriminator * loss}

    def vae_alignment_losses(
        self, latents: Tensor, features: Tensor | None, draws: PathDraws
    ) -> dict[str, Tensor]:
        """lambda1 L_align with running latent statistics: the gradient reaches the encoder."""
        if self.weights.vae_alignment == 0:
            return {}
        normalised = self.latent_norm.normalise(latents)
        noisy = self.interpolant.interpolate(normalised, draws.noise, draws.time)
        projected = self.sit.project_features(noisy, draws.time)
        return {"vae_alignment": self.weights.vae_alignment * self._aligned(projected, features)}

    def flow_losses(
        self, normalised: Tensor, features: Tensor | None, draws: PathDraws
    ) -> dict[str, Tensor]:
        """L_denoise + lambda2 L_align on normalised latents without gradient."""
        weights = self.weights
        noisy = self.interpolant.interpolate(normalised, draws.noise, draws.time)
        velocity, projected = self._predict(
            self.sit, noisy, draws.time, weights.denoising != 0, weights.sit_alignment != 0
        )
        parts = {}
        if velocity is None:
            parts["denoising"] = _nothing_of(self.sit)
        else:
            target = self.interpolant.target(normalised, draws.noise, draws.time)
            error = losses.flow_matching_loss(velocity, target).mean()
            parts["denoising"] = weights.denoising * error
        if projected is not None:
            parts["sit_alignment"] = weights.sit_alignment * self._aligned(projected, features)
        return parts

    @staticmethod
    def _predict(
        sit: VelocityNetwork, noisy: Tensor, time: Tensor, velocity: bool, features: bool
    ) -> tuple[Tensor | None, Tensor | None]:
        """Velocity and projected features, what is not asked for being None and not computed."""
        if velocity and features:
            return sit(noisy, time)
        if velocity:
            return sit.velocity(noisy, time), None
        return None, sit.project_features(noisy, time) if features else None

    def weigh_and_log(self, parts: dict[str, Tensor]) -> Tensor:
        """Sums weighted losses; logs the sum as ``train/loss``, each loss without its weight.

        Args:
            parts: Weighted losses under the names of their weights in :class:`LossWeights`.
        """
        total = torch.stack(list(parts.values())).sum()
        values = {**self.unweighted(parts), "loss": total.detach()}
        self.log_dict({f"train/{name}": value for name, value in values.items()})
        if self.guard is not None:
            self.guard.saw(values)
        return total

    def unweighted(self, parts: dict[str, Tensor]) -> dict[str, Tensor]:
        """The losses without their weights, detached; those of weight 0 are left out."""
        weights = {name: getattr(self.weights, name) for name in parts}
        return {n: value.detach() / weights[n] for n, value in parts.items() if weights[n] != 0}

    def _aligned(self, projected: Tensor, features: Tensor | None) -> Tensor:
        if features is None:
            raise ValueError(
                f"stage {self.stage} aligns with 3D features, but the batch holds no feature_grid"
            )
        return losses.alignment_loss(
            projected, features, skip_empty_cells=self.weights.skip_empty_cells
        ).mean()

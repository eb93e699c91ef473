"""Base of the baselines: a network that generates range images, trained on the scans of r3dpa."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any, Literal

import torch
from torch import Tensor, nn

from r3dpa.baselines.diffusion_paths import repaint
from r3dpa.baselines.efficient_unet import corner_angles
from r3dpa.baselines.generator import BaselineGenerator
from r3dpa.data.datasets import LidarBatch
from r3dpa.flow.interpolant import LINEAR, Interpolant
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.flow.solvers import Velocity
from r3dpa.modules.settings import OptimizerConfig, TimeSampling
from r3dpa.modules.stage import Stage
from r3dpa.nn.ema import update_average


class AveragedNetwork(nn.Module):
    """Averaged copy of a network, in evaluation mode.

    After optimiser step n, counted from 0, ``average = d average + (1 - d) weight`` with
    ``d = decay(n)``: 0 copies, 1 leaves the average alone. Buffers with fractions are averaged too.

    Args:
        network: Network to average; copied, never changed.
        decay: Decay by step.
    """

    def __init__(self, network: nn.Module, decay: Callable[[int], float]) -> None:
        super().__init__()
        self.network = copy.deepcopy(network).eval().requires_grad_(False)
        self.decay = decay

    def update(self, network: nn.Module, step: int) -> None:
        """Move the average towards the weights after ``step``."""
        decay = self.decay(step)
        if decay < 1:
            update_average(self.network, network, decay, buffers="decay")

    def train(self, mode: bool = True) -> AveragedNetwork:
        """Stay in evaluation mode."""
        return super().train(False)


class Baseline(Stage):
    """Base class of the baselines.

    A subclass names its ``stage`` and has its own ``training_step``. To be sampled by every
    command it has an ``interpolant`` between samples (time 0) and noise (time 1), a
    :meth:`velocity` on it, and :meth:`decode` where samples are latents. :meth:`settings` returns
    what else, beside the networks, rebuilds it from a checkpoint.

    Args:
        network: Network that is trained, from ``latent_shape`` to ``latent_shape``.
        latent_shape: Shape ``(C, h, w)`` of a sample, which is a range image unless a subclass
            overrides :meth:`decode`.
        optimizer: Optimiser settings.
        decay: Decay of the averaged weights by step; None for no average and no sampling.
        seed: Key of the training draws.
        time_sampling: Density of the training times.
    """

    interpolant: Interpolant = LINEAR
    published: SamplerConfig  #: sampler of the paper or of the released script

    def __init__(
        self,
        network: nn.Module,
        latent_shape: tuple[int, int, int],
        optimizer: OptimizerConfig,
        decay: Callable[[int], float] | None,
        seed: int,
        time_sampling: TimeSampling = "uniform",
    ) -> None:
        super().__init__(optimizer, seed, time_sampling)
        self.network, self.latent_shape = network, latent_shape
        self.ema: Any = None if decay is None else AveragedNetwork(network, decay)

    def velocity(self, network: nn.Module, x: Tensor, time: Tensor) -> Tensor:
        """Velocity on the interpolant of samples ``(B, C, h, w)`` at times ``(B,)``."""
        raise NotImplementedError

    def decode(self, latents: Tensor) -> Tensor:
        """Encoded range images ``(B, C, H, W)`` of samples ``(B, C, h, w)``."""
        return latents

    def encode(self, image: Tensor) -> Tensor:
        """Samples ``(B, C, h, w)`` of encoded range images ``(B, C, H, W)``."""
        return image

    def errors(self, network: nn.Module, data: Tensor, time: Tensor, noise: Tensor) -> Tensor:
        """Training loss ``(B,)`` of each sample ``(B, C, h, w)`` at a time ``(B,)``."""
        raise NotImplementedError

    def trainable(self) -> dict[str, nn.Module]:
        """Trained networks by name."""
        return {"network": self.network}

    def complete(
        self,
        velocity: Velocity,
        known: Tensor,
        mask: Tensor,
        draws: Iterator[Tensor],
        sampler: SamplerConfig,
        resamplings: int,
    ) -> Tensor:
        """Samples ``(B, C, h, w)`` that are ``known`` where the mask ``(B, 1, h, w)`` is 1."""
        path, steps = self.interpolant, sampler.steps
        samples = repaint(velocity, known, mask, draws, path, steps, resamplings)
        return torch.where(mask > 0, known, samples)  # a diffusion ends with some noise

    def settings(self) -> dict[str, Any]:
        """Plain values of the constructor arguments that sampling depends on, but for networks."""
        return {}

    # Starting and optimisation

    def setup(self, stage: str) -> None:
        """Check the data, and give a network with ``coords`` the ray angles of their pixels."""
        _, geometry = self.attach_scans()
        sensor = geometry.projection.sensor
        if geometry.codec.without_further() != geometry.codec:
            raise ValueError(
                f"stage {self.stage} generates no intensity_channel and no classes: set "
                "codec.intensity_channel of the data to false and codec.num_classes to 0"
            )
        wanted = (geometry.codec.channels, sensor.beams, sensor.columns)
        if self.image_shape() != wanted:
            raise ValueError(
                f"stage {self.stage} is built for images {self.image_shape()} (channels, rows, "
                f"columns), but sensor and codec of the data give {wanted}; give both the same"
            )
        for network in (self.network, getattr(self.ema, "network", None)):
            if isinstance(coords := getattr(network, "coords", None), Tensor):
                coords.copy_(corner_angles(geometry.projection))

    def image_shape(self) -> tuple[int, ...]:
        """Channels, rows and columns of the range images that it generates."""
        return self.latent_shape

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Step the optimiser, then the average, unless the step was skipped."""
        step = self.global_step
        super().optimizer_step(*args, **kwargs)
        if self.ema is not None and not self.step_skipped:
            self.ema.update(self.network, step)

    def log_loss(self, loss: Tensor) -> Tensor:
        """The loss of a training step, logged as ``train/loss``."""
        self.logged_losses = {"loss": loss.detach()}  # for StepGuard
        self.log("train/loss", loss.detach())
        return loss

    # Evaluation

    def validation_step(self, batch: LidarBatch, batch_idx: int) -> None:
        """Add the training loss of the averaged network on held-out scans to the means."""
        draws = self.draw_held_out(batch["index"])
        data = self.encode(batch["range_image"])
        noise = batch.get("noise", draws.noise)
        errors = self.errors(self.ema.network, data, draws.time, noise)
        self.held_out.update(batch["index"], loss=errors)

    test_step = validation_step

    def scene_generator(
        self, sampler: SamplerConfig, precision: Literal["fp32", "bf16"] = "fp32"
    ) -> BaselineGenerator:
        """Samples from the averaged weights."""
        return BaselineGenerator(self, self.ema.network, self.scan_geometry, sampler, precision)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the settings that sampling needs."""
        super().on_save_checkpoint(checkpoint)
        checkpoint["r3dpa"]["settings"] = self.settings()

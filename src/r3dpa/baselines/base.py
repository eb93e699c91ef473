"""Base of the baselines: a network that generates range images, trained on the scans of r3dpa."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any, Literal

import lightning as L
import torch
from torch import Tensor, nn

from r3dpa.baselines.diffusion import repaint
from r3dpa.baselines.efficient_unet import corner_angles
from r3dpa.baselines.generator import BaselineGenerator
from r3dpa.data.augmentation import Augmentation
from r3dpa.data.datasets import LidarBatch
from r3dpa.flow import Interpolant
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.flow.solvers import Velocity
from r3dpa.geometry import ScanGeometry
from r3dpa.modules import steps
from r3dpa.modules.checks import check_trainer, geometry_of
from r3dpa.modules.settings import OptimizerConfig, TimeSampling


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

    @torch.no_grad()
    def update(self, network: nn.Module, step: int) -> None:
        """Moves the average towards the weights after ``step``."""
        if (decay := self.decay(step)) == 1:
            return
        ours = [*self.network.parameters(), *self.network.buffers()]
        theirs = [*network.parameters(), *network.buffers()]
        for average, weight in zip(ours, theirs, strict=True):
            if decay == 0 or not average.is_floating_point():
                average.copy_(weight)
            else:
                average.lerp_(weight.to(average.dtype), 1 - decay)

    def train(self, mode: bool = True) -> AveragedNetwork:
        """Stays in evaluation mode."""
        return super().train(False)


class Baseline(L.LightningModule):
    """Base of the baselines, beside :class:`r3dpa.modules.GenerativeModule`.

    A subclass names its ``stage`` and has its own ``training_step``. To be sampled by every
    command it has an ``interpolant`` between samples (time 0) and noise (time 1), a
    :meth:`velocity` on it, and :meth:`decode` where samples are latents. What it needs beside
    its networks to be rebuilt from a checkpoint is in :meth:`settings`.

    Random numbers of a step are a function of ``(seed, batch, sample)`` alone.

    Args:
        network: Network that is trained, from ``latent_shape`` to ``latent_shape``.
        latent_shape: Size ``(C, h, w)`` of a sample; of a range image where :meth:`decode` is none.
        optimizer: Optimiser settings.
        decay: Decay of the averaged weights by step.
        seed: Key of the training draws.
        time_sampling: Density of the training times.
    """

    stage: str
    interpolant: Interpolant
    published: SamplerConfig  #: sampler of the paper or of the released script
    feature_source = None

    def __init__(
        self,
        network: nn.Module,
        latent_shape: tuple[int, int, int],
        optimizer: OptimizerConfig,
        decay: Callable[[int], float],
        seed: int,
        time_sampling: TimeSampling = "uniform",
    ) -> None:
        super().__init__()
        self.network, self.latent_shape = network, latent_shape
        self.ema = AveragedNetwork(network, decay)
        self.optimizer_config, self.seed, self.time_sampling = optimizer, seed, time_sampling
        self.geometry: ScanGeometry | None = None
        self.augmentation: Augmentation | None = None
        self.held_out = steps.HeldOutMeans()
        self.logged_losses: dict[str, Tensor] = {}  # of the last training batch
        self.step_skipped = False  # set by StepGuard
        self.loaded_step = 0

    # What a subclass is

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

    def complete(
        self,
        velocity: Velocity,
        known: Tensor,
        mask: Tensor,
        draws: Iterator[Tensor],
        sampler: SamplerConfig,
        resamplings: int,
        jump: int,
    ) -> Tensor:
        """Samples ``(B, C, h, w)`` that are ``known`` where the mask ``(B, 1, h, w)`` is 1."""
        path = self.interpolant
        return repaint(velocity, known, mask, draws, path, sampler.steps, resamplings, jump)

    def settings(self) -> dict[str, Any]:
        """Plain values of the constructor arguments that sampling depends on, but for networks."""
        return {}

    # Starting and optimisation

    def setup(self, stage: str) -> None:
        """Checks the data, and gives a network with ``coords`` the ray angles of their pixels."""
        check_trainer(self.trainer)
        datamodule = getattr(self.trainer, "datamodule", None)
        geometry = self.geometry = geometry_of(datamodule, self)
        self.augmentation = getattr(datamodule, "augmentation", None)
        sensor = geometry.projection.sensor
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

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """AdamW of the network."""
        return steps.adamw(self, {"network": self.network}, self.optimizer_config)

    configure_gradient_clipping = steps.clip_per_network
    on_before_optimizer_step = steps.set_learning_rate
    on_train_start = steps.fit_optimizer

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Steps the optimiser, then the average, unless the step was skipped."""
        step = self.global_step
        super().optimizer_step(*args, **kwargs)
        if not self.step_skipped:
            self.ema.update(self.network, step)

    def log_loss(self, loss: Tensor) -> Tensor:
        """The loss of a training step, logged as ``train/loss``."""
        self.logged_losses = {"loss": loss.detach()}  # for StepGuard
        self.log("train/loss", loss.detach())
        return loss

    # Evaluation

    @property
    def scan_geometry(self) -> ScanGeometry:
        """Geometry of the scans it trains on, known from setup or from a checkpoint."""
        if self.geometry is None:
            raise RuntimeError("the module has no scan geometry yet: set it up with a data module")
        return self.geometry

    def validation_step(self, batch: LidarBatch, batch_idx: int) -> None:
        """Adds the training loss of the averaged network on held-out scans to the means."""
        draws = steps.draw_held_out(self, batch["index"])
        data = self.encode(batch["range_image"])
        noise = batch.get("noise", draws.noise)
        errors = self.errors(self.ema.network, data, draws.time, noise)
        self.held_out.update(batch["index"], loss=errors)

    test_step = validation_step
    on_validation_epoch_end = on_test_epoch_end = steps.log_held_out

    def scene_generator(
        self, sampler: SamplerConfig, precision: Literal["fp32", "bf16"] = "fp32"
    ) -> BaselineGenerator:
        """Samples from the averaged weights."""
        return BaselineGenerator(self, self.ema.network, self.scan_geometry, sampler, precision)

    # Checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds stage, settings and scan geometry, enough to sample from."""
        steps.describe_stage(checkpoint, self.stage, self.interpolant.path)
        checkpoint["r3dpa"] |= {
            "geometry": self.scan_geometry.to_dict(),
            "augmentation": None if self.augmentation is None else asdict(self.augmentation),
            "settings": self.settings(),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuses the checkpoint of another stage or of other range images."""
        steps.check_resumed(self, checkpoint)

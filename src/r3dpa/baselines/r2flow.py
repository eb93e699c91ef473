"""R2Flow: rectified flow of range images, its straightening and its distillation."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from r3dpa.baselines.base import Baseline
from r3dpa.baselines.diffusion import Norm, sample_errors
from r3dpa.baselines.r2dm import RECIPE, ema_decay_at
from r3dpa.checkpoints import load_into, read_checkpoint
from r3dpa.data.datasets import LidarBatch
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.modules.settings import OptimizerConfig, TimeSampling
from r3dpa.modules.stage import networks_as_settings


class R2Flow(Baseline):
    """R2Flow: velocity of the straight path between range images and noise, in pixel space.

    Trained on scans it is the 1-rectified flow. Trained on pairs of noise and the scene that a
    trained flow makes of it, see :class:`r3dpa.baselines.ReflowPairs`, it becomes straighter
    (2-rectified flow); with ``num_steps`` it learns the velocities at the times of these Euler
    steps alone (timestep distillation).

    Source: Nakashima et al., "Fast LiDAR Data Generation with Rectified Flows" (ICRA 2025).

    Args:
        network: :class:`~r3dpa.baselines.HDiT`, :class:`~r3dpa.baselines.ADMUNet` or
            :class:`~r3dpa.baselines.EfficientUNet`.
        norm: Error of the velocity, see :func:`sample_errors`.
        num_steps: Euler steps to distil to; None trains all times.
        init_from: Checkpoint of the previous flow; training starts from its averaged weights.
        optimizer: Optimiser settings.
        time_sampling: Density of the training times; ``u_shaped`` for pairs.
        ema_decay: Decay of the averaged weights.
        ema_every: Steps between two updates of the average.
        ema_after: Steps until which the average is a copy.
        seed: Key of the training draws.

    Raises:
        ValueError: If ``num_steps`` is below 1.
    """

    stage = "r2flow"
    published = SamplerConfig("euler", 256)

    def __init__(
        self,
        network: nn.Module,
        norm: Norm = "l2",
        num_steps: int | None = None,
        init_from: str | None = None,
        optimizer: OptimizerConfig = RECIPE,
        time_sampling: TimeSampling = "uniform",
        ema_decay: float = 0.995,
        ema_every: int = 10,
        ema_after: int = 10_000,
        seed: int = 0,
    ) -> None:
        if num_steps is not None and num_steps < 1:
            raise ValueError(f"num_steps must be at least 1, got {num_steps}")
        decay = partial(ema_decay_at, decay=ema_decay, every=ema_every, after=ema_after)
        sized: Any = network
        shape = (sized.in_channels, *sized.resolution)
        super().__init__(network, shape, optimizer, decay, seed, time_sampling)
        with networks_as_settings():
            self.save_hyperparameters()
        self.norm, self.num_steps, self.init_from = norm, num_steps, init_from
        if num_steps is not None:
            self.published = SamplerConfig("euler", num_steps)

    def settings(self) -> dict[str, Any]:
        """Number of steps that it was distilled to."""
        return {"num_steps": self.num_steps}

    def on_fit_start(self) -> None:
        """Load the previous flow, unless this run resumes from a checkpoint."""
        if self.init_from is not None and not self.loaded_step:
            load_into({"ema_network": self.network}, read_checkpoint(self.init_from), self.stage)
            self.ema.network.load_state_dict(self.network.state_dict())

    def velocity(self, network: nn.Module, x: Tensor, time: Tensor) -> Tensor:
        """Output of the network."""
        return network(x, time)

    def errors(self, network: nn.Module, data: Tensor, time: Tensor, noise: Tensor) -> Tensor:
        """Error ``(B,)`` of the velocity at the times, or at those that they are rounded to."""
        time = distilled_times(time, self.num_steps)
        predicted = network(self.interpolant.interpolate(data, noise, time), time)
        return sample_errors(predicted, self.interpolant.target(data, noise, time), self.norm)

    def training_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """One step on images ``(B, C, H, W)``, with the noise of the batch if it is of pairs."""
        image = batch["range_image"]
        draws = self.draw_path(len(image))
        noise = batch.get("noise", draws.noise)
        return self.log_loss(self.errors(self.network, image, draws.time, noise).mean())


def distilled_times(time: Tensor, num_steps: int | None) -> Tensor:
    """Times at which an Euler sampler of ``num_steps`` steps starts its steps, or all times.

    ``1 - floor(u k) / k`` for uniform draws u in [0, 1): with one step always 1, pure noise.
    """
    return time if num_steps is None else 1 - torch.floor(time * num_steps) / num_steps

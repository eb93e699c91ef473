"""R2DM: Gaussian diffusion of range and reflectance images."""

from __future__ import annotations

from functools import partial
from typing import Any

from torch import Tensor, nn

from r3dpa.baselines.base import Baseline
from r3dpa.baselines.diffusion import (
    Norm,
    Prediction,
    data_of,
    loss_weight,
    sample_errors,
    target_of,
    weighted_mean,
)
from r3dpa.baselines.diffusion_paths import DiffusionPath, Schedule
from r3dpa.baselines.efficient_unet import EfficientUNet
from r3dpa.data.datasets import LidarBatch
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.flow.times import per_sample
from r3dpa.modules.settings import OptimizerConfig
from r3dpa.modules.stage import networks_as_settings

RECIPE = OptimizerConfig(betas=(0.9, 0.99), weight_decay=0.0, warmup_steps=10_000, cosine=True)


class R2DM(Baseline):
    """R2DM: pixel-space diffusion in continuous time, conditioned on the log-SNR.

    Source: Nakashima and Kurazume, "LiDAR Data Synthesis with Denoising Diffusion Probabilistic
    Models" (ICRA 2024).

    Args:
        network: Efficient U-Net of the images.
        prediction: What the network predicts: the noise ``eps``, ``v`` or the data ``x_0``.
        schedule: Log-SNR by time, see :class:`DiffusionPath`.
        shift: Added to the log-SNR.
        clip: Clip the data that the network predicts to [-1, 1] when sampling.
        norm: Error of the prediction, see :func:`sample_errors`.
        gamma: Bound of the min-SNR weights; None for the plain SNR.
        official_min_snr: Weight as the released code does, see :func:`weighted_mean`.
        optimizer: Optimiser settings.
        ema_decay: Decay of the averaged weights.
        ema_every: Steps between two updates of the average.
        ema_after: Steps until which the average is a copy.
        seed: Key of the training draws.
    """

    stage = "r2dm"
    published = SamplerConfig("ddpm", 256)

    def __init__(
        self,
        network: EfficientUNet,
        prediction: Prediction = "eps",
        schedule: Schedule = "cosine",
        shift: float = 0.0,
        clip: bool = True,
        norm: Norm = "l2",
        gamma: float | None = 5.0,
        official_min_snr: bool = False,
        optimizer: OptimizerConfig = RECIPE,
        ema_decay: float = 0.995,
        ema_every: int = 10,
        ema_after: int = 10_000,
        seed: int = 0,
    ) -> None:
        decay = partial(ema_decay_at, decay=ema_decay, every=ema_every, after=ema_after)
        shape = (network.in_channels, *network.resolution)
        super().__init__(network, shape, optimizer, decay, seed)
        with networks_as_settings():
            self.save_hyperparameters()
        self.interpolant: DiffusionPath = DiffusionPath(schedule=schedule, shift=shift)
        self.prediction, self.clip, self.norm = prediction, clip, norm
        self.gamma, self.official_min_snr = gamma, official_min_snr

    def settings(self) -> dict[str, Any]:
        """Prediction, schedule and clipping."""
        return {
            "prediction": self.prediction,
            "schedule": self.interpolant.schedule,
            "shift": self.interpolant.shift,
            "clip": self.clip,
        }

    def denoise(self, network: nn.Module, x: Tensor, time: Tensor) -> Tensor:
        """Clean data ``(B, C, H, W)`` that the network sees in samples at times ``(B,)``."""
        alpha, sigma, *_ = self.interpolant.coefficients(per_sample(time, x))
        prediction = network(x, self.interpolant.log_snr(time)).float()
        data = data_of(prediction, self.prediction, x, alpha, sigma)
        return data.clamp(-1, 1) if self.clip else data

    def velocity(self, network: nn.Module, x: Tensor, time: Tensor) -> Tensor:
        """Velocity on the path, from :meth:`denoise`."""
        return self.interpolant.velocity(self.denoise(network, x, time), x, time)

    def errors(self, network: nn.Module, data: Tensor, time: Tensor, noise: Tensor) -> Tensor:
        """Unweighted error ``(B,)`` of the prediction."""
        alpha, sigma, *_ = self.interpolant.coefficients(per_sample(time, data))
        prediction = network(alpha * data + sigma * noise, self.interpolant.log_snr(time))
        target = target_of(self.prediction, data, noise, alpha, sigma)
        return sample_errors(prediction, target, self.norm)

    def training_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """One step on images ``(B, C, H, W)`` of range and reflectance."""
        image = batch["range_image"]
        draws = self.draw_path(len(image))
        errors = self.errors(self.network, image, draws.time, draws.noise)
        weights = loss_weight(self.interpolant.log_snr(draws.time), self.prediction, self.gamma)
        return self.log_loss(weighted_mean(errors, weights, self.official_min_snr))


def ema_decay_at(step: int, decay: float, every: int, after: int) -> float:
    """Decay of the average of R2DM and R2Flow at an optimiser step, counted from 0.

    Every ``every``-th step counts. Until ``after`` they copy, later the decay rises to ``decay``
    as ``1 - (n + 1)^(-2/3)`` with the number n of steps since.

    Source: ema-pytorch 0.7.7, as both repositories use it.
    """
    if step % every and step:
        return 1.0
    if step <= after:
        return 0.0
    return min(decay, 1 - (step - after + 1) ** (-2 / 3))

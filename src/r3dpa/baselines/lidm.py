"""LiDM: diffusion in the latents of a vector-quantised autoencoder, in 1000 steps.

Time t in [0, 1] stands for step ``1000 t`` of the official code. Letters: B batch, C latent
channels, H x W image size, h x w latent size.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from r3dpa.baselines.base import Baseline
from r3dpa.baselines.diffusion import Norm, sample_errors
from r3dpa.baselines.diffusion_paths import StepPath, inpaint
from r3dpa.baselines.lidm_networks import LiDMUNet, VQAutoencoder
from r3dpa.checkpoints import load_into, read_checkpoint
from r3dpa.data.datasets import LidarBatch
from r3dpa.flow import Interpolant
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.flow.sde import ancestral
from r3dpa.flow.solvers import Velocity
from r3dpa.flow.times import per_sample
from r3dpa.modules.settings import OptimizerConfig
from r3dpa.modules.stage import networks_as_settings


@dataclass(frozen=True)
class ReleasedDDIM(SamplerConfig):
    """DDIM on the steps of the released code, see :func:`released_times`; ``ddpm`` adds noise."""

    def solve(
        self,
        velocity: Velocity,
        noise: Tensor,
        draws: torch.Generator | Iterable[Tensor],
        interpolant: Interpolant,
    ) -> Tensor:
        """Solve as :meth:`SamplerConfig.solve` does; the list determines the number of steps."""
        if self.solver not in ("ddpm", "ddim") or self.shift != 1:  # not of the released code
            return super().solve(velocity, noise, draws, interpolant)
        times = released_times(self.steps)
        eta = self.eta if self.solver == "ddpm" else 0.0
        return ancestral(velocity, noise, times, draws, eta=eta, interpolant=interpolant)


def released_times(num: int, num_steps: int = 1000) -> Tensor:
    """Times of DDIM in the released code, float64, largest first and 0 last.

    They are every ``floor(1000 / num)``-th step plus 1: more than ``num`` where it does not divide
    1000 (16 gives 17).

    Raises:
        ValueError: If the list would reach beyond the last step, as for 3 or 256 steps.
    """
    chosen = torch.arange(0, num_steps, max(num_steps // num, 1)) + 1
    if chosen[-1] >= num_steps:
        raise ValueError(
            f"DDIM of LiDM cannot take {num} of {num_steps} steps: its list would end at step "
            f"{int(chosen[-1])}; give a divisor of {num_steps}"
        )
    return torch.cat([chosen.flip(0), torch.zeros(1)]).double() / num_steps


class LiDM(Baseline):
    """LiDM: diffusion on the latents of a frozen first stage, before their quantisation.

    Source: Ran, Guizilini, Wang, "Towards Realistic Scene Generation with LiDAR Diffusion Models"
    (CVPR 2024). R3DPA's table I samples it with 250 steps.

    Args:
        network: U-Net of the latents; with a position bias it is the table's "LiDM + APE".
        first_stage: Autoencoder; its weights come from ``init_from`` and stay fixed.
        init_from: Checkpoint of stage ``lidm_first_stage``, or a converted one of LiDM.
        norm: Error of the noise, see :func:`sample_errors`.
        first_beta: Variance of the first step.
        last_beta: Variance of the last step.
        optimizer: Optimiser settings; the released rate is 1e-6 times the batch size.
        ema_decay: Largest decay of the averaged weights.
        seed: Key of the training draws.
    """

    stage = "lidm"
    published = ReleasedDDIM("ddpm", 250)

    def __init__(
        self,
        network: LiDMUNet,
        first_stage: VQAutoencoder,
        init_from: str | None = None,
        norm: Norm = "l2",
        first_beta: float = 0.0015,
        last_beta: float = 0.0195,
        optimizer: OptimizerConfig = OptimizerConfig(lr=1.6e-5, weight_decay=0.01),
        ema_decay: float = 0.9999,
        seed: int = 0,
    ) -> None:
        shape = (network.in_channels, *network.input_size)
        super().__init__(
            network, shape, optimizer, lambda step: min(ema_decay, (2 + step) / (11 + step)), seed
        )
        with networks_as_settings():
            self.save_hyperparameters()
        if first_stage.latent_channels != network.in_channels:
            raise ValueError(
                f"network.in_channels is {network.in_channels}, but the first stage has "
                f"{first_stage.latent_channels} latent channels; give both the same number"
            )
        self.first_stage = first_stage.eval().requires_grad_(False)
        self.interpolant: StepPath = StepPath(first_beta=first_beta, last_beta=last_beta)
        self.norm, self.init_from = norm, init_from

    def settings(self) -> dict[str, Any]:
        """Schedule of the steps."""
        return {name: getattr(self.interpolant, name) for name in ("first_beta", "last_beta")}

    def image_shape(self) -> tuple[int, ...]:
        """Channels, rows and columns of the images of the first stage."""
        (_, rows, columns), stride = self.latent_shape, self.first_stage.stride
        return self.first_stage.in_channels, rows * stride[0], columns * stride[1]

    def on_fit_start(self) -> None:
        """Load the first stage, unless this run resumes from a checkpoint."""
        if self.loaded_step:
            return
        if self.init_from is None:
            raise ValueError(
                "stage lidm trains on the latents of a trained autoencoder: give "
                "--model.init_args.init_from a checkpoint of stage lidm_first_stage, or a "
                "converted one of LiDM"
            )
        before = read_checkpoint(self.init_from)
        name = "first_stage" if "first_stage" in before.networks else "network"
        load_into({name: self.first_stage}, before, self.stage)

    def train(self, mode: bool = True) -> LiDM:
        """Keep the first stage in evaluation mode."""
        super().train(mode)
        self.first_stage.eval()
        return self

    @torch.no_grad()
    def encode(self, image: Tensor) -> Tensor:
        """Latents ``(B, C, h, w)`` of encoded range images ``(B, 1, H, W)``."""
        return self.first_stage.encode(image).mean

    def decode(self, latents: Tensor) -> Tensor:
        """Encoded range images ``(B, 1, H, W)`` of latents, which are quantised."""
        return self.first_stage.decode(latents)

    def complete(
        self,
        velocity: Velocity,
        known: Tensor,
        mask: Tensor,
        draws: Iterator[Tensor],
        sampler: SamplerConfig,
        resamplings: int,
    ) -> Tensor:
        """Complete latents by :func:`inpaint`, as released: without resampling."""
        times = released_times(sampler.steps)
        return inpaint(velocity, next(draws), known, mask, times, draws, self.interpolant)

    def velocity(self, network: nn.Module, x: Tensor, time: Tensor) -> Tensor:
        """Velocity on the path, from the noise that the network predicts."""
        alpha, sigma, *_ = self.interpolant.coefficients(per_sample(time, x))
        noise = network(x, self.interpolant.step_of(time)).float()
        return self.interpolant.target((x - sigma * noise) / alpha, noise, time)

    def errors(self, network: nn.Module, data: Tensor, time: Tensor, noise: Tensor) -> Tensor:
        """Error ``(B,)`` of the noise at the steps that times in [0, 1) belong to."""
        step = (time * self.interpolant.num_steps).floor()
        noisy = self.interpolant.interpolate(data, noise, step / self.interpolant.num_steps)
        return sample_errors(network(noisy, step), noise, self.norm)

    def training_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """One step on encoded range images ``(B, 1, H, W)``."""
        latents = self.encode(batch["range_image"])
        draws = self.draw_path(len(latents))
        return self.log_loss(self.errors(self.network, latents, draws.time, draws.noise).mean())

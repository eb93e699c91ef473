"""LiDM: diffusion in the latents of a vector-quantised autoencoder, in 1000 steps.

Time t in [0, 1] stands for step ``1000 t`` of the official code. Letters: B batch, C latent
channels, H x W image size, h x w latent size.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.baselines.base import Baseline
from r3dpa.baselines.diffusion import DiffusionPath, sample_errors
from r3dpa.baselines.lidm_networks import LiDMUNet, VQAutoencoder
from r3dpa.checkpoints import load_into, read_checkpoint
from r3dpa.data.datasets import LidarBatch
from r3dpa.flow import Interpolant
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.flow.sde import ancestral, ancestral_step
from r3dpa.flow.solvers import Velocity
from r3dpa.flow.times import batch_time, per_sample, step_pairs
from r3dpa.modules import steps
from r3dpa.modules.settings import OptimizerConfig

_STEPS = 1000
_FIRST_BETA, _LAST_BETA = 0.0015, 0.0195


@dataclass(frozen=True)
class StepPath(DiffusionPath):
    """Path of a diffusion in discrete steps; between two steps the log-SNR is interpolated.

    The roots of the variances of the steps rise linearly, ``linear`` in LDM and LiDM. The first
    step is at time 0 and not free of noise.
    """

    first_beta: float = _FIRST_BETA
    last_beta: float = _LAST_BETA
    num_steps: int = _STEPS

    @cached_property
    def betas(self) -> Tensor:
        """Variances ``(num_steps,)`` of the steps, float64."""
        ends = self.first_beta**0.5, self.last_beta**0.5
        return torch.linspace(*ends, self.num_steps, dtype=torch.float64).square()

    @cached_property
    def signal(self) -> Tensor:
        """``alpha^2`` of each step ``(num_steps,)``, float64."""
        return (1 - self.betas).cumprod(0)

    def step_of(self, time: Tensor) -> Tensor:
        """Step of a time, with a fraction; times of whole steps have none."""
        step = (time * self.num_steps).clamp(0, self.num_steps - 1)
        return torch.where((step - step.round()).abs() < 1e-3, step.round(), step)

    def log_snr(self, time: Tensor) -> Tensor:
        """Log signal-to-noise ratio at times in [0, 1] of any shape."""
        step, table = self.step_of(time), self.signal.logit().to(time.device)
        low = step.floor().long().clamp(max=self.num_steps - 2)
        return torch.lerp(table[low], table[low + 1], (step - low).double()).to(time.dtype)

    def _rate(self, time: Tensor) -> Tensor:
        table = self.signal.logit().to(time.device).diff() * self.num_steps
        low = self.step_of(time).floor().long().clamp(max=self.num_steps - 2)
        return table[low].to(time.dtype)

    def bound_weights(self) -> Tensor:
        """Weights ``(num_steps,)`` of the squared errors in the bound of the likelihood."""
        before = F.pad(self.signal[:-1], (1, 0), value=1.0)
        posterior = self.betas * (1 - before) / (1 - self.signal)
        weights = self.betas.square() / (2 * posterior * (1 - self.betas) * (1 - self.signal))
        weights[0] = weights[1]
        return weights


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
        """As :meth:`SamplerConfig.solve`; the number of steps is that of the list."""
        times = released_times(self.steps)
        eta = self.eta if self.solver == "ddpm" else 0.0
        return ancestral(velocity, noise, times, draws, eta=eta, interpolant=interpolant)


def released_times(num: int, num_steps: int = _STEPS) -> Tensor:
    """Times of DDIM in the released code, float64, largest first and 0 last.

    They are every ``floor(1000 / num)``-th step plus 1: more than ``num`` where it does not divide
    1000 (16 gives 17).

    Raises:
        ValueError: If the list would reach beyond the last step, as for 3 or 256 steps.
    """
    chosen = torch.arange(0, num_steps, num_steps // num) + 1
    if chosen[-1] >= num_steps:
        raise ValueError(
            f"DDIM of LiDM cannot take {num} of {num_steps} steps: its list would end at step "
            f"{int(chosen[-1])}; give a divisor of {num_steps}"
        )
    return torch.cat([chosen.flip(0), torch.zeros(1)]).double() / num_steps


@torch.no_grad()
def inpaint(
    velocity: Velocity,
    x: Tensor,
    known: Tensor,
    mask: Tensor,
    times: Tensor,
    draws: Iterator[Tensor],
    path: Interpolant,
) -> Tensor:
    """DDIM without noise, whose state is overwritten before each step where the mask is 1.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
        x: ``(B, ...)`` Gaussian noise, the state at the first time.
        known: ``(B, ...)`` data.
        mask: Broadcast to ``known``; 1 where it is kept.
        times: ``(T,)`` decreasing times.
        draws: T - 1 Gaussian draws ``(B, ...)`` for the known part.
        path: Path of the velocity.
    """
    for now, then in step_pairs(times):
        here, there = batch_time(now, x), batch_time(then, x)
        x = mask * path.interpolate(known, next(draws), here) + (1 - mask) * x
        data = path.denoise(velocity(x, here), x, here)
        x = ancestral_step(data, x, here, there, None, interpolant=path)
    return x


class LiDM(Baseline):
    """LiDM: diffusion on the latents of a frozen first stage, before their quantisation.

    Source: Ran, Guizilini, Wang, "Towards Realistic Scene Generation with LiDAR Diffusion Models"
    (CVPR 2024). R3DPA's table I samples it with 250 steps.

    Args:
        network: U-Net of the latents; with a position bias it is the table's "LiDM + APE".
        first_stage: Autoencoder; its weights come from ``init_from`` and stay fixed.
        init_from: Checkpoint of stage ``lidm_first_stage``, or a converted one of LiDM.
        norm: ``l2`` or ``l1`` error of the noise.
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
        norm: Literal["l2", "l1"] = "l2",
        first_beta: float = _FIRST_BETA,
        last_beta: float = _LAST_BETA,
        optimizer: OptimizerConfig = OptimizerConfig(lr=1.6e-5, weight_decay=0.01),
        ema_decay: float = 0.9999,
        seed: int = 0,
    ) -> None:
        def decay(step: int) -> float:
            return min(ema_decay, (2 + step) / (11 + step))

        shape = (network.in_channels, *network.input_size)
        super().__init__(network, shape, optimizer, decay, seed)
        with steps.networks_as_settings():
            self.save_hyperparameters()
        if first_stage.latent_channels != network.in_channels:
            raise ValueError(
                f"network.in_channels is {network.in_channels}, but the first stage has "
                f"{first_stage.latent_channels} latent channels; give both the same number"
            )
        self.first_stage = first_stage.eval().requires_grad_(False)
        self.interpolant: StepPath = StepPath(first_beta=first_beta, last_beta=last_beta)
        self.norm, self.init_from, self._has_weights = norm, init_from, False

    def settings(self) -> dict[str, Any]:
        """Schedule of the steps."""
        path = self.interpolant
        return {"first_beta": path.first_beta, "last_beta": path.last_beta}

    def image_shape(self) -> tuple[int, ...]:
        """Channels, rows and columns of the images of the first stage."""
        (_, rows, columns), stride = self.latent_shape, self.first_stage.stride
        return self.first_stage.in_channels, rows * stride[0], columns * stride[1]

    def on_fit_start(self) -> None:
        """Loads the first stage, unless this run goes on from a checkpoint of its own."""
        if self._has_weights:
            return
        if self.init_from is None:
            raise ValueError(
                "stage lidm trains on the latents of a trained autoencoder: give model.init_from "
                "a checkpoint of stage lidm_first_stage, or a converted one of LiDM"
            )
        before = read_checkpoint(self.init_from)
        name = "first_stage" if "first_stage" in before.networks else "network"
        load_into({name: self.first_stage}, before, self.stage)

    def train(self, mode: bool = True) -> LiDM:
        """Leaves the first stage in evaluation mode."""
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
        resamplings: int = 1,
        jump: int = 1,
    ) -> Tensor:
        """Completes latents by :func:`inpaint`, as released: without resampling."""
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
        return sample_errors(network(noisy, step).float(), noise, self.norm)

    def training_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """One step on encoded range images ``(B, 1, H, W)``."""
        latents = self.encode(batch["range_image"])
        draws = steps.draw_path(self, len(latents))
        return self.log_loss(self.errors(self.network, latents, draws.time, draws.noise).mean())

    def validation_step(self, batch: LidarBatch, batch_idx: int) -> None:
        """Adds held-out scans to the means: the loss, and its part of the likelihood bound."""
        draws, latents = (
            steps.draw_held_out(self, batch["index"]),
            self.encode(batch["range_image"]),
        )
        errors = self.errors(self.ema.network, latents, draws.time, draws.noise)
        self.held_out.update(batch["index"], loss=errors, bound=self.bound(errors, draws.time))

    test_step = validation_step

    def bound(self, errors: Tensor, time: Tensor) -> Tensor:
        """Weighted errors ``(B,)`` at times ``(B,)``, LiDM's ``loss_vlb``."""
        step = (time * self.interpolant.num_steps).long()
        return self.interpolant.bound_weights().to(errors)[step] * errors

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuses the checkpoint of another stage or of other range images."""
        super().on_load_checkpoint(checkpoint)
        self._has_weights = True

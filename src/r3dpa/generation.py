"""From noise to scenes: solver over the SiT, denormalised latents, VAE decoder, range images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from r3dpa.flow import (
    CountingVelocity,
    Interpolant,
    euler,
    euler_maruyama,
    heun,
    ode_times,
    sde_times,
)
from r3dpa.geometry import ScanGeometry
from r3dpa.nn import VAE, LatentNorm, SiT

__all__ = ["SamplerConfig", "SceneBatch", "SceneGenerator"]

_ODE_SOLVERS = {"euler": euler, "heun": heun}


@dataclass(frozen=True)
class SamplerConfig:
    """How noise becomes latents.

    Args:
        solver: ``euler`` and ``heun`` solve the ODE, ``euler_maruyama`` the SDE.
        steps: Solver steps.
        sde_last_time: Time from which the SDE takes its last, noise-free step.
        sde_last: ``denoise``, or ``mean`` as in the official sampler.

    Raises:
        ValueError: If the solver is unknown.
    """

    solver: Literal["euler", "heun", "euler_maruyama"] = "euler_maruyama"
    steps: int = 256
    sde_last_time: float = 0.04
    sde_last: Literal["denoise", "mean"] = "denoise"

    def __post_init__(self) -> None:
        """Check the solver's name."""
        if self.solver not in (*_ODE_SOLVERS, "euler_maruyama"):
            raise ValueError(f"solver must be euler, heun or euler_maruyama, got {self.solver!r}")


class SceneBatch(NamedTuple):
    """Generated scenes.

    ``range_m`` is ``(B, H, W)`` float32 metres with -1 where there is no return, ``latents`` the
    normalised ``(B, C, h, w)`` latents, ``nfe`` the network evaluations per scene.
    """

    range_m: Tensor
    latents: Tensor
    nfe: int


class SceneGenerator:
    """Draws scenes from a SiT and decodes them.

    The random numbers of a scene are a function of (seed, index) alone and are drawn on the CPU:
    a scene is the same whatever the batch size and, up to rounding, the device.

    Args:
        vae: Decoder of the latents.
        sit: Velocity network, averaged weights as a rule.
        latent_norm: Statistics of the latents the SiT was trained on.
        geometry: Projection and range encoding of the training data.
        sampler: Solver and steps.
        path: Interpolant that the SiT was trained on.
        precision: ``bf16`` runs the networks under autocast; state and solver stay float32.

    Raises:
        ValueError: If the latent statistics were never fitted.
    """

    def __init__(
        self,
        vae: VAE,
        sit: SiT,
        latent_norm: LatentNorm,
        geometry: ScanGeometry,
        sampler: SamplerConfig = SamplerConfig(),
        path: Literal["linear", "cosine"] = "linear",
        precision: Literal["fp32", "bf16"] = "fp32",
    ) -> None:
        if not latent_norm.fitted:
            raise ValueError(
                "the latent statistics were never fitted, so latents cannot be denormalised; "
                "sample from a checkpoint of stage joint or flow_matching"
            )
        self.vae = vae.eval()
        self.sit = sit.eval()
        self.latent_norm = latent_norm.eval()
        self.geometry = geometry
        self.sampler = sampler
        self.interpolant = Interpolant(path)
        self.precision = precision

    @property
    def device(self) -> torch.device:
        """Where the networks are."""
        return next(self.sit.parameters()).device

    @torch.inference_mode()
    def generate(self, indices: Sequence[int], seed: int = 0) -> SceneBatch:
        """Draws one scene per index.

        Args:
            indices: Numbers of the scenes.
            seed: Number of the collection.

        Returns:
            Scenes on the networks' device.
        """
        generators = [_scene_random(seed, index) for index in indices]
        shape = (self.sit.in_channels, *self.sit.input_size)

        def draws() -> Iterator[Tensor]:
            while True:
                noise = [torch.randn(shape, generator=generator) for generator in generators]
                yield torch.stack(noise).to(self.device)

        velocity, noise = CountingVelocity(self._velocity), draws()
        latents = self._solve(velocity, next(noise), noise)
        with self._autocast():
            image = self.vae.decode(self.latent_norm.denormalise(latents))
        range_m = self.geometry.codec.decode(image[:, 0].float(), self.geometry.projection.sensor)
        return SceneBatch(range_m, latents, velocity.nfe)

    def _solve(self, velocity: CountingVelocity, noise: Tensor, draws: Iterator[Tensor]) -> Tensor:
        sampler = self.sampler
        if sampler.solver == "euler_maruyama":
            return euler_maruyama(
                velocity,
                noise,
                sde_times(sampler.steps, sampler.sde_last_time),
                draws,
                interpolant=self.interpolant,
                last=sampler.sde_last,
            )
        return _ODE_SOLVERS[sampler.solver](velocity, noise, ode_times(sampler.steps))

    def _velocity(self, latents: Tensor, time: Tensor) -> Tensor:
        with self._autocast():
            return self.sit.velocity(latents, time).float()

    def _autocast(self) -> torch.autocast:
        return torch.autocast(
            self.device.type, dtype=torch.bfloat16, enabled=self.precision == "bf16"
        )


def _scene_random(seed: int, index: int) -> torch.Generator:
    key = np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(key[0]) >> 1)

"""Velocity networks at the times of a schedule, guided and compiled as requested.

Letters: B batch, C latent channels, h x w latent size, T times.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import cast

import torch
from torch import Tensor

from r3dpa.flow.autoguidance import PerturbedAttention, extrapolated
from r3dpa.nn import AverageVelocitySiT, SiT, VelocityNetwork
from r3dpa.nn.perturbed_attention import velocity_and_perturbed


@dataclass(frozen=True)
class Autoguidance:
    """Guidance away from a weaker model, see :func:`r3dpa.flow.autoguided`.

    ``weak`` and ``latent_shift`` ``(C,)`` are on the device of the other networks; the latents of
    the weak model are ``latent_scale * latents + latent_shift``.
    """

    weak: VelocityNetwork
    scale: float
    interval: tuple[float, float] = (0.0, 1.0)
    latent_scale: float = 1.0
    latent_shift: Tensor = field(default_factory=lambda: torch.zeros(1))


class ScheduledVelocity:
    """A network as the velocity function of a solver, at times known in advance.

    All samples of a call have the same time. The k-th call after :meth:`restart` takes row k of
    the precomputed modulations, so that no value of a time is read back from a GPU.

    Args:
        sit: Velocity network.
        compile: Compile its evaluations.
        graphs: Replay them as CUDA graphs.
        guidance: Perturbed-attention guidance of velocities. Average velocities are never guided,
            though their training may have been.

    Attributes:
        num_times: Times of the schedule.
    """

    def __init__(
        self,
        sit: VelocityNetwork,
        compile: bool,
        graphs: bool,
        guidance: PerturbedAttention | None = None,
    ) -> None:
        if guidance is not None:
            check_guidance(guidance, sit)
        self.sit, self.guidance = sit, guidance
        self.num_times = 0
        self._averages = False
        self._table: Tensor | None = None
        self._rows: Iterator[Tensor] = iter(())
        self._graphs = graphs
        self._velocity_at = self._evaluate_velocity
        self._average_velocity_at = self._evaluate_average
        if compile:
            mode = "reduce-overhead" if graphs else None
            self._velocity_at = torch.compile(self._velocity_at, dynamic=False, mode=mode)
            self._average_velocity_at = torch.compile(
                self._average_velocity_at, dynamic=False, mode=mode
            )

    @property
    def evaluations(self) -> int:
        """Network evaluations per scene, two of each guided velocity."""
        guided = self.guidance is not None and not self._averages
        return self.num_times * (2 if guided else 1)

    def schedule(self, times: Tensor, target: Tensor | None = None) -> None:
        """Precompute the modulations of times ``(T,)``, with targets of average velocities."""
        self.num_times, self._averages = len(times), target is not None
        if target is not None:
            self._table = cast(AverageVelocitySiT, self.sit).average_modulations(times, target)
        else:
            self._table = self.sit.modulations(times) if self.num_times else None

    def restart(self) -> None:
        """Start from the first time again."""
        self._rows = iter(() if self._table is None else self._table.split(1))

    def __call__(self, latents: Tensor, time: Tensor, target: Tensor | None = None) -> Tensor:
        """Velocity ``(B, C, h, w)`` float32 at the next time, or the average until a target."""
        evaluate = self._velocity_at if target is None else self._average_velocity_at
        velocity = evaluate(latents, next(self._rows))
        return velocity.clone() if self._graphs else velocity  # a replay writes to one place

    def _evaluate_velocity(self, latents: Tensor, row: Tensor) -> Tensor:
        if self.guidance is None:
            return self.sit.velocity_at(latents, row)
        return guided_velocity_at(cast(SiT, self.sit), latents, row, self.guidance)

    def _evaluate_average(self, latents: Tensor, row: Tensor) -> Tensor:
        return cast(AverageVelocitySiT, self.sit).average_velocity_at(latents, row)


def guided_velocity_at(
    sit: SiT, latents: Tensor, modulations: Tensor, guidance: PerturbedAttention
) -> Tensor:
    """Velocity ``(B, C, h, w)`` float32 under perturbed-attention guidance.

    Args:
        sit: Velocity network.
        latents: ``(B, C, h, w)`` noisy normalised latents.
        modulations: ``(B, M)``, or ``(1, M)`` for all samples, see :meth:`SiT.modulations`.
        guidance: Perturbed block and strength; gives the source.
    """
    pair = velocity_and_perturbed(sit, latents, modulations, guidance.block)
    return extrapolated(*pair, guidance.scale)


def check_guidance(guidance: PerturbedAttention, sit: VelocityNetwork) -> None:
    """Refuse guidance of a network that is no SiT, or of a block that it does not have."""
    if not isinstance(sit, SiT):
        raise ValueError(f"perturbed attention is for a SiT, got a {type(sit).__name__}")
    if guidance.block > len(sit.blocks):
        raise ValueError(f"block {guidance.block} of the guidance is not in 1..{len(sit.blocks)}")

"""SiT that also predicts average velocities, for scenes in few steps.

Letters: B batch, C latent channels, h x w latent size, T times, D token width, M width of a
modulation row.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from r3dpa.nn.layers import zeroed
from r3dpa.nn.sit import SiT, TimeEmbedding, modulations_of


class AverageVelocitySiT(SiT):
    """SiT whose last blocks have a second copy, which predicts average velocities.

    Everything else is :class:`SiT`: the velocity and the features do not depend on the copy.

    Source: MeanFlow (Geng et al. 2025); layout of Decoupled MeanFlow (Lee et al. 2025).

    Args:
        average_blocks: Number of last blocks that are copied, a third of the depth as a rule.
        **kwargs: See :class:`SiT`.
    """

    def __init__(self, average_blocks: int = 4, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        depth = len(self.blocks)
        if not 1 <= average_blocks <= depth:
            raise ValueError(
                f"average_blocks must lie in 1..depth = 1..{depth}, got {average_blocks}"
            )
        self.average = _AverageHead(
            self.hidden_size,
            copy.deepcopy(self.blocks[depth - average_blocks :]),
            copy.deepcopy(self.final_layer),
        )

    def average_velocity(
        self, latents: Tensor, time: Tensor, target: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        """Mean ``(B, C, h, w)`` of the velocity along the path from ``time`` to ``target``.

        ``(x_t - x_r) / (t - r)`` of the points at ``time`` t and ``target`` r, both ``(B,)``. The
        first blocks are shared with :meth:`velocity`; the copies are also modulated by ``t - r``,
        by weights that start at 0: until training it equals :meth:`velocity` bit for bit.
        """
        self._check(latents, time)
        return self.average_velocity_at(latents, self.average_modulations(time, target, labels))

    def average_modulations(
        self, time: Tensor, target: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        """Modulations ``(T, M)`` of :meth:`average_velocity_at` for both times ``(T,)``."""
        conditioning = self.conditioning(time, labels)
        length = self.average.embedder(time - target).to(conditioning.dtype)
        late = modulations_of(
            [*self.average.blocks, self.average.final_layer], conditioning + length
        )
        shared = self.blocks[: -len(self.average.blocks)]
        if not shared:
            return late
        return torch.cat([modulations_of(shared, conditioning), late], dim=1)

    def average_velocity_at(self, latents: Tensor, modulations: Tensor) -> Tensor:
        """Average velocity ``(B, C, h, w)`` from precomputed modulations of both times."""
        blocks = [*self.blocks[: -len(self.average.blocks)], *self.average.blocks]
        tokens = self.run_blocks(blocks, self.embed(latents), modulations)
        return self.output(self.average.final_layer, tokens, modulations)

    def with_average(self, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Weights of a :class:`SiT` with the copies that this network adds."""
        state = self.state_dict()
        first = len(self.blocks) - len(self.average.blocks)
        added = {key: state[key] for key in state if key.startswith("average.embedder.")}
        for key, value in weights.items():
            kind, _, rest = key.partition(".")
            index, _, name = rest.partition(".")
            if kind == "final_layer":
                added[f"average.{key}"] = value
            elif kind == "blocks" and int(index) >= first:
                added[f"average.blocks.{int(index) - first}.{name}"] = value
        return {**weights, **added}

    @property
    def compiled_parts(self) -> list[nn.Module]:
        """The blocks and their copies, which share a graph."""
        return [*self.blocks, *self.average.blocks]


class _AverageHead(nn.Module):
    """Embedding of the length of a step, and copies of the last blocks and the output layer."""

    def __init__(self, hidden_size: int, blocks: nn.ModuleList, final_layer: nn.Module) -> None:
        super().__init__()
        self.embedder = TimeEmbedding(hidden_size)
        zeroed(self.embedder.mlp[2])
        self.blocks = blocks
        self.final_layer = final_layer

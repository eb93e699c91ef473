"""Exponential moving average of network weights, kept as explicit state."""

from __future__ import annotations

import copy
from typing import Literal

import torch
from torch import Tensor, nn

__all__ = ["EMA"]


class EMA(nn.Module):
    """Averaged float32 copies of named networks.

    Parameters follow ``average = decay * average + (1 - decay) * weight`` after every optimiser
    step. Buffers (the latent statistics, which are an average already) are copied by default: at
    decay 0.9999 an averaged statistic lags about 1e4 steps behind the VAE. The official code
    averages floating-point buffers too; ``buffers="decay"`` does the same.

    The copies are attributes under the names given, so ``EMA({"sit": sit}).sit`` is the averaged
    network and the state dict holds ``sit.*``.

    Args:
        networks: Networks to average; copied, never changed.
        decay: Weight of the old average, in [0, 1).
        buffers: ``copy`` or ``decay``.

    Raises:
        ValueError: If ``decay`` or ``buffers`` is out of range.
    """

    def __init__(
        self,
        networks: dict[str, nn.Module],
        decay: float = 0.9999,
        buffers: Literal["copy", "decay"] = "copy",
    ) -> None:
        super().__init__()
        if not 0.0 <= decay < 1.0:
            raise ValueError(f"EMA decay must be in [0, 1), got {decay}")
        if buffers not in ("copy", "decay"):
            raise ValueError(f"EMA buffers must be 'copy' or 'decay', got {buffers!r}")
        self.decay = decay
        self.buffer_rule = buffers
        for name, network in networks.items():
            average = copy.deepcopy(network).float().eval().requires_grad_(False)
            self.add_module(name, average)

    @torch.no_grad()
    def update(self, networks: dict[str, nn.Module]) -> None:
        """Moves the averages one step towards ``networks`` (same names and shapes as given)."""
        for name, network in networks.items():
            average = self.get_submodule(name)
            self._lerp(list(average.parameters()), list(network.parameters()))
            old, new = list(average.buffers()), list(network.buffers())
            decayed = [
                self.buffer_rule == "decay" and buffer.is_floating_point() for buffer in new
            ]
            self._lerp(
                [b for b, moves in zip(old, decayed, strict=True) if moves],
                [b for b, moves in zip(new, decayed, strict=True) if moves],
            )
            for target, source, moves in zip(old, new, decayed, strict=True):
                if not moves:
                    target.copy_(source)

    @torch.no_grad()
    def reset(self, networks: dict[str, nn.Module]) -> None:
        """Sets the averages to the present weights, as at the start of a training stage."""
        for name, network in networks.items():
            self.get_submodule(name).load_state_dict(network.state_dict())

    def _lerp(self, averages: list[Tensor], values: list[Tensor]) -> None:
        if averages:
            torch._foreach_lerp_(averages, [v.float() for v in values], 1.0 - self.decay)

    def train(self, mode: bool = True) -> EMA:
        """Keeps the averages in evaluation mode whatever the surrounding module does."""
        return super().train(False)

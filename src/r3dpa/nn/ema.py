"""Exponential moving average of a velocity network and its latent statistics."""

from __future__ import annotations

import copy
from typing import Literal

import torch
from torch import nn

from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.velocity_network import VelocityNetwork

Buffers = Literal["copy", "decay"]


@torch.no_grad()
def update_average(
    average: nn.Module, network: nn.Module, decay: float, buffers: Buffers = "copy"
) -> None:
    """Move an averaged copy of a network one step towards the network.

    Parameters follow ``average = decay * average + (1 - decay) * weight``, in the precision of the
    average. Buffers are copied; with ``buffers="decay"`` floating-point ones are averaged too.
    """
    pairs = zip(average.parameters(), network.parameters(), strict=True)
    weights = [weight.to(mean.dtype) for mean, weight in pairs]
    if weights:
        torch._foreach_lerp_([*average.parameters()], weights, 1.0 - decay)
    for target, source in zip(average.buffers(), network.buffers(), strict=True):
        if buffers == "decay" and source.is_floating_point():
            target.lerp_(source.to(target.dtype), 1.0 - decay)
        else:
            target.copy_(source)


class EMA(nn.Module):
    """Averaged float32 copies of a velocity network and of its latent statistics.

    They follow :func:`update_average` after every optimiser step. Buffers (the latent statistics,
    which are an average already) are copied by default: at decay 0.9999 an averaged statistic lags
    about 1e4 steps behind the VAE. The official code averages floating-point buffers too, as does
    ``buffers="decay"``.

    Args:
        sit: Network to average; copied, never changed.
        latent_norm: Its statistics.
        decay: Weight of the old average, in [0, 1).
        buffers: ``copy`` or ``decay``.

    Example:
        >>> from r3dpa.nn import SiT
        >>> small = {"hidden_size": 32, "depth": 2, "num_heads": 2, "alignment_depth": 1}
        >>> sit = SiT((4, 8), in_channels=2, **small)
        >>> norm = LatentNorm(channels=2)
        >>> ema = EMA(sit, norm, decay=0.5)
        >>> with torch.no_grad():
        ...     for weight in sit.parameters():
        ...         _ = weight.add_(1.0)
        >>> before = next(ema.sit.parameters()).clone()
        >>> ema.update(sit, norm)
        >>> (next(ema.sit.parameters()) - before).mean().round(decimals=3).item()
        0.5
    """

    def __init__(
        self,
        sit: VelocityNetwork,
        latent_norm: LatentNorm,
        decay: float = 0.9999,
        buffers: Buffers = "copy",
    ) -> None:
        super().__init__()
        if not 0.0 <= decay < 1.0:
            raise ValueError(f"EMA decay must be in [0, 1), got {decay}")
        self.decay = decay
        self.buffers_by: Buffers = buffers
        self.sit = copy.deepcopy(sit).float().eval().requires_grad_(False)
        self.latent_norm = copy.deepcopy(latent_norm).float().eval().requires_grad_(False)

    def update(self, sit: VelocityNetwork, latent_norm: LatentNorm) -> None:
        """Move the averages one step towards the current weights."""
        update_average(self.sit, sit, self.decay, self.buffers_by)
        update_average(self.latent_norm, latent_norm, self.decay, self.buffers_by)

    @torch.no_grad()
    def reset(self, sit: VelocityNetwork, latent_norm: LatentNorm) -> None:
        """Set the averages to the current weights, as at the start of a training stage."""
        self.sit.load_state_dict(sit.state_dict())
        self.latent_norm.load_state_dict(latent_norm.state_dict())

    def train(self, mode: bool = True) -> EMA:
        """Stay in evaluation mode."""
        return super().train(False)

"""Layers of :class:`r3dpa.nn.unet.UNet`; names and order follow the official state dict.

Letters: B batch, D channels, H x W size at some resolution, E embedding width.
"""

from __future__ import annotations

from typing import TypeVar

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from r3dpa.nn.layers import CircularConv2d, GroupNorm

KERNEL = (3, 3)
_NORM_EPS = 1e-5  # the VAE of the same authors has 1e-6

_Layer = TypeVar("_Layer", nn.Conv1d, CircularConv2d)


def unet_norm(channels: int) -> GroupNorm:
    """Group norm of the UNet."""
    return GroupNorm(channels, _NORM_EPS)


def zeroed(layer: _Layer) -> _Layer:
    """Start of all branches and of the output: every block is its shortcut, the velocity 0."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


class Layers(nn.ModuleList):
    """Layers one after the other, of which residual blocks are given the embedding.

    Args:
        *layers: In their order.
    """

    def __init__(self, *layers: nn.Module) -> None:
        super().__init__(layers)

    def forward(self, hidden: Tensor, embedding: Tensor) -> Tensor:
        """``(B, D, H, W)`` through all layers; ``embedding`` is ``(B, E)`` or ``(1, E)``."""
        for layer in self:
            timed = isinstance(layer, TimedResBlock)
            hidden = layer(hidden, embedding) if timed else layer(hidden)
        return hidden


class TimedResBlock(nn.Module):
    """Two convolutions around a shortcut, with a shift between them that the time decides.

    Args:
        in_channels: Input channels, a multiple of 32.
        out_channels: Output channels, a multiple of 32; a 1x1 convolution adapts the shortcut.
        embedding: Width E of the embedding of the time.
    """

    def __init__(self, in_channels: int, out_channels: int, embedding: int) -> None:
        super().__init__()
        self.in_layers = nn.Sequential(
            unet_norm(in_channels), nn.SiLU(), CircularConv2d(in_channels, out_channels, KERNEL)
        )
        self.emb_layers = nn.Sequential(nn.SiLU(), nn.Linear(embedding, out_channels))
        self.out_layers = nn.Sequential(
            unet_norm(out_channels),
            nn.SiLU(),
            nn.Identity(),  # a dropout of 0 in the official code, which counts in the names
            zeroed(CircularConv2d(out_channels, out_channels, KERNEL)),
        )
        self.skip_connection = (
            nn.Identity()
            if in_channels == out_channels
            else CircularConv2d(in_channels, out_channels, (1, 1))
        )

    def forward(self, hidden: Tensor, embedding: Tensor) -> Tensor:
        """``(B, in_channels, H, W)`` to ``(B, out_channels, H, W)``."""
        branch = self.in_layers(hidden)
        shift = self.emb_layers(embedding).to(branch.dtype)
        branch = self.out_layers(branch + shift[:, :, None, None])
        return self.skip_connection(hidden) + branch


class HeadsAttention(nn.Module):
    """Attention with several heads between all pixels, added to the input.

    Args:
        channels: Channels D, a multiple of 32 and of ``head_channels``.
        head_channels: Channels of a head.
    """

    def __init__(self, channels: int, head_channels: int) -> None:
        super().__init__()
        self.num_heads = channels // head_channels
        self.norm = unet_norm(channels)
        self.qkv = nn.Conv1d(channels, 3 * channels, 1)
        self.proj_out = zeroed(nn.Conv1d(channels, channels, 1))

    def forward(self, hidden: Tensor) -> Tensor:
        """Attend within each image of ``(B, D, H, W)``."""
        pixels = self.norm(hidden).flatten(2)
        query, key, value = rearrange(
            self.qkv(pixels), "B (head three d) N -> three B head N d", three=3, head=self.num_heads
        )
        mixed = F.scaled_dot_product_attention(query, key, value)
        mixed = self.proj_out(rearrange(mixed, "B head N d -> B (head d) N"))
        return hidden + mixed.view(hidden.shape)


class HalfSize(nn.Module):
    """Half the rows and columns, by a convolution with stride 2.

    Args:
        channels: Input and output channels.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.op = CircularConv2d(channels, channels, KERNEL, (2, 2))

    def forward(self, hidden: Tensor) -> Tensor:
        """``(B, D, H, W)`` to ``(B, D, H / 2, W / 2)``."""
        return self.op(hidden)


class DoubleSize(nn.Module):
    """Twice the rows and columns: every pixel four times, then a convolution.

    Args:
        channels: Input and output channels.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = CircularConv2d(channels, channels, KERNEL)

    def forward(self, hidden: Tensor) -> Tensor:
        """``(B, D, H, W)`` to ``(B, D, 2 H, 2 W)``."""
        return self.conv(F.interpolate(hidden, scale_factor=2, mode="nearest"))


class PositionBias(nn.Module):
    """A learned bias on every pixel: the absolute position encoding.

    Args:
        channels: Channels D.
        size: Rows and columns.
    """

    def __init__(self, channels: int, size: tuple[int, int]) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(1, channels, *size))

    def forward(self, hidden: Tensor) -> Tensor:
        """Add it to ``(B, D, H, W)``."""
        return hidden + self.bias

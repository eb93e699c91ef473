"""The convolutional UNet of LiDM as velocity network, the other backbone of the ablations.

Letters: B batch, C latent channels, h x w latent size, D channels of a layer, E embedding width.
Module names follow the official state dict, except that the projection head is ``projector`` and
the latent batch norm is a network of its own (:class:`r3dpa.nn.latent_norm.LatentNorm`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Self

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from r3dpa.nn.layers import (
    CircularConv2d,
    Float32CircularConv2d,
    GroupNorm,
    at_least_float32,
    named_layers,
    zeroed,
)
from r3dpa.nn.velocity_network import Float32Linear, VelocityNetwork, time_frequencies

_KERNEL = (3, 3)
_NORM_EPS = 1e-5  # the VAE of the same authors has 1e-6


class UNet(VelocityNetwork):
    """UNet over the latents, whose middle block is aligned with 3D features (U-REPA).

    Columns wrap around, and a learned bias on every latent pixel is the position encoding. Each
    step down halves rows and columns, so latents of 16 x 128 have a middle of 4 x 32: feature grids
    must have this size (``grid_size`` of the data). The default is the network of the paper's
    ablation (258.3 M parameters and 7.9 M of the head); ``channels`` 160 is the official small one
    (101.1 M).

    Source: LiDM (Ran et al. 2024), as used by R3DPA (ICRA 2026), table IV.

    Args:
        input_size: Latent rows and columns ``(h, w)``.
        in_channels: Latent channels C.
        channels: Channels at full resolution, a multiple of 32.
        channel_multipliers: Width of each resolution in units of ``channels``.
        num_res_blocks: Residual blocks per resolution on the way down; one more on the way up.
        head_channels: Channels of an attention head.
        feature_dim: Width F of the 3D features.
        projector_dim: Width of the projection head.
        num_classes: Rows of the class table.
        attention_resolutions: Reductions (1, 2, 4, ...) at which residual blocks are followed by
            attention, as in LiDM's configurations; the middle block always has it. Default: all.
    """

    def __init__(
        self,
        input_size: tuple[int, int] = (16, 128),
        in_channels: int = 8,
        channels: int = 256,
        channel_multipliers: Sequence[int] = (1, 2, 4),
        num_res_blocks: int = 2,
        head_channels: int = 32,
        feature_dim: int = 768,
        projector_dim: int = 2048,
        num_classes: int = 1,
        attention_resolutions: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        rows, columns = input_size
        reduction = 2 ** (len(channel_multipliers) - 1)
        if rows % reduction or columns % reduction:
            raise ValueError(
                f"latents of {rows} x {columns} cannot be halved {len(channel_multipliers) - 1} "
                "times; give fewer channel_multipliers, or another input_size"
            )
        if channels % head_channels:
            raise ValueError(
                f"channels {channels} is not a multiple of head_channels {head_channels}"
            )
        reductions = [2**level for level in range(len(channel_multipliers))]
        if not set(attention_resolutions or ()) <= set(reductions):
            raise ValueError(
                f"attention_resolutions must be among {reductions}, got {attention_resolutions}"
            )
        self.input_size = (rows, columns)
        self.in_channels = in_channels
        self.channels = channels
        self.head_channels = head_channels
        self.grid_size = (rows // reduction, columns // reduction)
        self.feature_dim = feature_dim
        self.num_classes = num_classes

        widths = [channels * multiplier for multiplier in channel_multipliers]
        embedding = 4 * channels
        self.time_embed = nn.Sequential(
            Float32Linear(channels, embedding), nn.SiLU(), Float32Linear(embedding, embedding)
        )
        self.label_emb = nn.Embedding(num_classes, embedding)

        attends = [
            attention_resolutions is None or reduction in attention_resolutions
            for reduction in reductions
        ]

        def blocks(inside: int, outside: int, attention: bool = True) -> list[nn.Module]:
            layers: list[nn.Module] = [_TimedResBlock(inside, outside, embedding)]
            return [*layers, _HeadsAttention(outside, head_channels)] if attention else layers

        self.input_blocks = nn.ModuleList([_Layers(CircularConv2d(in_channels, channels, _KERNEL))])
        kept, width = [channels], channels  # widths of the skip connections
        for level, wider in enumerate(widths):
            for _ in range(num_res_blocks):
                self.input_blocks.append(_Layers(*blocks(width, wider, attends[level])))
                width = wider
                kept.append(width)
            if level < len(widths) - 1:
                halved = CircularConv2d(width, width, _KERNEL, (2, 2))
                self.input_blocks.append(_Layers(named_layers(op=halved)))
                kept.append(width)
        self.ape: nn.Module = _PositionBias(channels, self.input_size)
        self.middle_block = _Layers(*blocks(width, width), _TimedResBlock(width, width, embedding))
        self.projector = nn.Sequential(
            nn.Conv2d(width, projector_dim, 1),
            nn.SiLU(),
            nn.Conv2d(projector_dim, projector_dim, 1),
            nn.SiLU(),
            nn.Conv2d(projector_dim, feature_dim, 1),
        )
        self.output_blocks = nn.ModuleList()
        for level, wider in reversed(list(enumerate(widths))):
            for index in range(num_res_blocks + 1):
                layers = blocks(width + kept.pop(), wider, attends[level])
                width = wider
                if level and index == num_res_blocks:
                    doubled = CircularConv2d(width, width, _KERNEL)
                    layers.append(named_layers(up=nn.Upsample(scale_factor=2), conv=doubled))
                self.output_blocks.append(_Layers(*layers))
        self.out = nn.Sequential(
            _norm(width), nn.SiLU(), zeroed(Float32CircularConv2d(width, in_channels, _KERNEL))
        )

    @property
    def input_layer(self) -> nn.Module:
        """The first convolution."""
        return self.input_blocks[0]

    @property
    def compiled_parts(self) -> list[nn.Module]:
        """The blocks of all resolutions."""
        return [*self.input_blocks, self.middle_block, *self.output_blocks]

    def modulations(self, time: Tensor, labels: Tensor | None = None) -> Tensor:
        """Embeddings ``(T, E)`` of times ``(T,)`` and classes ``(T,)``, at least float32."""
        labels = self._labels(time, labels)
        frequencies = time_frequencies(at_least_float32(time), self.channels)
        return self.time_embed(frequencies) + self.label_emb(labels)

    def to_bfloat16_(self) -> Self:
        """Cast all convolutions between the first and the last to bfloat16, for sampling.

        Time embedding, statistics of the norms, the first layer with the position bias and the
        output layer stay float32.
        """
        for part in (*self.input_blocks[1:], self.middle_block, *self.output_blocks):
            for layer in part.modules():
                if isinstance(layer, nn.Conv1d | nn.Conv2d):
                    layer.bfloat16()
        return self

    def _begin(self, latents: Tensor, modulations: Tensor) -> tuple[Tensor, ...]:
        hidden = self.ape(self.input_layer(latents, modulations))
        narrow = self.middle_block.get_parameter("0.in_layers.2.weight").dtype  # after to_bfloat16_
        kept = [hidden.to(narrow)]
        for block in self.input_blocks[1:]:
            kept.append(block(kept[-1], modulations))
        return self.middle_block(kept[-1], modulations), *kept

    def _project(self, activations: Tensor) -> Tensor:
        features = self.projector(activations.to(self.projector.get_parameter("0.weight").dtype))
        return rearrange(features, "B F row column -> B (row column) F")

    def _finish(self, activations: tuple[Tensor, ...], modulations: Tensor) -> Tensor:
        hidden, *kept = activations
        for block, skipped in zip(self.output_blocks, reversed(kept), strict=True):
            hidden = block(torch.cat([hidden, skipped], dim=1), modulations)
        return self.out(at_least_float32(hidden))


_norm = partial(GroupNorm, eps=_NORM_EPS)


class _Layers(nn.ModuleList):
    """Sequential layers, of which residual blocks receive the time embedding."""

    def __init__(self, *layers: nn.Module) -> None:
        super().__init__(layers)

    def forward(self, hidden: Tensor, embedding: Tensor) -> Tensor:
        """``(B, D, H, W)`` through all layers; ``embedding`` is ``(B, E)`` or ``(1, E)``."""
        for layer in self:
            timed = isinstance(layer, _TimedResBlock)
            hidden = layer(hidden, embedding) if timed else layer(hidden)
        return hidden


class _TimedResBlock(nn.Module):
    """Two convolutions around a shortcut, with a shift by the time embedding between them."""

    def __init__(self, in_channels: int, out_channels: int, embedding: int) -> None:
        super().__init__()
        self.in_layers = nn.Sequential(
            _norm(in_channels), nn.SiLU(), CircularConv2d(in_channels, out_channels, _KERNEL)
        )
        self.emb_layers = nn.Sequential(nn.SiLU(), nn.Linear(embedding, out_channels))
        self.out_layers = nn.Sequential(
            _norm(out_channels),
            nn.SiLU(),
            nn.Identity(),  # a dropout of 0 in the official code, which counts in the names
            zeroed(CircularConv2d(out_channels, out_channels, _KERNEL)),
        )
        self.skip_connection = (
            nn.Identity()
            if in_channels == out_channels
            else CircularConv2d(in_channels, out_channels, (1, 1))
        )

    def forward(self, hidden: Tensor, embedding: Tensor) -> Tensor:
        branch = self.in_layers(hidden)
        shift = self.emb_layers(embedding).to(branch.dtype)
        branch = self.out_layers(branch + shift[:, :, None, None])
        return self.skip_connection(hidden) + branch


class _HeadsAttention(nn.Module):
    def __init__(self, channels: int, head_channels: int) -> None:
        super().__init__()
        self.num_heads = channels // head_channels
        self.norm = _norm(channels)
        self.qkv = nn.Conv1d(channels, 3 * channels, 1)
        self.proj_out = zeroed(nn.Conv1d(channels, channels, 1))

    def forward(self, hidden: Tensor) -> Tensor:
        pixels = self.norm(hidden).flatten(2)
        query, key, value = rearrange(
            self.qkv(pixels), "B (head three d) N -> three B head N d", three=3, head=self.num_heads
        )
        mixed = F.scaled_dot_product_attention(query, key, value)
        mixed = self.proj_out(rearrange(mixed, "B head N d -> B (head d) N"))
        return hidden + mixed.view(hidden.shape)


class _PositionBias(nn.Module):
    def __init__(self, channels: int, size: tuple[int, int]) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(1, channels, *size))

    def forward(self, hidden: Tensor) -> Tensor:
        return hidden + self.bias

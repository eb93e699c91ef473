"""The convolutional UNet of LiDM as velocity network, the other backbone of the ablations.

Letters: B batch, C latent channels, h x w latent size, D channels of a layer, E embedding width.
Module names follow the official state dict, except that the projection head is ``projector`` and
the latent batch norm is a network of its own (:class:`r3dpa.nn.latent_norm.LatentNorm`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import torch
from einops import rearrange
from torch import Tensor, nn

from r3dpa.nn.layers import CircularConv2d, WideCircularConv2d, at_least_float32
from r3dpa.nn.unet_blocks import (
    KERNEL,
    DoubleSize,
    HalfSize,
    HeadsAttention,
    Layers,
    PositionBias,
    TimedResBlock,
    unet_norm,
    zeroed,
)
from r3dpa.nn.velocity_network import VelocityNetwork, WideLinear, time_frequencies

__all__ = ["UNet"]


class UNet(VelocityNetwork):
    """UNet over the latents, whose middle block is aligned with 3D features (U-REPA).

    Residual and attention blocks at every resolution; columns wrap around, and a learned bias on
    every latent pixel tells where it is (absolute position encoding). Each step down halves rows
    and columns, so latents of 16 x 128 have a middle of 4 x 32: feature grids must have this size,
    which ``grid_size`` of the data sets. The default is the size of the paper's ablation (258.3 M
    parameters and 7.9 M of the head); ``channels`` 160 is the official small one (101.1 M).

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

    Raises:
        ValueError: If sizes do not divide.
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
        self.input_size = (rows, columns)
        self.in_channels = in_channels
        self.channels = channels
        self.grid_size = (rows // reduction, columns // reduction)
        self.head_channels = head_channels
        self.feature_dim = feature_dim
        self.num_classes = num_classes

        widths = [channels * multiplier for multiplier in channel_multipliers]
        embedding = 4 * channels
        self.time_embed = nn.Sequential(
            WideLinear(channels, embedding), nn.SiLU(), WideLinear(embedding, embedding)
        )
        self.label_emb = nn.Embedding(num_classes, embedding)

        def blocks(inside: int, outside: int) -> list[nn.Module]:
            return [
                TimedResBlock(inside, outside, embedding),
                HeadsAttention(outside, head_channels),
            ]

        first = Layers(CircularConv2d(in_channels, channels, KERNEL))
        self.input_blocks = nn.ModuleList([first])
        kept, width = [channels], channels  # of what the way up is given
        for level, wider in enumerate(widths):
            for _ in range(num_res_blocks):
                self.input_blocks.append(Layers(*blocks(width, wider)))
                width = wider
                kept.append(width)
            if level < len(widths) - 1:
                self.input_blocks.append(Layers(HalfSize(width)))
                kept.append(width)
        self.ape = PositionBias(channels, self.input_size)
        self.middle_block = Layers(*blocks(width, width), TimedResBlock(width, width, embedding))
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
                layers = blocks(width + kept.pop(), wider)
                width = wider
                if level and index == num_res_blocks:
                    layers.append(DoubleSize(width))
                self.output_blocks.append(Layers(*layers))
        self.out = nn.Sequential(
            unet_norm(width), nn.SiLU(), zeroed(WideCircularConv2d(width, in_channels, KERNEL))
        )

    @property
    def modulation_width(self) -> int:
        """Width of the embedding that every residual block is given."""
        return 4 * self.channels

    @property
    def input_layer(self) -> nn.Module:
        """The first convolution."""
        return self.input_blocks[0]

    @property
    def compiled_parts(self) -> list[nn.Module]:
        """The blocks of all resolutions."""
        return [*self.input_blocks, self.middle_block, *self.output_blocks]

    def modulations(self, time: Tensor, labels: Tensor | None = None) -> Tensor:
        """Embeddings of times and classes, which every residual block is given.

        Args:
            time: ``(T,)`` flow times, 0 data, 1 noise.
            labels: ``(T,)`` int64 classes; may be left out of a one-class model.

        Returns:
            ``(T, E)``, at least float32.

        Raises:
            ValueError: As :meth:`VelocityNetwork.modulations`.
        """
        labels = self._labels(time, labels)
        frequencies = time_frequencies(at_least_float32(time), self.channels)
        return self.time_embed(frequencies) + self.label_emb(labels)

    def halve_(self) -> Self:
        """Casts all convolutions between the first and the last to bfloat16 in place.

        For sampling without autocast. Float32 stay the embedding of the time, the statistics of
        all norms, the first layer with the position bias, and the output layer.
        """
        for part in (*self.input_blocks[1:], self.middle_block, *self.output_blocks):
            for layer in part.modules():
                if isinstance(layer, nn.Conv1d | nn.Conv2d):
                    layer.bfloat16()
        return self

    @property
    def _narrow(self) -> torch.dtype:
        """That of the activations between the first layer and the last: bfloat16 once halved."""
        return self.middle_block.get_parameter("0.in_layers.2.weight").dtype

    def _begin(self, latents: Tensor, modulations: Tensor) -> tuple[Tensor, ...]:
        hidden = self.ape(self.input_layer(latents, modulations))
        kept = [hidden.to(self._narrow)]
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

"""Encoder and decoder of the range-image VAE.

Letters: B batch, C channels, H x W image size, h x w size in blocks of pixels or of latents.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from r3dpa.geometry import NUM_CLASSES, SEMANTIC_CLASSES
from r3dpa.nn.layers import (
    AttentionBlock,
    CircularConv2d,
    Float32CircularConv2d,
    GroupNorm,
    ResBlock,
    Size,
    Upsample,
    downsample,
    zeroed,
)

# AdamW moves a weight by at most the learning rate per step: without this gain, logits need
# hundreds of steps to learn even the class frequencies.
LOGIT_GAIN = 8.0
_VEGETATION = [known.name for known in SEMANTIC_CLASSES].index("vegetation")
LevelSizes = tuple[int, int, bool, Size | None]  # input, output, attention, stride


class Encoder(nn.Module):
    """From images ``(B, C, H, W)`` to the moments of their latents, level by level."""

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        levels: Sequence[LevelSizes],
        num_blocks: int,
        stem: Size,
        intensity: bool,
        num_classes: int,
    ) -> None:
        super().__init__()
        first, last = levels[0][1], levels[-1][1]
        self.stem = (stem[0], stem[1])
        self.in_channels, self.num_classes = in_channels, num_classes
        self.conv_in = CircularConv2d(in_channels * math.prod(stem), first, (3, 3))
        self.down = nn.ModuleList(
            _Level(level, num_blocks, (3, 3), "downsample", downsample) for level in levels
        )
        self.mid = _Middle(last)
        self.norm_out = GroupNorm(last)
        self.conv_out = CircularConv2d(last, out_channels, (3, 3))
        self.image_channels = in_channels + intensity + (num_classes > 0)
        self.further_in: nn.Module | None = None
        if further := intensity + num_classes:
            self.further_in = zeroed(CircularConv2d(further * math.prod(stem), first, (1, 1)))

    def forward(self, image: Tensor) -> Tensor:
        """Means and log-variances of images."""
        hidden = self.conv_in(self._blocks(image[:, : self.in_channels]))
        if self.further_in is not None:
            hidden = hidden + self.further_in(self._blocks(self._further(image)))
        for level in self.down:
            hidden = level(hidden)
        return self.conv_out(F.silu(self.norm_out(self.mid(hidden))))

    def _blocks(self, image: Tensor) -> Tensor:
        rows, columns = self.stem
        return rearrange(image, "B C (h p) (w q) -> B (C p q) h w", p=rows, q=columns)

    def _further(self, image: Tensor) -> Tensor:
        """Intensity where images have it, and a channel for each class: 1 where it is, else 0."""
        if image.shape[1] != self.image_channels:
            raise ValueError(
                f"this encoder sees intensity or class: it needs images of {self.image_channels} "
                f"channels, got {image.shape[1]}; the codec of the checkpoint makes them, with an "
                "intensity of 0 and no class where these are unknown"
            )
        further = image[:, self.in_channels :]
        if not self.num_classes:
            return further
        numbers = torch.arange(self.num_classes, device=image.device).view(-1, 1, 1)
        return torch.cat([further[:, :-1], (further[:, -1:] == numbers).to(image)], dim=1)


class Decoder(nn.Module):
    """From latents ``(B, C, h, w)`` to what is said about each pixel of their images."""

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        levels: Sequence[LevelSizes],
        num_blocks: int,
        legacy: bool,
        stem: Size,
        further: int,
    ) -> None:
        super().__init__()
        first, last = levels[0][1], levels[-1][1]  # level 0 has the resolution of the stem
        self.stem = (stem[0], stem[1])
        self.conv_in = CircularConv2d(in_channels, last, (3, 3))
        self.mid = _Middle(last)
        upsample = partial(Upsample, legacy=legacy)
        # Kernels extend over columns only, unless the rows are upsampled afterwards.
        by_pixel = math.prod(stem) == 1
        columns_only = [by_pixel and (s is None or s[0] == 1) for *_, s in levels]
        self.up = nn.ModuleList(
            _Level(level, num_blocks, (1, 4) if flat else (3, 3), "upsample", upsample)
            for level, flat in zip(levels, columns_only, strict=True)
        )
        self.norm_out = GroupNorm(first)
        kernel = (1, 4) if by_pixel else (3, 3)
        self.conv_out = Float32CircularConv2d(first, out_channels * math.prod(stem), kernel)
        self.further_out: nn.Module | None = None
        self.further_refinement: nn.Module | None = None
        if further:
            self.further_out = Float32CircularConv2d(first, further * math.prod(stem), (1, 1))

    def forward(self, latents: Tensor) -> Tensor:
        """Outputs, see :meth:`r3dpa.nn.VAE.outputs_of`."""
        hidden = self.mid(self.conv_in(latents.to(self.conv_in.weight.dtype)))
        for level in reversed(self.up):
            hidden = level(hidden)
        hidden = F.silu(self.norm_out(hidden))
        outputs = self._pixels(self.conv_out(hidden))
        if self.further_out is None:
            return outputs
        further = self._pixels(self.further_out(hidden))
        if self.further_refinement is not None:
            correction = self.further_refinement(hidden, outputs)
            if not self.training:  # leaves stay rough
                logits = LOGIT_GAIN * further[:, -NUM_CLASSES:]
                correction = correction * (1 - logits.softmax(dim=1)[:, _VEGETATION, None])
            outputs = outputs + correction
        return torch.cat([outputs, further], dim=1)

    def _pixels(self, blocks: Tensor) -> Tensor:
        rows, columns = self.stem
        return rearrange(blocks, "B (C p q) h w -> B C (h p) (w q)", p=rows, q=columns)


class _Level(nn.Module):
    """Residual blocks, optionally each followed by attention, and a resampling layer."""

    def __init__(
        self,
        sizes: LevelSizes,
        num_blocks: int,
        kernel: Size,
        name: str,
        resampler: Callable[[int, Size], nn.Module],
    ) -> None:
        super().__init__()
        in_channels, out_channels, attention, stride = sizes
        self.block = nn.ModuleList(
            ResBlock(out_channels if index else in_channels, out_channels, kernel)
            for index in range(num_blocks)
        )
        self.attn = nn.ModuleList(
            AttentionBlock(out_channels) if attention else nn.Identity() for _ in self.block
        )
        self.name = name  # of the resampling layer in the official state dict
        self.add_module(name, nn.Identity() if stride is None else resampler(out_channels, stride))

    def forward(self, hidden: Tensor) -> Tensor:
        for block, attn in zip(self.block, self.attn, strict=True):
            hidden = attn(block(hidden))
        return getattr(self, self.name)(hidden)


class _Middle(nn.Sequential):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.block_1 = ResBlock(channels, channels)
        self.attn_1 = AttentionBlock(channels)
        self.block_2 = ResBlock(channels, channels)

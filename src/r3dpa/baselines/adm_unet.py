"""ADM U-Net on range images, the third network of R2Flow.

Letters: B batch, C channels, H x W image size, D width of the time embedding.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.baselines.efficient_unet import (
    Encoding,
    ImageAttention,
    ResidualBlock,
    conv3x3,
    encode_angles,
    hdl64e_angles,
    sinusoid,
)
from r3dpa.nn.layers import Size, zeroed

_LEVELS = 4


class ADMUNet(nn.Module):
    """U-Net of residual blocks that resample between their norm and their first convolution.

    Every block on the way down is concatenated to one on the way up; the lowest level and the
    middle have attention. Columns wrap around. Arguments and ``coords`` are those of
    :class:`r3dpa.baselines.efficient_unet.EfficientUNet`.

    Source: Dhariwal and Nichol 2021, as in R2Flow (Nakashima et al. 2025).
    """

    coords: Tensor

    def __init__(
        self,
        in_channels: int,
        resolution: Size,
        base_channels: int = 64,
        temb_channels: int | None = None,
        channel_multiplier: Sequence[int] = (1, 2, 4, 8),
        num_residual_blocks: Sequence[int] = (3, 3, 3, 3),
        gn_num_groups: int = 8,
        gn_eps: float = 1e-6,
        attn_num_heads: int = 8,
        coords_encoding: Encoding | None = "fourier_features",
    ) -> None:
        super().__init__()
        if any(side % 2 ** (_LEVELS - 1) for side in resolution):
            raise ValueError(f"images must be divisible by 8, got {tuple(resolution)} pixels")
        self.in_channels, self.resolution = in_channels, (resolution[0], resolution[1])
        self.coords_encoding, self.base_channels = coords_encoding, base_channels
        self.register_buffer("coords", hdl64e_angles(self.resolution))
        with torch.device("cpu"):
            known = encode_angles(torch.zeros(1, 2, 1, 1), coords_encoding, self.resolution)
        width = temb_channels or 4 * base_channels
        self.time_embedding = nn.Sequential(
            nn.Linear(base_channels, width), nn.SiLU(), nn.Linear(width, width)
        )
        norm = gn_num_groups, gn_eps

        def block(ins: int, outs: int, heads: int = 0, **options: nn.Module) -> _ResamplingBlock:
            return _ResamplingBlock(ins, outs, width, norm, heads, **options)

        widths = [base_channels * factor for factor in channel_multiplier]
        heads = [0] * (_LEVELS - 1) + [attn_num_heads]
        self.in_conv = conv3x3(in_channels + known.shape[1], widths[0], ring=True)
        skips = [widths[0]]
        self.down_blocks = nn.ModuleList()
        for level, channels in enumerate(widths):
            for _ in range(num_residual_blocks[level]):
                self.down_blocks.append(block(skips[-1], channels, heads[level]))
                skips.append(channels)
            if level < _LEVELS - 1:
                self.down_blocks.append(block(channels, channels, resample=nn.AvgPool2d(2)))
                skips.append(channels)
        self.mid_blocks = _Blocks(
            [block(skips[-1], skips[-1], heads[-1]), block(skips[-1], skips[-1])]
        )
        last = skips[-1]
        self.up_blocks = nn.ModuleList()
        for level in reversed(range(_LEVELS)):
            channels = widths[level]
            count = num_residual_blocks[level] + 1
            for index in range(count):
                layers = [block(last + skips.pop(), channels, heads[level])]
                if level and index == count - 1:
                    layers.append(block(channels, channels, resample=nn.Upsample(scale_factor=2)))
                self.up_blocks.append(_Blocks(layers))
                last = channels
        self.out_conv = nn.Sequential(
            nn.GroupNorm(gn_num_groups, widths[0], gn_eps),
            nn.SiLU(),
            zeroed(conv3x3(widths[0], in_channels, ring=True)),
        )

    def forward(self, image: Tensor, time: Tensor) -> Tensor:
        """Prediction ``(B, C, H, W)`` for images at times ``(B,)``."""
        embedding = self.time_embedding(sinusoid(time, self.base_channels))
        angles = encode_angles(self.coords, self.coords_encoding, self.resolution)
        image = torch.cat([image, angles.to(image).expand(len(image), -1, -1, -1)], dim=1)
        skips = [self.in_conv(image)]
        for block in self.down_blocks:
            skips.append(block(skips[-1], embedding))
        hidden = self.mid_blocks(skips[-1], embedding)
        for block in self.up_blocks:
            hidden = block(torch.cat([hidden, skips.pop()], dim=1), embedding)
        return self.out_conv(hidden)


class _ResamplingBlock(ResidualBlock):
    """Residual block with a box filter in both branches, and attention behind."""

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        width: int,
        norm: tuple[int, float],
        heads: int,
        resample: nn.Module | None = None,
    ) -> None:
        super().__init__(in_channels, out_channels, width, norm, ring=True)
        self.resample = resample or nn.Identity()
        self.attention = ImageAttention(out_channels, heads, norm) if heads else nn.Identity()

    def forward(self, image: Tensor, embedding: Tensor) -> Tensor:
        hidden = self.conv1(F.silu(self.resample(self.norm1(image))))
        scale, shift = self.modulation(F.silu(embedding))[..., None, None].chunk(2, dim=1)
        hidden = self.conv2(F.silu(self.norm2(hidden) * (1 + scale) + shift))
        return self.attention((self.resample(self.skip(image)) + hidden) * math.sqrt(0.5))


class _Blocks(nn.ModuleList):
    def forward(self, image: Tensor, embedding: Tensor) -> Tensor:
        for block in self:
            image = block(image, embedding)
        return image

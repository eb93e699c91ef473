"""ADM U-Net on range images, the third network of R2Flow."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from r3dpa.baselines.efficient_unet import Blocks, EfficientUNet, ResidualBlock, Shared
from r3dpa.nn.layers import zeroed


class ADMUNet(EfficientUNet):
    """U-Net of residual blocks that resample between their norm and their first convolution.

    Every block on the way down is concatenated to one on the way up; the lowest level and the
    middle have attention. Arguments and ``coords`` as in :class:`EfficientUNet`.

    Source: Dhariwal and Nichol 2021, as in R2Flow (Nakashima et al. 2025).
    """

    def _build(
        self, channels: int, widths: Sequence[int], counts: Sequence[int], shared: Shared
    ) -> None:
        lowest = len(widths) - 1
        last = widths[-1]
        self.in_conv = shared.conv(channels, widths[0])
        skips = [widths[0]]
        self.down_blocks, self.up_blocks = nn.ModuleList(), nn.ModuleList()
        for level, width in enumerate(widths):
            for _ in range(counts[level]):
                self.down_blocks.append(ResidualBlock(skips[-1], width, shared, level == lowest))
                skips.append(width)
            if level < lowest:
                half = nn.AvgPool2d(2)
                self.down_blocks.append(ResidualBlock(width, width, shared, resample=half))
                skips.append(width)
        middle = ResidualBlock(last, last, shared, True), ResidualBlock(last, last, shared)
        self.mid_blocks = Blocks(middle)
        for level in reversed(range(len(widths))):
            width = widths[level]
            for index in reversed(range(counts[level] + 1)):
                blocks = [ResidualBlock(last + skips.pop(), width, shared, level == lowest)]
                if level and not index:
                    twice = nn.Upsample(scale_factor=2)
                    blocks.append(ResidualBlock(width, width, shared, resample=twice))
                self.up_blocks.append(Blocks(blocks))
                last = width
        self.out_conv = nn.Sequential(
            shared.norm(last), nn.SiLU(), zeroed(shared.conv(last, self.in_channels))
        )

    def _levels(self, hidden: Tensor, embedding: Tensor) -> Tensor:
        skips = [hidden]
        for block in self.down_blocks:
            skips.append(block(skips[-1], embedding))
        hidden = self.mid_blocks(skips[-1], embedding)
        for block in self.up_blocks:
            hidden = block(torch.cat([hidden, skips.pop()], dim=1), embedding)
        return hidden

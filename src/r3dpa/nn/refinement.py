"""Correction of decoded ranges at full resolution.

Letters: B batch, D width of the decoder, H x W image size, h x w size in blocks of pixels.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from r3dpa.nn.layers import CircularConv2d, Float32CircularConv2d, Size, zeroed
from r3dpa.nn.pixel_outputs import RangeMixture

_NEIGHBOURS = (1, -1, 2, -2, 4, -4)  # columns
_NUM_REFINED = RangeMixture.num_outputs + 1  # and the logit of a return
# Differences to neighbours, above, below, between the modes; and the outputs that are no range.
_NUM_KNOWN = len(_NEIGHBOURS) + 3 + _NUM_REFINED - 2
_DILATIONS = (1, 2, 4)  # columns between the taps of a kernel, block by block
# Encoded ranges are compared up to 1 / 32, about 6 % of the range in log2; other outputs are
# divided by 5. Both then lie near [-1, 1].
_RANGE_FACTOR, _OUTPUT_FACTOR = 32.0, 0.2
# Sizes of a correction: centres of the mixture move by about 1 % of the range, others by more.
_CORRECTION = (0.02, 0.02, 0.2, 0.2, 1.0, 1.0)


class Refinement(nn.Module):
    """Correction of the range mixture and the return of each pixel, which starts at 0.

    A decoder with a stem makes each block of pixels from one vector, so that its ranges ripple from
    pixel to pixel and surfaces end at the borders of blocks. Here, a few convolutions of few
    channels see features of the decoder and how the likelier range of each pixel differs from its
    neighbours'.

    A VAE corrects leaves in training alone. The likeliest ranges of a tree form a smooth surface,
    which no tree has; a decoder that need not find them keeps its leaves rough.

    Args:
        width: Channels D of the decoder's features.
        channels: Channels at full resolution.
        stem: Rows and columns of a block of pixels.
        least_scale: See :class:`RangeMixture`.
    """

    sizes: Tensor

    def __init__(self, width: int, channels: int, stem: Size, least_scale: float) -> None:
        super().__init__()
        self.stem, self.least_scale = (stem[0], stem[1]), least_scale
        self.features = nn.Conv2d(width, channels * stem[0] * stem[1], 1)
        self.conv_in = CircularConv2d(channels + _NUM_KNOWN, channels, (3, 3))
        self.blocks = nn.ModuleList(_Block(channels, dilation) for dilation in _DILATIONS)
        self.conv_out = zeroed(Float32CircularConv2d(channels, _NUM_REFINED, (3, 3)))
        sizes = torch.tensor(_CORRECTION).view(-1, 1, 1)
        self.register_buffer("sizes", sizes, persistent=False)

    def forward(self, features: Tensor, outputs: Tensor) -> Tensor:
        """Correction ``(B, 6, H, W)`` to add to the outputs.

        Args:
            features: ``(B, D, h, w)`` of the decoder's last layer but one.
            outputs: ``(B, 6, H, W)`` of its last: see :class:`RangeMixture`, and the logit of a
                return.
        """
        rows, columns = self.stem
        hidden = rearrange(
            self.features(features), "B (C p q) h w -> B C (h p) (w q)", p=rows, q=columns
        )
        known = self._known(outputs).to(hidden.dtype)
        hidden = self.conv_in(torch.cat([hidden, known], dim=1))
        for block in self.blocks:
            hidden = block(hidden)
        return self.conv_out(F.silu(hidden)) * self.sizes

    def _known(self, outputs: Tensor) -> Tensor:
        """Differences to neighbours and between the modes, and the other outputs, about 1 in size.

        Differences, since bfloat16 would round the ranges themselves by more than they ripple.
        """
        likelier = RangeMixture(outputs, self.least_scale).mode()
        beside = [likelier.roll(columns, -1) - likelier for columns in _NEIGHBOURS]
        padded = F.pad(likelier, (0, 0, 1, 1), mode="replicate")
        above, below = padded[:, :, :-2] - likelier, padded[:, :, 2:] - likelier
        modes = outputs[:, 1:2] - outputs[:, :1]
        differences = torch.cat([*beside, above, below, modes], dim=1)
        differences = (_RANGE_FACTOR * differences).clamp(-1, 1)
        return torch.cat([differences, _OUTPUT_FACTOR * outputs[:, 2:]], dim=1)


class _Block(nn.Module):
    """Two convolutions, each after a swish, around a shortcut."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.conv1 = CircularConv2d(channels, channels, (3, 3), dilation=(1, dilation))
        self.conv2 = zeroed(CircularConv2d(channels, channels, (3, 3)))

    def forward(self, hidden: Tensor) -> Tensor:
        return hidden + self.conv2(F.silu(self.conv1(F.silu(hidden))))

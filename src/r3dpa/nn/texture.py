"""Random detail of decoded images: what latents leave open is drawn in place of averaged.

Letters: B batch, H x W image size, h x w size in blocks of pixels.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from torch import Tensor, nn

from r3dpa.geometry import NUM_CLASSES
from r3dpa.nn.layers import CircularConv2d, Float32CircularConv2d, Size
from r3dpa.nn.refinement import NUM_DIFFERENCES, DilatedBlock, neighbour_differences

_BLOCK = (2, 4)  # rows and columns of a block of pixels
_COARSE = (4, 8)  # rows and columns of blocks that share a value of the coarse noise
_PIXEL_NOISE, _BLOCK_NOISE, _COARSE_NOISE = 4, 8, 4  # channels
_ROW_CYCLES = (1, 4, 12, 28)  # over all rows: rings differ, and so do their returns
_NUM_KNOWN = NUM_DIFFERENCES + 7 + NUM_CLASSES + 2 * len(_ROW_CYCLES)
_DIFFERENCE = 0.02  # encoded; larger differences to neighbours count by their logarithm
_OUTPUT_FACTOR = 0.2  # brings logits and logarithms of scales near [-1, 1]
_LOG_MOVE = -6.0  # size of the first moves of ranges, encoded: .0025, 5 cm at 10 m
_LOG_MOVES = (-10.0, -3.5)  # at most 6 % of the range in log2
_INTENSITY = 0.2  # encoded, unit of the moves of intensities


class Texture(nn.Module):
    """Draws an image from noise and from what a decoder says about its pixels.

    The likeliest range of each pixel makes trees smooth and far ground too near, and no pixel
    loses its return by chance. Here, noise of single pixels and of blocks of 2 x 4 and 8 x 32
    pixels takes part: it chooses between the two modes of a range, moves the range, the logit of
    the return and the intensity. Trained by :func:`r3dpa.losses.energy_score`, images of the same
    latents differ from each other as scans of these latents do.

    Args:
        channels: Channels at full resolution.
        hidden: Channels at the resolution of the blocks.
    """

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        folded = channels * math.prod(_BLOCK)
        self.conv_in = CircularConv2d(_NUM_KNOWN + _PIXEL_NOISE, channels, (3, 3))
        self.down = nn.Conv2d(folded + _BLOCK_NOISE + _COARSE_NOISE, hidden, 1)
        self.mid = nn.ModuleList(DilatedBlock(hidden, dilation) for dilation in (1, 2, 4, 1))
        self.up = nn.Conv2d(hidden, folded, 1)
        self.mix = nn.Conv2d(channels + _PIXEL_NOISE, channels, 1)
        self.fine = nn.ModuleList(DilatedBlock(channels, dilation=1) for _ in range(2))
        self.conv_out = Float32CircularConv2d(channels, 5, (3, 3))

    def noise_size(self, size: Size) -> int:
        """Standard normal values that an image of this size, rows and columns, takes."""
        return sum(math.prod(shape) for shape in _noise_shapes(size))

    def forward(self, outputs: Tensor, ranges: Tensor, noise: Tensor) -> Tensor:
        """Images ``(B, 3, H, W)``: encoded ranges, logits of a return, encoded intensities.

        Args:
            outputs: ``(B, 22, H, W)`` of a decoder: the parameters of a
                :class:`r3dpa.nn.pixel_outputs.RangeMixture`, the logit of a return, the intensity
                and the logits of the classes.
            ranges: ``(B, 1, H, W)`` encoded ranges that are made of them without noise.
            noise: ``(B, noise_size)`` standard normal.
        """
        shapes = _noise_shapes((outputs.shape[-2], outputs.shape[-1]))
        parts = noise.split([math.prod(shape) for shape in shapes], dim=1)
        before, after, blocks, coarse = (
            part.unflatten(1, shape) for part, shape in zip(parts, shapes, strict=True)
        )
        p, q = _COARSE
        coarse = repeat(coarse, "B C h w -> B C (h p) (w q)", p=p, q=q)
        coarse = coarse[:, :, : blocks.shape[2], : blocks.shape[3]]

        known = torch.cat([self._known(outputs, ranges), before], dim=1)
        hidden = self.conv_in(known.to(self.conv_in.weight.dtype))
        p, q = _BLOCK
        folded = rearrange(F.silu(hidden), "B C (h p) (w q) -> B (C p q) h w", p=p, q=q)
        folded = self.down(
            torch.cat([folded, blocks.to(folded.dtype), coarse.to(folded.dtype)], dim=1)
        )
        for block in self.mid:
            folded = block(folded)
        unfolded = self.up(F.silu(folded))
        hidden = hidden + rearrange(unfolded, "B (C p q) h w -> B C (h p) (w q)", p=p, q=q)
        hidden = self.mix(torch.cat([hidden, after.to(hidden.dtype)], dim=1))
        for block in self.fine:
            hidden = block(hidden)
        return self._image(outputs, ranges, self.conv_out(F.silu(hidden)))

    def _known(self, outputs: Tensor, ranges: Tensor) -> Tensor:
        """What the network sees of the outputs ``(B, 22, H, W)``, and which row a pixel is in."""
        differences = torch.asinh(neighbour_differences(outputs, ranges) / _DIFFERENCE)
        logits = _OUTPUT_FACTOR * outputs[:, 2:6]
        intensity, classes = outputs[:, 6:7], outputs[:, 7:].softmax(dim=1)
        place = torch.linspace(0, 1, outputs.shape[2], device=outputs.device)
        angles = 2 * math.pi * place * torch.tensor(_ROW_CYCLES, device=place.device)[:, None]
        rows = torch.cat([place[None], angles.sin(), angles.cos()])[None, :, :, None]
        rows = rows.expand(len(outputs), -1, -1, outputs.shape[3])
        return torch.cat([differences, logits, intensity, ranges, classes, rows], dim=1)

    def _image(self, outputs: Tensor, ranges: Tensor, drawn: Tensor) -> Tensor:
        """Image of the outputs of a decoder, moved by what was drawn ``(B, 5, H, W)``."""
        choice, move, log_size, returns, intensity = drawn.split(1, dim=1)
        first, second, logit = outputs[:, :1], outputs[:, 1:2], outputs[:, 4:5]
        at_first = (ranges - first).abs() < (ranges - second).abs()
        other, odds = torch.where(at_first, second, first), torch.where(at_first, -logit, logit)
        share = torch.sigmoid(4 * choice + odds.clamp(-8, 8) - 3)  # of the other mode
        size = (_LOG_MOVE + log_size).clamp(*_LOG_MOVES).exp()
        moved = ranges + share * (other - ranges) + size * move.tanh()
        logits = 2 * outputs[:, 5:6] + 4 * returns
        return torch.cat([moved, logits, outputs[:, 6:7] + _INTENSITY * intensity], dim=1)


def _noise_shapes(size: Size) -> list[tuple[int, int, int]]:
    """Channels, rows and columns of the noise of pixels (twice), blocks, coarse blocks."""
    rows, columns = size
    if rows % _BLOCK[0] or columns % _BLOCK[1]:
        raise ValueError(f"a texture needs images of a multiple of {_BLOCK} pixels, got {size}")
    blocks = rows // _BLOCK[0], columns // _BLOCK[1]
    coarse = math.ceil(blocks[0] / _COARSE[0]), math.ceil(blocks[1] / _COARSE[1])
    pixels = (_PIXEL_NOISE, rows, columns)
    return [
        pixels,
        pixels,
        (_BLOCK_NOISE, *blocks),
        (_COARSE_NOISE, *coarse),
    ]

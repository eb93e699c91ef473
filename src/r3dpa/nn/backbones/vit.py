"""Vision transformer of the range-image networks of the metrics, and the blocks of DINOv2.

Letters: B batch, h x w token grid, N = h * w tokens, D token width.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from r3dpa.nn.layers import Mlp, SelfAttention

_HEAD_WIDTH = 64  # of every released ViT
_MLP_RATIO = 4
_TABLE_STD = 0.02

Size = tuple[int, int]


class TransformerTrunk(nn.Module):
    """Class token, learned positions and pre-norm blocks of a ViT, without the last norm.

    Positions of the training grid ``grid_size`` are resized bilinearly to that of the patches.

    Source: ViT (Dosovitskiy et al. 2021); names and order of computation of timm.
    """

    def __init__(
        self, width: int, depth: int, num_heads: int, grid_size: Size, norm_eps: float
    ) -> None:
        super().__init__()
        if num_heads < 1 or width % num_heads:
            raise ValueError(f"num_heads must divide the width {width}, got {num_heads}")
        rows, columns = self.grid_size = grid_size
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.randn(1, 1 + rows * columns, width) * _TABLE_STD)
        self.blocks = nn.ModuleList(Block(width, num_heads, norm_eps) for _ in range(depth))

    def forward(self, patches: Tensor) -> Tensor:
        """Class token, then row-major tokens, ``(B, 1 + N, D)``, of patches ``(B, D, h, w)``."""
        size = (patches.shape[-2], patches.shape[-1])
        positions = resized_positions(self.pos_embed, self.grid_size, size, "bilinear")
        tokens = with_class_token(self.cls_token, patches) + positions
        for block in self.blocks:
            tokens = block(tokens)
        return tokens


def with_class_token(cls_token: Tensor, patches: Tensor) -> Tensor:
    """Class token, then row-major tokens, ``(B, 1 + N, D)``, of patches ``(B, D, h, w)``."""
    class_token = cls_token.expand(len(patches), -1, -1)
    return torch.cat([class_token, rearrange(patches, "B D h w -> B (h w) D")], dim=1)


def resized_positions(
    table: Tensor, grid_size: Size, size: Size, mode: str, antialias: bool = False
) -> Tensor:
    """Position table ``(1, 1 + N, D)`` of ``grid_size``, interpolated to the grid ``size``."""
    if size == grid_size:
        return table
    grid = rearrange(table[:, 1:], "1 (h w) D -> 1 D h w", h=grid_size[0])
    grid = F.interpolate(grid, size, mode=mode, antialias=antialias)
    return torch.cat([table[:, :1], rearrange(grid, "1 D h w -> 1 (h w) D")], dim=1)


def trunk_depth(names: Iterable[str]) -> int:
    """Number of transformer blocks of a state dict with official names."""
    indices = [re.search(r"(?:^|\.)blocks\.(\d+)\.", name) for name in names]
    return max((int(index[1]) + 1 for index in indices if index), default=0)


def usual_heads(width: int) -> int:
    """Number of heads of the released ViT of this width, which its weights do not determine."""
    if width % _HEAD_WIDTH:
        raise ValueError(
            f"tokens of width {width} do not divide into heads of {_HEAD_WIDTH}; give num_heads."
        )
    return width // _HEAD_WIDTH


class Block(nn.Module):
    """Pre-norm transformer block; ``layer_scale`` weights the channels of both branches."""

    def __init__(
        self, width: int, num_heads: int, norm_eps: float, layer_scale: bool = False
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, norm_eps)
        self.attn = SelfAttention(width, num_heads)
        self.ls1 = _Scale(width) if layer_scale else nn.Identity()
        self.norm2 = nn.LayerNorm(width, norm_eps)
        self.mlp = Mlp(width, _MLP_RATIO * width)
        self.ls2 = _Scale(width) if layer_scale else nn.Identity()

    def forward(self, tokens: Tensor) -> Tensor:
        """``(B, N, D)`` to the same shape."""
        tokens = tokens + self.ls1(self.attn(self.norm1(tokens)))
        return tokens + self.ls2(self.mlp(self.norm2(tokens)))


class _Scale(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, tokens: Tensor) -> Tensor:
        return tokens * self.gamma

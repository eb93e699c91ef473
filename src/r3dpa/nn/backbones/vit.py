"""The plain vision transformer that both range-image networks of the metrics share.

Letters: B batch, h x w token grid, N = h * w tokens, D token width.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from r3dpa.nn.layers import SelfAttention

_HEAD_WIDTH = 64  # of every released ViT
_MLP_RATIO = 4
_TABLE_STD = 0.02


class TransformerTrunk(nn.Module):
    """Class token, learned positions and pre-norm blocks of a ViT, without the last norm.

    Positions are resized bilinearly (corners not aligned) to another token grid.

    Source: ViT (Dosovitskiy et al. 2021); names and order of computation of its timm
    implementation.

    Args:
        width: Token width D.
        depth: Number of blocks.
        num_heads: Attention heads, a divisor of ``width``.
        grid_size: Rows and columns of the token grid in training.
        norm_eps: Added to the variance in every layer norm.

    Raises:
        ValueError: If ``num_heads`` does not divide ``width``.
    """

    def __init__(
        self, width: int, depth: int, num_heads: int, grid_size: tuple[int, int], norm_eps: float
    ) -> None:
        super().__init__()
        if num_heads < 1 or width % num_heads:
            raise ValueError(f"num_heads must divide the width {width}, got {num_heads}")
        rows, columns = self.grid_size = grid_size
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.randn(1, 1 + rows * columns, width) * _TABLE_STD)
        self.blocks = nn.ModuleList(_Block(width, num_heads, norm_eps) for _ in range(depth))

    def forward(self, patches: Tensor) -> Tensor:
        """Class token and tokens behind the last block.

        Args:
            patches: ``(B, D, h, w)`` embedded patches.

        Returns:
            ``(B, 1 + N, D)``, the class token first, the others row-major.
        """
        positions = self._positions(patches.shape[-2], patches.shape[-1])
        class_token = self.cls_token.expand(len(patches), -1, -1)
        tokens = torch.cat([class_token, rearrange(patches, "B D h w -> B (h w) D")], dim=1)
        tokens = tokens + positions
        for block in self.blocks:
            tokens = block(tokens)
        return tokens

    def _positions(self, rows: int, columns: int) -> Tensor:
        if (rows, columns) == self.grid_size:
            return self.pos_embed
        table = rearrange(self.pos_embed[:, 1:], "1 (h w) D -> 1 D h w", h=self.grid_size[0])
        table = F.interpolate(table, (rows, columns), mode="bilinear", align_corners=False)
        return torch.cat([self.pos_embed[:, :1], rearrange(table, "1 D h w -> 1 (h w) D")], dim=1)


def trunk_depth(names: Iterable[str]) -> int:
    """Number of transformer blocks of a state dict with official names."""
    indices = [re.search(r"(?:^|\.)blocks\.(\d+)\.", name) for name in names]
    return max((int(index[1]) + 1 for index in indices if index), default=0)


def usual_heads(width: int) -> int:
    """Number of heads of the released ViT of this width, which its weights do not tell.

    Raises:
        ValueError: If no released ViT can have this width.
    """
    if width % _HEAD_WIDTH:
        raise ValueError(
            f"tokens of width {width} do not divide into heads of {_HEAD_WIDTH}; give num_heads."
        )
    return width // _HEAD_WIDTH


class _Block(nn.Module):
    def __init__(self, width: int, num_heads: int, norm_eps: float) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, norm_eps)
        self.attn = SelfAttention(width, num_heads)
        self.norm2 = nn.LayerNorm(width, norm_eps)
        self.mlp = _Mlp(width)

    def forward(self, tokens: Tensor) -> Tensor:
        tokens = tokens + self.attn(self.norm1(tokens))
        return tokens + self.mlp(self.norm2(tokens))


class _Mlp(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, _MLP_RATIO * width)
        self.fc2 = nn.Linear(_MLP_RATIO * width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(tokens)))

"""Vision transformers: the trunk of the range-image networks of the metrics, and DINOv2.

Letters: B batch, h x w token grid, N = h * w tokens, D token width, S side of a square image.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable
from pathlib import Path

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from r3dpa.features.official import load_strictly, read_released
from r3dpa.nn.layers import Mlp, SelfAttention, Size

_HEAD_WIDTH = 64  # of every released ViT
_MLP_RATIO = 4
_TABLE_STD = 0.02
_PATCH = 14  # of DINOv2
_EPS = 1e-6
# Mean and deviation of red, green and blue in [0, 1] on ImageNet.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class TransformerTrunk(nn.Module):
    """Class token, learned positions and pre-norm blocks of a ViT, without the last norm.

    Positions of the training grid ``grid_size`` are resized bilinearly to the grid of the patches.

    Source: ViT (Dosovitskiy et al. 2021); names and order of computation of timm.
    """

    def __init__(
        self, width: int, depth: int, num_heads: int, grid_size: Size, norm_eps: float
    ) -> None:
        super().__init__()
        rows, columns = self.grid_size = grid_size
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.randn(1, 1 + rows * columns, width) * _TABLE_STD)
        self.blocks = nn.ModuleList(
            TransformerBlock(width, num_heads, norm_eps) for _ in range(depth)
        )

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
            f"tokens of width {width} do not divide into heads of {_HEAD_WIDTH}; give num_heads"
        )
    return width // _HEAD_WIDTH


class TransformerBlock(nn.Module):
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


class DINOv2(nn.Module):
    """Vision transformer of DINOv2 without registers; the defaults are ViT-B/14.

    State-dict keys and shapes as in the released ``dinov2_vit{s,b,l}14_pretrain.pth``. The
    features are the normalised patch tokens of the last block; positions are resized by antialiased
    bicubic interpolation.

    Source: Oquab et al., "DINOv2: learning robust visual features without supervision" (TMLR
    2024); resizing and input size as in REPA (Yu et al. 2025) and REPA-E.

    Args:
        weights: Released file. Default: random weights, which `fit` refuses.
        dim: Token width D, a multiple of ``num_heads``.
        depth: Number of blocks.
        num_heads: Attention heads.
        grid_size: Side of the token grid of the position table.

    Attributes:
        trained: Whether the weights were read from a file.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        weights: str | None = None,
        dim: int = 768,
        depth: int = 12,
        num_heads: int = 12,
        grid_size: int = 37,
    ) -> None:
        super().__init__()
        self.dim, self.grid_size = dim, grid_size
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim))
        self.pos_embed = nn.Parameter(torch.randn(1, 1 + grid_size**2, dim) * 0.02)
        self.mask_token = nn.Parameter(torch.zeros(1, dim))  # of its training; not used here
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, dim, _PATCH, stride=_PATCH)})
        self.blocks = nn.ModuleList(
            TransformerBlock(dim, num_heads, _EPS, True) for _ in range(depth)
        )
        self.norm = nn.LayerNorm(dim, _EPS)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD)[:, None, None], persistent=False)
        self.trained = weights is not None
        if weights is not None:
            self._load(Path(weights))

    def forward(self, image: Tensor, grid_size: tuple[int, int]) -> Tensor:
        """Features ``(B, N, D)`` of the cells of a grid ``(h, w)``, row-major.

        Images are ``(B, 3, S, S)`` red, green, blue in [-1, 1], resized to 14 pixels a cell.
        """
        sides = [_PATCH * cells for cells in grid_size]
        image = ((image + 1) / 2 - self.mean) / self.std
        image = F.interpolate(image, sides, mode="bicubic")
        tokens = with_class_token(self.cls_token, self.patch_embed["proj"](image))
        table_size = (self.grid_size, self.grid_size)
        tokens = tokens + resized_positions(
            self.pos_embed, table_size, grid_size, "bicubic", antialias=True
        )
        for block in self.blocks:
            tokens = block(tokens)
        return self.norm(tokens)[:, 1:]

    def _load(self, path: Path) -> None:
        released = "a released dinov2_vit?14_pretrain.pth, without registers"
        try:
            with torch.serialization.safe_globals([argparse.Namespace]):
                load_strictly(self, read_released(path, released), str)
        except ValueError as error:
            raise ValueError(
                f"{path} as DINOv2 of width {self.dim} and {len(self.blocks)} blocks: {error}"
            ) from error

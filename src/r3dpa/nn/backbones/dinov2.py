"""DINOv2, an image network whose features stage 0 may be aligned with.

Letters: B batch, h x w token grid, N = h * w tokens, D token width, S side of a square image.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.io import UNPICKLING_ERRORS, first_line
from r3dpa.nn.backbones.vit import Block, resized_positions, with_class_token

__all__ = ["DINOv2"]

_PATCH = 14
_EPS = 1e-6
_MEAN = (0.485, 0.456, 0.406)  # of ImageNet, red, green, blue in [0, 1]
_STD = (0.229, 0.224, 0.225)


class DINOv2(nn.Module):
    """Vision transformer of DINOv2 without registers; the defaults are ViT-B/14.

    State-dict keys and shapes are those of the released ``dinov2_vit{s,b,l}14_pretrain.pth``. The
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
        trained: Whether the weights are those of a file.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is damaged, would run code, or does not fit, naming all keys.
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
        self.blocks = nn.ModuleList(Block(dim, num_heads, _EPS, True) for _ in range(depth))
        self.norm = nn.LayerNorm(dim, _EPS)
        self.register_buffer("mean", torch.tensor(_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(_STD)[:, None, None], persistent=False)
        self.trained = weights is not None
        if weights is not None:
            self._load(Path(weights))

    def forward(self, image: Tensor, grid_size: tuple[int, int]) -> Tensor:
        """Features ``(B, N, D)`` of the cells of a grid, row-major.

        Args:
            image: ``(B, 3, S, S)`` red, green, blue in [-1, 1]; resized to 14 pixels a cell.
            grid_size: Rows and columns ``(h, w)`` of the cells.
        """
        sides = [_PATCH * cells for cells in grid_size]
        image = ((image + 1) / 2 - self.mean) / self.std
        image = F.interpolate(image, sides, mode="bicubic")
        tokens = with_class_token(self.cls_token, self.patch_embed["proj"](image))
        tokens = tokens + self._positions(grid_size)
        for block in self.blocks:
            tokens = block(tokens)
        return self.norm(tokens)[:, 1:]

    def _positions(self, grid_size: tuple[int, int]) -> Tensor:
        table_size = (self.grid_size, self.grid_size)
        return resized_positions(self.pos_embed, table_size, grid_size, "bicubic", antialias=True)

    def _load(self, path: Path) -> None:
        if not path.is_file():
            raise FileNotFoundError(f"no file {path}; give a released dinov2_vitb14_pretrain.pth")
        try:
            with torch.serialization.safe_globals([argparse.Namespace]):
                state = torch.load(path, map_location="cpu", weights_only=True)
            self.load_state_dict(state, strict=True)
        except UNPICKLING_ERRORS as error:
            raise ValueError(
                f"{path} holds no DINOv2 of width {self.dim} and {len(self.blocks)} blocks "
                f"({first_line(error)}): give a released dinov2_vit?14_pretrain.pth, without "
                "registers, with dim, depth and num_heads of its size"
            ) from error

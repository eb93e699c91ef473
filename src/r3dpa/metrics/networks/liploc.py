"""LIP-Loc's encoder of range images, whose features FLD compares.

Letters: B batch, H x W range image, D token width.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.features.dinov2 import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    TransformerTrunk,
    trunk_depth,
    usual_heads,
)
from r3dpa.features.official import (
    FrozenNetwork,
    key_renamer,
    load_strictly,
    naming,
    read_state_dict,
)

_NORM_EPS = 1e-6
GREY_LEVELS_PER_M = 5.1
_ENCODER = "encoder_lidar.model."
# Beginning of our names -> of the official ones.
_NAMES = {"embedding.": "patch_embed.proj.", "encoder.": "", "norm.": "fc_norm."}


class LIPLoc(FrozenNetwork):
    """Features of range images for FLD: mean of the patch tokens of a ViT, normalised.

    Range images become grey pictures as in the published numbers, see :func:`wrapped_picture`.
    The defaults are the sizes of ViT-S/16. Always in evaluation mode.

    Source: LIP-Loc (Puligilla et al. 2024) as ``eval/models/liploc`` of valeoai/R3DPA uses it.

    Args:
        picture_side: Rows and columns of the square pictures, a multiple of ``patch_side``.
        patch_side: Rows and columns of a patch.
        width: Token width D, also the width of the features (``dim``).
        depth: Number of transformer blocks.
        num_heads: Attention heads.
    """

    def __init__(
        self,
        picture_side: int = 224,
        patch_side: int = 16,
        width: int = 384,
        depth: int = 12,
        num_heads: int = 6,
    ) -> None:
        super().__init__()
        if picture_side % patch_side:
            raise ValueError(
                f"pictures of {picture_side} pixels do not divide into patches of {patch_side}"
            )
        self.picture_side, self.dim = picture_side, width
        self.embedding = nn.Conv2d(3, width, patch_side, patch_side)
        grid_side = picture_side // patch_side
        self.encoder = TransformerTrunk(width, depth, num_heads, (grid_side, grid_side), _NORM_EPS)
        self.norm = nn.LayerNorm(width, _NORM_EPS)
        self.requires_grad_(False).eval()

    @classmethod
    def from_checkpoint(cls, path: str | Path, *, num_heads: int | None = None) -> Self:
        """Load weights and sizes of ``encoder_lidar`` from an official ``model.ckpt``."""
        with naming(path):
            weights = {
                name.removeprefix(_ENCODER): value
                for name, value in read_state_dict(Path(path)).items()
                if name.startswith(_ENCODER)
            }
            sizes = _sizes(weights)
            heads = usual_heads(sizes["width"]) if num_heads is None else num_heads
            network = cls(**sizes, num_heads=heads)
            load_strictly(network, weights, key_renamer(_NAMES))
        return network

    def forward(self, range_m: Tensor) -> Tensor:
        """Features ``(B, dim)`` of range images ``(B, H, W)`` in metres, -1 without a return."""
        pictures = wrapped_picture(range_m, (self.picture_side, self.picture_side))
        return self.norm(self.encoder(self.embedding(pictures))[:, 1:].mean(dim=1))


def wrapped_picture(range_m: Tensor, size: tuple[int, int] = (224, 224)) -> Tensor:
    """Pictures ``(B, 3, *size)`` float32 of range images, as in LIP-Loc's published numbers.

    The bytes of :func:`wrapped_grey_levels`, resized bilinearly with antialiasing, repeated for
    three colours, and normalised with the constants of ImageNet.

    Source: ``createRangeImage`` and ``Model.preprocess`` of valeoai/R3DPA.
    """
    grey = wrapped_grey_levels(range_m).float()[:, None] / 255
    grey = F.interpolate(grey, size, mode="bilinear", align_corners=False, antialias=True)
    mean, std = (grey.new_tensor(v).view(3, 1, 1) for v in (IMAGENET_MEAN, IMAGENET_STD))
    return (grey - mean) / std


def wrapped_grey_levels(range_m: Tensor) -> Tensor:
    """Range as bytes, ``trunc(5.1 * range_m) mod 256`` in float32; any shape, metres, finite.

    Empty pixels (-1) become 251, nearly white; ranges from 256 / 5.1 = 50.2 m on start from black
    again. The official code leaves this to a C cast, which is undefined outside of 0..255 and gives
    the same on x86.
    """
    return torch.remainder(torch.trunc(range_m.float() * GREY_LEVELS_PER_M), 256).to(torch.uint8)


def _sizes(weights: Mapping[str, Tensor]) -> dict[str, int]:
    patches, positions = weights.get("patch_embed.proj.weight"), weights.get("pos_embed")
    if patches is None or positions is None or patches.ndim != 4 or positions.ndim != 3:
        raise ValueError(
            f"holds no LIP-Loc with a ViT: no {_ENCODER}patch_embed.proj.weight or "
            f"{_ENCODER}pos_embed"
        )
    patch_side = patches.shape[-1]
    return {
        "picture_side": math.isqrt(positions.shape[1] - 1) * patch_side,
        "patch_side": patch_side,
        "width": patches.shape[0],
        "depth": trunk_depth(weights),
    }

"""HDiT, the hourglass transformer of R2Flow: neighbourhood attention, global in the middle.

Letters: B batch, C channels, H x W image, h x w tokens of a level, D token width, E width of the
time embedding. Module names as in the official state dict.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import torch
import torch.nn.functional as F
from einops import rearrange
from einops.layers.torch import Rearrange
from torch import Tensor, nn

from r3dpa.baselines.efficient_unet import Blocks, Encoding, encode_angles, hdl64e_angles
from r3dpa.baselines.neighbourhood import neighbourhood_attention
from r3dpa.nn.layers import Size, at_least_float32, zeroed

_MAX_LOG_SCALE = math.log(100)
_linear = partial(nn.Linear, bias=False)


class HDiT(nn.Module):
    """Velocity of noisy range images, from an hourglass of attention blocks.

    Each level halves rows and columns of the tokens and doubles their width. Attention sees a
    window of tokens, whose columns wrap around, and all tokens at the last level. But for
    ``spatial_pe``, rotating a scene by tokens of the last level (32 columns) rotates the velocity.

    Source: Hourglass diffusion transformer (Crowson et al. 2024) as in R2Flow (Nakashima et al.
    2025). The default has 80.9 M parameters.

    Args:
        resolution: Rows and columns of the images.
        in_channels: Channels C of images and velocities.
        base_channels: Token width of the first level.
        time_channels: Width E of the time embedding.
        patch_size: Rows and columns of a token.
        window_size: Rows and columns of the attention window, odd.
        depths: Blocks of each level, on the way down and again on the way up; last, of the middle.
        num_heads: Attention heads of each level.
        mlp_ratio: Width of the feed-forward layers in units of the token width.
        mapping_depth: Feed-forward layers of the time embedding, and of the position embedding
            where that is a network.
        positional_embedding: ``learnable_embedding``: a vector per token; otherwise a network of
            the ray angles, encoded as in :func:`~r3dpa.baselines.efficient_unet.encode_angles`.

    Raises:
        ValueError: If tokens of the last level do not divide the image.
    """

    coords: Tensor

    def __init__(
        self,
        resolution: Size = (64, 1024),
        in_channels: int = 2,
        base_channels: int = 128,
        time_channels: int = 256,
        patch_size: Size = (1, 4),
        window_size: Size = (3, 9),
        depths: Sequence[int] = (3, 3, 3, 3),
        num_heads: Sequence[int] = (2, 4, 8, 16),
        mlp_ratio: float = 3.0,
        mapping_depth: int = 2,
        positional_embedding: Literal["learnable_embedding"] | Encoding = "learnable_embedding",
    ) -> None:
        super().__init__()
        levels = len(depths) - 1
        least = patch_size[0] << levels, patch_size[1] << levels
        if resolution[0] % least[0] or resolution[1] % least[1]:
            raise ValueError(f"resolution must be a multiple of {least}, got {tuple(resolution)}")
        self.resolution, self.in_channels, self.patch_size = resolution, in_channels, patch_size
        self.register_buffer("coords", hdl64e_angles(resolution))
        grid = resolution[0] // patch_size[0], resolution[1] // patch_size[1]
        self.spatial_pe: nn.Module
        if positional_embedding == "learnable_embedding":
            self.spatial_pe = _LearnedPositions(base_channels, grid)
        else:
            self.spatial_pe = nn.Sequential(
                _EncodedAngles(base_channels, grid, positional_embedding),
                _mapping(base_channels, mlp_ratio, mapping_depth),
            )
        time_mapping = _mapping(time_channels, mlp_ratio, mapping_depth)
        self.timestep_pe = nn.Sequential(_TimeFeatures(time_channels), time_mapping)
        self.tokenizer = nn.Sequential(
            nn.Conv2d(in_channels, base_channels, patch_size, patch_size, bias=False),
            Rearrange("B D h w -> B h w D"),
        )
        self.down_levels, self.up_levels = nn.ModuleDict(), nn.ModuleDict()
        for level, (depth, heads) in enumerate(zip(depths, num_heads, strict=True)):
            width = base_channels << level
            harmonics = max(1, grid[0] // 2 >> level), max(1, grid[1] // 2 >> level)
            window = window_size if level < levels else None
            attention = width, time_channels, heads, window, harmonics
            feed_forward = width, int(width * mlp_ratio), time_channels
            if level == levels:
                self.mid_levels = _blocks(depth, attention, feed_forward)
                break
            for part in (self.down_levels, self.up_levels):
                part[f"level_{level}"] = _blocks(depth, attention, feed_forward)
            self.down_levels[f"merge_{level}"] = nn.Sequential(
                Rearrange("B (h p) (w q) D -> B h w (p q D)", p=2, q=2),
                _linear(4 * width, 2 * width),
            )
            self.up_levels[f"expand_{level}"] = _Expand(2 * width)
        rows, columns = patch_size
        self.detokenizer = nn.Sequential(
            _RmsNorm(base_channels),
            zeroed(_linear(base_channels, rows * columns * in_channels)),
            Rearrange("B h w (p q C) -> B C (h p) (w q)", p=rows, q=columns),
        )

    def forward(self, image: Tensor, time: Tensor) -> Tensor:
        """Velocity ``(B, C, H, W)`` of images ``(B, C, H, W)`` at times ``(B,)`` (0 data)."""
        embedding = self.timestep_pe(time)
        angles = [F.avg_pool2d(self.coords, self.patch_size, self.patch_size)]
        hidden = self.tokenizer(image) + self.spatial_pe(angles[0])
        skipped = []
        for level in range(len(self.down_levels) // 2):
            hidden = self.down_levels[f"level_{level}"](hidden, angles[-1], embedding)
            skipped.append(hidden)
            angles.append(F.avg_pool2d(angles[-1], 2))
            hidden = self.down_levels[f"merge_{level}"](hidden)
        hidden = self.mid_levels(hidden, angles[-1], embedding)
        for level in reversed(range(len(skipped))):
            hidden = self.up_levels[f"expand_{level}"](hidden, skipped[level])
            hidden = self.up_levels[f"level_{level}"](hidden, angles[level], embedding)
        return self.detokenizer(hidden)


class _RmsNorm(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(width))

    def forward(self, tokens: Tensor) -> Tensor:
        return (_normalise_rms(tokens) * self.scale).to(tokens.dtype)


class _TimedRmsNorm(nn.Module):
    """RMS norm whose scale is 1 plus a linear map of the time embedding."""

    def __init__(self, width: int, embedding: int) -> None:
        super().__init__()
        self.proj = nn.Sequential(zeroed(_linear(embedding, width)), Rearrange("B D -> B 1 1 D"))

    def forward(self, tokens: Tensor, embedding: Tensor) -> Tensor:
        return _normalise_rms(tokens).to(tokens.dtype) * (1 + self.proj(embedding))


class _LearnedPositions(nn.Module):
    """One learned vector per token."""

    def __init__(self, width: int, grid: Size) -> None:
        super().__init__()
        self.embedding = nn.Parameter(torch.empty(1, *grid, width))
        nn.init.trunc_normal_(self.embedding, std=0.02)

    def forward(self, angles: Tensor) -> Tensor:
        return self.embedding


class _EncodedAngles(nn.Module):
    """Linear map of encoded ray angles ``(1, 2, h, w)`` to ``(1, h, w, D)``."""

    def __init__(self, width: int, grid: Size, encoding: Encoding) -> None:
        super().__init__()
        self.grid, self.encoding = grid, encoding
        with torch.device("cpu"):  # also where networks are built without memory
            encoded = encode_angles(torch.zeros(1, 2, 1, 1), encoding, grid)
        self.linear = _linear(encoded.shape[1], width)

    def forward(self, angles: Tensor) -> Tensor:
        encoded = encode_angles(angles, self.encoding, self.grid)
        return self.linear(rearrange(encoded, "B E h w -> B h w E"))


class _TimeFeatures(nn.Module):
    """Linear map of cosines and sines of ``2 pi t f`` at fixed random frequencies."""

    freqs: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("freqs", torch.randn(width // 2))
        self.linear = _linear(width, width)

    def forward(self, time: Tensor) -> Tensor:
        angles = time[:, None] * (2 * math.pi * self.freqs)
        return self.linear(torch.cat([angles.cos(), angles.sin()], dim=1))


class _FeedForward(nn.Module):
    """Linear layers around a gated GELU; the norm of tokens is ``adarms`` and takes the time."""

    def __init__(self, width: int, hidden: int, embedding: int | None = None) -> None:
        super().__init__()
        if embedding is None:
            self.norm = _RmsNorm(width)
        else:
            self.adarms = _TimedRmsNorm(width, embedding)
        self.gegelu = _linear(width, 2 * hidden)
        self.linear = zeroed(_linear(hidden, width))

    def forward(self, tokens: Tensor, *time: Tensor) -> Tensor:
        normalised = self.adarms(tokens, *time) if time else self.norm(tokens)
        values, gate = self.gegelu(normalised).chunk(2, dim=-1)
        return tokens + self.linear(values * F.gelu(gate))


def _mapping(width: int, mlp_ratio: float, depth: int) -> nn.Sequential:
    """Feed-forward layers between two norms."""
    layers = [_FeedForward(width, int(width * mlp_ratio)) for _ in range(depth)]
    return nn.Sequential(_RmsNorm(width), *layers, _RmsNorm(width))


class _RotaryEmbedding(nn.Module):
    """Rotation of each head's dimensions i and i + d/2 by multiples of inclination and azimuth.

    The multiples are whole numbers, so the azimuth has no seam; they are spread over the heads.
    """

    freqs_h: Tensor
    freqs_w: Tensor

    def __init__(self, head_width: int, num_heads: int, harmonics: Size) -> None:
        super().__init__()
        quarter = head_width // 4
        for name, most in zip(("freqs_h", "freqs_w"), harmonics, strict=True):
            values = torch.linspace(0, math.log(most), quarter * num_heads).exp().round()
            self.register_buffer(name, values.view(quarter, num_heads).T.contiguous())

    def forward(self, angles: Tensor) -> Tensor:
        """Angles ``(1, h, w, heads, d/2)`` of ray angles ``(1, 2, h, w)``, radians."""
        inclination, azimuth = rearrange(angles, "B two h w -> two B h w 1 1")
        return torch.cat([inclination * self.freqs_h, azimuth * self.freqs_w], dim=-1)

    @staticmethod
    def rotate(vectors: Tensor, angles: Tensor) -> Tensor:
        """Rotated vectors ``(B, h, w, heads, d)``."""
        first, second = vectors.chunk(2, dim=-1)
        cosine, sine = angles.cos(), angles.sin()
        rotated = first * cosine - second * sine, first * sine + second * cosine
        return torch.cat(rotated, dim=-1).to(vectors.dtype)


class _CosineAttention(nn.Module):
    """Attention by the cosine of rotated queries and keys, in a window or between all tokens."""

    def __init__(
        self, width: int, embedding: int, num_heads: int, window: Size | None, harmonics: Size
    ) -> None:
        super().__init__()
        self.heads, self.window = num_heads, window
        self.norm = _TimedRmsNorm(width, embedding)
        self.scale = nn.Parameter(torch.full((num_heads, 1), math.log(10)))
        self.qkv_proj = _linear(width, 3 * width)
        self.rope = _RotaryEmbedding(width // num_heads, num_heads, harmonics)
        self.out_proj = zeroed(_linear(width, width))

    def forward(self, tokens: Tensor, angles: Tensor, embedding: Tensor) -> Tensor:
        qkv = self.qkv_proj(self.norm(tokens, embedding))
        query, key, value = rearrange(
            qkv, "B h w (three head d) -> three B h w head d", three=3, head=self.heads
        )
        scale = self.scale.clamp(max=_MAX_LOG_SCALE).div(2).exp()
        turn = self.rope(angles)
        query, key = (
            self.rope.rotate(F.normalize(x, dim=-1, eps=1e-6) * scale, turn).to(value.dtype)
            for x in (query, key)
        )
        if self.window is None:
            query, key, value = (
                rearrange(x, "B h w head d -> B head (h w) d") for x in (query, key, value)
            )
            mixed = F.scaled_dot_product_attention(query, key, value, scale=1.0)
            mixed = rearrange(mixed, "B head (h w) d -> B h w (head d)", h=tokens.shape[1])
        else:
            mixed = neighbourhood_attention(query, key, value, self.window, wrap_columns=True)
            mixed = mixed.flatten(3)
        return tokens + self.out_proj(mixed)


def _blocks(depth: int, attention: tuple[Any, ...], feed_forward: tuple[Any, ...]) -> Blocks:
    return Blocks(_TokenBlock(attention, feed_forward) for _ in range(depth))


class _TokenBlock(nn.Module):
    def __init__(self, attention: tuple[Any, ...], feed_forward: tuple[Any, ...]) -> None:
        super().__init__()
        self.residual_attn, self.residual_ffn = (
            _CosineAttention(*attention),
            _FeedForward(*feed_forward),
        )

    def forward(self, tokens: Tensor, angles: Tensor, embedding: Tensor) -> Tensor:
        return self.residual_ffn(self.residual_attn(tokens, angles, embedding), embedding)


class _Expand(nn.Module):
    """Tokens of the next finer level, blended with those that were kept on the way down."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear = _linear(width, 2 * width)
        self.alpha = nn.Parameter(torch.zeros(width // 2))

    def forward(self, tokens: Tensor, skipped: Tensor) -> Tensor:
        fine = rearrange(self.linear(tokens), "B h w (p q D) -> B (h p) (w q) D", p=2, q=2)
        return torch.lerp(skipped, fine.to(skipped.dtype), self.alpha.sigmoid().to(skipped.dtype))


def _normalise_rms(tokens: Tensor) -> Tensor:
    values = at_least_float32(tokens)
    return F.rms_norm(values, values.shape[-1:], eps=1e-6)

"""Variational autoencoder of RGB images, in the architecture of Stable Diffusion.

Letters: B batch, C latent channels, H x W image size, h x w latent size.
"""

from __future__ import annotations

from collections.abc import Callable

import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from r3dpa.nn.layers import named_layers
from r3dpa.nn.vae import Autoencoder

_NORM_EPS = 1e-6
_RGB = 3


class ImageVAE(Autoencoder):
    """Convolutional autoencoder of RGB images; the defaults are Stable Diffusion's, f8d4.

    Images are red, green and blue. Level i has ``channels[i]`` channels and half the rows and
    columns of level i - 1. Latents are not scaled: :class:`r3dpa.nn.LatentNorm` replaces the usual
    factor 0.18215.

    Source: Rombach et al., "High-resolution image synthesis with latent diffusion models" (CVPR
    2022). State-dict keys follow ``AutoencoderKL`` in diffusers, whose safetensors files
    :func:`r3dpa.checkpoints.read_checkpoint` reads.

    Args:
        latent_channels: Channels C of the latents.
        channels: Width of each level, multiples of ``norm_groups``.
        num_res_blocks: Residual blocks per encoder level; decoder levels have one more.
        norm_groups: Groups of all group norms.
    """

    def __init__(
        self,
        latent_channels: int = 4,
        channels: tuple[int, ...] = (128, 256, 512, 512),
        num_res_blocks: int = 2,
        norm_groups: int = 32,
    ) -> None:
        if not channels or any(width % norm_groups for width in channels):
            raise ValueError(
                f"channels must be multiples of norm_groups {norm_groups}, got {channels}"
            )
        super().__init__(
            _Encoder(2 * latent_channels, list(channels), num_res_blocks, norm_groups),
            _Decoder(latent_channels, list(channels), num_res_blocks + 1, norm_groups),
            _RGB,
            latent_channels,
            (2 ** (len(channels) - 1), 2 ** (len(channels) - 1)),
        )


class _Encoder(nn.Module):
    def __init__(self, out_channels: int, widths: list[int], num_blocks: int, groups: int) -> None:
        super().__init__()
        self.conv_in = nn.Conv2d(_RGB, widths[0], 3, padding=1)
        self.down_blocks = _levels(widths, num_blocks, groups, "downsamplers", _downsample)
        self.mid_block = _Middle(widths[-1], groups)
        self.conv_norm_out = nn.GroupNorm(groups, widths[-1], _NORM_EPS)
        self.conv_out = nn.Conv2d(widths[-1], out_channels, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        hidden = self.conv_in(image)
        for level in self.down_blocks:
            hidden = level(hidden)
        return self.conv_out(F.silu(self.conv_norm_out(self.mid_block(hidden))))


class _Decoder(nn.Module):
    def __init__(self, in_channels: int, widths: list[int], num_blocks: int, groups: int) -> None:
        super().__init__()
        widths = widths[::-1]  # up_blocks.0 is the lowest resolution
        self.conv_in = nn.Conv2d(in_channels, widths[0], 3, padding=1)
        self.mid_block = _Middle(widths[0], groups)
        self.up_blocks = _levels(widths, num_blocks, groups, "upsamplers", _upsample)
        self.conv_norm_out = nn.GroupNorm(groups, widths[-1], _NORM_EPS)
        self.conv_out = nn.Conv2d(widths[-1], _RGB, 3, padding=1)

    def forward(self, latents: Tensor) -> Tensor:
        hidden = self.mid_block(self.conv_in(latents))
        for level in self.up_blocks:
            hidden = level(hidden)
        return self.conv_out(F.silu(self.conv_norm_out(hidden)))


def _levels(
    widths: list[int],
    num_blocks: int,
    groups: int,
    name: str,
    resampler: Callable[[int], nn.Module],
) -> nn.ModuleList:
    """Levels of the given widths; all but the last end with a resampling layer called ``name``."""
    levels = nn.ModuleList()
    before = widths[0]
    for index, width in enumerate(widths):
        sizes = [(before, width), *[(width, width)] * (num_blocks - 1)]
        blocks = nn.ModuleList(_ResBlock(*size, groups) for size in sizes)
        last = index == len(widths) - 1
        resampling = nn.ModuleList([] if last else [resampler(width)])
        levels.append(_Level({"resnets": blocks, name: resampling}))
        before = width
    return levels


class _Level(nn.ModuleDict):
    def forward(self, hidden: Tensor) -> Tensor:
        for layers in self.values():
            for layer in layers.children():
                hidden = layer(hidden)
        return hidden


def _downsample(channels: int) -> nn.Module:
    pad = nn.ZeroPad2d((0, 1, 0, 1))  # right and bottom only, as released
    return named_layers(pad=pad, conv=nn.Conv2d(channels, channels, 3, stride=2))


def _upsample(channels: int) -> nn.Module:
    conv = nn.Conv2d(channels, channels, 3, padding=1)
    return named_layers(up=nn.Upsample(scale_factor=2), conv=conv)


class _Middle(nn.Module):
    def __init__(self, channels: int, groups: int) -> None:
        super().__init__()
        self.attentions = nn.ModuleList([_Attention(channels, groups)])
        self.resnets = nn.ModuleList(_ResBlock(channels, channels, groups) for _ in range(2))

    def forward(self, hidden: Tensor) -> Tensor:
        return self.resnets[1](self.attentions[0](self.resnets[0](hidden)))


class _ResBlock(nn.Module):
    def __init__(self, in_channels: int, out_channels: int, groups: int) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(groups, in_channels, _NORM_EPS)
        self.conv1 = nn.Conv2d(in_channels, out_channels, 3, padding=1)
        self.norm2 = nn.GroupNorm(groups, out_channels, _NORM_EPS)
        self.conv2 = nn.Conv2d(out_channels, out_channels, 3, padding=1)
        same = in_channels == out_channels
        self.conv_shortcut = nn.Identity() if same else nn.Conv2d(in_channels, out_channels, 1)

    def forward(self, hidden: Tensor) -> Tensor:
        change = self.conv1(F.silu(self.norm1(hidden)))
        change = self.conv2(F.silu(self.norm2(change)))
        return self.conv_shortcut(hidden) + change


class _Attention(nn.Module):
    def __init__(self, channels: int, groups: int) -> None:
        super().__init__()
        self.group_norm = nn.GroupNorm(groups, channels, _NORM_EPS)
        self.to_q = nn.Linear(channels, channels)
        self.to_k = nn.Linear(channels, channels)
        self.to_v = nn.Linear(channels, channels)
        self.to_out = nn.ModuleList([nn.Linear(channels, channels)])

    def forward(self, hidden: Tensor) -> Tensor:
        pixels = rearrange(self.group_norm(hidden), "b c h w -> b 1 (h w) c")
        mixed = F.scaled_dot_product_attention(
            self.to_q(pixels), self.to_k(pixels), self.to_v(pixels)
        )
        mixed = rearrange(self.to_out[0](mixed), "b 1 (h w) c -> b c h w", h=hidden.shape[-2])
        return hidden + mixed

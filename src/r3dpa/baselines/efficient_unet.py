"""Efficient U-Net on range images of R2DM and R2Flow, with the angles of the rays as an input.

Letters: B batch, C channels, H x W image size, D width of the time embedding.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from r3dpa.geometry import LidarSensor, Projection, SphericalProjection
from r3dpa.nn.layers import CircularConv2d, SelfAttention, Size, zeroed

Encoding = Literal["spherical_harmonics", "polar_coordinates", "fourier_features"]
_HALF = 1 / math.sqrt(2)  # keeps the variance of a sum of two branches
_LEVELS = 4


class Shared(NamedTuple):
    """Settings of all blocks of a network: width D of the time embedding, layers, heads, ring."""

    width: int
    norm: Callable[..., nn.GroupNorm]
    conv: Callable[[int, int], nn.Conv2d]
    heads: int
    ring: bool


class EfficientUNet(nn.Module):
    """U-Net of R2DM, and of R2Flow with times of a flow.

    Four levels, each half the size of the one before, with attention at the lowest. Columns wrap
    around, rows are padded with zeros.

    Source: Nakashima and Kurazume, R2DM (ICRA 2024), after Imagen (Saharia et al. 2022).

    Args:
        in_channels: Channels C of image and output.
        resolution: Rows and columns of the image.
        base_channels: Channels at full size.
        temb_channels: Width D of the time embedding; four times ``base_channels`` where None.
        channel_multiplier: Channels of the levels, over ``base_channels``.
        num_residual_blocks: Residual blocks of the levels, on each way.
        gn_num_groups: Groups of the group norms.
        gn_eps: Added to their variances.
        attn_num_heads: Heads of the attention.
        coords_encoding: Encoding of the ray angles, see :func:`encode_angles`; None for no angles.
        ring: Wrap columns around; else they are padded with zeros as well.

    Attributes:
        coords: ``(1, 2, H, W)`` inclination and azimuth of the rays, radians; rays through the
            upper left pixel corners of an HDL-64E, until other weights or data set them.
    """

    coords: Tensor

    def __init__(
        self,
        in_channels: int,
        resolution: Size,
        base_channels: int = 64,
        temb_channels: int | None = None,
        channel_multiplier: Sequence[int] = (1, 2, 4, 8),
        num_residual_blocks: Sequence[int] = (3, 3, 3, 3),
        gn_num_groups: int = 8,
        gn_eps: float = 1e-6,
        attn_num_heads: int = 8,
        coords_encoding: Encoding | None = "fourier_features",
        ring: bool = True,
    ) -> None:
        super().__init__()
        counts = len(channel_multiplier), len(num_residual_blocks)
        if counts != (_LEVELS, _LEVELS) or any(side % 8 for side in resolution):
            raise ValueError(
                f"the U-Net has {_LEVELS} levels, and images divisible by 8, got {counts} "
                f"multipliers and numbers of blocks, and {tuple(resolution)} pixels"
            )
        self.in_channels, self.resolution = in_channels, (resolution[0], resolution[1])
        self.coords_encoding, self.base_channels = coords_encoding, base_channels
        self.register_buffer("coords", hdl64e_angles(self.resolution))
        with torch.device("cpu"):  # also where networks are built without memory
            known = encode_angles(torch.zeros(1, 2, 1, 1), coords_encoding, self.resolution)
        width = temb_channels or 4 * base_channels
        self.time_embedding = nn.Sequential(
            nn.Linear(base_channels, width), nn.SiLU(), nn.Linear(width, width)
        )
        norm, conv = partial(nn.GroupNorm, gn_num_groups, eps=gn_eps), partial(conv3x3, ring=ring)
        shared = Shared(width, norm, conv, attn_num_heads, ring)
        widths = [base_channels * factor for factor in channel_multiplier]
        self._build(in_channels + known.shape[1], widths, num_residual_blocks, shared)

    def _build(
        self, channels: int, widths: Sequence[int], counts: Sequence[int], shared: Shared
    ) -> None:
        """First and last convolution, and the levels between, on an image of some channels."""
        base, last = self.base_channels, _LEVELS - 1
        c = [base, *widths]
        self.in_conv: nn.Module = shared.conv(channels, base)
        self.down = nn.ModuleList(
            ResolutionLevel(c[i], c[i + 1], counts[i], shared, i == last, down=i > 0)
            for i in range(_LEVELS)
        )
        # Deepest first; the skip of its own level joins every block but that.
        self.up = nn.ModuleList(
            ResolutionLevel(
                c[i + 1] * (1 + (i < last)), c[i], counts[i], shared, i == last, up=i > 0
            )
            for i in reversed(range(_LEVELS))
        )
        self.out_conv: nn.Module = zeroed(shared.conv(base, self.in_channels))

    def forward(self, image: Tensor, time: Tensor) -> Tensor:
        """Prediction ``(B, C, H, W)`` for images at times ``(B,)`` or ``()``, unscaled."""
        embedding = self.time_embedding(sinusoid(time.expand(len(image)), self.base_channels))
        angles = encode_angles(self.coords, self.coords_encoding, self.resolution)
        image = torch.cat([image, angles.to(image).expand(len(image), -1, -1, -1)], dim=1)
        return self.out_conv(self._levels(self.in_conv(image), embedding))

    def _levels(self, hidden: Tensor, embedding: Tensor) -> Tensor:
        skips: list[Tensor] = []
        for block in self.down:
            hidden = block(hidden, embedding)
            skips.append(hidden)
        skips.pop()
        hidden = self.up[0](hidden, embedding)
        for block in self.up[1:]:
            hidden = block(torch.cat([hidden, skips.pop()], dim=1), embedding)
        return hidden


class Blocks(nn.ModuleList):
    """Blocks in a row, with further inputs that all of them take."""

    def forward(self, hidden: Tensor, *more: Tensor) -> Tensor:
        """Output of the last one, of the shape that it gives."""
        for block in self:
            hidden = block(hidden, *more)
        return hidden


class ResolutionLevel(nn.Module):
    """A level: step down, residual blocks, attention, step up; all but the blocks are optional."""

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        num_blocks: int,
        shared: Shared,
        attends: bool,
        down: bool = False,
        up: bool = False,
    ) -> None:
        super().__init__()
        self.downsample: nn.Module = nn.Identity()
        self.upsample: nn.Module = nn.Identity()
        if down:
            half = Resample(down=(2, 2), ring=shared.ring)
            self.downsample = nn.Sequential(shared.conv(in_channels, out_channels), half)
            in_channels = out_channels
        inputs = [in_channels, *[out_channels] * (num_blocks - 1)]
        self.blocks = Blocks(ResidualBlock(width, out_channels, shared) for width in inputs)
        self.attention = ImageAttention(out_channels, shared) if attends else nn.Identity()
        if up:
            twice = Resample(up=(2, 2), ring=shared.ring)
            self.upsample = nn.Sequential(twice, shared.conv(out_channels, out_channels))

    def forward(self, image: Tensor, embedding: Tensor) -> Tensor:
        """``(B, C, H, W)`` and ``(B, D)`` to the size after the step."""
        return self.upsample(self.attention(self.blocks(self.downsample(image), embedding)))


class ResidualBlock(nn.Module):
    """Two convolutions after group norm and SiLU, the second norm modulated by the time.

    ``resample`` changes the size in both branches, ``attends`` adds attention behind.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        shared: Shared,
        attends: bool = False,
        resample: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.norm1 = shared.norm(in_channels)
        self.conv1 = shared.conv(in_channels, out_channels)
        self.norm2 = shared.norm(out_channels, affine=False)
        self.modulation = nn.Linear(shared.width, 2 * out_channels)
        self.conv2 = zeroed(shared.conv(out_channels, out_channels))
        same = in_channels == out_channels
        self.skip = nn.Identity() if same else nn.Conv2d(in_channels, out_channels, 1)
        self.resample = resample or nn.Identity()
        self.attention = ImageAttention(out_channels, shared) if attends else nn.Identity()

    def forward(self, image: Tensor, embedding: Tensor) -> Tensor:
        """``(B, in_channels, H, W)`` and ``(B, D)`` to ``(B, out_channels, H, W)``."""
        hidden = self.norm2(self.conv1(F.silu(self.resample(self.norm1(image)))))
        scale, shift = self.modulation(F.silu(embedding))[..., None, None].chunk(2, dim=1)
        hidden = self.conv2(F.silu(hidden * (1 + scale) + shift))
        return self.attention((self.resample(self.skip(image)) + hidden) * _HALF)


class ImageAttention(nn.Module):
    """Multi-head attention between all pixels, added to the image."""

    def __init__(self, channels: int, shared: Shared) -> None:
        super().__init__()
        self.norm = shared.norm(channels)
        self.mix = SelfAttention(channels, shared.heads)
        zeroed(self.mix.proj)

    def forward(self, image: Tensor) -> Tensor:
        """``(B, C, H, W)`` to the same shape."""
        mixed = self.mix(rearrange(self.norm(image), "b c h w -> b (h w) c"))
        return (image + rearrange(mixed, "b (h w) c -> b c h w", h=image.shape[2])) * _HALF


def conv3x3(in_channels: int, out_channels: int, ring: bool) -> nn.Conv2d:
    """Convolution that keeps the size; with ``ring`` columns wrap around."""
    if ring:
        return CircularConv2d(in_channels, out_channels, (3, 3))
    return nn.Conv2d(in_channels, out_channels, 3, padding=1)


class Resample(nn.Module):
    """Filters rows and columns; keeps every ``down``-th pixel, or inserts zeros first for ``up``.

    The window is symmetric; it is divided by its sum and, for ``up``, multiplied by the factor.
    """

    def __init__(
        self,
        up: Size = (1, 1),
        down: Size = (1, 1),
        window: Sequence[float] = (1, 3, 3, 1),
        ring: bool = True,
    ) -> None:
        super().__init__()
        self.up, self.down, self.ring = up, down, ring
        self.window = tuple(value / sum(window) for value in window)

    def forward(self, image: Tensor) -> Tensor:
        """``(B, C, H, W)`` to ``(B, C, H up / down, W up / down)``."""
        size, (rows, columns) = len(self.window), self.up
        if max(self.up) > 1:
            batch, channels, height, width = image.shape
            spread = image.new_zeros(batch, channels, height * rows, width * columns)
            spread[..., ::rows, ::columns] = image
            image = spread
        pads = [
            pad
            for up, down in zip(self.up[::-1], self.down[::-1], strict=True)
            for pad in ((size - up * down + 1) // 2 + up - 1, (size - up * down) // 2)
        ]
        image = F.pad(image, (*pads[:2], 0, 0), mode="circular" if self.ring else "constant")
        window = image.new_tensor(self.window)
        kernel = rows * columns * torch.outer(window, window).expand(image.shape[1], 1, -1, -1)
        image = F.pad(image, (0, 0, *pads[2:]))
        return F.conv2d(image, kernel, stride=self.down, groups=image.shape[1])


def sinusoid(time: Tensor, width: int, max_period: float = 10_000.0) -> Tensor:
    """Features ``(B, width)`` of times ``(B,)``: sines, then cosines.

    Frequencies fall from 1 to exactly ``1 / max_period``, unlike in
    :func:`r3dpa.nn.velocity_network.time_frequencies`.
    """
    half = width // 2
    step = -math.log(max_period) / (half - 1)
    angles = time[:, None] * torch.exp(step * torch.arange(half, device=time.device))
    return torch.cat([angles.sin(), angles.cos()], dim=1)


def corner_angles(projection: Projection) -> Tensor:
    """Inclination and azimuth ``(1, 2, H, W)`` of the upper left pixel corners, radians."""
    angles = torch.meshgrid(*projection.ray_angles(corner=True), indexing="ij")
    return torch.stack(angles)[None].float()


def hdl64e_angles(size: Size) -> Tensor:
    """Corner angles of the HDL-64E as R2DM assumes it, for images ``(H, W)``."""
    return corner_angles(SphericalProjection(LidarSensor(*size)))


def encode_angles(angles: Tensor, encoding: Encoding | None, size: Size) -> Tensor:
    """Encoded ray angles ``(1, E, H, W)`` of angles ``(1, 2, H, W)``.

    ``fourier_features``: sines, then cosines of the inclination times ``2^k`` for
    ``k < log2(rows)`` and of the azimuth for ``k < log2(columns)`` of the image of this ``size``;
    ``spherical_harmonics``: the 25 of degree 4 and less; ``polar_coordinates``: the angles.
    """
    if encoding is None:
        return angles[:, :0]
    if encoding == "polar_coordinates":
        return angles
    if encoding == "spherical_harmonics":
        return spherical_harmonics(angles)
    powers = (
        2.0 ** torch.arange(math.ceil(math.log2(side)), device=angles.device) for side in size
    )
    each = [angles[:, i : i + 1] * power[:, None, None] for i, power in enumerate(powers)]
    phases = torch.cat(each, dim=1)
    return torch.cat([phases.sin(), phases.cos()], dim=1)


def spherical_harmonics(angles: Tensor) -> Tensor:
    """Real spherical harmonics ``(1, 25, H, W)`` of degrees 0 to 4 in the direction of the rays.

    Orders of a degree run from -l to l. The y axis points to the right, as in the official code.
    """
    sine = angles[:, 0].double().sin()
    azimuth = -angles[:, 1].double()
    harmonics = []
    for degree in range(5):
        for order in range(-degree, degree + 1):
            m = abs(order)
            below = torch.zeros_like(sine)
            legendre = math.prod(range(1, 2 * m, 2)) * (1 - sine.square()) ** (m / 2)
            for n in range(m + 1, degree + 1):
                above = (2 * n - 1) * sine * legendre - (n + m - 1) * below
                below, legendre = legendre, above / (n - m)
            factor = (2 - (m == 0)) * (2 * degree + 1) / (4 * math.pi)
            factor *= math.factorial(degree - m) / math.factorial(degree + m)
            wave = (m * azimuth).sin() if order < 0 else (m * azimuth).cos()
            harmonics.append(math.sqrt(factor) * legendre * wave)
    return torch.stack(harmonics, dim=1).to(angles.dtype)

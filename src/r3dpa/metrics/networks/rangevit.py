"""RangeViT, whose decoder features FRID compares.

Letters: B batch, H x W range image, D token width, C decoder channels.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import torch
import torch.nn.functional as F
from einops import rearrange, reduce
from torch import Tensor, nn

from r3dpa.features.dinov2 import TransformerTrunk, trunk_depth, usual_heads
from r3dpa.features.official import (
    FrozenNetwork,
    key_renamer,
    load_strictly,
    naming,
    read_state_dict,
)
from r3dpa.geometry import EMPTY_RANGE_M, LidarSensor, SphericalProjection, unproject
from r3dpa.nn.layers import Size

_NORM_EPS = 1e-5
# Mean and deviation of range, x, y, z in metres and intensity on KITTI-360, of valeoai/R3DPA.
_MEAN = (11.274, 0.076, 0.246, -1.041, 0.215)
_DEVIATION = (9.816, 10.239, 7.616, 0.797, 0.181)
_STEM = "rangevit.encoder.patch_embed."
_DECODER = "rangevit.decoder.up_conv_block."
# Beginning of our names -> of the official ones.
_NAMES = {
    "image_": "image_",
    "stem.": f"{_STEM}conv_block.",
    "embedding.": f"{_STEM}proj_block.1.",
    "encoder.": "rangevit.encoder.",
    "norm.": "rangevit.encoder.norm.",
    "upsample.": f"{_DECODER}conv_upsample.0.",
    "merge.": f"{_DECODER}conv1.",
    "output.": f"{_DECODER}conv_output.",
}
_CLASSIFIER = "rangevit.kpclassifier."  # works on points, behind the features


class RangeViT(FrozenNetwork):
    """Features of range images for FRID: decoder channels averaged over bands of rows.

    Always in evaluation mode. The defaults are the sizes of the released networks: ``in_channels``
    4 for ``rangevit_wo_i`` and 5 for ``rangevit_w_i``, which also reads the intensity.

    Source: RangeViT (Ando et al., CVPR 2023) as ``eval/models/rangevit`` of valeoai/R3DPA uses it.
    LiDAR-Diffusion's FRID uses another network; its scores are not comparable.

    Args:
        sensor: Image size, field of view and range limits. Default: as in R3DPA.
        in_channels: Number of input channels, of range, x, y, z and intensity, 1..5.
        width: Token width D.
        depth: Number of transformer blocks.
        num_heads: Attention heads.
        stem_channels: Channels of the first convolutions.
        skip_channels: Channels of the result of the convolutions, which the decoder reads too.
        decoder_channels: Channels C of the decoder.
        trained_size: Rows and columns of the images in training, for the position table.
        patch_size: Rows and columns of a patch, even numbers.
        band_rows: Rows of the image that one value of the features averages over.

    Attributes:
        dim: Width of the features, ``C * H / band_rows``.
    """

    image_mean: Tensor
    image_std: Tensor

    def __init__(
        self,
        sensor: LidarSensor | None = None,
        in_channels: int = 4,
        width: int = 384,
        depth: int = 12,
        num_heads: int = 6,
        stem_channels: int = 32,
        skip_channels: int = 256,
        decoder_channels: int = 128,
        trained_size: Size = (64, 384),
        patch_size: Size = (2, 8),
        band_rows: int = 8,
    ) -> None:
        super().__init__()
        sensor = sensor or LidarSensor()
        if sensor.beams % band_rows:
            raise ValueError(f"{sensor.beams} beams do not divide into bands of {band_rows} rows")
        for size in ((sensor.beams, sensor.columns), trained_size):
            if size[0] % patch_size[0] or size[1] % patch_size[1]:
                raise ValueError(f"{size} rows and columns do not divide into {patch_size} patches")
        self.sensor, self.in_channels = sensor, in_channels
        self.patch_size, self.band_rows = patch_size, band_rows
        self.dim = decoder_channels * sensor.beams // band_rows
        rows, columns = patch_size
        self.register_buffer("image_mean", torch.tensor(_MEAN).view(1, -1, 1, 1))
        self.register_buffer("image_std", torch.tensor(_DEVIATION).view(1, -1, 1, 1))
        self.stem = nn.Sequential(
            _ContextBlock(in_channels, stem_channels),
            _ContextBlock(stem_channels, stem_channels),
            _ContextBlock(stem_channels, stem_channels),
            _DenseBlock(stem_channels, skip_channels),
        )
        self.embedding = nn.Conv2d(skip_channels, width, 1)
        grid_size = trained_size[0] // rows, trained_size[1] // columns
        self.encoder = TransformerTrunk(width, depth, num_heads, grid_size, _NORM_EPS)
        self.norm = nn.LayerNorm(width, _NORM_EPS)
        self.upsample = nn.Conv2d(width, decoder_channels * rows * columns, 1)
        self.merge = _activated(
            nn.Conv2d(decoder_channels + skip_channels, decoder_channels, 3, padding=1)
        )
        self.output = _activated(nn.Conv2d(decoder_channels, decoder_channels, 1))
        self.requires_grad_(False).eval()

    @classmethod
    def from_checkpoint(
        cls,
        path: str | Path,
        sensor: LidarSensor | None = None,
        *,
        num_heads: int | None = None,
        **sizes: Any,
    ) -> Self:
        """Network with the weights of an official ``model.ckpt``, which determine most sizes.

        Other sizes are the released ones, unless ``num_heads`` or ``sizes`` give them.
        """
        with naming(path):
            weights = read_state_dict(Path(path))
            stem_channels, in_channels = _shape(weights, f"{_STEM}conv_block.0.conv1.weight")[:2]
            width, skip_channels = _shape(weights, f"{_STEM}proj_block.1.weight")[:2]
            network = cls(
                sensor,
                in_channels,
                width,
                trunk_depth(weights),
                usual_heads(width) if num_heads is None else num_heads,
                stem_channels,
                skip_channels,
                _shape(weights, f"{_DECODER}conv_output.0.weight")[0],
                **sizes,
            )
            load_official(network, weights)
        return network

    def forward(self, range_m: Tensor, intensity: Tensor | None = None) -> Tensor:
        """Features ``(B, dim)``: for each channel the means of bands of rows, from the top.

        Ranges ``(B, H, W)`` are metres, ``EMPTY_RANGE_M`` without a return; the intensity, in
        [0, 1], is read with ``in_channels`` 5 only.
        """
        features = self.feature_map(range_m, intensity)
        return reduce(features, "B C (band row) W -> B (C band)", "mean", row=self.band_rows)

    def feature_map(self, range_m: Tensor, intensity: Tensor | None = None) -> Tensor:
        """Result of the decoder ``(B, C, H, W)``; arguments as of :meth:`forward`."""
        if self.in_channels == len(_MEAN) and intensity is None:
            raise ValueError("this network reads the intensity: give it beside the range images")
        channels = range_channels(range_m, self.sensor, intensity)[:, : self.in_channels]
        used = channels.shape[1]
        skip = self.stem((channels - self.image_mean[:, :used]) / self.image_std[:, :used])
        tokens = self.norm(self.encoder(self.embed(skip)))[:, 1:]
        rows, columns = self.patch_size
        tokens = rearrange(tokens, "B (h w) D -> B D h w", h=self.sensor.beams // rows)
        pixels = rearrange(
            self.upsample(tokens), "B (C r c) h w -> B C (h r) (w c)", r=rows, c=columns
        )
        return self.output(self.merge(torch.cat([pixels, skip], dim=1)))

    def embed(self, skip: Tensor) -> Tensor:
        """Patches ``(B, D, h, w)`` of the result ``(B, skip_channels, H, W)`` of the stem.

        Patches overlap by a pixel, and zeros beyond the border count in their means.
        """
        rows, columns = self.patch_size
        pooled = F.avg_pool2d(
            skip, (rows + 1, columns + 1), self.patch_size, (rows // 2, columns // 2)
        )
        return self.embedding(pooled)


def range_channels(range_m: Tensor, sensor: LidarSensor, intensity: Tensor | None = None) -> Tensor:
    """Input of RangeViT ``(B, 4 or 5, H, W)``: range, x, y, z in metres (and intensity).

    The point of a pixel lies on the ray through its upper left corner, as in the official training.
    Pixels not strictly inside the range limits have x = y = z = -1; their range is unchanged.

    Source: ``preprocess_range`` and ``range2xyz`` of valeoai/R3DPA.
    """
    range_m = range_m.float()
    points = unproject(range_m, SphericalProjection(sensor), corner=True)
    valid_mask = (range_m > sensor.range_min_m) & (range_m < sensor.range_max_m)
    points = torch.where(valid_mask[..., None], points, EMPTY_RANGE_M)
    channels = [range_m, *points.unbind(dim=-1)]
    if intensity is not None:
        channels.append(intensity.float())
    return torch.stack(channels, dim=1)


def load_official(network: RangeViT, weights: Mapping[str, Tensor]) -> None:
    """Load every key of an official state dict but for the point classifier behind the features.

    Files of the original training lack the normalisation of the input, for which the official code
    has the constants of KITTI-360.
    """
    constants = {"image_mean": network.image_mean, "image_std": network.image_std}
    features = {name: value for name, value in weights.items() if not name.startswith(_CLASSIFIER)}
    load_strictly(network, constants | features, key_renamer(_NAMES))


def _shape(weights: Mapping[str, Tensor], name: str) -> torch.Size:
    if name not in weights or weights[name].ndim != 4:
        raise ValueError(f"holds no RangeViT with convolutional stem: no convolution {name}")
    return weights[name].shape


def _activated(convolution: nn.Conv2d) -> nn.Sequential:
    return nn.Sequential(convolution, nn.LeakyReLU(), nn.BatchNorm2d(convolution.out_channels))


class _ContextBlock(nn.Module):
    """Two convolutions, the second dilated, added to a 1 x 1 convolution (SalsaNext)."""

    def __init__(self, in_channels: int, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, channels, 1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv3 = nn.Conv2d(channels, channels, 3, padding=2, dilation=2)
        self.bn2 = nn.BatchNorm2d(channels)

    def forward(self, image: Tensor) -> Tensor:
        shortcut = F.leaky_relu(self.conv1(image))
        hidden = self.bn1(F.leaky_relu(self.conv2(shortcut)))
        return shortcut + self.bn2(F.leaky_relu(self.conv3(hidden)))


class _DenseBlock(nn.Module):
    """Three sequential convolutions, merged by a fourth (SalsaNext)."""

    def __init__(self, in_channels: int, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, channels, 1)
        self.conv2 = nn.Conv2d(in_channels, channels, 3, padding=1)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv3 = nn.Conv2d(channels, channels, 3, padding=2, dilation=2)
        self.bn2 = nn.BatchNorm2d(channels)
        self.conv4 = nn.Conv2d(channels, channels, 2, padding=1, dilation=2)
        self.bn3 = nn.BatchNorm2d(channels)
        self.conv5 = nn.Conv2d(3 * channels, channels, 1)
        self.bn4 = nn.BatchNorm2d(channels)

    def forward(self, image: Tensor) -> Tensor:
        first = self.bn1(F.leaky_relu(self.conv2(image)))
        second = self.bn2(F.leaky_relu(self.conv3(first)))
        third = self.bn3(F.leaky_relu(self.conv4(second)))
        merged = self.conv5(torch.cat([first, second, third], dim=1))
        return F.leaky_relu(self.conv1(image)) + self.bn4(F.leaky_relu(merged))

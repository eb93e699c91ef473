"""RangeNet++, whose features FRD and FRID of R2DM, R2Flow and LiDM compare.

Letters: B batch, H x W range image, C channels.
"""

from __future__ import annotations

import re
import tarfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path, PurePosixPath
from random import Random
from typing import Any, Literal, Self

import torch
import yaml
from einops import reduce
from torch import Tensor, nn

from r3dpa.features.official import FrozenNetwork, load_strictly, read_released
from r3dpa.io import UNPICKLING_ERRORS, first_line

_BLOCKS = {21: (1, 1, 2, 2, 1), 53: (1, 2, 8, 8, 4)}
_WIDTH = 32
NUM_BANDS = 16
NUM_PICKED = 4096
# Mean and deviation of range, x, y, z in metres and remission where the weights come without.
_MEAN = (12.12, 10.88, 0.23, -1.04, 0.21)
_DEVIATION = (12.32, 11.47, 6.91, 0.86, 0.16)
_PARTS = ("backbone", "segmentation_decoder", "segmentation_head", "arch_cfg.yaml")
_RELEASED = "the .tar.gz of the release, or the folder of its files"


class RangeNet(FrozenNetwork):
    """RangeNet++ with zero padding on all sides; always in evaluation mode.

    Columns are halved five times, rows never. Weights have the names that R2Flow gives them.

    Source: Milioto et al., "RangeNet++" (IROS 2019).

    Args:
        layers: 21 or 53, of the encoder.
        in_channels: Number of channels, of range, x, y, z in metres and remission, 1..5.
        num_classes: Classes of the head; 0 leaves it out.
        mean: Mean of each channel, for :meth:`normalise`.
        deviation: Standard deviation of each channel.
    """

    image_mean: Tensor
    image_std: Tensor
    width = _WIDTH

    def __init__(
        self,
        layers: Literal[21, 53] = 53,
        in_channels: int = 5,
        num_classes: int = 20,
        mean: tuple[float, ...] = _MEAN,
        deviation: tuple[float, ...] = _DEVIATION,
    ) -> None:
        super().__init__()
        self.in_channels = in_channels
        self.stem = _activated(nn.Conv2d(in_channels, _WIDTH, 3, padding=1, bias=False))
        widths = [_WIDTH << level for level in range(len(_BLOCKS[layers]) + 1)]
        for level, num_blocks in enumerate(_BLOCKS[layers], 1):
            narrow, wide = widths[level - 1], widths[level]
            down = nn.Conv2d(narrow, wide, 3, (1, 2), padding=1, bias=False)
            up = nn.ConvTranspose2d(wide, narrow, (1, 4), (1, 2), padding=(0, 1))
            self.add_module(f"enc{level}", _DarknetLevel(down, num_blocks))
            self.add_module(f"dec{level}", _DarknetLevel(up, 1))
        self.head: nn.Module | None = None
        if num_classes:
            self.head = nn.Sequential(nn.Identity(), nn.Conv2d(_WIDTH, num_classes, 3, padding=1))
        for name, values in (("image_mean", mean), ("image_std", deviation)):
            channels = torch.tensor(values[:in_channels]).view(1, -1, 1, 1)
            self.register_buffer(name, channels, persistent=False)
        self.requires_grad_(False).eval()

    @classmethod
    def from_weights(cls, weights: Mapping[str, Tensor], **constants: Any) -> Self:
        """Load a state dict with the names of RangeNet++ or R2Flow, strictly.

        Args:
            weights: The state dict.
            constants: ``mean`` and ``deviation``.

        Raises:
            ValueError: If the weights do not fit.
        """
        ours = {our_name(key): value for key, value in weights.items()}
        stem, head = ours.get("stem.0.weight"), ours.get("head.1.bias", ())
        if stem is None:
            raise ValueError(f"holds no weights of RangeNet++; give {_RELEASED}")
        layers: Any = 53 if any(key.startswith("enc3.residual_blocks.7.") for key in ours) else 21
        network = cls(layers, stem.shape[1], len(head), **constants)
        load_strictly(network, ours, lambda key: key)
        return network

    @classmethod
    def from_checkpoint(cls, path: str | Path) -> Self:
        """Load a released archive or its folder, or a file with one state dict.

        Mean and deviation come from ``arch_cfg.yaml``, where there is one.

        Raises:
            ValueError: If the weights cannot be read or do not fit; names the file.
        """
        try:
            return cls._of_parts(_read_parts(Path(path)))
        except (ValueError, *UNPICKLING_ERRORS) as error:
            raise ValueError(f"{path}: {first_line(error)}") from error

    @classmethod
    def _of_parts(cls, parts: dict[str, Any]) -> Self:
        sensor = parts.pop("arch_cfg.yaml", {}).get("dataset", {}).get("sensor", {})
        constants = {
            ours: tuple(sensor[theirs])
            for ours, theirs in (("mean", "img_means"), ("deviation", "img_stds"))
            if theirs in sensor
        }
        weights = {key: value for part in parts.values() for key, value in part.items()}
        return cls.from_weights(weights, **constants)

    def normalise(self, image: Tensor) -> Tensor:
        """Image ``(B, C, H, W)`` as R2Flow feeds it: standardised, 0 where the range is not > 0."""
        return (image - self.image_mean) / self.image_std * (image[:, :1] > 0)

    def encode(self, image: Tensor) -> list[Tensor]:
        """Activations of the stem and of the five levels ``(B, 32 * 2^i, H, W / 2^i)``."""
        levels = [self.stem(image)]
        for level in range(1, 6):
            levels.append(self.get_submodule(f"enc{level}")(levels[-1]))
        return levels

    def feature_map(self, image: Tensor) -> Tensor:
        """Result of the decoder ``(B, 32, H, W)``, of which all features are taken."""
        *skipped, hidden = self.encode(image)
        for level in range(5, 0, -1):
            hidden = self.get_submodule(f"dec{level}")(hidden) + skipped[level - 1]
        return hidden

    def forward(self, image: Tensor) -> Tensor:
        """Logits of the classes ``(B, num_classes, H, W)``."""
        if self.head is None:
            raise ValueError("these weights have no head for classes: use feature_map")
        return self.head(self.feature_map(image))


def banded(features: Tensor) -> Tensor:
    """Means ``(B, C * 16)`` of 16 bands of rows of each channel of ``(B, C, H, W)``: FRID."""
    return reduce(features, "B C (band row) W -> B (C band)", "mean", band=NUM_BANDS)


def picked(features: Tensor, num: int = NUM_PICKED) -> Tensor:
    """``num`` values of ``(B, C, H, W)`` at fixed places ``(B, num)``: FRD.

    Source: LiDARGen (Zyrianov et al. 2022), as R2DM and R2Flow use it.
    """
    return features.flatten(1)[:, picked_places(features[0].numel(), num)]


def picked_places(size: int, num: int = NUM_PICKED) -> list[int]:
    """Places of :func:`picked` among ``size`` values: Python's sample after seed 0."""
    return Random(0).sample(range(size), num)


def our_name(official: str) -> str:
    """Return R2Flow's name of a weight of RangeNet++; names of R2Flow stay."""
    name = re.sub(r"^conv1\.", "stem.0.", official)
    name = re.sub(r"^bn1\.", "stem.1.", name)
    name = re.sub(r"^1\.", "head.1.", name)
    name = re.sub(r"^(...\d)\.(?:up)?conv\.(?!\d)", r"\1.conv.0.", name)
    name = re.sub(r"^(...\d)\.bn\.", r"\1.conv.1.", name)
    return re.sub(r"\.residual_?(\d*)\.(conv|bn)([12])\.", _residual_name, name)


def _residual_name(match: re.Match[str]) -> str:
    block, layer, number = match.groups()
    place = f"{int(number) - 1}.{1 if layer == 'bn' else 0}"
    return f".residual_blocks.{block or 0}.residual.{place}."


def _read_parts(path: Path) -> dict[str, Any]:
    """Read the released files by name, or ``weights`` from a single file."""
    if path.is_dir():
        files = {name: (path / name).read_bytes() for name in _PARTS if (path / name).is_file()}
    elif path.is_file() and tarfile.is_tarfile(path):
        with tarfile.open(path) as archive:
            members = {PurePosixPath(m.name).name: archive.extractfile(m) for m in archive}
            files = {name: file.read() for name in _PARTS if (file := members.get(name))}
    else:
        content = read_released(path, _RELEASED)
        return {"weights": content.get("state_dict", content) if isinstance(content, dict) else {}}
    parts = {}
    for name, content in files.items():
        if name.endswith(".yaml"):
            parts[name] = yaml.safe_load(content)
        else:
            parts[name] = torch.load(BytesIO(content), map_location="cpu", weights_only=True)
    return parts


def _activated(layer: nn.Conv2d | nn.ConvTranspose2d) -> nn.Sequential:
    return nn.Sequential(layer, nn.BatchNorm2d(layer.out_channels), nn.LeakyReLU(0.1))


class _DarknetLevel(nn.Module):
    """A convolution that changes the width, and residual blocks."""

    def __init__(self, layer: nn.Conv2d | nn.ConvTranspose2d, num_blocks: int) -> None:
        super().__init__()
        self.conv = _activated(layer)
        inside, width = layer.in_channels, layer.out_channels
        self.residual_blocks = nn.ModuleList(
            _DarknetBlock(inside, width) for _ in range(num_blocks)
        )

    def forward(self, image: Tensor) -> Tensor:
        hidden = self.conv(image)
        for block in self.residual_blocks:
            hidden = block(hidden)
        return hidden


class _DarknetBlock(nn.Module):
    def __init__(self, inside: int, width: int) -> None:
        super().__init__()
        self.residual = nn.Sequential(
            _activated(nn.Conv2d(width, inside, 1, bias=False)),
            _activated(nn.Conv2d(inside, width, 3, padding=1, bias=False)),
        )

    def forward(self, image: Tensor) -> Tensor:
        return image + self.residual(image)

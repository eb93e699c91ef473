"""ScaLR: point features of a WaffleIron distilled from images, and its released checkpoint."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from r3dpa.nn.backbones.official import load_strictly, read_released
from r3dpa.nn.backbones.tokens import TokenFeatures
from r3dpa.nn.backbones.voxels import ScanGrid
from r3dpa.nn.backbones.waffleiron import WaffleIron

_RELEASED = "ckpt_last.pth of WI_768-DINOv2_ViT_L_14-NS_KI_PD"
# Where the distillation script and its successor keep the weights; the first that exists counts.
_MODEL_KEYS = ("model_points", "model_point")
_PREFIX = "module."  # of DistributedDataParallel
# Beginning of our names -> of the official ones; {} is the layer.
_NAMES = {
    r"embedding\.norm": "embed.norm",
    r"embedding\.point": "embed.conv1",
    r"embedding\.offset\.(\d)": "embed.conv2.{}",
    r"embedding\.neighbor": "embed.conv2.4",
    r"embedding\.merge": "embed.final",
    r"spatial\.(\d+)\.norm": "waffleiron.spatial_mix.{}.norm",
    r"spatial\.(\d+)\.convs": "waffleiron.spatial_mix.{}.ffn",
    r"spatial\.(\d+)\.scale": "waffleiron.spatial_mix.{}.scale.weight",
    r"channel\.(\d+)\.norm": "waffleiron.channel_mix.{}.norm",
    r"channel\.(\d+)\.mlp": "waffleiron.channel_mix.{}.mlp",
    r"channel\.(\d+)\.scale": "waffleiron.channel_mix.{}.scale.weight",
    r"head": "classif",
}


class ScaLR(TokenFeatures):
    """ScaLR: features distilled from images, of the width of the network.

    Source: Puy et al., "Three Pillars Improving Vision Foundation Model Distillation for Lidar"
    (CVPR 2024); as used by R3DPA.

    Args:
        network: Trained network; its head is taken off.
        grid: How scans are prepared, as in its training; that of the release where None.
        workers: Threads of the neighbour search, -1 for all cores.

    Raises:
        ValueError: If ``network`` has other planes than ``grid``.
    """

    name = "scalr"

    def __init__(
        self, network: WaffleIron, grid: ScanGrid | None = None, *, workers: int = 1
    ) -> None:
        super().__init__(network, grid or ScanGrid(), workers)

    @classmethod
    def from_checkpoint(
        cls, path: str | Path, grid: ScanGrid | None = None, *, workers: int = 1
    ) -> ScaLR:
        """Extractor with the weights of a ScaLR checkpoint; width and depth are those it has.

        Args:
            path: ``ckpt_last.pth`` of the release; nothing in it is executed.
            grid: How scans are prepared, as in its training; that of the release where None.
            workers: Threads of the neighbour search, -1 for all cores.

        Raises:
            ValueError: If the file is missing or unreadable, holds no such network, or if a
                weight is missing, left over or of another shape; the message names the file.
        """
        path, grid = Path(path), grid or ScanGrid()
        try:
            weights = _weights(read_released(path, _RELEASED))
            network = _network_like(weights, grid)
            load_official(network, weights)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        return cls(network, grid, workers=workers)


def load_official(network: WaffleIron, weights: Mapping[str, Tensor]) -> None:
    """Load an official state dict of WaffleIron, every key of it, into a network with a head.

    Args:
        network: Network of the same sizes.
        weights: Tensors by official name, without the prefix of data-parallel training.

    Raises:
        ValueError: If a weight is missing, left over or of another shape, by official name.
    """
    load_strictly(network, weights, _official_name)


def _official_name(key: str) -> str:
    for ours, official in _NAMES.items():
        if match := re.match(rf"{ours}(?=\.|$)", key):
            return official.format(*match.groups()) + key[match.end() :]
    raise KeyError(key)


def _network_like(weights: Mapping[str, Tensor], grid: ScanGrid) -> WaffleIron:
    """Untrained network of the sizes that the weights have."""
    try:
        head_dim, width = weights["classif.weight"].shape[:2]
    except KeyError as error:
        raise ValueError(
            f"holds no WaffleIron with a head (no {error}); give {_RELEASED}."
        ) from error
    layers = [re.match(r"waffleiron\.\w+\.(\d+)\.", key) for key in weights]
    depth = max((int(layer[1]) + 1 for layer in layers if layer), default=1)
    return WaffleIron(width, depth, grid.cells, head_dim)


def _weights(content: Any) -> dict[str, Tensor]:
    """State dict of the point network among what the distillation saved."""
    found = next((key for key in _MODEL_KEYS if isinstance(content, dict) and key in content), None)
    if found is None or not isinstance(content[found], Mapping):
        raise ValueError(f"has neither {' nor '.join(_MODEL_KEYS)}; give {_RELEASED}.")
    return {key.removeprefix(_PREFIX): value for key, value in content[found].items()}

"""ScaLR: point features of a WaffleIron distilled from images, and its released checkpoint."""

from __future__ import annotations

import hashlib
import pickle
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.nn.backbones.voxels import ScanGrid, collate_scans, prepare_scan
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


class ScaLR(nn.Module):
    """Frozen feature extractor: tokens of a WaffleIron on the points of a scan, of unit norm.

    A point has the token of the nearest point that the network saw, so points beyond the field of
    view have features too. Always in evaluation mode. Computes in float32; on a GPU
    ``torch.autocast`` around the call is what the official code does.

    Source: Puy et al., "Three Pillars Improving Vision Foundation Model Distillation for Lidar"
    (CVPR 2024); as used by R3DPA.

    Args:
        network: Trained network; its head is taken off.
        grid: How scans are prepared, as in its training; that of the release where None.
        workers: Threads of the neighbour search, -1 for all cores.

    Attributes:
        name: ``"scalr"``.
        dim: Width of the features.
        settings: What determines the features, see :class:`r3dpa.data.Extractor`.

    Raises:
        ValueError: If ``network`` has other planes than ``grid``.
    """

    def __init__(
        self, network: WaffleIron, grid: ScanGrid | None = None, *, workers: int = 1
    ) -> None:
        super().__init__()
        grid = grid or ScanGrid()
        if network.cells != grid.cells:
            raise ValueError(f"network has cells {network.cells}, but grid has {grid.cells}.")
        network.head = nn.Identity()
        self.network = network.requires_grad_(False)
        self.grid, self.workers = grid, workers
        self.name, self.dim = "scalr", network.width
        self.settings: dict[str, Any] = {"weights": _sha256(network), "version": 1}
        self.eval()

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
            weights = _weights(_read(path))
            network = _network_like(weights, grid)
            load_official(network, weights)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        return cls(network, grid, workers=workers)

    def train(self, mode: bool = True) -> Self:
        """Stays in evaluation mode: statistics of the batch would change the features."""
        return super().train(False)

    def forward(self, points: Tensor) -> Tensor:
        """Features of all points, see :meth:`point_features`."""
        return self.point_features(points)

    def point_features(self, points: Tensor) -> Tensor:
        """Features of unit norm.

        Args:
            points: ``(P, 4)`` x, y, z in metres, intensity 0..1.

        Returns:
            ``(P, dim)`` float32 on the device of the network; zeros where no point lies in the
            field of view.

        Raises:
            ValueError: If ``points`` has another shape, or holds NaN or infinite values.
        """
        device = self.network.embedding.merge.weight.device
        scan = prepare_scan(points.detach().cpu().numpy(), self.grid, workers=self.workers)
        if not len(scan.features):
            return torch.zeros(len(points), self.dim, device=device)
        tokens = self.network(collate_scans([scan]).to(device))
        return F.normalize(tokens.float(), dim=1)[scan.upsample.to(device)]


def load_official(network: WaffleIron, weights: Mapping[str, Tensor]) -> None:
    """Load an official state dict of WaffleIron, every key of it, into a network with a head.

    Args:
        network: Network of the same sizes.
        weights: Tensors by official name, without the prefix of data-parallel training.

    Raises:
        ValueError: If a weight is missing, left over or of another shape, by official name.
    """
    own = network.state_dict()
    names = {_official_name(key): key for key in own}
    missing = [name for name in names if name not in weights]
    unexpected = [name for name in weights if name not in names]
    if missing or unexpected:
        raise ValueError(
            f"the weights are not those of this WaffleIron: {len(missing)} missing {missing[:5]}, "
            f"{len(unexpected)} unexpected {unexpected[:5]}."
        )
    loaded = {}
    for name, key in names.items():
        shape, expected = tuple(weights[name].shape), tuple(own[key].shape)
        # Official layers are convolutions, whose weights have kernel axes of size 1 at the end.
        if shape[: len(expected)] != expected or any(size != 1 for size in shape[len(expected) :]):
            raise ValueError(f"weight {name} has shape {shape}, but {expected} is expected.")
        loaded[key] = weights[name].reshape(expected)
    network.load_state_dict(loaded)


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


def _read(path: Path) -> Any:
    if not path.is_file():
        raise ValueError(f"no such file; give {_RELEASED}.")
    try:
        # Memory-mapped, so that the optimiser beside the weights is not read.
        return torch.load(
            path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path)
        )
    except (pickle.UnpicklingError, RuntimeError, OSError, EOFError) as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(
            f"is damaged, or holds more than tensors and plain values ({reason}); give {_RELEASED}."
        ) from error


def _sha256(network: nn.Module) -> str:
    digest = hashlib.sha256()
    for key, value in network.state_dict().items():
        digest.update(key.encode())
        digest.update(value.cpu().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()

"""Frozen point features of a WaffleIron."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import partial
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.nn.backbones.voxels import (
    PointCloudBatch,
    PreparedScan,
    ScanGrid,
    collate_scans,
    prepare_scan,
)
from r3dpa.nn.backbones.waffleiron import WaffleIron


class TokenFeatures(nn.Module):
    """Frozen feature extractor: tokens of a WaffleIron on the points of a scan, of unit norm.

    A point has the token of the nearest point that the network saw, so points beyond the field of
    view have features too. Always in evaluation mode. Computes in float32; on a GPU
    ``torch.autocast`` around the call is what the official code of ScaLR does.

    Args:
        network: Trained network; its head is taken off.
        grid: How scans are prepared, as in its training.
        workers: Threads of the neighbour search, -1 for all cores.

    Attributes:
        name: Short name of the source.
        dim: Width of the features.
        settings: What determines the features, see :class:`r3dpa.data.Extractor`.
        prepare: :class:`PreparedScan` of the points ``(P, 4)`` of one scan; holds no weights.

    Raises:
        ValueError: If ``network`` has other planes than ``grid``.
    """

    name: str

    def __init__(self, network: WaffleIron, grid: ScanGrid, workers: int = 1) -> None:
        super().__init__()
        if network.cells != grid.cells:
            raise ValueError(f"network has cells {network.cells}, but grid has {grid.cells}.")
        network.head = nn.Identity()
        self.network = network.requires_grad_(False)
        self.grid = grid
        self.prepare = partial(_prepare_points, grid=grid, workers=workers)
        self.dim = network.width
        self.settings: dict[str, Any] = {"weights": sha256(network), "version": 1}
        self.eval()

    def train(self, mode: bool = True) -> Self:
        """Stays in evaluation mode: statistics of the batch would change the features."""
        return super().train(False)

    def forward(self, points: Tensor) -> Tensor:
        """Features of unit norm.

        Args:
            points: ``(P, 4)`` x, y, z in metres, intensity 0..1.

        Returns:
            ``(P, dim)`` as of :meth:`point_features`.

        Raises:
            ValueError: If ``points`` has another shape, or holds NaN or infinite values.
        """
        return self.point_features([self.prepare(points)])[0]

    def point_features(self, prepared: Sequence[PreparedScan]) -> list[Tensor]:
        """Features of unit norm, of all scans in one pass of the network.

        Args:
            prepared: The scans as ``prepare`` gives them, at least one.

        Returns:
            ``(P_i, F)`` float32 of each scan on the device of the network; zeros where no point
            of the scan lies in the field of view.
        """
        device = self.network.embedding.merge.weight.device
        counts = [len(scan.features) for scan in prepared]
        tokens = torch.zeros(0, self.network.width, device=device)
        if any(counts):
            batch = collate_scans(prepared).to(device)
            tokens = F.normalize(self.tokens(batch), dim=1)
        return [
            own[scan.upsample.to(device)]
            if len(own)
            else own.new_zeros(len(scan.upsample), self.network.width)
            for scan, own in zip(prepared, tokens.split(counts), strict=True)
        ]

    def tokens(self, batch: PointCloudBatch) -> Tensor:
        """Tokens ``(N, F)`` float32 whose direction is the feature."""
        return self.network(batch).float()


def sha256(network: nn.Module) -> str:
    """Hash of all weights and buffers, by name."""
    digest = hashlib.sha256()
    for key, value in network.state_dict().items():
        digest.update(key.encode())
        digest.update(value.cpu().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def _prepare_points(points: Tensor, grid: ScanGrid, workers: int = 1) -> PreparedScan:
    """:func:`prepare_scan` of a tensor, as a feature extractor is given it."""
    return prepare_scan(points.detach().cpu().numpy(), grid, workers=workers)

"""Perceptual loss: what a network on points sees in a reconstruction and in its scan.

Letters: B batch, C channels, H x W image size, F width of the tokens.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from r3dpa.features import WaffleIronS2, collate_scans
from r3dpa.geometry import ScanGeometry, unproject
from r3dpa.geometry.projection import pool_by_cell

_NUM_SCANS = 3  # of a batch, the first ones: each takes as long as a third of a training step of 8
_MEAN_WEIGHT = 10.0  # of the mean over a scan, to which errors of single cells add little


class PerceptualLoss:
    """Squared distance between the tokens of ``waffleiron-s-2`` of reconstructions and of scans.

    Tokens are standardised and averaged over the cells of the feature grid. Ten times the squared
    distance of their means over the scan comes on top. A decoder cannot know each leaf, but it can
    learn what leaves look like.

    Coordinates and intensity have a gradient. Which points the network keeps, their neighbours and
    their places on its planes follow the reconstruction without one.

    Source: Johnson et al., "Perceptual losses for real-time style transfer and super-resolution"
    (ECCV 2016), here with features of points. The network is not the one behind FWID.

    Args:
        geometry: Of the images.
    """

    def __init__(self, geometry: ScanGeometry) -> None:
        self.geometry = geometry
        self.network = WaffleIronS2()

    def __call__(self, reconstruction: Tensor, image: Tensor) -> Tensor:
        """Mean over the first scans of images ``(B, C, H, W)``; 0 where one has no points."""
        pairs = zip(reconstruction[:_NUM_SCANS], image[:_NUM_SCANS], strict=True)
        return torch.stack([self._distance(first, scan) for first, scan in pairs]).mean()

    def _distance(self, image: Tensor, scan: Tensor) -> Tensor:
        """Distance of two images ``(C, H, W)``, with gradient to the first."""
        means, counts = self._cell_means(image)
        with torch.no_grad():
            targets, target_counts = self._cell_means(scan)
        both = (counts > 0) & (target_counts > 0)
        if not both.any():
            return image.sum() * 0
        cells = (means - targets)[both].square().sum(dim=1).mean()
        difference = _scan_mean(means, counts) - _scan_mean(targets, target_counts)
        return cells + _MEAN_WEIGHT * difference.square().sum()

    def _cell_means(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Means ``(cells, F)`` of the tokens of an image ``(C, H, W)``, and points ``(cells,)``."""
        network = self.network.to(image.device)
        projection = self.geometry.projection
        pixels = self.geometry.codec.pixels_of(image, projection.sensor)
        returns = pixels.range_m > 0
        points = unproject(pixels.range_m, projection)[returns]
        row, column = returns.nonzero().unbind(dim=1)
        cell = projection.sensor.cell_of(row, column, self.geometry.grid_size)
        if pixels.intensity is None:
            intensity = torch.full_like(points[:, 0], network.grid.intensity_mean)
        else:
            intensity = pixels.intensity[returns]
        scan = network.prepare(torch.cat([points, intensity[:, None]], dim=1))
        kept = scan.kept.to(image.device)
        points, intensity, cell = points[kept], intensity[kept], cell[kept]
        standard = (intensity - network.grid.intensity_mean) / network.grid.intensity_std
        distance = points.norm(dim=1)
        features = torch.stack([standard, *points.unbind(dim=1), distance], dim=1)
        batch = collate_scans([scan]).to(image.device)._replace(features=features)
        tokens = network.tokens(batch) if len(kept) else points.new_zeros(0, network.network.width)
        return pool_by_cell(cell, tokens, math.prod(self.geometry.grid_size))


def _scan_mean(means: Tensor, counts: Tensor) -> Tensor:
    """Mean ``(F,)`` over all points; a product of matrices would be rounded under autocast."""
    return (counts[:, None] * means).sum(dim=0) / counts.sum()

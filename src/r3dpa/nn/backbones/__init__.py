"""Frozen point-feature extractors, and the network of one of them."""

from r3dpa.nn.backbones.geometric import GeometricFeatures
from r3dpa.nn.backbones.scalr import ScaLR
from r3dpa.nn.backbones.voxels import (
    PointCloudBatch,
    PreparedScan,
    ScanGrid,
    collate_scans,
    prepare_scan,
)
from r3dpa.nn.backbones.waffleiron import WaffleIron

__all__ = [
    "GeometricFeatures",
    "PointCloudBatch",
    "PreparedScan",
    "ScaLR",
    "ScanGrid",
    "WaffleIron",
    "collate_scans",
    "prepare_scan",
]

"""Frozen extractors of 3D point features that the method aligns with."""

from r3dpa.feature_names import SOURCES
from r3dpa.features.dinov2 import DINOv2
from r3dpa.features.geometric import GeometricFeatures
from r3dpa.features.scalr import (
    ScaLR,
    WaffleIronJudge,
    WaffleIronS,
    WaffleIronS2,
    feature_source,
)
from r3dpa.features.voxels import (
    Masking,
    PointCloudBatch,
    ScanGrid,
    collate_scans,
    prepare_scan,
)
from r3dpa.features.waffleiron import WaffleIron

__all__ = [
    "SOURCES",
    "DINOv2",
    "GeometricFeatures",
    "Masking",
    "PointCloudBatch",
    "ScaLR",
    "ScanGrid",
    "WaffleIron",
    "WaffleIronJudge",
    "WaffleIronS",
    "WaffleIronS2",
    "collate_scans",
    "feature_source",
    "prepare_scan",
]

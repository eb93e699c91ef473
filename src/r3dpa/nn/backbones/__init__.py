"""Frozen extractors: point features to align with, and the networks of the published metrics."""

from r3dpa.nn.backbones.geometric import GeometricFeatures
from r3dpa.nn.backbones.liploc import LIPLoc
from r3dpa.nn.backbones.minkowski import SPVCNN, MinkowskiNet
from r3dpa.nn.backbones.point_features import SOURCES, ScaLR, WaffleIronS, feature_source
from r3dpa.nn.backbones.rangevit import RangeViT
from r3dpa.nn.backbones.vit import DINOv2
from r3dpa.nn.backbones.voxels import (
    Masking,
    PointCloudBatch,
    ScanGrid,
    collate_scans,
    prepare_scan,
)
from r3dpa.nn.backbones.waffleiron import WaffleIron

__all__ = [
    "SOURCES",
    "SPVCNN",
    "DINOv2",
    "GeometricFeatures",
    "LIPLoc",
    "Masking",
    "MinkowskiNet",
    "PointCloudBatch",
    "RangeViT",
    "ScaLR",
    "ScanGrid",
    "WaffleIron",
    "WaffleIronS",
    "collate_scans",
    "feature_source",
    "prepare_scan",
]

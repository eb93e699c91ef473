"""Scans on disk, feature grids, data sets and Lightning data modules.

The data modules need Lightning, which takes seconds to import: they are loaded on first use.
"""

from importlib import import_module
from typing import Any

from lidarsim.scan_files import (
    ScanError,
    read_beside,
    read_npz,
    read_points,
    read_scan,
    write_bin,
    write_npz,
    write_ply,
)
from r3dpa.data.augmentation import Augmentation
from r3dpa.data.datasets import LidarBatch, LidarDataset, PointSample
from r3dpa.data.dead_leaves import DeadLeaves
from r3dpa.data.feature_grids import Extractor, FeatureGrids, pooled_grids, write_feature_grids
from r3dpa.data.images import ImageFolder
from r3dpa.data.samples import read_samples
from r3dpa.data.scans import Scan, check, find_scans, kitti360_scans
from r3dpa.data.store import StoreError

_ON_FIRST_USE = {
    "ImageDataModule": "image_datamodule",
    "KITTI360DataModule": "datamodules",
    "LabelledPointDataModule": "point_datamodules",
    "LidarDataModule": "datamodules",
    "PointDataModule": "point_datamodules",
    "SimulatedDataModule": "datamodules",
    "SimulatedImageDataModule": "range_images",
}

__all__ = [
    "Augmentation",
    "DeadLeaves",
    "Extractor",
    "FeatureGrids",
    "ImageDataModule",
    "ImageFolder",
    "KITTI360DataModule",
    "LabelledPointDataModule",
    "LidarBatch",
    "LidarDataModule",
    "LidarDataset",
    "PointDataModule",
    "PointSample",
    "Scan",
    "ScanError",
    "SimulatedDataModule",
    "SimulatedImageDataModule",
    "StoreError",
    "check",
    "find_scans",
    "kitti360_scans",
    "pooled_grids",
    "read_beside",
    "read_npz",
    "read_points",
    "read_samples",
    "read_scan",
    "write_bin",
    "write_feature_grids",
    "write_npz",
    "write_ply",
]


def __getattr__(name: str) -> Any:
    if name in _ON_FIRST_USE:
        return getattr(import_module(f"r3dpa.data.{_ON_FIRST_USE[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

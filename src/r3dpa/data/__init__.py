"""Scans on disk, feature grids, data sets and Lightning data modules.

The data modules need Lightning, which takes seconds to import: they are loaded on first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from r3dpa.data.augmentation import Augmentation, View
from r3dpa.data.datasets import (
    LatentBatch,
    LatentDataset,
    LatentSample,
    LidarBatch,
    LidarDataset,
    LidarSample,
)
from r3dpa.data.dead_leaves import DeadLeaves
from r3dpa.data.feature_grids import (
    Extractor,
    GridPlan,
    default_features_dir,
    features_lock,
    pooled_grids,
    write_feature_grids,
)
from r3dpa.data.feature_store import (
    FeatureGrids,
    FeatureGridWriter,
    stored_feature_dim,
    stored_source,
)
from r3dpa.data.grid_settings import FeatureGridError, GridSettings
from r3dpa.data.images import ImageFolder, ImageSource, TarImages
from r3dpa.data.points import PointDataset, PointSample, list_collate
from r3dpa.data.samples import Sample, SampleError, Samples, read_samples
from r3dpa.data.scan_cache import range_image_cache, write_range_images
from r3dpa.data.scans import (
    KITTI360_DRIVES,
    CheckReport,
    Scan,
    ScanError,
    check,
    find_scans,
    kitti360_scans,
    read_beside,
    read_npz,
    read_ply,
    read_scan,
    write_bin,
    write_npz,
    write_ply,
)

if TYPE_CHECKING:
    from r3dpa.data.datamodules import KITTI360DataModule, LidarDataModule, SimulatedDataModule
    from r3dpa.data.image_datamodule import ImageDataModule
    from r3dpa.data.point_datamodule import PointDataModule
from r3dpa.data.tensor_cache import CachedTensors, TensorCache, TensorCacheError

__all__ = [
    "KITTI360_DRIVES",
    "Augmentation",
    "CachedTensors",
    "CheckReport",
    "DeadLeaves",
    "Extractor",
    "FeatureGridError",
    "FeatureGridWriter",
    "FeatureGrids",
    "GridPlan",
    "GridSettings",
    "ImageDataModule",
    "ImageFolder",
    "ImageSource",
    "KITTI360DataModule",
    "LatentBatch",
    "LatentDataset",
    "LatentSample",
    "LidarBatch",
    "LidarDataModule",
    "LidarDataset",
    "LidarSample",
    "PointDataModule",
    "PointDataset",
    "PointSample",
    "Sample",
    "SampleError",
    "Samples",
    "Scan",
    "ScanError",
    "SimulatedDataModule",
    "TarImages",
    "TensorCache",
    "TensorCacheError",
    "View",
    "check",
    "default_features_dir",
    "features_lock",
    "find_scans",
    "kitti360_scans",
    "list_collate",
    "pooled_grids",
    "range_image_cache",
    "read_beside",
    "read_npz",
    "read_ply",
    "read_samples",
    "read_scan",
    "stored_feature_dim",
    "stored_source",
    "write_bin",
    "write_feature_grids",
    "write_npz",
    "write_ply",
    "write_range_images",
]


def __getattr__(name: str) -> Any:
    """Load the data modules on first use."""
    if name in {"KITTI360DataModule", "LidarDataModule", "SimulatedDataModule"}:
        return getattr(import_module("r3dpa.data.datamodules"), name)
    if name == "ImageDataModule":
        return import_module("r3dpa.data.image_datamodule").ImageDataModule
    if name == "PointDataModule":
        return import_module("r3dpa.data.point_datamodule").PointDataModule
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

"""Sensor, projections and range images: the one place that maps points to pixels."""

from r3dpa.geometry.projection import (
    Projection,
    RingProjection,
    SphericalProjection,
    in_range,
    points_of,
    pool_cells,
    range_image,
    unproject,
)
from r3dpa.geometry.scan_geometry import RangeCodec, ScanGeometry, projection_to_dict
from r3dpa.geometry.sensor import EMPTY_RANGE_M, LidarSensor

__all__ = [
    "EMPTY_RANGE_M",
    "LidarSensor",
    "Projection",
    "RangeCodec",
    "RingProjection",
    "ScanGeometry",
    "SphericalProjection",
    "in_range",
    "points_of",
    "pool_cells",
    "projection_to_dict",
    "range_image",
    "unproject",
]

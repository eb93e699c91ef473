"""Sensor, projections and range images: the one place that maps points to pixels."""

from lidarsim.sensors.view import LidarSensor
from r3dpa.geometry.beams import BeamProjection
from r3dpa.geometry.codec import (
    Pixels,
    RangeCodec,
    ScanGeometry,
    project_pixels,
    projection_to_dict,
)
from r3dpa.geometry.other_view import projection_for, values_in, view_of
from r3dpa.geometry.projection import (
    Projection,
    RingProjection,
    SphericalProjection,
    describe_share_kept,
    in_range,
    in_view,
    points_of,
    pool_cells,
    range_image,
    share_kept,
    share_outside_view,
    unproject,
    values_at_returns,
    view_limits_deg,
)
from r3dpa.geometry.semantics import (
    NUM_CLASSES,
    SEMANTIC_CLASSES,
    UNKNOWN_CLASS,
    classes_of,
    labels_of,
)
from r3dpa.geometry.sensor import EMPTY_RANGE_M

__all__ = [
    "EMPTY_RANGE_M",
    "NUM_CLASSES",
    "SEMANTIC_CLASSES",
    "UNKNOWN_CLASS",
    "BeamProjection",
    "LidarSensor",
    "Pixels",
    "Projection",
    "RangeCodec",
    "RingProjection",
    "ScanGeometry",
    "SphericalProjection",
    "classes_of",
    "describe_share_kept",
    "in_range",
    "in_view",
    "labels_of",
    "points_of",
    "pool_cells",
    "project_pixels",
    "projection_for",
    "projection_to_dict",
    "range_image",
    "share_kept",
    "share_outside_view",
    "unproject",
    "values_at_returns",
    "values_in",
    "view_limits_deg",
    "view_of",
]

"""Simulated lidar: seeded streets, ray casting, declared effects, KITTI-360 data sets."""

from r3dpa.simulation.drives import (
    TRAIN_DRIVES,
    VAL_DRIVES,
    SimulationReport,
    drive_name,
    expected_scans,
    simulate,
    split_scans,
)
from r3dpa.simulation.effects import DetectionLimit, Effect, LambertianReflection
from r3dpa.simulation.raycast import Returns, cast
from r3dpa.simulation.scan import SimulatedScan, simulate_scan
from r3dpa.simulation.scene import Pose, Primitive, Scene, Semantic, Shape
from r3dpa.simulation.sensor import HDL64E
from r3dpa.simulation.street import Street, generator_for

__all__ = [
    "HDL64E",
    "TRAIN_DRIVES",
    "VAL_DRIVES",
    "DetectionLimit",
    "Effect",
    "LambertianReflection",
    "Pose",
    "Primitive",
    "Returns",
    "Scene",
    "Semantic",
    "Shape",
    "SimulatedScan",
    "SimulationReport",
    "Street",
    "cast",
    "drive_name",
    "expected_scans",
    "generator_for",
    "simulate",
    "simulate_scan",
    "split_scans",
]

"""Simulated lidar: seeded streets, ray casting, effects that a scene calls for, data sets."""

from r3dpa.simulation.drive_files import drive_name
from r3dpa.simulation.drives import (
    SIMULATOR_VERSION,
    TRAIN_DRIVES,
    VAL_DRIVES,
    expected_scans,
    simulate,
    split_scans,
)
from r3dpa.simulation.scan import SimulatedScan, Simulator, simulate_scan
from r3dpa.simulation.scene import (
    EgoMotion,
    Material,
    Pose,
    Primitive,
    Puddle,
    Scene,
    Semantic,
    Shape,
    Weather,
)
from r3dpa.simulation.sensor import Lasers, SpinningLidar, hdl64e, load_sensor
from r3dpa.simulation.street import Street
from r3dpa.simulation.sweep import Origin, Sweep

__all__ = [
    "SIMULATOR_VERSION",
    "TRAIN_DRIVES",
    "VAL_DRIVES",
    "EgoMotion",
    "Lasers",
    "Material",
    "Origin",
    "Pose",
    "Primitive",
    "Puddle",
    "Scene",
    "Semantic",
    "Shape",
    "SimulatedScan",
    "Simulator",
    "SpinningLidar",
    "Street",
    "Sweep",
    "Weather",
    "drive_name",
    "expected_scans",
    "hdl64e",
    "load_sensor",
    "simulate",
    "simulate_scan",
    "split_scans",
]

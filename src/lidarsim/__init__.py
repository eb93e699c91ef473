"""Spinning LiDAR without torch: streets, ray casting, effects, weather, faults, files, realism.

Simulated scans need NumPy and SciPy alone. :class:`Weather` serves simulated streets and
recorded scans.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidarsim.drive_files import drive_name
    from lidarsim.drives import (
        SIMULATOR_VERSION,
        TRAIN_DRIVES,
        VAL_DRIVES,
        expected_scans,
        simulate,
        split_scans,
    )
    from lidarsim.recorded import Instrument, RecordedScan
    from lidarsim.scan import SimulatedScan, Simulator, simulate_scan
    from lidarsim.scene import (
        EgoMotion,
        Material,
        Pose,
        Primitive,
        Puddle,
        Scene,
        Semantic,
        Shape,
    )
    from lidarsim.sensors import Lasers, LidarSensor, SpinningLidar, hdl64e, load_sensor
    from lidarsim.street import Street
    from lidarsim.sweep import Origin, Sweep
    from lidarsim.weather import Weather, WeatheredScan, WeatherPrior

__all__ = [
    "SIMULATOR_VERSION",
    "TRAIN_DRIVES",
    "VAL_DRIVES",
    "EgoMotion",
    "Instrument",
    "Lasers",
    "LidarSensor",
    "Material",
    "Origin",
    "Pose",
    "Primitive",
    "Puddle",
    "RecordedScan",
    "Scene",
    "Semantic",
    "Shape",
    "SimulatedScan",
    "Simulator",
    "SpinningLidar",
    "Street",
    "Sweep",
    "Weather",
    "WeatherPrior",
    "WeatheredScan",
    "drive_name",
    "expected_scans",
    "hdl64e",
    "load_sensor",
    "simulate",
    "simulate_scan",
    "split_scans",
]

_MODULES = {
    "SIMULATOR_VERSION": "lidarsim.drives",
    "TRAIN_DRIVES": "lidarsim.drives",
    "VAL_DRIVES": "lidarsim.drives",
    "EgoMotion": "lidarsim.scene",
    "Instrument": "lidarsim.recorded",
    "Lasers": "lidarsim.sensors",
    "LidarSensor": "lidarsim.sensors",
    "Material": "lidarsim.scene",
    "Origin": "lidarsim.sweep",
    "Pose": "lidarsim.scene",
    "Primitive": "lidarsim.scene",
    "Puddle": "lidarsim.scene",
    "RecordedScan": "lidarsim.recorded",
    "Scene": "lidarsim.scene",
    "Semantic": "lidarsim.scene",
    "Shape": "lidarsim.scene",
    "SimulatedScan": "lidarsim.scan",
    "Simulator": "lidarsim.scan",
    "SpinningLidar": "lidarsim.sensors",
    "Street": "lidarsim.street",
    "Sweep": "lidarsim.sweep",
    "Weather": "lidarsim.weather",
    "WeatherPrior": "lidarsim.weather",
    "WeatheredScan": "lidarsim.weather",
    "drive_name": "lidarsim.drive_files",
    "expected_scans": "lidarsim.drives",
    "hdl64e": "lidarsim.sensors",
    "load_sensor": "lidarsim.sensors",
    "simulate": "lidarsim.drives",
    "simulate_scan": "lidarsim.scan",
    "split_scans": "lidarsim.drives",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use: SciPy takes half a second."""
    if name not in _MODULES:
        raise AttributeError(f"module 'lidarsim' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    """Names to complete after ``lidarsim.``, without importing them."""
    return sorted(__all__)

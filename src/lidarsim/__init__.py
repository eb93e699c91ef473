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

_NAMES = {
    "drive_files": ("drive_name",),
    "drives": (
        "SIMULATOR_VERSION", "TRAIN_DRIVES", "VAL_DRIVES", "expected_scans", "simulate",
        "split_scans",
    ),
    "recorded": ("Instrument", "RecordedScan"),
    "scan": ("SimulatedScan", "Simulator", "simulate_scan"),
    "scene": ("EgoMotion", "Material", "Pose", "Primitive", "Puddle", "Scene", "Semantic", "Shape"),
    "sensors": ("Lasers", "LidarSensor", "SpinningLidar", "hdl64e", "load_sensor"),
    "street": ("Street",),
    "sweep": ("Origin", "Sweep"),
    "weather": ("Weather", "WeatherPrior", "WeatheredScan"),
}  # fmt: skip
_MODULES = {name: f"lidarsim.{module}" for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name on first use: SciPy takes half a second."""
    if name not in _MODULES:
        raise AttributeError(f"module 'lidarsim' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    """Names to complete after ``lidarsim.``, without importing them."""
    return sorted(__all__)

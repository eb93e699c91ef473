"""Spinning LiDARs: presets and files, estimates from scans, and what their range images show."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarsim.sensors.files import (
    PRESETS,
    SensorFile,
    hdl64e,
    load_sensor,
    read_sensor,
    write_sensor,
)
from lidarsim.sensors.spinning import Lasers, SpinningLidar
from lidarsim.sensors.view import LidarSensor

if TYPE_CHECKING:
    from lidarsim.sensors.estimation import SensorEstimate

__all__ = [
    "PRESETS",
    "Lasers",
    "LidarSensor",
    "SensorFile",
    "SpinningLidar",
    "estimate",
    "hdl64e",
    "load_sensor",
    "read_sensor",
    "write_sensor",
]


def estimate(scans: Sequence[Any] | str | Path) -> SensorEstimate:
    """Estimate a sensor from its scans, see :func:`lidarsim.sensors.estimation.estimate_sensor`."""
    from lidarsim.sensors.estimation import estimate_sensor  # reads scans, which need SciPy

    return estimate_sensor(scans)

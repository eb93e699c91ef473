"""Spinning LiDARs: lasers and calibrations, and what their range images show."""

from lidarsim.sensors.spinning import Lasers, SpinningLidar, hdl64e, load_sensor
from lidarsim.sensors.view import LidarSensor

__all__ = [
    "Lasers",
    "LidarSensor",
    "SpinningLidar",
    "hdl64e",
    "load_sensor",
]

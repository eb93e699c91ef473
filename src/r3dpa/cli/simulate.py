"""``r3dpa data simulate``: simulated scans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:  # read by jsonargparse for the options of the weather
    from r3dpa.simulation import Weather

__all__ = ["simulate"]


def simulate(
    *,
    out: Path,
    scans: int = 100,
    seed: int = 0,
    workers: int = 1,
    drives: list[str] | None = None,
    sensor: str = "hdl64e",
    return_mode: Literal["strongest", "dual"] = "strongest",
    effects: dict[str, str | bool] | None = None,
    weather: Weather | None = None,
) -> Any:
    """Write simulated scans in the KITTI-360 layout.

    The same command completes an interrupted run. Prints what each effect did and cost;
    ``report.json`` and, for each scan, ``sim/*.json`` keep what it did.

    Args:
        out: Root of the data set to write.
        scans: Number of scans over all drives.
        seed: Seed of streets and instrument.
        workers: Processes; the bytes written do not depend on it.
        drives: Four-digit drives to fill, such as ``0000 0003``; default: all official ones.
        sensor: ``hdl64e``, ``hdl32e``, ``vls128``, or a calibration YAML as ``velodyne_pointcloud``
            reads, for an HDL-64E.
        return_mode: Strongest return of each shot, or the two strongest.
        effects: ``auto``, ``on`` or ``off`` by effect, such as ``--effects.fog off``; default: an
            effect runs where the scene calls for it.
        weather: Weather of all scans, such as ``--weather.rain_mm_h 10``; default: random.
    """
    from r3dpa.simulation import load_sensor
    from r3dpa.simulation import simulate as write

    lidar = load_sensor(sensor, return_mode=return_mode)
    return write(out, scans, seed, workers, drives, lidar, effects, weather)

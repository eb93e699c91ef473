"""``r3dpa data weather`` and ``data corrupt``: scans of files and folders, changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lidarsim.drive_files import weather_to_dict
from lidarsim.faults import Fault, Kind
from lidarsim.recorded import Instrument, RecordedScan
from lidarsim.weather import Weather
from r3dpa.scene_files.changed import change_scans
from r3dpa.scene_files.options import FolderOptions


def weather(
    source: Path,
    *,
    weather: Weather = Weather(),  # noqa: B008
    instrument: Instrument = Instrument(),  # noqa: B008
    effects: Mapping[str, str | bool] | None = None,
    **options: Any,
) -> str:
    """Write scans as they would be in other weather, in their own formats and below their names.

    Points that stay keep their coordinates and order, added ones come last. ``report.jsonl`` has
    one line per scan, ``scans.html`` shows some beside their results. The same command completes
    an interrupted run, and makes again what has changed: a scan, its labels or their results. Files
    do not depend on the number of workers.

    Args:
        source: Scan or folder of scans: .bin, .pcd, .ply, .npy, .npz, .las, with .label files.
        weather: Such as ``--weather.visibility_m 60 --weather.rain_mm_h 10``.
        instrument: What is assumed of the instrument; the intensity scale is found and reported.
        effects: ``off`` or ``on`` by effect, such as ``--effects.range_noise on``.
        **options: See :class:`FolderOptions`.
    """
    blooms = (effects or {}).get("blooming") in ("on", True)  # alone, other effects change nothing
    if weather == Weather() and not blooms:
        raise ValueError(
            "no weather is given, so that scans would stay as they are: give an option such as "
            "--weather.visibility_m 60 or --weather.rain_mm_h 10"
        )
    if weather.traffic_m_s and not weather.water_film_mm:
        raise ValueError(
            f"--weather.traffic_m_s {weather.traffic_m_s:g} throws up spray on a wet road only: "
            "give --weather.water_film_mm too, such as 1"
        )
    change = partial(weather.apply, instrument=instrument, effects=effects)
    # An error in the request must not be reported as one in the first scan.
    change(RecordedScan(np.ones((1, 3), np.float32)), 0)
    conditions = weather_to_dict(weather) | {"traffic_m_s": weather.traffic_m_s}
    request = {"weather": conditions, "instrument": asdict(instrument), "effects": effects}
    return change_scans(source, change, request, FolderOptions(**options))


def corrupt(
    source: Path,
    *,
    fault: Kind,
    severity: Literal[0, 1, 2, 3] = 2,
    strength: float | None = None,
    **options: Any,
) -> str:
    """Write scans with a fault of the sensor, as ``r3dpa data weather`` does.

    Args:
        source: Scan or folder of scans: .bin, .pcd, .ply, .npy, .npz, .las, with .label files.
        fault: What fails.
        severity: 0 (nothing) to 3, as in Robo3D.
        strength: In place of the severity: share of beams or points, metres, degrees.
        **options: See :class:`FolderOptions`.
    """
    change = Fault(fault, severity, strength)
    return change_scans(source, change.apply, asdict(change), FolderOptions(**options))

"""Describe a scan in words: format, columns, beams and frame."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lidarsim.clouds import PointCloud
from lidarsim.ground import ground_around
from lidarsim.rings import rings_of
from lidarsim.weather import recorded_scan

# The ground of a sensor on a car lies 1.2 to 3 m below it, in the frame of the vehicle near 0.
_VEHICLE_FRAME_M = 0.4
_KNOWN_BESIDE = (".label", ".origin", ".json", ".yaml", ".md")


def describe_scan(cloud: PointCloud) -> str:
    """Return format, columns, points, ranges and beams in a line, and a note about the frame.

    Points at (0, 0, 0) are no returns: their share is said, and they have no beam.
    """
    returns = cloud.without_origin()
    scan = recorded_scan(returns)
    rings = rings_of(scan)
    beams = f"{rings.num_rings} beams by {rings.how}, {rings.sure:.0%} of the points sure"
    line = f"{cloud.where}: {cloud.describe()}"
    if len(returns) < len(cloud):
        line += f", {1 - len(returns) / len(cloud):.1%} of the points at (0, 0, 0)"
    line += f", {beams}"
    ground = ground_around(scan.points)
    height_m = math.inf if ground is None else float(np.median(ground[:, 2]))
    if abs(height_m) < _VEHICLE_FRAME_M:
        line += (
            f"\nnote: {cloud.where}: its ground lies at z = {height_m:.2f} m, as in the frame of a "
            "vehicle: subtract the height of the sensor, which all commands take as the origin"
        )
    return line


def skipped_files(files: Iterable[Path], used: Iterable[Path]) -> str | None:
    """Return a line about the files that are no scans, labels or notes; None without any."""
    left = set(files).difference(used)
    counts = Counter(file.suffix or "without suffix" for file in sorted(left))
    others = [f"{count} {name}" for name, count in counts.items() if name not in _KNOWN_BESIDE]
    return f"skipped files: {', '.join(others)}" if others else None

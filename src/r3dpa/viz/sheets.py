"""Sheets of several scans: their range images one below the other, and all seen from above.

Letters: P points.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from r3dpa.geometry import LidarSensor, Projection, range_image
from r3dpa.viz.figures import EGO_OUTLINE_M
from r3dpa.viz.pixels import Array, as_numpy
from r3dpa.viz.scans import (
    HEIGHT_LIMITS_M,
    HEIGHT_MAP,
    RANGE_MAP,
    birds_eye_picture,
    range_image_picture,
    range_scale,
)


def range_strips(scans: Mapping[str, Array], projection: Projection) -> Figure:
    """Range images of scans, one below the other under their names, with the range scale.

    Args:
        scans: Points ``(P, 3+)`` in metres by name, at least one scan.
        projection: Makes the range images; its sensor gives the limits of the colour scale.

    Returns:
        Figure, 13 inches wide and about 1.2 inches high per scan.

    Raises:
        ValueError: If there is no scan or a shape is another.
    """
    figure, rows = _figure_of(scans, (13.0, 1.2 * len(scans) + 0.6), 1)
    for (name, points), axes in zip(scans.items(), rows, strict=True):
        xyz = torch.from_numpy(as_numpy(points, ("P", "3+"))[:, :3])
        range_m, _ = range_image(xyz, projection)
        valid = float((range_m > 0).double().mean())
        picture = range_image_picture(range_m, projection.sensor)
        axes.imshow(picture, aspect="auto", interpolation="nearest")
        axes.set_title(name, loc="left", fontsize=10, parse_math=False)
        axes.set_title(f"{valid:.0%} of the pixels have a return", loc="right", fontsize=9)
    scale = range_scale(projection.sensor)
    figure.colorbar(
        ScalarMappable(scale, RANGE_MAP),
        ax=list(rows),
        label="range (m)",
        ticks=range_ticks(projection.sensor),
        format="%g",
        pad=0.01,
        aspect=9 * len(scans),
    )
    return figure


def birds_eye_sheet(scans: Mapping[str, Array], extent_m: float = 50.0) -> Figure:
    """Scans seen from above, forward up, with their names, the ego vehicle and the height scale.

    Args:
        scans: Points ``(P, 3+)`` x forward, y left, z up in metres by name, at least one scan.
        extent_m: Half side of the square around the sensor that is shown.

    Returns:
        Figure with up to four scans in a row; one scan is larger than each of several.

    Raises:
        ValueError: If there is no scan or a shape is another.
    """
    count = len(scans)
    columns = count if count <= 4 else min((4, 3), key=lambda width: -count % width)  # fewest gaps
    side_in = 7.0 if columns == 1 else 4.0
    size_in = (columns * side_in + 0.9, math.ceil(count / max(1, columns)) * (side_in + 0.3))
    figure, cells = _figure_of(scans, size_in, columns)
    for axes in cells[count:]:
        axes.set_visible(False)
    for (name, points), axes in zip(scans.items(), cells, strict=False):
        axes.imshow(
            birds_eye_picture(points, extent_m, pixels=round(95 * side_in)),
            extent=(extent_m, -extent_m, -extent_m, extent_m),  # +y is to the left
        )
        axes.add_patch(Polygon(EGO_OUTLINE_M, facecolor="tab:red", edgecolor="white", lw=0.5))
        axes.set_title(name, loc="left", fontsize=10, parse_math=False)
        axes.set_xlabel(f"{2 * extent_m:g} m, {len(points):,} points", fontsize=9)
    figure.colorbar(
        ScalarMappable(Normalize(*HEIGHT_LIMITS_M), HEIGHT_MAP),
        ax=list(cells),
        label="height above the sensor (m)",
        extend="both",
        shrink=0.8,
        pad=0.02,
    )
    return figure


def range_ticks(sensor: LidarSensor) -> list[float]:
    """Labels of the range scale: both limits, and round ranges between that do not touch them."""
    low, high = sensor.range_min_m, sensor.range_max_m
    return [low, *(tick for tick in (5.0, 10.0, 20.0, 30.0) if 2 * low < tick < 0.75 * high), high]


def _figure_of(
    scans: Mapping[str, Array], size_in: tuple[float, float], columns: int
) -> tuple[Figure, np.ndarray]:
    """Figure with a cell without ticks for each scan, at least; cells row by row."""
    if not scans:
        raise ValueError("got no scan to draw; give at least one")
    figure = Figure(figsize=size_in, dpi=110, layout="constrained")
    cells = figure.subplots(math.ceil(len(scans) / columns), columns, squeeze=False).ravel()
    for axes in cells:
        axes.set(xticks=[], yticks=[])
    return figure, cells

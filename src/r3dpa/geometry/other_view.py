"""Images of one sensor as another one would see them, where its beams allow that.

Letters: B batch, H beams, W columns.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidarsim.sensors.files import load_sensor
from lidarsim.sensors.spinning import SpinningLidar
from lidarsim.sensors.view import LidarSensor
from r3dpa.geometry.beams import BeamProjection
from r3dpa.geometry.projection import Projection, SphericalProjection, unproject
from r3dpa.geometry.sensor import EMPTY_RANGE_M, angles_of, column_of

_DENSER = 1.1  # beams per degree of two sensors that count as alike
_SAME_SURFACE = 1.25  # ratio of the ranges of neighbouring rows that are interpolated
_ROUNDS = 3  # from a guess of the range to the direction in which the image is read
_FIRST_GUESS_M = 20.0


class View(NamedTuple):
    """Pixels ``(B, H, W)`` of images ``(B, H', W')``: rows above and below, and where between."""

    above: Tensor
    below: Tensor
    share: Tensor
    column: Tensor


def projection_for(model: str | Path | SpinningLidar, source: Projection) -> BeamProjection:
    """Projection of a sensor that sees nothing but what images of ``source`` show.

    It has at most as many columns, and ends at the range at which the images end.

    Args:
        model: Sensor, or what :func:`lidarsim.load_sensor` takes: a preset or a YAML file.
        source: Projection of the images.

    Raises:
        ValueError: If beams lie outside the field of view of the images, or closer to each other
            than their rows.
    """
    lidar = model if isinstance(model, SpinningLidar) else load_sensor(model)
    name = "the sensor" if isinstance(model, SpinningLidar) else f"sensor {model}"
    theirs = np.degrees(lidar.lasers.inclination_rad)
    sensor = source.sensor
    low, high = sensor.inclination_min_deg, sensor.inclination_max_deg
    if theirs[0] > high or theirs[-1] < low:
        raise ValueError(
            f"{name} looks from {theirs[-1]:.1f} to {theirs[0]:.1f} degrees, but the model knows "
            f"{low:.1f} to {high:.1f} only: fine-tune it with `r3dpa data plan`"
        )
    ours = source.ray_angles()[0].rad2deg().numpy()
    pitch_deg, least_deg = (
        float(abs(angles[0] - angles[-1])) / max(len(angles) - 1, 1) for angles in (theirs, ours)
    )
    if len(theirs) > 1 and pitch_deg * _DENSER < least_deg:
        raise ValueError(
            f"{name} has a beam every {pitch_deg:.2f} degrees, but the model every "
            f"{least_deg:.2f}: what lies between is unknown to it; fine-tune it with "
            "`r3dpa data plan`"
        )
    projection = BeamProjection.of(lidar, min(sensor.columns, lidar.shots))
    view = projection.sensor
    limited = replace(
        view,
        range_min_m=max(view.range_min_m, sensor.range_min_m),
        range_max_m=min(view.range_max_m, sensor.range_max_m),
    )
    return replace(projection, sensor=limited)


def view_of(range_m: Tensor, source: Projection, target: BeamProjection) -> tuple[Tensor, View]:
    """Range images ``(B, H, W)`` along the beams of ``target``, and where they were read.

    Between two rows of one surface, the inverse of the range is interpolated, which is exact on
    planes; elsewhere the nearer row counts. Rows of equal pitch that meet no beam of the sensor
    that a model learned from are filled from above and below. A beam starts at its own optical
    centre, so the direction in which an image is read depends on the range.

    Args:
        range_m: ``(B, H', W')`` metres, not positive without a return.
        source: Projection of these images.
        target: Projection of :func:`projection_for`.
    """
    has_return = range_m > 0
    if isinstance(source, SphericalProjection):
        range_m = _fill_missed_rows(range_m)
    size = (len(range_m), target.sensor.beams, target.sensor.columns)
    seen = torch.full(size, _FIRST_GUESS_M, dtype=range_m.dtype, device=range_m.device)
    for _ in range(_ROUNDS):
        guess = torch.where(seen > 0, seen, _FIRST_GUESS_M)
        view = _read_at(unproject(guess, target), source)
        seen = _interpolated(range_m, view)
    # A filled pixel has no values: they are read in the row beside it.
    batch = torch.arange(len(seen), device=seen.device)[:, None, None]
    share = view.share
    for rows, other in ((view.above, 1.0), (view.below, 0.0)):
        share = torch.where(has_return[batch, rows, view.column], share, other)
    return _inside(seen, target.sensor), view._replace(share=share)


def values_in(values: Tensor, view: View, range_m: Tensor) -> Tensor:
    """Values of images in the nearest pixel, 0 where ``range_m`` has no return."""
    row = torch.where(view.share < 0.5, view.above, view.below)
    batch = torch.arange(len(values), device=values.device)[:, None, None]
    return torch.where(range_m > 0, values[batch, row, view.column], 0)


def _read_at(points: Tensor, source: Projection) -> View:
    if isinstance(source, BeamProjection):
        height_m = float(np.median(source.height_m))
        points = points - points.new_tensor([0.0, 0.0, height_m])
    inclination, azimuth = angles_of(points)
    rows = source.ray_angles()[0].to(inclination.device)
    below = torch.searchsorted(-rows, -inclination).clamp(1, max(len(rows) - 1, 1))
    above = below - 1
    below = below.clamp(max=len(rows) - 1)
    share = (rows[above] - inclination) / (rows[above] - rows[below]).clamp(min=1e-9)
    column = column_of(azimuth, source.sensor.columns)
    return View(above, below, share.clamp(0, 1).to(points.dtype), column)


def _fill_missed_rows(range_m: Tensor) -> Tensor:
    """Fill pixels between two of one surface, in rows that are empty to both sides as well."""
    above, below = range_m.roll(1, dims=-2), range_m.roll(-1, dims=-2)
    is_empty = range_m <= 0
    is_missed = is_empty & is_empty.roll(1, dims=-1) & is_empty.roll(-1, dims=-1)
    is_missed &= (above > 0) & (below > 0) & _on_one_surface(above, below)
    is_missed[..., [0, -1], :] = False
    return torch.where(is_missed, 2 / (1 / above + 1 / below), range_m)


def _on_one_surface(first: Tensor, second: Tensor) -> Tensor:
    nearer = torch.minimum(first, second).clamp(min=1e-6)
    return torch.maximum(first, second) / nearer < _SAME_SURFACE


def _interpolated(range_m: Tensor, view: View) -> Tensor:
    batch = torch.arange(len(range_m), device=range_m.device)[:, None, None]
    above, below = range_m[batch, view.above, view.column], range_m[batch, view.below, view.column]
    nearer = torch.where(view.share < 0.5, above, below)
    both = (above > 0) & (below > 0)
    between = 1 / torch.lerp(1 / above.clamp(min=1e-6), 1 / below.clamp(min=1e-6), view.share)
    return torch.where(both & _on_one_surface(above, below), between, nearer)


def _inside(range_m: Tensor, sensor: LidarSensor) -> Tensor:
    is_inside = (range_m > sensor.range_min_m) & (range_m < sensor.range_max_m)
    return torch.where(is_inside | range_m.isnan(), range_m, EMPTY_RANGE_M)

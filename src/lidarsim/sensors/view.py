"""Field of view and limits of a range image; angles and pixels of points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.sensors.files import load_sensor
from lidarsim.sensors.spinning import SpinningLidar


@dataclass(frozen=True)
class LidarSensor:
    """Size of the range image, vertical field of view and range limits of a spinning LiDAR.

    The defaults are the ones R3DPA uses for the HDL-64E of KITTI-360.

    Args:
        beams: Rows H of the range image.
        columns: Columns W of the range image, one turn of the sensor.
        inclination_max_deg: Upper border of the first row, degrees above the horizon.
        inclination_min_deg: Lower border of the last row, degrees above the horizon.
        range_min_m: Points at this distance or nearer are dropped, metres.
        range_max_m: Points at this distance or farther are dropped, metres.

    Example:
        >>> sensor = LidarSensor()
        >>> sensor.cell_size((8, 64))
        (8, 16)
    """

    beams: int = 64
    columns: int = 1024
    inclination_max_deg: float = 3.0
    inclination_min_deg: float = -25.0
    range_min_m: float = 1.0
    range_max_m: float = 56.0

    def __post_init__(self) -> None:
        if self.beams < 1 or self.columns < 1:
            raise ValueError(
                "a sensor needs at least one beam and one column, "
                f"got beams={self.beams}, columns={self.columns}"
            )
        if not -90.0 <= self.inclination_min_deg < self.inclination_max_deg <= 90.0:
            raise ValueError(
                "the vertical field of view must satisfy -90 <= min < max <= 90 degrees, got "
                f"inclination_min_deg={self.inclination_min_deg}, "
                f"inclination_max_deg={self.inclination_max_deg}"
            )
        if not 0.0 <= self.range_min_m < self.range_max_m < math.inf:
            raise ValueError(
                "the range limits must satisfy 0 <= min < max < infinity metres, got "
                f"range_min_m={self.range_min_m}, range_max_m={self.range_max_m}"
            )

    @classmethod
    def of(
        cls, model: str | Path | SpinningLidar, columns: int | None = None, rows: int | None = None
    ) -> LidarSensor:
        """Return the range image of a sensor: a row per beam, half a pitch around the outer ones.

        Args:
            model: Sensor, or what :func:`lidarsim.load_sensor` takes: a preset or a YAML file.
            columns: Columns of the image; default: the shots of a turn.
            rows: Rows of the image; default: the beams. Further rows lie below, at the last pitch.

        Example:
            >>> LidarSensor.of("vlp16", columns=1024).inclination_max_deg
            16.0
        """
        sensor = model if isinstance(model, SpinningLidar) else load_sensor(model)
        degrees = np.degrees(sensor.lasers.inclination_rad)
        first, last = (degrees[:2], degrees[-2:]) if len(degrees) > 1 else ((1, -1), (1, -1))
        beams = rows or sensor.num_beams
        if beams < sensor.num_beams:
            raise ValueError(f"{sensor.num_beams} beams need as many rows, got rows {beams}")
        further_rows = beams - sensor.num_beams
        return cls(
            beams=beams,
            columns=columns or sensor.shots,
            inclination_max_deg=round(float(degrees[0] + (first[0] - first[1]) / 2), 6),
            inclination_min_deg=round(
                float(degrees[-1] - (further_rows + 0.5) * (last[0] - last[1])), 6
            ),
            range_min_m=sensor.min_range_m,
            range_max_m=sensor.max_range_m,
        )

    @classmethod
    def around(cls, points: NDArray[np.floating]) -> LidarSensor:
        """Return an image of the default size around points ``(P, 3)`` of any sensor, in metres.

        One point of 1000 may lie beyond each limit. Points at (0, 0, 0) or with NaN do not count.

        Raises:
            ValueError: If no point counts.
        """
        points = points[np.isfinite(points).all(axis=1) & points.any(axis=1)]
        if not len(points):
            raise ValueError("no point with a range and a direction: there is nothing to draw")
        lowest, highest = np.quantile(np.degrees(angles_of(points)[0]), (0.001, 0.999)).tolist()
        farthest_m = np.quantile(np.linalg.norm(points, axis=1), 0.999)
        half_row_deg = max((highest - lowest) / (2 * (cls.beams - 1)), 0.1)
        return cls(
            inclination_max_deg=min(highest + half_row_deg, 90.0),
            inclination_min_deg=max(lowest - half_row_deg, -90.0),
            range_max_m=max(math.floor(farthest_m) + 1.0, 2 * cls.range_min_m),
        )

    def cell_size(self, grid_size: tuple[int, int]) -> tuple[int, int]:
        """Rows and columns of pixels in one cell of a grid ``(rows, columns)``."""
        rows, columns = grid_size
        if rows < 1 or columns < 1 or self.beams % rows or self.columns % columns:
            raise ValueError(
                f"a grid of {rows} x {columns} cells does not divide the "
                f"{self.beams} x {self.columns} range image"
            )
        return self.beams // rows, self.columns // columns

    def cell_of(self, row: Any, column: Any, grid_size: tuple[int, int]) -> Any:
        """Cells of a grid, numbered row after row, of pixels given by whole numbers or arrays."""
        cell_rows, cell_columns = self.cell_size(grid_size)
        return row // cell_rows * grid_size[1] + column // cell_columns

    @property
    def inclination_max_rad(self) -> float:
        """Upper border of the first row, radians."""
        return math.radians(self.inclination_max_deg)

    @property
    def field_of_view_rad(self) -> float:
        """Height of the vertical field of view, radians."""
        return self.inclination_max_rad - math.radians(self.inclination_min_deg)


def in_range(points: NDArray[np.floating], sensor: LidarSensor) -> NDArray[np.bool_]:
    """Whether each point of ``(..., 3)`` is finite and strictly inside the range limits."""
    # Correctly rounded to float32.
    range_m = np.sqrt(np.square(points.astype(np.float64)).sum(axis=-1)).astype(np.float32)
    return (range_m > sensor.range_min_m) & (range_m < sensor.range_max_m)


def angles_of(points: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Inclination and azimuth of finite points ``(..., 3)``, radians."""
    x, y, z = np.moveaxis(points.astype(np.float64), -1, 0)
    return np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)


def phase_of(
    beam: NDArray[np.int64], azimuth: NDArray[np.float64], columns: int, num_beams: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Azimuth offset within a column and coherence of each beam, ``(H,)``.

    The offset is in [0, 2 pi / columns); the coherence is 1 if all azimuths of a beam have it.
    """
    turns = columns * azimuth
    counts = np.bincount(beam, minlength=num_beams).clip(1)
    real = np.bincount(beam, np.cos(turns), num_beams) / counts
    imaginary = np.bincount(beam, np.sin(turns), num_beams) / counts
    offset = (np.arctan2(imaginary, real) % (2 * math.pi)) / columns
    return offset, np.hypot(real, imaginary)


def hit_pixels(points: NDArray[np.floating], sensor: LidarSensor) -> NDArray[np.bool_]:
    """Pixels ``(H, W)`` of the spherical projection with a return of ``(P, 3)`` within range."""
    inclination, azimuth = angles_of(points[in_range(points, sensor)])
    pitch_rad = sensor.field_of_view_rad / sensor.beams
    row = np.floor((sensor.inclination_max_rad - inclination) / pitch_rad).astype(np.int64)
    column = np.floor((math.pi - azimuth) / (2 * math.pi) * sensor.columns).astype(np.int64)
    hit = np.zeros((sensor.beams, sensor.columns), dtype=bool)
    hit[row.clip(0, sensor.beams - 1), column % sensor.columns] = True
    return hit

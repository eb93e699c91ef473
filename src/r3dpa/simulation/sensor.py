"""The spinning lidar that is simulated: its laser table and the rays of one turn."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

NUM_BEAMS = 64
_BLOCK_BEAMS = 32
# (highest, lowest, standard deviation of the step) of the elevations of each block, degrees.
_UPPER_BLOCK_DEG = (1.96, -8.56, 0.042)
_LOWER_BLOCK_DEG = (-8.78, -24.56, 0.094)
_UPPER_HEIGHTS_M = (0.217, 0.204)
_LOWER_HEIGHTS_M = (0.163, 0.144)
_AZIMUTH_COLUMNS_DEG = (-8.5, 3.7, -2.4, 9.9)
_LATERAL_OFFSET_M = 0.026


class LaserTable(NamedTuple):
    """Calibration of each laser; every array is ``(64,)`` float64, highest beam first.

    ``inclination_rad``: elevation of the beam, falling from beam to beam. ``azimuth_offset_rad``:
    horizontal angle between the beam and the heading of the spinning head. ``height_m``: optical
    centre above the frame origin. ``lateral_m``: optical centre to the left of the beam.
    """

    inclination_rad: NDArray[np.float64]
    azimuth_offset_rad: NDArray[np.float64]
    height_m: NDArray[np.float64]
    lateral_m: NDArray[np.float64]


class Rays(NamedTuple):
    """The shots of one turn: ``origin`` and unit ``direction``, each ``(3, H, W)`` float32.

    H beams from top to bottom, W shots in the order of growing azimuth in ``[0, 2 pi)``; metres,
    x forward, y left, z up.
    """

    origin: NDArray[np.float32]
    direction: NDArray[np.float32]


@dataclass(frozen=True)
class HDL64E:
    """Velodyne HDL-64E as mounted on the recording car of KITTI-360.

    Two blocks of 32 lasers whose optical centres lie about 0.2 m above the frame origin, so that
    the inclination of a point seen from the origin depends on its range::

        inclinations   +1.96 ... -8.56 deg (upper block), -8.78 ... -24.56 deg (lower block)
        heights        0.217 ... 0.204 m,                  0.163 ... 0.144 m

    Source: S3 calibration of ros-drivers/velodyne; mount and shots: KITTI-360.

    Args:
        shots: Shots of each laser per turn, 2083 at 10 Hz.
        mount_height_m: Frame origin above the road.
        calibration_seed: Draws the small irregularities of the beam steps and azimuth offsets.

    Raises:
        ValueError: If ``shots`` is less than 8, the mount is not above the road, or the seed is
            negative.
    """

    shots: int = 2083
    mount_height_m: float = 1.73
    calibration_seed: int = 64

    def __post_init__(self) -> None:
        """Check the values."""
        if self.shots < 8:
            raise ValueError(f"shots must be at least 8 per turn, got {self.shots}")
        if not self.mount_height_m > 0:
            raise ValueError(
                f"mount_height_m must be positive (sensor above the road), "
                f"got {self.mount_height_m}"
            )
        if self.calibration_seed < 0:
            raise ValueError(f"calibration_seed must be 0 or greater, got {self.calibration_seed}")

    @property
    def lasers(self) -> LaserTable:
        """The laser table, ``(64,)`` arrays from the highest beam to the lowest."""
        return _laser_table(self.calibration_seed)

    @property
    def rays(self) -> Rays:
        """The rays of one turn in the sensor frame, ``(3, 64, shots)``; read-only."""
        return _rays(self)


def _block_inclinations(
    block_deg: tuple[float, float, float], generator: np.random.Generator
) -> NDArray[np.float64]:
    """Falling inclinations (32,) in degrees with the block's exact ends and irregular steps."""
    highest, lowest, step_sd = block_deg
    mean_step = (highest - lowest) / (_BLOCK_BEAMS - 1)
    steps = generator.normal(mean_step, step_sd, _BLOCK_BEAMS - 1).clip(min=mean_step / 4)
    return highest - np.append(0.0, steps.cumsum() * (highest - lowest) / steps.sum())


@lru_cache(maxsize=8)
def _laser_table(seed: int) -> LaserTable:
    generator = np.random.Generator(np.random.Philox(seed))
    inclination_deg = np.concatenate(
        [_block_inclinations(block, generator) for block in (_UPPER_BLOCK_DEG, _LOWER_BLOCK_DEG)]
    )
    beams = np.arange(NUM_BEAMS)
    lowest_deg, highest_deg = min(_AZIMUTH_COLUMNS_DEG), max(_AZIMUTH_COLUMNS_DEG)
    offset_deg = np.take(_AZIMUTH_COLUMNS_DEG, beams % 4) + generator.normal(0.0, 0.3, NUM_BEAMS)
    height_m = np.concatenate(
        [np.linspace(*heights, _BLOCK_BEAMS) for heights in (_UPPER_HEIGHTS_M, _LOWER_HEIGHTS_M)]
    )
    table = LaserTable(
        np.radians(inclination_deg),
        np.radians(offset_deg.clip(lowest_deg, highest_deg)),
        height_m,
        np.where(beams % 2 == 0, _LATERAL_OFFSET_M, -_LATERAL_OFFSET_M),
    )
    for column in table:
        column.flags.writeable = False
    return table


@lru_cache(maxsize=4)
def _rays(sensor: HDL64E) -> Rays:
    lasers = sensor.lasers
    step = 2 * np.pi / sensor.shots
    # A laser fires at head azimuth + offset, for every head azimuth of the turn; renumbering the
    # shots by the azimuth of the beam leaves only the offset's rest within one step.
    azimuth = step * np.arange(sensor.shots) + (lasers.azimuth_offset_rad % step)[:, None]
    cos_azimuth, sin_azimuth = np.cos(azimuth), np.sin(azimuth)
    cos_inclination = np.cos(lasers.inclination_rad)[:, None]
    lateral = lasers.lateral_m[:, None]
    shape = azimuth.shape
    origin = np.stack(
        [
            -lateral * sin_azimuth,
            lateral * cos_azimuth,
            np.broadcast_to(lasers.height_m[:, None], shape),
        ]
    )
    direction = np.stack(
        [
            cos_inclination * cos_azimuth,
            cos_inclination * sin_azimuth,
            np.broadcast_to(np.sin(lasers.inclination_rad)[:, None], shape),
        ]
    )
    rays = Rays(origin.astype(np.float32), direction.astype(np.float32))
    for array in rays:
        array.flags.writeable = False
    return rays

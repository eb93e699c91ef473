"""Spinning lidars: laser table, limits, and the rays of one turn."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarsim.scene import check_fields

_LIGHT_M_S = 299_792_458.0


class Rays(NamedTuple):
    """Shots of one turn: ``origin`` (metres) and unit ``direction``, each ``(3, H, W)`` float32.

    H beams from top to bottom, W shots by growing azimuth in ``[0, 2 pi)``; x forward, z up.
    """

    origin: NDArray[np.float32]
    direction: NDArray[np.float32]


@dataclass(frozen=True)
class Lasers:
    """Calibration of each laser, highest beam first."""

    inclination_rad: tuple[float, ...]  # falling from beam to beam, within 80 degrees
    azimuth_offset_rad: tuple[float, ...]  # from the heading of the spinning head
    height_m: tuple[float, ...]  # optical centre above the frame origin
    lateral_m: tuple[float, ...]  # optical centre to the left of the beam
    range_bias_m: tuple[float, ...]  # excess of the measured range
    intensity_gain: tuple[float, ...]  # factor on its intensity

    def __post_init__(self) -> None:
        columns = {field.name: getattr(self, field.name) for field in fields(self)}
        lengths = {name: len(column) for name, column in columns.items()}
        if len(set(lengths.values())) > 1 or not self.inclination_rad:
            raise ValueError(f"lasers need columns of one length of at least 1, got {lengths}")
        for name, column in columns.items():
            if not np.isfinite(column).all():
                raise ValueError(f"{name} of the lasers must be finite, got {column}")
        inclination = np.array(self.inclination_rad)
        if (np.diff(inclination) >= 0).any():
            raise ValueError("inclination_rad of the lasers must fall from beam to beam")
        if np.abs(inclination).max() > math.radians(80):
            raise ValueError("inclination_rad of the lasers must stay within 80 degrees")
        if min(self.intensity_gain) <= 0:
            raise ValueError("intensity_gain of the lasers must be positive")


@dataclass(frozen=True)
class SpinningLidar:
    """A spinning lidar; the defaults are the Velodyne HDL-64E of KITTI-360's recording car.

    The optical centres of its two blocks lie about 0.2 m above the frame origin, so that the
    inclination of a point seen from the origin depends on its range.

    Source: KITTI's scans (laser table, nearest range, noise), the datasheet (other limits,
    divergence), KITTI-360 (mount, spin).

    Example:
        >>> from lidarsim import load_sensor
        >>> sensor = load_sensor("hdl32e")
        >>> sensor.num_beams, sensor.rays.direction.shape
        (32, (3, 32, 2170))
    """

    lasers: Lasers
    shots: int = 2083  # of each laser per turn, at least 8
    spin_hz: float = 10.0
    mount_height_m: float = 1.73  # frame origin above the road
    # Weakest power that is detected, m^-2: 10 % asphalt seen from 1.73 m vanishes at 50 m, see
    # ``effects.surface``.
    min_power: float = 1.43e-5
    # Smallest reported range, as in KITTI's scans; 0.9 m in the datasheet.
    min_range_m: float = 1.45
    max_range_m: float = 120.0
    divergence_rad: float = 2e-3  # full angle of the beam; 0 for a line
    pulse_s: float = 5e-9  # echoes nearer to each other than ``pulse_depth_m`` merge
    overlap_range_m: float = 5.0  # from here on the receiver sees the whole beam
    threshold_spread: float = 0.3  # standard deviation of the logarithm of the threshold
    lost_share: float = 0.0009  # of shots at the ground that are lost, see ``effects.instrument``
    weak_share: float = 0.0  # of the echoes that are barely detected, see ``effects.surface``
    range_sigma_m: float = 0.0068  # range noise of a strong return
    weak_range_sigma_m: float = 0.05  # further noise at a signal-to-noise ratio of 1/2
    range_step_m: float = 0.002  # in which ranges are reported; 0 for none
    return_mode: Literal["strongest", "dual"] = "strongest"  # or the two strongest of a shot

    def __post_init__(self) -> None:
        check_fields(self, "be a whole number, 0 or greater", "shots")
        object.__setattr__(self, "shots", int(self.shots))  # JSON has no integers of NumPy
        if self.shots < 8:
            raise ValueError(f"shots must be at least 8 per turn, got {self.shots}")
        check_fields(
            self, "be positive", "spin_hz", "mount_height_m", "min_power", "overlap_range_m"
        )
        check_fields(
            self, "be 0 or greater", "divergence_rad", "pulse_s", "threshold_spread",
            "range_sigma_m", "weak_range_sigma_m", "range_step_m",
        )  # fmt: skip
        for name in ("lost_share", "weak_share"):
            if not 0 <= getattr(self, name) < 0.1:
                raise ValueError(f"{name} must lie in [0, 0.1), got {getattr(self, name)}")
        if not 0 <= self.min_range_m < self.max_range_m < math.inf:
            raise ValueError(
                f"ranges must satisfy 0 <= min_range_m < max_range_m, "
                f"got {self.min_range_m} and {self.max_range_m}"
            )
        if self.return_mode not in ("strongest", "dual"):
            raise ValueError(f"return_mode must be strongest or dual, got {self.return_mode!r}")

    @property
    def num_beams(self) -> int:
        """Number of lasers."""
        return len(self.lasers.inclination_rad)

    @property
    def pulse_depth_m(self) -> float:
        """Range interval illuminated by a pulse at a time: ``c * pulse_s / 2``."""
        return _LIGHT_M_S * self.pulse_s / 2

    @property
    def rays(self) -> Rays:
        """The rays of one turn in the sensor frame, ``(3, H, W)``; read-only."""
        return _rays(self.lasers, self.shots)

    @property
    def time_s(self) -> NDArray[np.float32]:
        """Time of each shot, ``(H, W)`` seconds from the middle of the sweep; read-only.

        The head looks ahead in the middle of the sweep, turns counter-clockwise, and starts and
        ends looking backwards.
        """
        return _time_s(self.lasers, self.shots, self.spin_hz)


def _azimuth(lasers: Lasers, shots: int) -> NDArray[np.float64]:
    """Azimuth (H, W) of the beams.

    A laser fires at head azimuth + offset. Shots are numbered by the azimuth of the beam, so that
    only the remainder of the offset within one step is left.
    """
    step = 2 * np.pi / shots
    return step * np.arange(shots) + (np.array(lasers.azimuth_offset_rad) % step)[:, None]


@lru_cache(maxsize=4)
def _time_s(lasers: Lasers, shots: int, spin_hz: float) -> NDArray[np.float32]:
    turns = (_azimuth(lasers, shots) - np.array(lasers.azimuth_offset_rad)[:, None]) / (2 * np.pi)
    return _frozen(((turns + 0.5) % 1.0 - 0.5) / spin_hz)


@lru_cache(maxsize=4)
def _rays(lasers: Lasers, shots: int) -> Rays:
    azimuth = _azimuth(lasers, shots)
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    inclination, lateral, height = (
        np.array(column)[:, None] + np.zeros_like(azimuth)
        for column in (lasers.inclination_rad, lasers.lateral_m, lasers.height_m)
    )
    origin = np.stack([-lateral * sine, lateral * cosine, height])
    level, up = np.cos(inclination), np.sin(inclination)
    return Rays(_frozen(origin), _frozen(np.stack([level * cosine, level * sine, up])))


def _frozen(values: NDArray[np.float64]) -> NDArray[np.float32]:
    frozen = values.astype(np.float32)
    frozen.flags.writeable = False
    return frozen

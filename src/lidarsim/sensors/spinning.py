"""Spinning lidars: laser table, limits, and the rays of one turn."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarsim.scene import check_fields

_LIGHT_M_S = 299_792_458.0
_BLOCK_BEAMS = 32
# HDL-64E as fitted to scans of KITTI (z = height + r tan(elevation) for each laser, residual below
# 1 mm): (highest, lowest, standard deviation of the step) of each block's elevations in degrees,
# optical centres, sign of the lateral offset, spread of bias and gain. The azimuth offsets are from
# the S3 calibration of ros-drivers; its elevations (1.96 ... -8.56, -8.78 ... -24.56) end 0.4
# degrees higher than KITTI's.
_UPPER_BLOCK_DEG = (1.94, -8.71, 0.045)
_LOWER_BLOCK_DEG = (-9.03, -25.00, 0.070)
_UPPER_HEIGHTS_M = (0.209, 0.198)
_LOWER_HEIGHTS_M = (0.126, 0.116)
_AZIMUTH_COLUMNS_DEG = (-8.5, 3.7, -2.4, 9.9)
_LATERAL_OFFSET_M = 0.026
_BIAS_SD_M = 0.025
_GAIN_SD = 0.2
_IRREGULARITIES_SEED = 64


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
    lost_share: float = 0.001  # of shots at the ground that are lost, see ``effects.instrument``
    range_sigma_m: float = 0.008  # range noise of a strong return
    weak_range_sigma_m: float = 0.05  # further noise at a signal-to-noise ratio of 1/2
    range_step_m: float = 0.002  # in which ranges are reported; 0 for none
    return_mode: Literal["strongest", "dual"] = "strongest"  # or the two strongest of a shot

    def __post_init__(self) -> None:
        if self.shots < 8:
            raise ValueError(f"shots must be at least 8 per turn, got {self.shots}")
        check_fields(
            self, "be positive", "spin_hz", "mount_height_m", "min_power", "overlap_range_m"
        )
        check_fields(
            self, "be 0 or greater", "divergence_rad", "pulse_s", "threshold_spread",
            "range_sigma_m", "weak_range_sigma_m", "range_step_m",
        )  # fmt: skip
        if not 0 <= self.lost_share < 0.1:
            raise ValueError(f"lost_share must lie in [0, 0.1), got {self.lost_share}")
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


def hdl64e(shots: int = 2083) -> SpinningLidar:
    """Velodyne HDL-64E as mounted on the recording car of KITTI-360, 2083 shots at 10 Hz."""
    return SpinningLidar(_hdl64e_lasers(), shots)


def hdl32e() -> SpinningLidar:
    """Velodyne HDL-32E: 32 beams from +10.67 to -30.67 degrees, 2170 shots at 10 Hz.

    Source: the datasheet.
    """
    lasers = _lasers(np.radians(np.linspace(10.67, -30.67, 32)))
    return SpinningLidar(lasers, 2170, min_range_m=0.9, max_range_m=100.0)


def vls128() -> SpinningLidar:
    """Velodyne VLS-128: 128 beams from +15 to -25 degrees, 0.11 degrees apart around the horizon.

    Source: beam angles of ros-drivers/velodyne; the datasheet (1800 shots at 10 Hz, 245 m).
    """
    above = (15, 11.75, 9.7, 8.43, 7.58, 6.98, 6.48, 6.08, 5.73, 5.43, 5.18, 4.98, 4.83)
    below = (6.65, 6.85, 7.15, 7.65, 8.35, 9.24, 10.35, 11.74, 13.57, 16.04, 19.58, 25)
    inclination_deg = np.concatenate([above, np.linspace(4.72, -6.5, 103), np.negative(below)])
    columns_deg = (4.548, 2.732, 0.911, -0.911, -2.732, -4.548, -6.354, 6.354)
    lasers = _lasers(
        np.radians(inclination_deg), azimuth_offset_rad=np.radians(np.resize(columns_deg, 128))
    )
    return SpinningLidar(lasers, 1800, min_range_m=0.9, max_range_m=245.0, min_power=3.4e-6)


PRESETS = {"hdl64e": hdl64e, "hdl32e": hdl32e, "vls128": vls128}


def load_sensor(model: str, **changes: Any) -> SpinningLidar:
    """A sensor by its name, or an HDL-64E with the laser table of a calibration file.

    Args:
        model: One of ``PRESETS``, or a YAML file as ``velodyne_pointcloud`` of ros-drivers reads:
            a list ``lasers`` with ``vert_correction`` and ``rot_correction`` in radians and
            ``vert_offset_correction`` and ``horiz_offset_correction`` in metres.
        changes: Other values for fields of :class:`SpinningLidar`.
    """
    if model in PRESETS:
        return replace(PRESETS[model](), **changes)
    path = Path(model)
    if not path.is_file():
        raise ValueError(
            f"unknown sensor {model!r}; choose from {', '.join(PRESETS)}, or give a calibration "
            "YAML"
        )
    return SpinningLidar(_read_calibration(path), **changes)


def _read_calibration(path: Path) -> Lasers:
    import yaml  # the presets do not need it

    try:
        content = yaml.safe_load(path.read_text())
        table = sorted(content["lasers"], key=lambda laser: -laser["vert_correction"])
        columns = {
            name: np.array([float(laser.get(key, 0.0)) for laser in table])
            for name, key in (
                ("inclination_rad", "vert_correction"),
                ("azimuth_offset_rad", "rot_correction"),
                ("height_m", "vert_offset_correction"),
                ("lateral_m", "horiz_offset_correction"),
            )
        }
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path} is not a calibration of velodyne_pointcloud ({error!r}): it needs a list "
            f"`lasers`, each with at least vert_correction (radians)"
        ) from error
    try:
        return _lasers(**columns)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _lasers(inclination_rad: NDArray[np.float64], **columns: NDArray[np.float64]) -> Lasers:
    """Laser table of these columns; missing gains are 1, other missing values 0."""
    zeros = np.zeros(len(inclination_rad))
    table = {field.name: zeros for field in fields(Lasers)} | {"intensity_gain": zeros + 1}
    table |= {"inclination_rad": inclination_rad} | columns
    return Lasers(*(tuple(map(float, column)) for column in table.values()))


def _block_inclinations(
    block_deg: tuple[float, float, float], generator: np.random.Generator
) -> NDArray[np.float64]:
    """Falling inclinations (32,) in degrees with the block's exact ends and irregular steps."""
    highest, lowest, step_sd = block_deg
    mean_step = (highest - lowest) / (_BLOCK_BEAMS - 1)
    steps = generator.normal(mean_step, step_sd, _BLOCK_BEAMS - 1).clip(min=mean_step / 4)
    return highest - np.append(0.0, steps.cumsum() * (highest - lowest) / steps.sum())


@cache
def _hdl64e_lasers() -> Lasers:
    generator = np.random.Generator(np.random.Philox(_IRREGULARITIES_SEED))
    inclination_deg = np.concatenate(
        [_block_inclinations(block, generator) for block in (_UPPER_BLOCK_DEG, _LOWER_BLOCK_DEG)]
    )
    beams = np.arange(2 * _BLOCK_BEAMS)
    lowest_deg, highest_deg = min(_AZIMUTH_COLUMNS_DEG), max(_AZIMUTH_COLUMNS_DEG)
    offset_deg = np.take(_AZIMUTH_COLUMNS_DEG, beams % 4) + generator.normal(0.0, 0.3, len(beams))
    return _lasers(
        inclination_rad=np.radians(inclination_deg),
        azimuth_offset_rad=np.radians(offset_deg.clip(lowest_deg, highest_deg)),
        height_m=np.concatenate(
            [np.linspace(*ends, _BLOCK_BEAMS) for ends in (_UPPER_HEIGHTS_M, _LOWER_HEIGHTS_M)]
        ),
        lateral_m=np.where(beams % 2 == 0, -_LATERAL_OFFSET_M, _LATERAL_OFFSET_M),
        range_bias_m=generator.normal(0.0, _BIAS_SD_M, len(beams)),
        intensity_gain=np.exp(generator.normal(0.0, _GAIN_SD, len(beams))),
    )


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

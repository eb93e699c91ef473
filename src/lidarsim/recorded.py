"""Recorded scans, and the turn of one on which the effects of the simulator can act.

One ray per point, from the origin of the frame. Shots without a return are unknown and have no
ray, so that no effect gives them an echo.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarsim.cloud_formats import refuse_two_scales
from lidarsim.draws import Draws
from lidarsim.ground import ground_of
from lidarsim.scan import damped_intensity, power_of_intensity
from lidarsim.scene import Material, Primitive, Scene
from lidarsim.sensors.files import load_sensor
from lidarsim.sensors.spinning import Lasers, SpinningLidar
from lidarsim.sensors.view import angles_of
from lidarsim.solids import GROUND, NO_SURFACE, Floats, Solids
from lidarsim.sweep import Echoes, Sweep

Returns = Literal["strongest", "dual"]
# No LiDAR on a car reaches farther.
_FARTHEST_M = 1000.0
# Points of at least this share of the full intensity count as retro-reflectors.
_SATURATED = 0.985
_UNKNOWN_INTENSITY = 0.2
# ln(power / min_power) of points without intensity by the least range of their row in metres: these
# shares of them are below.
_SHARES = (0.0, 0.001, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
_DARK = {
    0.0: (-0.75, -0.4, -0.05, 0.35, 1.05, 1.5, 1.9, 2.45, 3.2),
    5.0: (-0.8, -0.45, -0.15, 0.15, 0.6, 0.95, 1.35, 2.05, 3.15),
    8.0: (-1.05, -0.55, -0.3, -0.05, 0.35, 0.8, 1.3, 2.05, 3.1),
    11.0: (-1.0, -0.6, -0.35, 0.0, 0.65, 1.5, 2.2, 3.0, 3.1),
    20.0: (-1.1, -0.3, 0.05, 0.6, 1.35, 1.65, 1.9, 2.2, 2.3),
    30.0: (-0.8, -0.25, 0.1, 0.5, 1.0, 1.3, 1.55, 1.95, 2.3),
    40.0: (-0.75, -0.3, 0.0, 0.25, 0.7, 1.0, 1.3, 1.7, 2.3),
    50.0: (-0.85, -0.5, -0.2, 0.05, 0.45, 0.75, 1.1, 1.5, 2.3),
    65.0: (-0.9, -0.6, -0.35, -0.15, 0.2, 0.5, 0.85, 1.35, 2.25),
}
# Shares of saturated points of simulated scans, and ln of their power over the least one.
_BRIGHT = (0.0, 0.3, 0.5, 0.6, 0.7, 0.95, 1.0), (0.0, 0.0, 0.5, 2.1, 4.0, 5.4, 6.2)
# A sun with a return within this angle is hidden.
_SUN_RADIUS_RAD = np.radians(0.5)
# Points whose inclinations show the highest laser, which at most is so high.
_SOME_POINTS, _HIGHEST_DEG = 256, 80


@dataclass(frozen=True)
class RecordedScan:
    """One scan of any spinning lidar, in the order of its file.

    Args:
        points: ``(P, 3)`` float32, x forward, y left, z up in the sensor frame, metres.
        intensity: ``(P,)`` in the units of the file; None if it has none.
        ring: ``(P,)`` laser of each point as stored; None if it is not stored.
        time_s: ``(P,)`` seconds from any moment; None if it is not stored.
        labels: ``(P,)`` uint32; None without labels.

    Raises:
        ValueError: If there are no points, a column has another length, or points cannot be used.

    Example:
        >>> scan = RecordedScan(np.ones((5, 3), np.float32), intensity=np.zeros(5, np.float32))
        >>> len(scan)
        5
    """

    points: NDArray[np.float32]
    intensity: NDArray | None = None
    ring: NDArray | None = None
    time_s: NDArray | None = None
    labels: NDArray[np.uint32] | None = None

    def __post_init__(self) -> None:
        shape = self.points.shape
        if len(shape) != 2 or shape[1] != 3 or not len(self.points):
            raise ValueError(f"points must be (P, 3) with at least one point, got {shape}")
        for name in ("intensity", "ring", "time_s", "labels"):
            column = getattr(self, name)
            if column is not None and column.shape != (len(self),):
                raise ValueError(
                    f"{name} must have one value for each of {len(self)} points, "
                    f"got the shape {column.shape}"
                )
        are_finite = {"points": np.isfinite(self.points).all(axis=1)}
        if self.intensity is not None:
            are_finite["intensities"] = np.isfinite(self.intensity)
        for what, is_finite in are_finite.items():
            if num_bad := np.count_nonzero(~is_finite):
                raise ValueError(
                    f"{num_bad} of {len(self)} {what} are NaN or infinite: drop these points first"
                )
        farthest_m = float(np.abs(self.points).max())
        if farthest_m > _FARTHEST_M:
            raise ValueError(
                f"points reach {farthest_m:.0f} m, farther than {_FARTHEST_M:g}: give metres"
            )

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class Instrument:
    """Assumed properties of the instrument that recorded a scan.

    Args:
        sensor: Its detection limit, beam, pulse and noise, and the mean height of its lasers, from
            which added points are seen: a preset such as ``hdl32e``, a calibration file or a
            :class:`SpinningLidar`.
        returns: Which echoes of a shot it reports.
        full_intensity: Intensity of a white surface in front of it. Default: from the 99.9 %
            quantile q of each scan: 1 if q <= 1 (not for integers), 255 if q <= 255, else q.
        response: ``root``: intensity is the root of the power, corrected for range and damped for
            weak echoes as in KITTI's scans; ``linear``: proportional to the power, corrected for
            range, as in calibrated reflectivities.
    """

    sensor: str | Path | SpinningLidar = "hdl64e"
    returns: Returns = "strongest"
    full_intensity: float | None = None
    response: Literal["root", "linear"] = "root"

    def __post_init__(self) -> None:
        full = self.full_intensity
        if full is not None and not 0 < full < np.inf:
            raise ValueError(f"full_intensity must be positive, got {full}")
        for name, choices in (("returns", ("strongest", "dual")), ("response", ("root", "linear"))):
            if getattr(self, name) not in choices:
                given = getattr(self, name)
                raise ValueError(f"{name} must be {' or '.join(choices)}, got {given!r}")

    def sensor_for(self, scan: RecordedScan) -> SpinningLidar:
        """The sensor with one laser, as high as some points of the scan, which the sun needs."""
        x, y, z = scan.points[:: 1 + len(scan) // _SOME_POINTS].T
        highest_deg = math.degrees(np.arctan2(z, np.hypot(x, y)).max())
        return _with_laser(self.sensor, self.returns, math.ceil(highest_deg))


@lru_cache
def _with_laser(
    sensor: str | Path | SpinningLidar, returns: Returns, inclination_deg: int
) -> SpinningLidar:
    sensor = sensor if isinstance(sensor, SpinningLidar) else load_sensor(sensor)
    highest = min(inclination_deg, _HIGHEST_DEG)
    height_m = float(np.mean(sensor.lasers.height_m))
    laser = Lasers((np.radians(highest),), (0.0,), (height_m,), (0.0,), (0.0,), (1.0,))
    return replace(sensor, lasers=laser, range_step_m=0.0, return_mode=returns)


class IntensityScale(NamedTuple):
    """Units of the intensities of a scan."""

    full: float  # of a white surface; the constant where it is unknown
    step: float  # 0 if they are not on a grid
    known: bool  # False where they are missing or constant
    text: str


def scale_of(intensity: NDArray | None, full: float | None = None) -> IntensityScale:
    """Scale of intensities ``(P,)`` by their 99.9 % quantile, so that single points do not set it.

    1 up to 1, 255 up to 255, else the quantile itself. Integers are never shares of 1.

    Raises:
        ValueError: If some are negative, or few of them exceed 1 and ``full`` is not given.
    """
    values = np.zeros(1) if intensity is None else intensity.astype(float)
    low, high = values.min(), values.max()
    if low < 0:
        raise ValueError(f"intensity must be 0 or greater, got {low:g}..{high:g}")
    if low == high:
        missing = "no intensity" if intensity is None else f"intensity is {low:g} throughout"
        text = f"{missing}: a white share of {_UNKNOWN_INTENSITY:g} is assumed of every point"
        return IntensityScale(float(low), 0.0, False, text)
    if intensity is not None and full is None:
        refuse_two_scales(intensity, "the scan")
    is_integer = intensity is not None and intensity.dtype.kind in "iu"
    largest = high if high <= 1 else float(np.quantile(values, 0.999))
    if largest <= 1 and not is_integer:
        scale, unit = 1.0, "0..1"
    elif largest <= 255:
        scale, unit = 255.0, "0..255"
    else:
        scale, unit = largest, "instrument units"
    scale = full or scale
    step = 0.0
    for candidate in (1.0, scale / 100):  # the last that fits counts
        if candidate < scale and _are_multiples(values, candidate):
            step = candidate
    steps = f" in steps of {step:g}" if step else ""
    text = f"intensity {low:g}..{high:g}{steps}: {unit}, full scale {scale:g}"
    return IntensityScale(scale, step, True, text)


def _are_multiples(values: NDArray, step: float) -> bool:
    """Whether values are multiples of a step, to a thousandth of it."""
    off_grid = np.abs(values / step - np.round(values / step))
    return bool(off_grid.max() < 1e-3)


def _shares(scan: RecordedScan, scale: IntensityScale) -> Floats:
    """Intensities ``(P,)`` over the intensity of a white surface, at most 1."""
    if scan.intensity is None or not scale.known:
        return np.full(len(scan), _UNKNOWN_INTENSITY, dtype=np.float32)
    shares: Floats = (scan.intensity / scale.full).astype(np.float32).clip(max=1)
    return shares


def num_saturated(scan: RecordedScan, instrument: Instrument) -> int:
    """Return the number of points as bright as sheeting."""
    shares = _shares(scan, scale_of(scan.intensity, instrument.full_intensity))
    return int(np.count_nonzero(shares >= _SATURATED))


class RecordedSweep(Sweep):
    """The turn in which a scan was recorded, with one ray for each point.

    Powers are those that give the recorded intensities. An intensity of 0 stands for any power
    below about six times the detection limit; it is drawn from the distribution that such points of
    simulated scans have at their range; likewise the power of saturated points, unless the response
    is linear. Rays start at the mean height of the instrument's optical centres. The time of a shot
    is read from the file, or else grows with the azimuth.

    Args:
        scene: Weather, and boxes of moving vehicles as the scan shows them.
        scan: The scan.
        instrument: What is assumed of its instrument.
        sensor: ``instrument.sensor_for(scan)``; its limits are widened to hold all points.
        draws: Of the unknown powers.
    """

    def __init__(
        self,
        scene: Scene,
        scan: RecordedScan,
        instrument: Instrument,
        sensor: SpinningLidar,
        draws: Draws,
    ) -> None:
        # Points at the origin show nothing.
        self.rays_of = np.flatnonzero(scan.points.any(axis=1))
        self.points = scan.points[self.rays_of]
        start = np.zeros_like(self.points.T)
        start[2] = sensor.lasers.height_m[0]
        along = self.points.T - start
        range_m = np.sqrt((along.astype(float) ** 2).sum(axis=0)).astype(np.float32)
        direction = (along / np.maximum(range_m, 1e-6)).astype(np.float32)
        nearest, farthest = range_m.min(initial=np.inf), range_m.max(initial=0)
        sensor = replace(
            sensor,
            min_range_m=min(sensor.min_range_m, float(nearest)),
            max_range_m=max(sensor.max_range_m, float(farthest)),
        )
        if scan.time_s is None:
            turns = angles_of(self.points)[1] % (2 * np.pi) / (2 * np.pi)
            time_s = ((turns + 0.5) % 1.0 - 0.5) / sensor.spin_hz
        else:
            time_s = scan.time_s[self.rays_of].astype(float)
            time_s -= (time_s.min() + time_s.max()) / 2
        moved = tuple(_in_the_middle(box, direction, time_s) for box in scene.primitives)
        scene = replace(scene, primitives=moved)
        self._begin(scene, sensor, start, direction, time_s.astype(np.float32))
        self.material = np.full(len(range_m), Material.CONCRETE, dtype=np.uint8)

        self.scale = scale_of(scan.intensity, instrument.full_intensity)
        self.response = instrument.response
        self.share = _shares(scan, self.scale)[self.rays_of]
        self.recorded_m = range_m
        self.recorded_power: Floats = self._power(range_m, draws)
        surface = np.full(len(range_m), NO_SURFACE, dtype=np.int32)
        origin = np.zeros(len(range_m), dtype=np.uint8)
        self.first = Echoes(range_m.copy(), self.recorded_power.copy(), surface, origin)

    def _power(self, range_m: Floats, draws: Draws) -> Floats:
        least = np.float32(self.sensor.min_power)
        if self.response == "linear":
            power = (self.share / np.square(range_m)).astype(np.float32)
        else:
            power = power_of_intensity(self.share, range_m, self.sensor.min_power)
        dark = np.flatnonzero(self.share == 0)
        row = np.searchsorted(list(_DARK), range_m[dark], "right") - 1
        for number, logarithms in enumerate(_DARK.values()):
            rays = dark[row == number]
            power[rays] = least * np.exp(np.interp(draws.uniform(rays), _SHARES, logarithms))
        if self.response == "root":
            bright = np.flatnonzero(self.on_sheets())
            power[bright] *= np.exp(np.interp(draws.uniform(bright), *_BRIGHT))
        # Weaker ones could not have been detected.
        return np.maximum(power, least * np.exp(np.float32(-3 * self.sensor.threshold_spread)))

    def at(self, rays: NDArray[np.int64], range_m: Floats) -> Floats:
        """Points ``(M, 3)`` of rays at ranges."""
        return (self.start[:, rays] + range_m * self.direction[:, rays]).T

    def in_units(self, power: Floats, range_m: Floats) -> Floats:
        """Intensities of powers in the units and steps of the scan; inverse to the recorded."""
        if not self.scale.known:
            return np.full(len(power), self.scale.full)
        if self.response == "linear":
            share = power * np.square(range_m)
        else:
            share = damped_intensity(power, range_m, self.sensor.min_power)
        values: Floats = share.clip(0, 1) * np.float32(self.scale.full)
        step = np.float32(self.scale.step)
        return np.round(values / step) * step if step else values

    def rays_near(self, solids: Solids) -> list[NDArray[np.int64]]:
        """Rays for each solid that meet the sphere around it, where it is during the turn."""
        away = solids.centre - self.start[:, :1].T
        distance = np.linalg.norm(away, axis=1)
        moved = np.linalg.norm(solids.velocity, axis=1) * np.abs(self.time_s).max(initial=0)
        radius = np.linalg.norm(solids.half_size, axis=1) + moved
        sine = np.minimum(radius / np.maximum(distance, 1e-6), 1)
        least = np.where(radius < distance, np.sqrt(1 - sine**2) - 1e-6, -np.inf)
        ahead = away / np.maximum(distance, 1e-6)[:, None]
        return [
            np.flatnonzero(axis @ self.direction > cosine)
            for axis, cosine in zip(ahead, least, strict=True)
        ]

    def on_ground(self) -> NDArray[np.int64]:
        """Rays that hit the plane of the ground in their sector."""
        is_ground, normal = ground_of(self.points)
        rays = np.flatnonzero(is_ground)
        self.cos_incidence = np.abs(np.einsum("pi,ip->p", normal, self.direction))
        self.material[rays], self.first.surface[rays] = Material.ASPHALT, GROUND
        return rays

    def on_sheets(self) -> NDArray[np.bool_]:
        """Rays of a saturated intensity."""
        is_saturated: NDArray[np.bool_] = self.share >= _SATURATED
        return is_saturated

    def pairs_around(
        self, rays: NDArray[np.int64], reach_rad: float
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Pairs of a ray and a neighbour within ``reach_rad``."""
        near = cKDTree(self.direction.T).query_ball_point(self.direction.T[rays], reach_rad)
        count = np.array([len(rays_near) for rays_near in near], dtype=np.int64)
        beside = np.array([ray for rays_near in near for ray in rays_near], dtype=np.int64)
        return np.repeat(rays, count), beside

    def is_open(self, direction: Floats) -> bool:
        """Whether no point lies within half a degree of a direction ``(3,)``."""
        return bool((direction @ self.direction).max() < np.cos(_SUN_RADIUS_RAD))


def _in_the_middle(box: Primitive, direction: Floats, time_s: NDArray) -> Primitive:
    """A vehicle that is where rays show it, moved to its place in the middle of the turn."""
    time = float(time_s[(np.array(box.centre) @ direction).argmax()])
    x, y, z = box.centre
    speed_x, speed_y = box.velocity_m_s
    return replace(box, centre=(x - speed_x * time, y - speed_y * time, z))

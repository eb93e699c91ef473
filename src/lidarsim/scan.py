"""Simulated scans: rays, cast, effects, and the points as KITTI-360 stores them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import lambertw

from lidarsim.draws import Draws
from lidarsim.effects import ECHO_EFFECTS, EFFECTS, RAY_EFFECTS
from lidarsim.scene import Conditions, Scene
from lidarsim.sensors.files import load_sensor
from lidarsim.sensors.spinning import SpinningLidar
from lidarsim.street import Street
from lidarsim.sweep import Echoes, Effect, Origin, Sweep

#: Smallest distance of two echoes of one shot, metres.
SECOND_RETURN_M = 1.0
# Powers, in units of the weakest that is detected, below which the intensity is 0 and from which on
# it is not damped.
_ZERO_INTENSITY, _FULL_INTENSITY = 4.0, 8.0


@dataclass(frozen=True)
class EffectRecord:
    """Status of one effect in one scan."""

    name: str
    status: Literal["ran", "not_called", "off"]
    reason: str
    rays: int  # selected by the effect


@dataclass(frozen=True)
class SimulatedScan:
    """A scan, its labels, and a record of its effects.

    Args:
        points: ``(P, 4)`` float32, x forward, y left, z up in the sensor frame in metres, and the
            intensity in [0, 0.99] in steps of 0.01; beam after beam from the highest to the
            lowest, in each beam by growing azimuth in [0, 2 pi).
        labels: ``(P,)`` uint32, semantic class in the lower 16 bits, instance in the upper; 0 for
            points that show no surface.
        origins: ``(P,)`` uint8, the ``Origin`` of each point.
        effects: One record for each effect, in the order of ``EFFECTS``.
        scene: Solids, pose and motion of the sensor, weather.
        sensor: What recorded it.
    """

    points: NDArray[np.float32]
    labels: NDArray[np.uint32]
    origins: NDArray[np.uint8]
    effects: tuple[EffectRecord, ...]
    scene: Scene
    sensor: SpinningLidar

    def __repr__(self) -> str:
        ran = [effect.name for effect in self.effects if effect.status == "ran"]
        return f"SimulatedScan({len(self.points)} points, effects: {', '.join(ran)})"


@cache
def effect_name(effect: Effect) -> str:
    """Name of an effect for switches and reports: its class in snake case."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", type(effect).__name__).lower()


def check_switches(switches: Mapping[str, str | bool]) -> dict[str, str]:
    """The effects that are switched ``off``, sorted by name; ``on`` is the same as ``auto``.

    True and False, the YAML values of a bare ``on`` and ``off``, are accepted as well.
    """
    names = [effect_name(effect) for effect in EFFECTS]
    for name, switch in switches.items():
        if name not in names:
            raise ValueError(f"unknown effect {name!r}; choose from {', '.join(names)}")
        if switch not in ("auto", "on", "off", True, False):
            raise ValueError(f"effect {name} must be auto, on or off, got {switch!r}")
    return {name: "off" for name in sorted(switches) if switches[name] in ("off", False)}


def simulate_scan(
    scene: Scene,
    sensor: SpinningLidar,
    key: tuple[int | str, ...],
    switches: Mapping[str, str | bool] | None = None,
) -> SimulatedScan:
    """Simulate one scan of a scene.

    Args:
        scene: Scene to scan.
        sensor: Instrument; its mount height is not used, the pose holds the height.
        key: Seed of the random draws, see ``generator_for``; the name of each effect is added, so
            that effects do not change the draws of each other.
        switches: ``off`` omits an effect; the others run if scene or sensor call for them.
    """
    off = check_switches(switches or {})
    sweep = Sweep(scene, sensor)
    records = [run_effect(effect, sweep, key, off) for effect in RAY_EFFECTS]
    sweep.cast()
    records += [run_effect(effect, sweep, key, off) for effect in ECHO_EFFECTS]
    return SimulatedScan(*_points(sweep), tuple(records), scene, sensor)


class Simulator:
    """Simulates the scans of one drive, in any order and without files.

    They are the scans that :func:`simulate` writes for the same seed, drive and settings.

    Args:
        seed: Seed of street and instrument, 0 or greater.
        drive: Number of the drive; each leads through a street of its own.
        weather: Weather of all scans; None draws another one every 100 scans.
        sensor: Instrument, or an argument of ``load_sensor``.
        effects: ``off`` or ``auto`` by effect; those not named are ``auto``.

    Raises:
        ValueError: If a value is out of range or an effect unknown.

    Example:
        >>> from lidarsim import Weather
        >>> scan = Simulator(seed=0, weather=Weather(rain_mm_h=10)).scan(3)
        >>> scan.points.shape[1], scan.points.dtype, len(scan.labels) == len(scan.points)
        (4, dtype('float32'), True)
        >>> [effect.reason for effect in scan.effects if effect.name == "rain"]
        ['10 mm/h of rain']
    """

    def __init__(
        self,
        seed: int = 0,
        drive: int = 0,
        weather: Conditions | None = None,
        sensor: str | Path | SpinningLidar = "hdl64e",
        effects: Mapping[str, str | bool] | None = None,
    ) -> None:
        if isinstance(weather, Mapping):
            arguments = ", ".join(f"{name}={value}" for name, value in weather.items())
            raise ValueError(f"weather must be an object such as Weather({arguments}), got a dict")
        self.street = Street(seed, drive, weather)
        self.sensor = sensor if isinstance(sensor, SpinningLidar) else load_sensor(sensor)
        self.switches = check_switches(effects or {})

    def __repr__(self) -> str:
        street = self.street
        weather = street.weather or "drawn"
        return (
            f"Simulator(seed={street.seed}, drive={street.drive}, weather={weather}, "
            f"{len(self.sensor.lasers.inclination_rad)} beams)"
        )

    def scan(self, number: int) -> SimulatedScan:
        """Scan ``number`` of the drive, 0 to 1,000,000; neighbours are 0.1 s apart."""
        scene = self.street.scene(number, self.sensor.mount_height_m)
        key = (self.street.seed, "effects", self.street.drive, number)
        return simulate_scan(scene, self.sensor, key, self.switches)


def run_effect(
    effect: Effect, sweep: Sweep, key: tuple[int | str, ...], off: Mapping[str, str]
) -> EffectRecord:
    """Run an effect on a sweep if its scene calls for it, see :func:`simulate_scan`."""
    name = effect_name(effect)
    if name in off:
        return EffectRecord(name, "off", "switched off", 0)
    reason = effect.called_by(sweep.scene, sweep.sensor)
    if reason is None:
        return EffectRecord(name, "not_called", "nothing in the scene calls for it", 0)
    rays = effect.rays(sweep)
    num_rays = sweep.num_rays if isinstance(rays, slice) else len(rays)
    if num_rays:
        effect.apply(sweep, rays, Draws(sweep.num_rays, *key, name))
    return EffectRecord(name, "ran", reason, num_rays)


def _points(sweep: Sweep) -> tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.uint8]]:
    first, second = sweep.first, sweep.second
    seen = np.flatnonzero(np.isfinite(first.range_m))
    parts = [_export(sweep, first, seen)]
    beams = [seen // sweep.shape[1]]
    if second is not None and sweep.sensor.return_mode == "dual":
        apart = np.abs(second.range_m[seen] - first.range_m[seen]) > SECOND_RETURN_M
        seen = seen[apart & np.isfinite(second.range_m[seen])]
        points, labels, _ = _export(sweep, second, seen)
        parts.append((points, labels, np.full(len(seen), Origin.SECOND_RETURN, dtype=np.uint8)))
        beams.append(seen // sweep.shape[1])
    points, labels, origins = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    # By beam, then by azimuth in [0, 2 pi), so that a beam ends where azimuth falls.
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % np.float32(2 * np.pi)
    order = np.argsort(7.0 * np.concatenate(beams) + azimuth, kind="stable")
    return points[order], labels[order], origins[order]


def _export(
    sweep: Sweep, echoes: Echoes, seen: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.uint8]]:
    """Points along the rays of a sensor at rest, as the instrument stores them."""
    origin, direction = (array.reshape(3, -1)[:, seen] for array in sweep.sensor.rays)
    range_m, surface, made_by = echoes.range_m[seen], echoes.surface[seen], echoes.origin[seen]
    points = np.empty((len(seen), 4), dtype=np.float32)
    points[:, :3] = (origin + range_m * direction).T
    points[:, 3] = calibrated_intensity(echoes.power[seen], range_m, sweep.sensor.min_power)
    return points, sweep.labels(surface, made_by), made_by


def calibrated_intensity(
    power: NDArray[np.float32], range_m: NDArray[np.float32], min_power: float
) -> NDArray[np.float32]:
    """Intensity as KITTI stores it: corrected for range, 0 to 0.99 in steps of 0.01.

    The square root models the gain control of the instrument, which amplifies weak returns; the
    weakest are reported with 0::

        intensity = sqrt(power * range^2) * clip(ln(power / a) / ln(b / a), 0, 1)
        a = 4 min_power        b = 8 min_power

    with the received ``power`` in m^-2. Source: fitted to the intensities of KITTI's scans by
    range and incidence.
    """
    return np.round(damped_intensity(power, range_m, min_power).clip(0, 0.99), 2)


def damped_intensity(
    power: NDArray[np.float32], range_m: NDArray[np.float32], min_power: float
) -> NDArray[np.float32]:
    """:func:`calibrated_intensity` before it is limited and rounded."""
    weakest = np.float32(_ZERO_INTENSITY * min_power)
    strong = _FULL_INTENSITY / _ZERO_INTENSITY
    ramp = np.log(np.maximum(power, weakest) / weakest) / np.float32(np.log(strong))
    return np.sqrt(power * range_m**2) * ramp.clip(max=1)


def power_of_intensity(
    intensity: NDArray[np.float32], range_m: NDArray[np.float32], min_power: float
) -> NDArray[np.float32]:
    """Received power, m^-2, of intensities above 0: the inverse of :func:`damped_intensity`.

    Where the intensity is damped, with Lambert's function W and ``L = ln(b / a)``::

        power = a exp(2 W(c / 2))        c = L intensity / (range sqrt(a))
    """
    weakest = _ZERO_INTENSITY * min_power
    ramp = np.log(_FULL_INTENSITY / _ZERO_INTENSITY)
    root = intensity / range_m / np.float32(np.sqrt(weakest))  # of power / a, undamped
    exponent = 2 * np.log(np.maximum(root, np.finfo(np.float32).tiny))
    damped = np.flatnonzero(exponent < ramp)
    exponent[damped] = 2 * lambertw(ramp * root[damped] / 2).real
    return np.float32(weakest) * np.exp(exponent)

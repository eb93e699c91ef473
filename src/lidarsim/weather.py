"""Weather on recorded scans, by the effects of the simulator."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from lidarsim import scene
from lidarsim.clouds import PointCloud, ScanError, read_cloud
from lidarsim.draws import Draws
from lidarsim.effects import EFFECTS
from lidarsim.effects.instrument import Blooming
from lidarsim.recorded import Instrument, RecordedScan, RecordedSweep, num_saturated
from lidarsim.scan import (
    SECOND_RETURN_M,
    EffectRecord,
    SimulatedScan,
    check_switches,
    effect_name,
    run_effect,
)
from lidarsim.scene import Interval, Pose, Primitive, Scene, Semantic, Shape
from lidarsim.sweep import Echoes, Effect, Origin

#: Added points have this class plus their ``Origin``: no data set uses these numbers.
ADDED_CLASS = 0xFF00
_HERE = "the scan shows it already"
#: Why effects cannot act on a recorded scan.
REFUSED = {
    "glass": "what stands behind a pane is not in it",
    "polished_metal": "what a mirror shows is not in it",
    "foliage_occlusion": "what stands behind leaves is not in it",
    "moving_actors": "what vehicles hide is not in it",
    "rolling_shutter": "what the sensor would see from elsewhere is not in it",
    "mixed_pixels": _HERE,
    "ego_occlusion": _HERE,
    "diffuse_reflection": _HERE,
    "surface_texture": _HERE,
    "retro_reflection": _HERE,
    "laser_calibration": _HERE,
    "lost_shots": _HERE,
    "weak_patches": _HERE,
}
# Instrument effects that every recorded scan has: they run where they are switched on.
_ON_REQUEST = ("blooming", "range_noise")
# Detection is re-evaluated where the power of an echo has changed.
_DETECTION = {"soft_raydrop", "detection_limit", "dual_return"}
# Classes of vehicles: of KITTI-360, then of SemanticKITTI, whose ids from 252 on are in motion.
_VEHICLES = (Semantic.CAR, Semantic.TRUCK, Semantic.BUS, 10, 18, 252, 257, 258, 259)
# A vehicle of fewer points has no box.
_LEAST_POINTS = 20
_INSTRUMENT = Instrument()
# Fields of a prior, equally likely, and the deepest film of a road in rain.
_FIELDS = ("visibility_m", "rain_mm_h", "snow_mm_h")
_FULL_FILM_MM = 1.5
_LONGEST_TURN_S = 1.0
Seed = int | tuple[int | str, ...]
Points = TypeVar("Points")  # array, tensor or cloud


@dataclass(frozen=True)
class WeatheredScan:
    """A scan in weather. Letter Q: points; remaining ones keep the order of the input.

    Args:
        points: ``(Q, 3)`` float32; remaining points equal the input bit for bit unless
            ``range_noise`` runs, added points come last.
        intensity: ``(Q,)`` in units and type of the input; None if it has none.
        labels: ``(Q,)`` uint32, ``ADDED_CLASS`` plus the ``Origin`` of added points; None if the
            input has none.
        index: ``(Q,)`` number of each point in the input, -1 for added ones.
        shot: ``(Q,)`` number of the input's point of the same shot.
        origins: ``(Q,)`` uint8, the ``Origin`` of each point.
        effects: Which effects ran, and why.
        report: What was assumed, and counts of points that were lost, moved and added, by cause.
    """

    points: NDArray[np.float32]
    intensity: NDArray | None
    labels: NDArray[np.uint32] | None
    index: NDArray[np.int64]
    shot: NDArray[np.int64]
    origins: NDArray[np.uint8]
    effects: tuple[EffectRecord, ...]
    report: dict[str, object]


@dataclass(frozen=True)
class Weather(scene.Conditions):
    """Weather of simulated streets and of recorded scans, see :class:`lidarsim.scene.Conditions`.

    On recorded scans, ``sun_azimuth_deg`` is counter-clockwise from the scan's x axis. The scan is
    assumed to show clear air and a dry road. Shots without a return stay empty, even where fog,
    rain or snow in front of the sky would give one, since nothing is known of them.

    Args:
        traffic_m_s: Speed of vehicles that have an instance in the labels, for their spray, which
            begins at 10 m/s and needs ``water_film_mm``; they are assumed to drive along their
            length, ahead rather than back.

    Example:
        >>> points = np.random.default_rng(0).uniform(5, 40, (1000, 3)).astype(np.float32)
        >>> Weather(visibility_m=60).apply(points).shape[1]
        3
        >>> weathered = Weather(visibility_m=60).apply(RecordedScan(points))
        >>> weathered.report["points"], len(weathered.points) > 0
        (1000, True)
    """

    traffic_m_s: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        scene.check_fields(self, "be 0 or greater", "traffic_m_s")

    def __call__(self, points: Any) -> Any:
        """Apply this weather as a transform of a data set, with a new seed in each call.

        The seed comes from :mod:`random`, which a ``DataLoader`` seeds in each of its processes.
        """
        return self.apply(points, random.getrandbits(63))

    @overload
    def apply(
        self,
        scan: RecordedScan | SimulatedScan | str | Path,
        seed: Seed = 0,
        *args: Any,
        **options: Any,
    ) -> WeatheredScan: ...
    @overload
    def apply(self, scan: Points, seed: Seed = 0, *args: Any, **options: Any) -> Points: ...

    def apply(
        self,
        scan: Any,
        seed: Seed = 0,
        instrument: Instrument | None = None,
        boxes: NDArray[np.floating] | None = None,
        effects: Mapping[str, str | bool] | None = None,
    ) -> Any:
        """Return a scan as it would be in this weather.

        Args:
            scan: Array or tensor ``(P, 3)``, or ``(P, 4)`` with intensity; a
                :class:`PointCloud`; a :class:`RecordedScan`, a :class:`SimulatedScan`, or the path
                of a scan.
            seed: Of the random draws; the draws of each effect do not depend on other effects.
            instrument: What is assumed of the instrument. Default: the sensor of a simulated
                scan, else ``Instrument()``.
            boxes: ``(N, 8)`` vehicles that throw spray: centre x, y, z, length, width, height in
                metres, heading in radians, speed in m/s.
            effects: ``off`` omits an effect; ``blooming`` and ``range_noise``, which a recorded
                scan has already, run where they are ``on``.

        Returns:
            The kind that was given; a :class:`WeatheredScan`, which says what happened to each
            point, for a recorded or simulated scan or a path.

        Raises:
            ValueError: If an effect is unknown or cannot act on a recorded scan, or boxes or
                intensities cannot be used.
        """
        known = Instrument(scan.sensor) if isinstance(scan, SimulatedScan) else _INSTRUMENT
        used = instrument or known
        return change_scan(scan, lambda recorded: self._apply(recorded, seed, used, boxes, effects))

    def _apply(
        self,
        scan: RecordedScan,
        seed: Seed,
        instrument: Instrument,
        boxes: NDArray[np.floating] | None,
        effects: Mapping[str, str | bool] | None,
    ) -> WeatheredScan:
        off, wanted, idle = _switched(effects or {})
        vehicles = _vehicles(boxes)
        if self.traffic_m_s and self.water_film_mm and scan.labels is not None:
            vehicles += _labelled_vehicles(scan, self.traffic_m_s)
        blooms = any(isinstance(effect, Blooming) for effect in wanted)
        bright = num_saturated(scan, instrument) if blooms else 0
        world = Scene(vehicles, Pose(z_m=0.0), weather=self, ground_m=-1e3, sheet_points=bright)
        sensor = instrument.sensor_for(scan)
        called = {effect_name(effect) for effect in wanted if effect.called_by(world, sensor)}
        shows_nothing = not scan.points.any()  # points at the origin are no returns
        if shows_nothing or not called - off.keys() - _DETECTION:
            return kept_part(scan, np.arange(len(scan)), idle)
        key = seed if isinstance(seed, tuple) else (seed,)
        sweep = RecordedSweep(world, scan, instrument, sensor, Draws(len(scan), *key, "power"))
        records = tuple(run_effect(effect, sweep, key, off) for effect in wanted)
        return _result(scan, sweep, records)


def recorded_scan(cloud: PointCloud) -> RecordedScan:
    """Return the points of a cloud as float32, and the columns that are understood.

    Raises:
        ScanError: If weather and faults cannot act on them.
    """
    points = cloud.points.astype(np.float32)
    try:
        return RecordedScan(points, cloud.intensity, cloud.ring, _seconds(cloud), cloud.labels)
    except ValueError as error:
        raise ScanError(f"{cloud.where}: {error}") from error


def _seconds(cloud: PointCloud) -> NDArray[np.float64] | None:
    """Return times from the first point on; files have them in s, ms, us or ns."""
    if cloud.time_s is None or not len(cloud):
        return cloud.time_s
    elapsed = (cloud.time_s - cloud.time_s.min()).astype(float)
    for unit_s in (1.0, 1e-3, 1e-6):
        if elapsed.max() * unit_s <= _LONGEST_TURN_S:
            return elapsed * unit_s
    return elapsed * 1e-9


def changed_cloud(cloud: PointCloud, result: WeatheredScan) -> PointCloud:
    """Return the cloud of a changed scan; added points have the further columns of their shot."""
    return cloud.changed(result.shot, result.points, result.intensity, result.labels)


def change_scan(scan: Any, change: Callable[[RecordedScan], WeatheredScan]) -> Any:
    """Apply a change to a scan of any kind, see :meth:`Weather.apply`."""
    if isinstance(scan, RecordedScan):
        return change(scan)
    if isinstance(scan, str | Path):
        return change(recorded_scan(read_cloud(scan)))
    if isinstance(scan, PointCloud):
        return changed_cloud(scan, change(recorded_scan(scan)))
    if isinstance(scan, SimulatedScan):
        points, intensity = scan.points[:, :3], scan.points[:, 3]
        return change(RecordedScan(points, intensity, labels=scan.labels))
    is_tensor = hasattr(scan, "new_tensor")  # of torch, which is not imported here
    array = scan.detach().cpu().numpy() if is_tensor else np.asarray(scan)
    cloud = PointCloud.of(array)
    table = changed_cloud(cloud, change(recorded_scan(cloud))).table
    points = np.stack([table[name] for name in table.dtype.names or ()], axis=1)
    return scan.new_tensor(points) if is_tensor else points


def _switched(
    effects: Mapping[str, str | bool],
) -> tuple[dict[str, str], list[Effect], tuple[EffectRecord, ...]]:
    """Effects that are off, those that may run, and the records where none is called."""
    off = check_switches(effects)
    on = {name for name, switch in effects.items() if switch in ("on", True)}
    for name in REFUSED.keys() & on:
        raise ValueError(f"effect {name} cannot act on a recorded scan: {REFUSED[name]}")
    left_out = {*REFUSED, *_ON_REQUEST} - on
    by_name = {effect_name(effect): effect for effect in EFFECTS}
    wanted = {name: effect for name, effect in by_name.items() if name not in left_out}
    idle = tuple(
        EffectRecord(name, "off" if name in off else "not_called", "nothing calls for it", 0)
        for name in wanted
    )
    return off, list(wanted.values()), idle


def kept_part(
    scan: RecordedScan,
    kept: NDArray[np.int64],
    records: tuple[EffectRecord, ...],
    lost: dict[str, int] | None = None,
    moved: int = 0,
) -> WeatheredScan:
    """Result that consists of some points ``(Q,)`` of a scan."""
    report = {"points": len(scan), "lost": lost or {}, "moved": moved, "dimmed": 0, "added": {}}
    columns: dict[str, Any] = {n: getattr(scan, n) for n in ("points", "intensity", "labels")}
    if len(kept) < len(scan):
        columns = {n: None if column is None else column[kept] for n, column in columns.items()}
    nothing = np.zeros(len(kept), dtype=np.uint8)
    return WeatheredScan(
        index=kept, shot=kept, origins=nothing, effects=records, report=report, **columns
    )


def _result(
    scan: RecordedScan, sweep: RecordedSweep, records: tuple[EffectRecord, ...]
) -> WeatheredScan:
    """Return the points of the remaining echoes: recorded ones, then echoes of the air."""
    echoes = list(sweep.echoes())
    seen = _detected(echoes)
    points = scan.points.copy()
    intensity = None if scan.intensity is None else scan.intensity.copy()
    stays = np.ones(len(scan), dtype=bool)
    stays[sweep.rays_of] = False
    added = []
    num_moved = num_dimmed = 0
    for echo, is_seen in zip(echoes, seen, strict=True):
        is_surface = echo.origin == Origin.SURFACE
        surface_rays = np.flatnonzero(is_seen & is_surface)
        stays[sweep.rays_of[surface_rays]] = True
        away = surface_rays[echo.range_m[surface_rays] != sweep.recorded_m[surface_rays]]
        points[sweep.rays_of[away]] = sweep.at(away, echo.range_m[away])
        weaker = surface_rays[echo.power[surface_rays] != sweep.recorded_power[surface_rays]]
        num_moved += len(away)
        num_dimmed += len(weaker)
        if intensity is not None:
            faded = sweep.in_units(echo.power[weaker], echo.range_m[weaker])
            at = sweep.rays_of[weaker]
            intensity[at] = np.minimum(intensity[at], faded.astype(intensity.dtype))
        air_rays = np.flatnonzero(is_seen & ~is_surface)
        range_m, origin = echo.range_m[air_rays], echo.origin[air_rays]
        shown = sweep.in_units(echo.power[air_rays], range_m)
        added.append((sweep.at(air_rays, range_m), shown, sweep.rays_of[air_rays], origin))

    new, shown, shot, made_by = (np.concatenate(parts) for parts in zip(*added, strict=True))
    kept = np.flatnonzero(stays)
    labels = scan.labels
    if labels is not None:
        labels = np.concatenate([labels[kept], ADDED_CLASS + made_by.astype(np.uint32)])
    if intensity is not None:
        intensity = np.concatenate([intensity[kept], shown.astype(intensity.dtype)])
    # What the shots of lost points report in their place; the surface if nothing.
    in_place = np.where(seen[0], echoes[0].origin, Origin.SURFACE)[~stays[sweep.rays_of]]
    counts = _by_origin(in_place)
    lost = {"too weak": counts.pop("surface", 0)} | counts
    report = {
        "points": len(scan),
        "intensity": sweep.scale.text,
        "lost": lost,
        "moved": num_moved,
        "dimmed": num_dimmed,
        "added": _by_origin(made_by),
    }
    return WeatheredScan(
        points=np.concatenate([points[kept], new]),
        intensity=intensity,
        labels=labels,
        index=np.concatenate([kept, np.full(len(new), -1)]),
        shot=np.concatenate([kept, shot]),
        origins=np.concatenate([np.zeros(len(kept), dtype=np.uint8), made_by]),
        effects=records,
        report=report,
    )


def _detected(echoes: list[Echoes]) -> list[NDArray[np.bool_]]:
    """Which shots report each echo; a second one has to be apart from the first."""
    detected = [np.isfinite(echo.range_m) & (echo.power > 0) for echo in echoes]
    for second, is_seen in zip(echoes[1:], detected[1:], strict=True):
        is_seen &= detected[0]
        apart_m = second.range_m[is_seen] - echoes[0].range_m[is_seen]
        is_seen[is_seen] = np.abs(apart_m) > SECOND_RETURN_M
    return detected


def _by_origin(origins: NDArray[np.uint8]) -> dict[str, int]:
    """Number of points of each origin that occurs, by its name."""
    codes, counts = np.unique(origins, return_counts=True)
    return {Origin(o).name.lower(): int(n) for o, n in zip(codes, counts, strict=True)}


def _vehicles(boxes: NDArray[np.floating] | None) -> tuple[Primitive, ...]:
    """Boxes ``(N, 8)`` of :meth:`Weather.apply`."""
    if boxes is None:
        return ()
    boxes = np.asarray(boxes, dtype=float)
    if boxes.ndim != 2 or boxes.shape[1] != 8 or not np.isfinite(boxes).all():
        raise ValueError(
            "boxes must be (N, 8) numbers x, y, z, length, width, height, heading, speed, "
            f"got the shape {boxes.shape}"
        )
    return tuple(
        Primitive(
            Shape.BOX, (x, y, z), (length / 2, width / 2, height / 2), Semantic.CAR, 0.5, heading,
            velocity_m_s=(speed * math.cos(heading), speed * math.sin(heading)),
        )
        for x, y, z, length, width, height, heading, speed in boxes.tolist()
    )  # fmt: skip


def _labelled_vehicles(scan: RecordedScan, speed_m_s: float) -> tuple[Primitive, ...]:
    """Boxes around the points of each vehicle, along the longer axis of these."""
    assert scan.labels is not None
    boxes = []
    is_vehicle = np.isin(scan.labels & 0xFFFF, _VEHICLES) & (scan.labels >> 16 > 0)
    for code in np.unique(scan.labels[is_vehicle]):
        points = scan.points[scan.labels == code].astype(float)
        if len(points) < _LEAST_POINTS:
            continue
        _, axes = np.linalg.eigh(np.cov(points[:, :2].T))
        ahead = axes[:, 1] * (1 if axes[0, 1] >= 0 else -1)
        turn = np.array([[*ahead, 0], [-ahead[1], ahead[0], 0], [0, 0, 1]])
        low, high = (points @ turn.T).min(axis=0), (points @ turn.T).max(axis=0)
        size = (high - low).clip(min=0.1)
        heading = math.atan2(ahead[1], ahead[0])
        boxes.append([*(turn.T @ ((low + high) / 2)), *size, heading, speed_m_s])
    return _vehicles(np.array(boxes)) if boxes else ()


@dataclass(frozen=True)
class WeatherPrior:
    """Random weather for each training scan and epoch: fog, rain on a wet road, or snow.

    The three are equally likely; visibility and rates are log-uniform.

    Args:
        probability: Probability of bad weather; other scans stay as they are.
        visibility_m: Least and largest visibility in fog.
        rain_mm_h: Least and largest rate.
        snow_mm_h: Least and largest rate, as water.
        instrument: Assumptions about the instrument.

    Example:
        >>> foggy = WeatherPrior(probability=1.0).draw(np.random.default_rng(0))
        >>> round(foggy.visibility_m)
        35
    """

    probability: float = 0.5
    visibility_m: Interval = (30.0, 1000.0)
    rain_mm_h: Interval = (1.0, 30.0)
    snow_mm_h: Interval = (0.5, 3.0)
    instrument: Instrument = _INSTRUMENT

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= 1:
            raise ValueError(f"probability must lie in [0, 1], got {self.probability}")
        for name in _FIELDS:
            low, high = getattr(self, name)
            if not 0 < low <= high < math.inf:
                raise ValueError(f"{name} must be a positive interval, got {low}..{high}")
            for limit in (low, high):
                Weather(**{name: limit})

    def draw(self, generator: np.random.Generator) -> Weather | None:
        """Draw the weather of one scan; None where it stays as it is."""
        chance, kind, share, film = generator.random(4)
        if chance >= self.probability:
            return None
        name = _FIELDS[int(3 * kind)]
        low, high = np.log(getattr(self, name))
        values: dict[str, Any] = {name: math.exp(low + share * (high - low))}
        if name == "rain_mm_h":
            values["water_film_mm"] = _FULL_FILM_MM * film
        return Weather(**values)

    def points(self, points: NDArray[np.float32], seed: tuple[int, ...]) -> NDArray[np.float32]:
        """Return points ``(P, 4)`` in the weather of a seed, such as (training, epoch, scan)."""
        weather = self.draw(np.random.default_rng(seed))
        if weather is None:
            return points
        return weather.apply(points, ("training", *seed), self.instrument)

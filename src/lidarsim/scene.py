"""Scenes: solids on the ground, weather, and the motion of sensor and actors.

A scene is a description; which effects it calls for is read from it (see ``effects``).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from enum import IntEnum
from numbers import Integral, Real
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

MAX_INSTANCE = 0xFFFF
Interval = tuple[float, float]
Times = TypeVar("Times", float, NDArray[np.float32])
# Shares of scenes in clear air over a dry and a wet road; and, in the first, of a clear sky.
_CLEAR_DRY, _CLEAR_WET = 0.85, 0.10
_CLEAR_SKY = 0.6
_MOST_MM_H = 500.0

Rule = Literal["be finite", "be positive", "be 0 or greater", "be a whole number, 0 or greater"]

_RULES: dict[Rule, Callable[[float], bool]] = {
    "be finite": math.isfinite,
    "be positive": lambda value: 0 < value < math.inf,
    "be 0 or greater": lambda value: 0 <= value < math.inf,
    "be a whole number, 0 or greater": lambda value: isinstance(value, Integral) and value >= 0,
}


def check_fields(values: object, rule: Rule, *names: str) -> None:
    """Raise a ValueError that names the first of these fields that breaks a rule."""
    for name in names:
        if not _RULES[rule](value := getattr(values, name)):
            raise ValueError(f"{name} must {rule}, got {value}")


class Semantic(IntEnum):
    """Class ids of the labels, as in KITTI-360."""

    UNLABELED = 0
    EGO_VEHICLE = 1
    ROAD = 7
    SIDEWALK = 8
    PARKING = 9
    BUILDING = 11
    WALL = 12
    FENCE = 13
    POLE = 17
    TRAFFIC_LIGHT = 19
    SIGN = 20
    VEGETATION = 21
    TERRAIN = 22
    PERSON = 24
    RIDER = 25
    CAR = 26
    TRUCK = 27
    BUS = 28
    CARAVAN = 29
    TRAILER = 30
    MOTORCYCLE = 32
    BICYCLE = 33
    GARAGE = 34
    GATE = 35
    STOP = 36
    SMALL_POLE = 37
    LAMP = 38
    TRASH_BIN = 39
    BOX = 41
    UNKNOWN_CONSTRUCTION = 42
    UNKNOWN_OBJECT = 44


class Material(IntEnum):
    """Material of a surface, in classes that differ at 905 nm."""

    ASPHALT = 0
    PAVING = 1
    SOIL = 2
    CONCRETE = 3
    BRICK = 4
    PAINT = 5
    WOOD = 6
    FOLIAGE = 7
    CLOTH = 8
    GLASS = 9
    POLISHED_METAL = 10
    RETROREFLECTOR = 11


class Shape(IntEnum):
    """Solid of a primitive, by the coordinates ``u`` scaled by its half size.

    Box: ``max|u| <= 1``. Cylinder, upright: ``u_x^2 + u_y^2 <= 1`` and ``|u_z| <= 1``.
    Ellipsoid: ``|u|^2 <= 1``.
    """

    BOX = 0
    CYLINDER = 1
    ELLIPSOID = 2


@dataclass(frozen=True, slots=True)
class Primitive:
    """One solid of the scene, turned about its upright axis and sheared along slopes.

    With ``(x, y, z)`` from the centre along the turned axes::

        u = (x / a, y / b, (z - grade_x * x - grade_y * y) / c)
    """

    shape: Shape
    centre: tuple[float, float, float]  # world frame in the middle of the sweep, metres, z up
    # (a, b, c): half edges, radii and half height, or semi-axes, metres
    half_size: tuple[float, float, float]
    semantic: Semantic
    reflectivity: float  # diffuse, in (0, 1], see effects.surface_power
    yaw_rad: float = 0.0  # about the upright axis, counter-clockwise seen from above
    instance: int = 0  # number of the object, 0 where the class has no objects
    material: Material = Material.CONCRETE
    velocity_m_s: tuple[float, float] = (0.0, 0.0)  # (x, y) in the world frame
    # Rise per metre along the turned x and y axis, at most 0.2; upright walls stay upright.
    grade: tuple[float, float] = (0.0, 0.0)
    # Chance of a hit per metre inside leaves, grass and wire mesh, which are media rather than
    # surfaces; 0 for a closed surface.
    extinction_per_m: float = 0.0
    # Upright slats across the turned x axis, of pickets, railings and scaffolds: their pitch in
    # metres and the share of it that they fill. A ray that enters between two slats passes.
    slats: tuple[float, float] = (0.0, 1.0)
    # Heights above the lowest point of the solid between which it is open between the slats: a wall
    # with windows has a sill and a lintel.
    open_m: tuple[float, float] = (0.0, math.inf)

    def __post_init__(self) -> None:
        numbers = (*self.centre, *self.half_size, self.yaw_rad, *self.velocity_m_s, *self.grade)
        if not math.isfinite(sum(numbers)):
            raise ValueError(f"places, sizes, turns and speeds must be finite, got {self}")
        if not min(self.half_size) > 0:
            raise ValueError(f"half_size must be positive on every axis, got {self.half_size}")
        if not 0 < self.reflectivity <= 1:
            raise ValueError(f"reflectivity must lie in (0, 1], got {self.reflectivity}")
        if not 0 <= self.instance <= MAX_INSTANCE:
            raise ValueError(
                f"instance must lie in 0..{MAX_INSTANCE} (16 bits of a label), got {self.instance}"
            )
        check_fields(self, "be 0 or greater", "extinction_per_m")
        pitch_m, share = self.slats
        if not (0 <= pitch_m < math.inf and 0 < share <= 1):
            raise ValueError(
                f"slats must be a pitch of 0 or more and a share in (0, 1], got {self.slats}"
            )
        if max(map(abs, self.grade)) > 0.2:
            raise ValueError(f"grade must stay within 0.2, got {self.grade}")


@dataclass(frozen=True)
class Pose:
    """Position and orientation of the sensor frame in the world frame.

    Applied to a vector of the sensor frame in the order roll (about x), pitch (about y, positive
    = nose down), heading (about z).
    """

    x_m: float = 0.0  # east
    y_m: float = 0.0  # north
    z_m: float = 1.73  # up
    heading_rad: float = 0.0  # from +x, counter-clockwise
    pitch_rad: float = 0.0  # nose down positive
    roll_rad: float = 0.0  # right side down positive; both tilts together within 0.2

    def __post_init__(self) -> None:
        check_fields(self, "be finite", *(field.name for field in fields(self)))
        tilt_rad = math.hypot(self.pitch_rad, self.roll_rad)
        if tilt_rad > 0.2:
            raise ValueError(f"pitch and roll must stay within 0.2 rad, got {tilt_rad:.3f}")


@dataclass(frozen=True)
class EgoMotion:
    """Motion of the sensor during the sweep."""

    speed_m_s: float = 0.0  # along the heading
    yaw_rate_rad_s: float = 0.0  # counter-clockwise seen from above

    def __post_init__(self) -> None:
        check_fields(self, "be finite", "speed_m_s", "yaw_rate_rad_s")

    def moved(self, time_s: Times) -> tuple[Times, Times, Times]:
        """Place x and y and heading at a time, in the sensor's frame at time 0: metres, radians.

        With speed v and yaw rate w: ``v / w * (sin(w t), 1 - cos(w t))`` and ``w t``.
        """
        angle = self.yaw_rate_rad_s * time_s
        # sinc(x) = sin(pi x) / (pi x) stands for sin(w t / 2) / (w t / 2): no division by w.
        chord = self.speed_m_s * time_s * np.sinc(angle / (2 * np.pi))
        return chord * np.cos(angle / 2), chord * np.sin(angle / 2), angle


@dataclass(frozen=True)
class Conditions:
    """State of the air, the sky and the road; :class:`lidarsim.Weather` also acts on scans.

    Args:
        visibility_m: Meteorological optical range (MOR): where a beam keeps 5 % of its power; at
            least 1 (the densest fogs have some 10 m), infinity (typed ``.inf``) without fog.
        rain_mm_h: Rain rate, at most 500 (a cloudburst has 100).
        snow_mm_h: Snow rate, as millimetres of water, likewise.
        water_film_mm: Depth of the water on the ground.
        clear_sky: Whether nothing covers the sun.
        sun_elevation_deg: Above the horizon, -90 to 90.
        sun_azimuth_deg: In the world frame, counter-clockwise from +x.
    """

    visibility_m: float = math.inf
    rain_mm_h: float = 0.0
    snow_mm_h: float = 0.0
    water_film_mm: float = 0.0
    clear_sky: bool = True
    sun_elevation_deg: float = 45.0
    sun_azimuth_deg: float = 0.0

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self) if field.name != "clear_sky"):
            if not isinstance(getattr(self, name), Real):
                raise ValueError(f"{name} must be a number, got {getattr(self, name)!r}")
        if self.clear_sky not in (True, False):
            raise ValueError(f"clear_sky must be True or False, got {self.clear_sky!r}")
        if not self.visibility_m >= 1:
            raise ValueError(
                f"visibility_m must be 1 or greater (no fog is denser), got {self.visibility_m}"
            )
        check_fields(self, "be 0 or greater", "rain_mm_h", "snow_mm_h", "water_film_mm")
        for name in ("rain_mm_h", "snow_mm_h"):
            if getattr(self, name) > _MOST_MM_H:
                raise ValueError(
                    f"{name} must be at most {_MOST_MM_H:g} (a cloudburst has 100), "
                    f"got {getattr(self, name):g}"
                )
        check_fields(self, "be finite", "sun_azimuth_deg")
        if not -90 <= self.sun_elevation_deg <= 90:
            raise ValueError(f"sun_elevation_deg must lie in -90..90, got {self.sun_elevation_deg}")


def draw_weather(generator: np.random.Generator) -> Conditions:
    """Random weather: clear over a dry road (85 %), clear over a wet one (10 %), or bad air.

    Bad air is fog, rain or snow, a third each. Visibility and rates are log-uniform, the other
    values uniform. In rain the road is wet; a sun below the horizon is night.
    """
    air, kind, sky = generator.random(3)
    film_mm = generator.uniform(0.1, 1.5)
    sun = {
        "sun_elevation_deg": generator.uniform(-18.0, 62.0),
        "sun_azimuth_deg": generator.uniform(-180.0, 180.0),
    }
    if air < _CLEAR_DRY:
        return Conditions(clear_sky=bool(sky < _CLEAR_SKY), **sun)
    if air < _CLEAR_DRY + _CLEAR_WET:
        return Conditions(water_film_mm=film_mm, clear_sky=False, **sun)
    if kind < 1 / 3:
        return Conditions(_log_uniform(generator, (30.0, 1000.0)), clear_sky=False, **sun)
    if kind < 2 / 3:
        rain_mm_h = _log_uniform(generator, (1.0, 30.0))
        return Conditions(rain_mm_h=rain_mm_h, water_film_mm=film_mm, clear_sky=False, **sun)
    return Conditions(snow_mm_h=_log_uniform(generator, (0.5, 3.0)), clear_sky=False, **sun)


def _log_uniform(generator: np.random.Generator, interval: Interval) -> float:
    return math.exp(generator.uniform(*np.log(interval)))


class Puddle(NamedTuple):
    """Round pool of standing water on the ground, world frame, metres."""

    x_m: float
    y_m: float
    radius_m: float


@dataclass(frozen=True)
class Scene:
    """The world of one scan."""

    primitives: tuple[Primitive, ...] = ()
    pose: Pose = Pose()  # of the sensor frame in the middle of the sweep
    motion: EgoMotion = EgoMotion()
    weather: Conditions = Conditions()
    puddles: tuple[Puddle, ...] = ()  # where water stands on the ground, if the road is wet
    ego_body: tuple[Primitive, ...] = ()  # parts of the recording car in the sensor frame
    ground_m: float = 0.0  # height of the level ground below all solids
    ground_reflectivity: float = 0.15  # of that ground: asphalt, labelled as road
    sheet_points: int = 0  # points of a recorded scan that are as bright as sheeting
    unseen: tuple[Primitive, ...] = ()  # details of far objects, which are not cast

    def __post_init__(self) -> None:
        if not 0 < self.ground_reflectivity <= 1:
            raise ValueError(
                f"ground_reflectivity must lie in (0, 1], got {self.ground_reflectivity}"
            )
        if not self.pose.z_m > self.ground_m:
            raise ValueError(
                f"the sensor must be above the ground at {self.ground_m} m, got z_m={self.pose.z_m}"
            )

"""What a scan is taken of: solids on the ground, weather, and how sensor and actors move.

A scene is a description; which effects it calls for is read from it (see ``effects``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

MAX_INSTANCE = 0xFFFF


class Semantic(IntEnum):
    """Class ids of the labels, those of KITTI-360 and Cityscapes."""

    UNLABELED = 0
    EGO_VEHICLE = 1
    ROAD = 7
    SIDEWALK = 8
    BUILDING = 11
    WALL = 12
    FENCE = 13
    POLE = 17
    SIGN = 20
    VEGETATION = 21
    TERRAIN = 22
    PERSON = 24
    RIDER = 25
    CAR = 26
    TRUCK = 27
    BUS = 28
    BICYCLE = 33


class Material(IntEnum):
    """What a surface is made of, as far as a laser beam of 905 nm can tell."""

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


#: Materials on which a film of water lies.
GROUND_MATERIALS = (Material.ASPHALT, Material.PAVING, Material.SOIL)


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

    Args:
        shape: Box, upright cylinder or ellipsoid.
        centre: ``(x, y, z)`` in the world frame in the middle of the sweep, metres, z up.
        half_size: ``(a, b, c)``: half edges, radii and half height, or semi-axes, metres.
        semantic: Class of the surface.
        reflectivity: Diffuse reflectivity in (0, 1], see ``effects.surface_power``.
        yaw_rad: Turn about the upright axis, counter-clockwise seen from above.
        instance: Number of the object it belongs to, 0 where the class has no objects.
        material: What the surface is made of.
        velocity_m_s: ``(x, y)`` in the world frame, metres per second.
        grade: Rise per metre along the turned x and y axis; upright walls stay upright.
        extinction_per_m: Of leaves, grass and wire mesh, which are media rather than surfaces:
            chance of a hit per metre inside the solid; 0 for a closed surface.

    Raises:
        ValueError: If a size is not positive, the reflectivity lies outside (0, 1], the instance
            does not fit in 16 bits, the extinction is negative, or a grade exceeds 0.2.
    """

    shape: Shape
    centre: tuple[float, float, float]
    half_size: tuple[float, float, float]
    semantic: Semantic
    reflectivity: float
    yaw_rad: float = 0.0
    instance: int = 0
    material: Material = Material.CONCRETE
    velocity_m_s: tuple[float, float] = (0.0, 0.0)
    grade: tuple[float, float] = (0.0, 0.0)
    extinction_per_m: float = 0.0

    def __post_init__(self) -> None:
        """Check the values."""
        if not min(self.half_size) > 0:
            raise ValueError(f"half_size must be positive on every axis, got {self.half_size}")
        _check_reflectivity(self.reflectivity)
        if not 0 <= self.instance <= MAX_INSTANCE:
            raise ValueError(
                f"instance must lie in 0..{MAX_INSTANCE} (16 bits of a label), got {self.instance}"
            )
        if not 0 <= self.extinction_per_m < math.inf:
            raise ValueError(f"extinction_per_m must be 0 or greater, got {self.extinction_per_m}")
        if max(map(abs, self.grade)) > 0.2:
            raise ValueError(f"grade must stay within 0.2, got {self.grade}")


@dataclass(frozen=True)
class Pose:
    """Where the frame origin of the sensor is and how it is turned, in the world frame.

    Applied to a vector of the sensor frame in the order roll (about x), pitch (about y, positive
    = nose down), heading (about z).

    Args:
        x_m: Position east.
        y_m: Position north.
        z_m: Height in the world frame.
        heading_rad: Angle from +x, counter-clockwise.
        pitch_rad: Small tilt of the body, nose down positive.
        roll_rad: Small tilt of the body, right side down positive.

    Raises:
        ValueError: If a tilt exceeds 0.2 rad.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 1.73
    heading_rad: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0

    def __post_init__(self) -> None:
        """Check the values."""
        tilt_rad = math.hypot(self.pitch_rad, self.roll_rad)
        if tilt_rad > 0.2:
            raise ValueError(
                f"pitch and roll together must stay within 0.2 rad, got {tilt_rad:.3f}"
            )


@dataclass(frozen=True)
class EgoMotion:
    """How the sensor moves during the sweep.

    Args:
        speed_m_s: Along the heading.
        yaw_rate_rad_s: Counter-clockwise seen from above.
    """

    speed_m_s: float = 0.0
    yaw_rate_rad_s: float = 0.0


@dataclass(frozen=True)
class Weather:
    """State of the air, the sky and the road.

    Args:
        visibility_m: Meteorological optical range (MOR): where a beam keeps 5 % of its power;
            infinity without fog.
        rain_mm_h: Rain rate.
        snow_mm_h: Snow rate, as millimetres of water.
        water_film_mm: Depth of the water on the ground.
        clear_sky: Whether nothing covers the sun.
        sun_elevation_deg: Above the horizon.
        sun_azimuth_deg: In the world frame, counter-clockwise from +x.

    Raises:
        ValueError: If the visibility is not positive, a rate or depth is negative or infinite, or
            the elevation lies outside -90..90.
    """

    visibility_m: float = math.inf
    rain_mm_h: float = 0.0
    snow_mm_h: float = 0.0
    water_film_mm: float = 0.0
    clear_sky: bool = True
    sun_elevation_deg: float = 45.0
    sun_azimuth_deg: float = 0.0

    def __post_init__(self) -> None:
        """Check the values."""
        if not self.visibility_m > 0:
            raise ValueError(f"visibility_m must be positive, got {self.visibility_m}")
        for name in ("rain_mm_h", "snow_mm_h", "water_film_mm"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be 0 or greater, got {getattr(self, name)}")
        if not -90 <= self.sun_elevation_deg <= 90:
            raise ValueError(f"sun_elevation_deg must lie in -90..90, got {self.sun_elevation_deg}")


class Puddle(NamedTuple):
    """Round pool of standing water on the ground, world frame, metres."""

    x_m: float
    y_m: float
    radius_m: float


@dataclass(frozen=True)
class Scene:
    """A scan's world.

    Args:
        primitives: Solids, in any order.
        pose: Pose of the sensor frame in the middle of the sweep.
        motion: Motion of the sensor.
        weather: Air, sky and water.
        puddles: Where water stands on the ground, if the road is wet.
        ego_body: Parts of the recording car in the sensor frame; they move with the sensor.
        ground_m: Height of the level ground that lies under everything.
        ground_reflectivity: Diffuse reflectivity of that ground: asphalt, labelled as road.

    Raises:
        ValueError: If the reflectivity lies outside (0, 1] or the sensor is not above the ground.
    """

    primitives: tuple[Primitive, ...] = ()
    pose: Pose = Pose()
    motion: EgoMotion = EgoMotion()
    weather: Weather = Weather()
    puddles: tuple[Puddle, ...] = ()
    ego_body: tuple[Primitive, ...] = ()
    ground_m: float = 0.0
    ground_reflectivity: float = 0.15

    def __post_init__(self) -> None:
        """Check the values."""
        _check_reflectivity(self.ground_reflectivity)
        if not self.pose.z_m > self.ground_m:
            raise ValueError(
                f"the sensor must be above the ground at {self.ground_m} m, got z_m={self.pose.z_m}"
            )


def _check_reflectivity(reflectivity: float) -> None:
    if not 0 < reflectivity <= 1:
        raise ValueError(f"reflectivity must lie in (0, 1], got {reflectivity}")

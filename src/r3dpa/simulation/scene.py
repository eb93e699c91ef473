"""What a scan is taken of: primitives on level ground, the sensor's pose, declared effects."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from r3dpa.simulation.effects import Effect

MAX_INSTANCE = 0xFFFF


class Semantic(IntEnum):
    """Class ids of the labels, those of KITTI-360 and Cityscapes."""

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
    CAR = 26


class Shape(IntEnum):
    """Solid of a primitive, by the coordinates ``u = (x/a, y/b, z/c)`` scaled by its half size.

    Box: ``max|u| <= 1``. Cylinder, upright: ``u_x^2 + u_y^2 <= 1`` and ``|u_z| <= 1``.
    Ellipsoid: ``|u|^2 <= 1``.
    """

    BOX = 0
    CYLINDER = 1
    ELLIPSOID = 2


@dataclass(frozen=True, slots=True)
class Primitive:
    """One solid of the scene, turned about its upright axis.

    Args:
        shape: Box, upright cylinder or ellipsoid.
        centre: ``(x, y, z)`` in the world frame, metres, z up from the ground.
        half_size: ``(a, b, c)``: half edges, radii and half height, or semi-axes, metres.
        semantic: Class of the surface.
        reflectivity: Lambertian reflectivity in (0, 1].
        yaw_rad: Turn about the upright axis, counter-clockwise seen from above.
        instance: Number of the object it belongs to, 0 where the class has no objects.

    Raises:
        ValueError: If a size is not positive, the reflectivity lies outside (0, 1], or the
            instance does not fit in 16 bits.
    """

    shape: Shape
    centre: tuple[float, float, float]
    half_size: tuple[float, float, float]
    semantic: Semantic
    reflectivity: float
    yaw_rad: float = 0.0
    instance: int = 0

    def __post_init__(self) -> None:
        """Check the values."""
        if not min(self.half_size) > 0:
            raise ValueError(f"half_size must be positive on every axis, got {self.half_size}")
        _check_reflectivity(self.reflectivity)
        if not 0 <= self.instance <= MAX_INSTANCE:
            raise ValueError(
                f"instance must lie in 0..{MAX_INSTANCE} (16 bits of a label), got {self.instance}"
            )


@dataclass(frozen=True)
class Pose:
    """Where the frame origin of the sensor is and how it is turned, in the world frame.

    Applied to a vector of the sensor frame in the order roll (about x), pitch (about y, positive
    = nose down), heading (about z).

    Args:
        x_m: Position east.
        y_m: Position north.
        z_m: Height above the ground.
        heading_rad: Angle from +x, counter-clockwise.
        pitch_rad: Small tilt of the body, nose down positive.
        roll_rad: Small tilt of the body, right side down positive.

    Raises:
        ValueError: If the height is not positive or a tilt exceeds 0.2 rad.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 1.73
    heading_rad: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0

    def __post_init__(self) -> None:
        """Check the values."""
        if not self.z_m > 0:
            raise ValueError(f"the sensor must be above the ground, got z_m={self.z_m}")
        tilt_rad = math.hypot(self.pitch_rad, self.roll_rad)
        if tilt_rad > 0.2:
            raise ValueError(
                f"pitch and roll together must stay within 0.2 rad, got {tilt_rad:.3f}"
            )


@dataclass(frozen=True)
class Scene:
    """A scan's world: solids on the level ground z = 0, the sensor's pose, and the effects.

    Args:
        primitives: Solids, in any order.
        pose: Pose of the sensor frame.
        effects: What changes the returns after the ray cast, in the order of their stages; an
            empty tuple gives the bare geometry.
        ground_reflectivity: Lambertian reflectivity of the ground, which is labelled as road.

    Raises:
        ValueError: If the reflectivity lies outside (0, 1] or the effects are not in order.
    """

    primitives: tuple[Primitive, ...] = ()
    pose: Pose = Pose()
    effects: tuple[Effect, ...] = ()
    ground_reflectivity: float = 0.15

    def __post_init__(self) -> None:
        """Check the values."""
        _check_reflectivity(self.ground_reflectivity)
        stages = [effect.stage for effect in self.effects]
        if stages != sorted(stages):
            listed = ", ".join(f"{type(e).__name__} (stage {e.stage})" for e in self.effects)
            raise ValueError(f"effects must be in the order of their stages, got {listed}")


def _check_reflectivity(reflectivity: float) -> None:
    if not 0 < reflectivity <= 1:
        raise ValueError(f"reflectivity must lie in (0, 1], got {reflectivity}")

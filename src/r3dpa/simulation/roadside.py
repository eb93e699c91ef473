"""What stands along a street: houses, gardens, trees, parked cars, lamps and people."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from r3dpa.simulation.scene import Primitive, Semantic, Shape

BLOCK_M = 20.0
KERB_M = 0.12

# Street coordinates (s, lateral) to world x, y and the heading of the street there.
Frame = Callable[[float, float], tuple[float, float, float]]


class Builder:
    """Collects primitives that are given in street coordinates.

    Args:
        frame: Street coordinates to the world.
        chord_rad: Direction of the street, with which every solid is turned.
        first_instance: Number of the first object.
    """

    def __init__(self, frame: Frame, chord_rad: float, first_instance: int) -> None:
        self.primitives: list[Primitive] = []
        self._frame = frame
        self._chord_rad = chord_rad
        self._first_instance = first_instance
        self.num_objects = 0

    def new_instance(self) -> int:
        """A number that no other object of the block has."""
        self.num_objects += 1
        return self._first_instance + self.num_objects - 1

    def add(
        self,
        shape: Shape,
        centre: tuple[float, float, float],
        size: tuple[float, float, float],
        semantic: Semantic,
        reflectivity: float,
        instance: int = 0,
        yaw_rad: float = 0.0,
    ) -> None:
        """Add a solid: centre (s, lateral, z) and full size (along, across, up) in metres."""
        x, y, _ = self._frame(centre[0], centre[1])
        half_size = (size[0] / 2, size[1] / 2, size[2] / 2)
        self.primitives.append(
            Primitive(
                shape,
                (x, y, centre[2]),
                half_size,
                semantic,
                reflectivity,
                self._chord_rad + yaw_rad,
                instance,
            )
        )

    def box(
        self,
        centre: tuple[float, float],
        size: tuple[float, float, float],
        semantic: Semantic,
        reflectivity: float,
        instance: int = 0,
        bottom_m: float = 0.0,
    ) -> None:
        """Add a box that stands on ``bottom_m``; centre (s, lateral)."""
        self.add(
            Shape.BOX,
            (*centre, bottom_m + size[2] / 2),
            size,
            semantic,
            reflectivity,
            instance,
        )

    def pole(
        self,
        centre: tuple[float, float],
        radius_m: float,
        height_m: float,
        semantic: Semantic,
        reflectivity: float,
        instance: int,
    ) -> None:
        """Add an upright cylinder on the ground; centre (s, lateral)."""
        size = (2 * radius_m, 2 * radius_m, height_m)
        self.add(Shape.CYLINDER, (*centre, height_m / 2), size, semantic, reflectivity, instance)

    def car(
        self, centre: tuple[float, float], draw: np.random.Generator, yaw_rad: float, instance: int
    ) -> None:
        """Add a car of two boxes: body and cabin."""
        length, width = draw.uniform(3.7, 4.9), draw.uniform(1.65, 1.9)
        body_m, cabin_m = draw.uniform(0.62, 0.78), draw.uniform(0.5, 0.75)
        paint = draw.uniform(0.15, 0.7)
        shift = draw.uniform(-0.35, 0.1)
        s, lateral = centre
        self.add(
            Shape.BOX,
            (s, lateral, 0.22 + body_m / 2),
            (length, width, body_m),
            Semantic.CAR,
            paint,
            instance,
            yaw_rad,
        )
        self.add(
            Shape.BOX,
            (s + math.copysign(shift, math.cos(yaw_rad)), lateral, 0.22 + body_m + cabin_m / 2),
            (length * draw.uniform(0.42, 0.6), width * 0.86, cabin_m),
            Semantic.CAR,
            paint * 0.6,
            instance,
            yaw_rad,
        )


def _tree(
    builder: Builder, draw: np.random.Generator, s: float, lateral: float, low: bool = False
) -> None:
    instance = builder.new_instance()
    trunk_m = draw.uniform(0.8, 1.4) if low else draw.uniform(1.9, 2.8)
    crown_m = draw.uniform(1.6, 3.2) if low else draw.uniform(2.6, 4.8)
    tall_m = crown_m * draw.uniform(0.8, 1.3)
    builder.pole(
        (s, lateral), draw.uniform(0.1, 0.25), trunk_m + 0.8, Semantic.VEGETATION, 0.3, instance
    )
    for _ in range(int(draw.integers(1, 4))):
        ds, dl, dz = draw.normal(0.0, 0.18 * crown_m, 3)
        scale = draw.uniform(0.65, 1.0)
        builder.add(
            Shape.ELLIPSOID,
            (s + ds, lateral + dl, trunk_m + tall_m / 2 + abs(dz)),
            (crown_m * scale, crown_m * scale * draw.uniform(0.8, 1.2), tall_m * scale),
            Semantic.VEGETATION,
            0.5,
            instance,
            draw.uniform(0, math.pi),
        )


def _bush(builder: Builder, draw: np.random.Generator, s: float, lateral: float) -> None:
    width, height = draw.uniform(0.8, 2.6), draw.uniform(0.7, 2.0)
    builder.add(
        Shape.ELLIPSOID,
        (s, lateral, 0.4 * height),
        (width, width * draw.uniform(0.7, 1.4), height),
        Semantic.VEGETATION,
        0.5,
        builder.new_instance(),
        draw.uniform(0, math.pi),
    )


def _building(
    builder: Builder,
    draw: np.random.Generator,
    centre_s: float,
    front: float,
    side: float,
    size: tuple[float, float, float],
) -> None:
    """A house whose front stands ``front`` metres from the axis, with an oriel or a porch."""
    instance = builder.new_instance()
    reflectivity = draw.uniform(0.25, 0.55)
    width, depth, _ = size
    lateral = side * (front + depth / 2)
    builder.box((centre_s, lateral), size, Semantic.BUILDING, reflectivity, instance)
    for _ in range(int(draw.integers(0, 3))):
        bay = (draw.uniform(1.2, 3.0), draw.uniform(0.4, 1.4), draw.uniform(2.4, 4.0))
        at = centre_s + draw.uniform(-0.4, 0.4) * width
        builder.box((at, side * front), bay, Semantic.BUILDING, reflectivity * 0.8, instance)


def _town(
    builder: Builder, draw: np.random.Generator, start: float, side: float, edge_m: float
) -> None:
    """Facades in a row, now and then a passage with a yard behind it."""
    s = start
    while s < start + BLOCK_M - 4:
        width = min(draw.uniform(7, 14), start + BLOCK_M - s)
        if draw.random() < 0.8:
            size = (width, draw.uniform(8, 12), draw.uniform(8, 18))
            setback = draw.uniform(0.0, 1.2)
            _building(builder, draw, s + width / 2, edge_m + setback, side, size)
        elif draw.random() < 0.7:
            _bush(builder, draw, s + width / 2, side * (edge_m + 4))
        s += width
    if draw.random() < 0.4:
        builder.box(
            (start + BLOCK_M / 2, side * (edge_m + 24)),
            (16, 4, 9),
            Semantic.BUILDING,
            0.35,
            builder.new_instance(),
        )


def _houses(
    builder: Builder, draw: np.random.Generator, start: float, side: float, edge_m: float
) -> None:
    """One house in a garden behind a hedge, a fence or a low wall with a gate."""
    setback = draw.uniform(3.0, 7.0)
    width = draw.uniform(8, 14)
    centre_s = start + draw.uniform(8, 12)
    size = (width, draw.uniform(8, 11), draw.uniform(5, 9))
    _building(builder, draw, centre_s, edge_m + setback, side, size)
    semantic, thickness, height, reflectivity = (
        (Semantic.VEGETATION, 0.7, draw.uniform(1.0, 2.0), 0.5),
        (Semantic.FENCE, 0.08, draw.uniform(0.9, 1.5), 0.35),
        (Semantic.WALL, 0.25, draw.uniform(0.6, 1.6), 0.35),
    )[int(draw.integers(3))]
    gate_s = start + draw.uniform(4, 16)
    for first, last in ((start, gate_s - 1.6), (gate_s + 1.6, start + BLOCK_M)):
        builder.box(
            ((first + last) / 2, side * (edge_m + 0.4)),
            (last - first, thickness, height),
            semantic,
            reflectivity,
            builder.new_instance(),
        )
    for _ in range(int(draw.integers(1, 4))):
        _bush(
            builder, draw, start + draw.uniform(0, BLOCK_M), side * (edge_m + draw.uniform(1, 12))
        )
    _tree(builder, draw, start + draw.uniform(0, 20), side * (edge_m + draw.uniform(2, 9)), True)
    if draw.random() < 0.5:
        _car_in_garden(builder, draw, gate_s, side, edge_m)
    if draw.random() < 0.3:
        builder.box(
            (start + BLOCK_M / 2, side * (edge_m + 26)),
            (14, 8, 7),
            Semantic.BUILDING,
            0.35,
            builder.new_instance(),
        )


def _car_in_garden(
    builder: Builder, draw: np.random.Generator, s: float, side: float, edge_m: float
) -> None:
    yaw_rad = math.pi / 2 + draw.normal(0, 0.05)
    builder.car((s, side * (edge_m + 3.4)), draw, yaw_rad, builder.new_instance())


def _green(
    builder: Builder, draw: np.random.Generator, start: float, side: float, edge_m: float
) -> None:
    """A meadow with bushes and trees, sometimes behind a fence, sometimes before a wood."""
    if draw.random() < 0.35:
        builder.box(
            (start + BLOCK_M / 2, side * (edge_m + 0.3)),
            (BLOCK_M, 0.06, draw.uniform(0.8, 1.4)),
            Semantic.FENCE,
            0.35,
            builder.new_instance(),
        )
    for _ in range(int(draw.integers(1, 5))):
        _bush(
            builder, draw, start + draw.uniform(0, BLOCK_M), side * (edge_m + draw.uniform(0.8, 14))
        )
    for _ in range(int(draw.integers(0, 3))):
        lateral = side * (edge_m + draw.uniform(2, 16))
        _tree(builder, draw, start + draw.uniform(0, BLOCK_M), lateral, draw.random() < 0.6)
    if draw.random() < 0.3:
        for s in (start + 3, start + 10, start + 17):
            lateral = side * (edge_m + draw.uniform(17, 24))
            _tree(builder, draw, s, lateral, True)


def _yard(
    builder: Builder, draw: np.random.Generator, start: float, side: float, edge_m: float
) -> None:
    """A wall along the pavement or an open car park, with a hall at its back."""
    if draw.random() < 0.5:
        builder.box(
            (start + BLOCK_M / 2, side * (edge_m + 0.3)),
            (BLOCK_M, 0.3, draw.uniform(1.2, 2.6)),
            Semantic.WALL,
            0.35,
            builder.new_instance(),
        )
    else:
        for slot in range(7):
            if draw.random() < 0.5:
                _car_in_garden(builder, draw, start + 1.6 + 2.8 * slot, side, edge_m)
    if draw.random() < 0.7:
        size = (BLOCK_M, draw.uniform(10, 14), draw.uniform(5, 9))
        front = edge_m + draw.uniform(9, 15)
        _building(builder, draw, start + BLOCK_M / 2, front, side, size)


DISTRICTS = (_town, _houses, _green, _green, _yard)


def build_kerbside(
    builder: Builder,
    draw: np.random.Generator,
    start: float,
    side: float,
    half_road_m: float,
    pavement_m: float,
    district: np.random.Generator,
) -> None:
    """Parked cars, lamps, signs, street trees and people along the kerb of one block."""
    parked_share, tree_share, people = district.uniform([0.2, 0.0, 0.2], [0.9, 0.7, 1.5])
    for slot in range(3):
        s = start + 3.4 + 6.6 * slot + draw.uniform(-0.4, 0.4)
        if draw.random() < parked_share:
            yaw_rad = draw.normal(0.0, 0.02) + (math.pi if side > 0 else 0.0)
            lateral = side * (half_road_m - 1.05)
            builder.car((s, lateral), draw, yaw_rad, builder.new_instance())
    kerb = side * (half_road_m + 0.45)
    if draw.random() < 0.7:
        height, s = draw.uniform(5, 9), start + draw.uniform(0, BLOCK_M)
        radius = draw.uniform(0.06, 0.12)
        builder.pole((s, kerb), radius, height, Semantic.POLE, 0.35, builder.new_instance())
    if draw.random() < 0.35:
        s = start + draw.uniform(0, BLOCK_M)
        builder.pole((s, kerb), 0.035, 2.9, Semantic.POLE, 0.4, builder.new_instance())
        builder.box((s, kerb), (0.05, 0.65, 0.65), Semantic.SIGN, 0.9, builder.new_instance(), 2.15)
    if draw.random() < tree_share:
        for s in (start + draw.uniform(2, 8), start + draw.uniform(11, 18)):
            _tree(builder, draw, s, side * (half_road_m + 0.8))
    for _ in range(int(draw.poisson(people))):
        s = start + draw.uniform(0, BLOCK_M)
        lateral = side * (half_road_m + draw.uniform(0.3, pavement_m - 0.3))
        height = draw.uniform(1.3, 1.6)
        instance, cloth = builder.new_instance(), draw.uniform(0.3, 0.6)
        builder.pole(
            (s, lateral), draw.uniform(0.17, 0.27), height, Semantic.PERSON, cloth, instance
        )
        builder.add(
            Shape.ELLIPSOID,
            (s, lateral, height + 0.12),
            (0.2, 0.18, 0.26),
            Semantic.PERSON,
            0.4,
            instance,
        )


def build_side_street(
    builder: Builder, draw: np.random.Generator, start: float, side: float, half_road_m: float
) -> None:
    """A street that leaves between two strips of ground, with houses along it and at its end."""
    half_width = draw.uniform(3.0, 4.5)
    middle = start + BLOCK_M / 2
    for along in (-1.0, 1.0):
        first, last = half_width, BLOCK_M / 2
        s = middle + along * (first + last) / 2
        size = (last - first, 50.0, KERB_M)
        builder.box((s, side * (half_road_m + 25)), size, Semantic.SIDEWALK, 0.25)
        front = half_road_m + draw.uniform(3.0, 6.0)
        for house in range(2):
            size = (last - first - 2.0, draw.uniform(9, 14), draw.uniform(6, 14))
            _building(builder, draw, s + along, front + 17 * house, side, size)
    for slot in range(3):
        if draw.random() < 0.4:
            lateral = side * (half_road_m + 12 + 6 * slot)
            instance = builder.new_instance()
            builder.car((middle - half_width + 1.0, lateral), draw, math.pi / 2, instance)
    if draw.random() < 0.4:
        builder.box(
            (middle, side * (half_road_m + 54)),
            (30, 8, 9),
            Semantic.BUILDING,
            0.35,
            builder.new_instance(),
        )

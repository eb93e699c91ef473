"""Bodies that stand on the ground: vehicles, cyclists and people, as parts about their origin."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from r3dpa.simulation.scene import Material, Primitive, Semantic, Shape

_PLATE_M = (0.02, 0.52, 0.12)
# Diffuse reflectivity of panes and mirrors: dirt.
DIRT = 0.0015
_DARK, _SEATS = (0.0007, 0.02), (0.0004, 0.006)


class Part(NamedTuple):
    """One solid of a body: centre and full size in metres, x forward, y left, z above the ground.

    ``detail``: built near the sensor only.
    """

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    semantic: Semantic
    material: Material
    reflectivity: float
    shape: Shape = Shape.BOX
    detail: bool = False


Body = tuple[Part, ...]

# Centre x and y, size along x and y, top and bottom, metres in the sensor frame.
_RECORDING_CAR = (
    (0.337, 0.007, 0.10, 0.17, -0.038, -0.101),
    (0.185, -0.486, 0.15, 0.11, -0.052, -0.088),
    (-1.10, 0.39, 0.10, 0.11, -0.176, -0.72),
    (-1.10, -0.422, 0.06, 0.13, -0.172, -0.78),
    (-1.131, 0.0, 0.07, 0.69, -0.289, -0.94),
    (-0.67, 0.731, 0.066, 0.065, -0.283, -0.79),
    (-0.629, -0.816, 0.04, 0.07, -0.291, -0.71),
    (0.808, 0.53, 0.02, 0.21, -0.335, -0.73),
    (0.85, -0.612, 0.08, 0.034, -0.348, -0.77),
)


def _plate(x: float, z: float, semantic: Semantic) -> Part:
    return Part((x, 0, z), _PLATE_M, semantic, Material.RETROREFLECTOR, 0.9, detail=True)


def _painted(semantic: Semantic, paint: float) -> Callable[..., Part]:
    return partial(Part, semantic=semantic, material=Material.PAINT, reflectivity=paint)


def _pane(x: float, z: float, size: tuple[float, float, float], semantic: Semantic) -> Part:
    return Part((x, 0, z), size, semantic, Material.GLASS, DIRT)


def coat(draw: Generator) -> float:
    """Reflectivity of a coat of paint.

    Under its clear coat a dark car returns little: at 5 m its intensity is 0, at 15 m it is not
    detected.
    """
    if draw.random() < 0.45:
        return float(np.exp(draw.uniform(*np.log(_DARK))))
    return draw.uniform(0.06, 0.25)


def _cabin(
    draw: Generator, x: float, z: float, size: tuple[float, float, float], roof: Part
) -> list[Part]:
    """A band of windows with seats behind it and a roof above.

    The inside returns little: panes of vehicles absorb, seats are dark.
    """
    seats_m = (0.9 * size[0], 0.9 * size[1], 0.95 * size[2])
    semantic, cloth = roof.semantic, float(np.exp(draw.uniform(*np.log(_SEATS))))
    seats_at = (x, 0, z - 0.025 * size[2])
    return [
        _pane(x, z, size, semantic),
        Part(seats_at, seats_m, semantic, Material.CLOTH, cloth, detail=True),
        roof,
    ]


def car(draw: Generator) -> Body:
    """A passenger car: body, cabin of glass with seats in it, roof, two licence plates."""
    length, width = draw.uniform(3.7, 4.9), draw.uniform(1.65, 1.88)
    floor_m, body_m, cabin_m = 0.2, draw.uniform(0.6, 0.72), draw.uniform(0.44, 0.56)
    cabin_long = length * draw.uniform(0.45, 0.68)
    cabin_at = -0.5 * (length - cabin_long) * draw.uniform(0.3, 0.95)
    top_m, painted = floor_m + body_m, _painted(Semantic.CAR, coat(draw))
    roof_at, roof_m = (cabin_at, 0, top_m + cabin_m + 0.03), (0.86 * cabin_long, 0.8 * width, 0.06)
    roof, glass_m = painted(roof_at, roof_m, detail=True), (cabin_long, 0.86 * width, cabin_m)
    return (
        painted((0, 0, floor_m + body_m / 2), (length, width, body_m)),
        *_cabin(draw, cabin_at, top_m + cabin_m / 2, glass_m, roof),
        _plate(length / 2, 0.45, Semantic.CAR),
        _plate(-length / 2, draw.uniform(0.45, 0.8), Semantic.CAR),
    )


def van(draw: Generator) -> Body:
    """A delivery van: box, bonnet, windscreen and plates."""
    length, width, height = draw.uniform(4.8, 6.4), draw.uniform(1.9, 2.05), draw.uniform(1.8, 2.5)
    painted, bonnet_m = _painted(Semantic.CAR, coat(draw)), 0.9
    front_m = length / 2 - bonnet_m
    return (
        painted((-bonnet_m / 2, 0, 0.25 + height / 2), (length - bonnet_m, width, height)),
        painted((front_m + bonnet_m / 2, 0, 0.7), (bonnet_m, width, 0.9)),
        _pane(front_m + 0.03, 1.6, (0.03, 0.85 * width, 0.8), Semantic.CAR),
        _plate(length / 2, 0.5, Semantic.CAR),
        _plate(-length / 2, 0.6, Semantic.CAR),
    )


def truck(draw: Generator) -> Body:
    """A truck with a box or, sometimes, a polished tank."""
    length, width = draw.uniform(7.0, 10.5), 2.45
    cab_m, load_m = 1.9, draw.uniform(2.3, 2.8)
    front_m, paint = length / 2, coat(draw)
    load_at = (-cab_m / 2 - 0.1, 0, 1.0 + load_m / 2)
    load_size = (length - cab_m - 0.2, width, load_m)
    if draw.random() < 0.3:
        metal = Material.POLISHED_METAL
        load = Part(load_at, load_size, Semantic.TRUCK, metal, 0.1, Shape.ELLIPSOID)
    else:
        load = _painted(Semantic.TRUCK, draw.uniform(0.12, 0.25))(load_at, load_size)
    cab_at, cab_size = (front_m - cab_m / 2, 0, 1.65), (cab_m, width, 2.5)
    return (
        _painted(Semantic.TRUCK, paint)(cab_at, cab_size),
        _pane(front_m + 0.03, 2.2, (0.03, 0.88 * width, 0.9), Semantic.TRUCK),
        _painted(Semantic.TRUCK, 0.05)((-cab_m / 2, 0, 0.75), (length - cab_m, 1.9, 0.5)),
        load,
        _plate(-front_m, 0.8, Semantic.TRUCK),
    )


def bus(draw: Generator) -> Body:
    """A city bus: a band of windows around seats, between a painted body and its roof."""
    length, width, paint = draw.uniform(10.5, 12.5), 2.5, draw.uniform(0.1, 0.25)
    painted = _painted(Semantic.BUS, paint)
    roof = painted((0, 0, 2.85), (length, width, 0.4))
    return (
        painted((0, 0, 0.8), (length, width, 1.0)),
        *_cabin(draw, 0, 1.975, (length - 0.1, width - 0.06, 1.35), roof),
        _plate(-length / 2, 0.6, Semantic.BUS),
    )


def vehicle(draw: Generator) -> Body:
    """A vehicle of the traffic: mostly cars."""
    kind = draw.random()
    if kind < 0.76:
        return car(draw)
    if kind < 0.88:
        return van(draw)
    return truck(draw) if kind < 0.95 else bus(draw)


def parked_vehicle(draw: Generator) -> Body:
    """A vehicle parked at a kerb: a car, sometimes a van."""
    return van(draw) if draw.random() < 0.08 else car(draw)


def bicycle(draw: Generator) -> Body:
    """Two thin wheels."""
    apart_m = draw.uniform(1.0, 1.1)
    return tuple(
        Part((x, 0, 0.34), (0.62, 0.05, 0.68), Semantic.BICYCLE, Material.PAINT, 0.1)
        for x in (apart_m / 2, -apart_m / 2)
    )


def cyclist(draw: Generator) -> Body:
    """A rider on a bicycle."""
    tall_m, wide_m = draw.uniform(0.95, 1.15), draw.uniform(0.4, 0.5)
    look, wheels = (Semantic.RIDER, Material.CLOTH), bicycle(draw)
    torso_at, torso_m = (-0.05, 0, 0.55 + tall_m / 2), (0.55, wide_m, tall_m)
    cloth = draw.uniform(0.1, 0.3)
    return (
        *wheels,
        Part(torso_at, torso_m, *look, cloth, Shape.ELLIPSOID),
        Part((0.12, 0, 0.62 + tall_m), (0.22, 0.18, 0.27), *look, 0.2, Shape.ELLIPSOID),
    )


def person(draw: Generator) -> Body:
    """A body and a head."""
    tall_m, wide_m = draw.uniform(1.2, 1.6), draw.uniform(0.32, 0.5)
    look, cloth = (Semantic.PERSON, Material.CLOTH), draw.uniform(0.1, 0.3)
    torso_m = (0.7 * wide_m, wide_m, tall_m)
    return (
        Part((0, 0, tall_m / 2), torso_m, *look, cloth, Shape.CYLINDER),
        Part((0, 0, tall_m + 0.12), (0.2, 0.18, 0.26), *look, 0.2, Shape.ELLIPSOID),
    )


@lru_cache
def recording_car() -> tuple[Primitive, ...]:
    """Roof and rack of the recording car, a station wagon, in the frame of the sensor.

    Source: boxes fitted to the shots without a return in all scans of KITTI: 5 % of all shots, in
    the lower 22 beams, mostly behind.
    """
    look = (Semantic.EGO_VEHICLE, 0.1)
    parts = []
    for x, y, long, wide, top, bottom in _RECORDING_CAR:
        at, half_size = (x, y, (top + bottom) / 2), (long / 2, wide / 2, (top - bottom) / 2)
        parts.append(Primitive(Shape.BOX, at, half_size, *look, material=Material.PAINT))
    return tuple(parts)

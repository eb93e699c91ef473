"""Vehicles that stand on the ground, as parts about their origin."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from lidarsim.scene import Interval, Material, Primitive, Semantic, Shape

_PLATE_M = (0.02, 0.52, 0.12)
# Diffuse reflectivity of panes and mirrors: dirt.
DIRT = 0.0015
# In about half of the real cars at 4 to 15 m nothing is detected in the windows, neither the dirt
# on them nor the inside.
_CLEAN, _SEATS = (0.00003, 0.005), (0.00003, 0.03)
_DARK = (0.0007, 0.02)
# Tyres are black rubber; mirrors, bumpers and saddles are plastic.
_RUBBER, _PLASTIC = 0.03, 0.06
# Clear of the ground: the sills of a car, of vans and caravans, and its tyres' height.
_SILL_M, _HIGH_SILL_M, _TYRE_M = 0.22, 0.35, 0.62
# A corner of a bumper is round by about this much, seen from above.
_ROUND_M = 0.35
# Wheels of bicycles (28 inches with the tyre) and of motorcycles.
_BICYCLE_WHEEL_M, _MOTORCYCLE_WHEEL_M = 0.7, 0.6
# Chance of a hit per metre across spokes or a frame of tubes, 4 cm deep: about every second beam.
_SPOKES_PER_M, _TUBES_PER_M = 18.0, 25.0


class Part(NamedTuple):
    """One solid of a body: centre and full size in metres, x forward, y left, z above the ground.

    ``detail``: built near the sensor only. ``extinction_per_m``: see ``Primitive``.
    """

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    semantic: Semantic
    material: Material
    reflectivity: float
    shape: Shape = Shape.BOX
    detail: bool = False
    extinction_per_m: float = 0.0


Body = tuple[Part, ...]


class _Build(NamedTuple):
    """Proportions of one kind of car; pairs are intervals in metres."""

    share: float
    length: Interval
    height: Interval
    boot: Interval  # behind the cabin
    upright: bool  # whether the rear of the cabin is steep


# Sizes of cars on sale in Europe between 2000 and 2015; the shares are estimates.
_BUILDS = (
    _Build(0.46, (3.6, 4.35), (1.42, 1.55), (0.05, 0.2), False),  # hatchback
    _Build(0.18, (4.4, 4.9), (1.40, 1.50), (0.7, 1.0), False),  # saloon
    _Build(0.18, (4.4, 4.9), (1.43, 1.55), (0.05, 0.15), True),  # estate
    _Build(0.16, (4.1, 4.8), (1.58, 1.80), (0.05, 0.15), True),  # people carrier, off-roader
    _Build(0.02, (5.0, 5.4), (1.72, 1.85), (1.4, 1.7), True),  # pick-up
)

# Centre x and y, size along x and y, top and bottom, metres in the sensor frame.
_RECORDING_CAR = (
    # in front of the sensor
    (0.5, 0, 0.02, 0.23, -0.087, -0.101),
    (0.5, 0, 0.02, 0.3, -0.107, -0.121),
    (0.5, 0, 0.02, 0.34, -0.127, -0.18),
    # beside it, on the right
    (0.185, -0.486, 0.175, 0.02, -0.036, -0.105),
    # bars and tail
    (-1.13, -0.44, 0.02, 0.155, -0.168, -0.29),
    (-1.13, 0.41, 0.02, 0.155, -0.168, -0.29),
    (-1.13, 0, 0.02, 0.885, -0.28, -0.94),
    (-1.13, 0, 0.02, 1.055, -0.368, -0.94),
    (-1.13, -0.02, 0.02, 1.155, -0.408, -0.94),
    (-1.13, -0.02, 0.02, 1.265, -0.448, -0.94),
    (-1.13, 0, 0.02, 1.375, -0.488, -0.94),
    (-1.13, 0, 0.02, 1.895, -0.528, -0.94),
    # left and right ends of the rack behind
    (-0.65, 0.7, 0.02, 0.085, -0.245, -0.262),
    (-0.65, 0.65, 0.02, 0.265, -0.262, -0.28),
    (-0.65, 0.695, 0.02, 0.235, -0.28, -0.3),
    (-0.65, 0.745, 0.02, 0.215, -0.3, -0.33),
    (-0.65, 0.79, 0.02, 0.145, -0.33, -0.36),
    (-0.65, 0.835, 0.02, 0.055, -0.36, -0.4),
    (-0.65, -0.57, 0.02, 0.065, -0.262, -0.302),
    (-0.65, -0.7625, 0.02, 0.11, -0.262, -0.282),
    (-0.65, -0.78, 0.02, 0.125, -0.282, -0.302),
    (-0.65, -0.7925, 0.02, 0.22, -0.302, -0.342),
    (-0.65, -0.8475, 0.02, 0.19, -0.342, -0.365),
    (-0.65, -0.9, 0.02, 0.125, -0.365, -0.41),
    # and in front
    (0.81, 0.445, 0.02, 0.06, -0.285, -0.325),
    (0.81, 0.5825, 0.02, 0.085, -0.325, -0.37),
    (0.81, -0.435, 0.02, 0.03, -0.275, -0.295),
    (0.81, -0.51, 0.02, 0.15, -0.295, -0.33),
    (0.81, -0.5835, 0.02, 0.077, -0.33, -0.38),
)


def _plate(x: float, z: float, semantic: Semantic) -> Part:
    return Part((x, 0, z), _PLATE_M, semantic, Material.RETROREFLECTOR, 0.9, detail=True)


def _painted(semantic: Semantic, paint: float) -> Callable[..., Part]:
    return partial(Part, semantic=semantic, material=Material.PAINT, reflectivity=paint)


def _pane(x: float, z: float, size: tuple[float, float, float], semantic: Semantic) -> Part:
    return Part((x, 0, z), size, semantic, Material.GLASS, DIRT)


def _dark_windows(semantic: Semantic, x: float, z: float, size: tuple[float, float, float]) -> Part:
    """Windows on both sides that nothing is seen through: as dark as dirt, no mirrors."""
    return _painted(semantic, DIRT)((x, 0, z), size, detail=True)


def coat(draw: Generator) -> float:
    """Reflectivity of a coat of paint.

    Under its clear coat a dark car returns little: at 5 m its intensity is 0, at 15 m it is not
    detected.
    """
    if draw.random() < 0.45:
        return float(np.exp(draw.uniform(*np.log(_DARK))))
    return draw.uniform(0.06, 0.25)


def _wheels(semantic: Semantic, width: float, *places: float) -> list[Part]:
    """Pairs of wheels at places along a vehicle, each as one block: all that rays from a roof see.

    They end a little outside of the sills, as tyres and mudguards do.
    """
    rubber = _painted(semantic, _RUBBER)
    size = (_TYRE_M, width + 0.02, _TYRE_M)
    return [rubber((x, 0, _TYRE_M / 2), size, detail=True) for x in places]


def _mirrors(semantic: Semantic, x: float, z: float, width: float) -> Part:
    """Both outside mirrors, and the dashboard between them behind the windscreen."""
    size = (0.12, width + 0.28, 0.15)
    return _painted(semantic, _PLASTIC)((x, 0, z), size, detail=True)


def _cabin(
    draw: Generator,
    x: float,
    z: float,
    size: tuple[float, float, float],
    roof: Part,
    shape: Shape = Shape.BOX,
) -> list[Part]:
    """A band of windows with seats behind it and a roof above.

    The inside returns little: panes of vehicles absorb, seats are dark.
    """
    seats_m = (0.9 * size[0], 0.9 * size[1], 0.95 * size[2])
    semantic = roof.semantic
    # One draw for both: whoever cleans a car cleans it in and out, and tinted panes dim both.
    least, most = np.transpose([_SEATS, _CLEAN])
    cloth, dirt = (least * (most / least) ** draw.random()).tolist()
    seats_at = (x, 0, z - 0.025 * size[2])
    return [
        Part((x, 0, z), size, semantic, Material.GLASS, dirt, shape),
        Part(seats_at, seats_m, semantic, Material.CLOTH, cloth, shape, detail=True),
        roof,
    ]


def car(draw: Generator) -> Body:
    """A passenger car of some build: hatchback, saloon, estate, people carrier or pick-up.

    Round at the corners, the bonnet lower than the cabin's sill; windows with seats behind them,
    pillars, mirrors, wheels, two licence plates.
    """
    build = _BUILDS[int(draw.choice(len(_BUILDS), p=[b.share for b in _BUILDS]))]
    length, width = draw.uniform(*build.length), draw.uniform(1.65, 1.88)
    height, boot_m = draw.uniform(*build.height), draw.uniform(*build.boot)
    # Upper edge of the doors, and the windscreen's foot.
    belt_m, bonnet_m = height * draw.uniform(0.62, 0.67), draw.uniform(0.85, 1.15)
    front, rear = length / 2, -length / 2
    foot = front - bonnet_m
    paint = coat(draw)
    painted = _painted(Semantic.CAR, paint)
    doors_from = rear + _ROUND_M
    middle_m, hood_m = foot - doors_from, 0.9 * belt_m
    nose_m = draw.uniform(0.72, 0.8) * belt_m
    up = (belt_m + _SILL_M) / 2
    parts = [
        painted(((foot + doors_from) / 2, 0, up), (middle_m, width, belt_m - _SILL_M)),
        painted(
            ((foot + front - _ROUND_M) / 2, 0, (hood_m + _SILL_M) / 2),
            (bonnet_m - _ROUND_M, 0.97 * width, hood_m - _SILL_M),
        ),
        _bumper(painted, front - _ROUND_M, width, nose_m),
        _bumper(painted, rear + _ROUND_M, width, belt_m),
    ]
    # The cabin reaches over the bonnet where the windscreen is raked.
    cabin_long = foot - (rear + boot_m) + 0.3 * (not build.upright)
    at = rear + boot_m + cabin_long / 2
    cabin = _upright_cabin if build.upright else _raked_cabin
    parts += cabin(draw, painted, at, belt_m, (cabin_long, 0.92 * width, height))
    parts += _wheels(Semantic.CAR, width, front - 0.85, rear + 0.75)
    parts += [
        _mirrors(Semantic.CAR, foot - 0.15, belt_m + 0.05, width),
        _plate(front, 0.45, Semantic.CAR),
        _plate(rear, draw.uniform(0.45, 0.8), Semantic.CAR),
    ]
    return tuple(parts)


def _bumper(painted: Callable[..., Part], x: float, width: float, top_m: float) -> Part:
    """A round end of a car."""
    size = (2 * _ROUND_M, width, top_m - _SILL_M)
    return painted((x, 0, (top_m + _SILL_M) / 2), size, shape=Shape.CYLINDER)


def _raked_cabin(
    draw: Generator,
    painted: Callable[..., Part],
    x: float,
    belt_m: float,
    size: tuple[float, float, float],
) -> list[Part]:
    """The cabin of a hatchback or a saloon: round, as its screens lean by 30 degrees and more."""
    long, wide, height = size
    up = height - 0.03 - belt_m
    # Three quarters up, an ellipsoid is 0.66 times as long and as wide as at its middle.
    roof_at, roof_m = (x, 0, belt_m + 0.75 * up), (0.69 * long, 0.69 * wide, 0.5 * up + 0.06)
    roof = painted(roof_at, roof_m, shape=Shape.ELLIPSOID, detail=True)
    return _cabin(draw, x, belt_m, (long, wide, 2 * up), roof, Shape.ELLIPSOID)


def _upright_cabin(
    draw: Generator,
    painted: Callable[..., Part],
    x: float,
    belt_m: float,
    size: tuple[float, float, float],
) -> list[Part]:
    """The cabin of an estate: a long flat roof, often with rails, on pillars and a steep rear.

    Its windows lean too, so that most of what they mirror is sky.
    """
    long, wide, height = size
    up = height - 0.04 - belt_m
    rear = x - long / 2
    roof_m = (0.68 * long, 0.78 * wide, 0.16)
    roof = painted((rear + 0.1 + roof_m[0] / 2, 0, height - 0.08), roof_m, detail=True)
    parts = _cabin(draw, x, belt_m, (1.1 * long, 1.05 * wide, 2 * up), roof, Shape.ELLIPSOID)
    for place, pillar_m in ((x, 0.12), (rear + 0.2, 0.3)):
        pillar = (pillar_m, 0.82 * wide + 0.1, up)
        parts.append(painted((place, 0, belt_m + up / 2), pillar, detail=True))
    if draw.random() < 0.5:
        rails_m = (0.55 * long, 0.7 * wide, 0.05)
        parts.append(painted((rear + 0.42 * long, 0, height + 0.06), rails_m, detail=True))
    return parts


def van(draw: Generator) -> Body:
    """A delivery van: box, bonnet, windscreen, windows of the cab, mirrors, wheels and plates."""
    length, width, height = draw.uniform(4.8, 6.4), draw.uniform(1.9, 2.05), draw.uniform(1.8, 2.5)
    painted, bonnet_m = _painted(Semantic.CAR, coat(draw)), 0.9
    front_m = length / 2 - bonnet_m
    return (
        painted((-bonnet_m / 2, 0, 0.25 + height / 2), (length - bonnet_m, width, height)),
        painted((front_m + bonnet_m / 2 - 0.15, 0, 0.7), (bonnet_m - 0.3, width, 0.9)),
        painted((length / 2 - 0.3, 0, 0.6), (0.6, width, 0.65), shape=Shape.CYLINDER),
        # The windscreen leans back, over the bonnet.
        _pane(front_m, 1.2, (0.8, 0.88 * width, 1.7), Semantic.CAR)._replace(shape=Shape.ELLIPSOID),
        _dark_windows(Semantic.CAR, front_m - 0.55, 1.55, (0.8, width + 0.02, 0.6)),
        _mirrors(Semantic.CAR, front_m - 0.1, 1.3, width + 0.1),
        *_wheels(Semantic.CAR, width, length / 2 - 1.0, 1.1 - length / 2),
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
        *_wheels(Semantic.TRUCK, width - 0.1, front_m - 1.2, 1.6 - front_m),
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
        *_wheels(Semantic.BUS, width, length / 2 - 2.7, 3.2 - length / 2),
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


def _open_boot(car_body: Body) -> Body:
    """A car whose tailgate stands open above its rear."""
    rear = min(part.centre[0] - part.size[0] / 2 for part in car_body)
    top_m = max(part.centre[2] + part.size[2] / 2 for part in car_body)
    painted = _painted(Semantic.CAR, car_body[0].reflectivity)
    gate = painted((rear + 0.05, 0, top_m + 0.15), (1.0, 1.2, 0.08))
    return (*car_body, gate)


def parked_vehicle(draw: Generator) -> Body:
    """A vehicle parked at a kerb: a car, sometimes with its boot open, a van, a caravan, a trailer.

    The shares of the rare ones are estimates.
    """
    kind = draw.random()
    if kind < 0.86:
        return car(draw)
    if kind < 0.88:
        return _open_boot(car(draw))
    if kind < 0.965:
        return van(draw)
    return caravan(draw) if kind < 0.98 else trailer(draw)


def caravan(draw: Generator) -> Body:
    """A caravan: a box with windows on one axle behind a drawbar."""
    length, width, height = draw.uniform(3.8, 4.8), draw.uniform(2.1, 2.3), draw.uniform(2.5, 2.65)
    painted = _painted(Semantic.CARAVAN, draw.uniform(0.15, 0.25))
    box_m, drawbar_m = height - _HIGH_SILL_M, 1.2
    x, middle = -drawbar_m / 2, _HIGH_SILL_M + box_m / 2
    panes_m = (0.75 * length, width + 0.02, 0.5)
    return (
        painted((x, 0, middle), (length, width, box_m)),
        painted((x + length / 2 + drawbar_m / 2, 0, 0.4), (drawbar_m, 0.9, 0.12)),
        _dark_windows(Semantic.CARAVAN, x, 1.6, panes_m),
        *_wheels(Semantic.CARAVAN, width - 0.1, x - 0.1),
        # The jockey wheel, which a parked caravan stands on.
        painted((x + length / 2 + drawbar_m - 0.25, 0, 0.3), (0.12, 0.12, 0.6)),
        _plate(x - length / 2, 0.6, Semantic.CARAVAN),
    )


def trailer(draw: Generator) -> Body:
    """A car trailer: a flat box with low walls, or under a tarpaulin, on one axle."""
    length, width = draw.uniform(1.9, 2.6), draw.uniform(1.1, 1.4)
    floor_m, drawbar_m = 0.5, 1.1
    covered = draw.random() < 0.4
    wall_m = draw.uniform(0.7, 1.3) if covered else draw.uniform(0.3, 0.45)
    look = (Semantic.TRAILER, Material.CLOTH if covered else Material.PAINT)
    painted, x = _painted(Semantic.TRAILER, 0.12), -drawbar_m / 2
    wall = draw.uniform(0.08, 0.2)
    return (
        Part((x, 0, floor_m + wall_m / 2), (length, width, wall_m), *look, wall),
        painted((x + length / 2 + drawbar_m / 2, 0, 0.48), (drawbar_m, 0.1, 0.1)),
        painted((x + length / 2 + drawbar_m - 0.15, 0, 0.25), (0.1, 0.1, 0.5)),
        *_wheels(Semantic.TRAILER, width + 0.35, x),
        _plate(x - length / 2, 0.5, Semantic.TRAILER),
    )


def bicycle(draw: Generator) -> Body:
    """Two wheels of spokes, a frame of tubes, and a handlebar."""
    apart_m, thin_m = draw.uniform(1.0, 1.1), 0.04
    painted = _painted(Semantic.BICYCLE, draw.uniform(0.06, 0.2))
    wheel = partial(painted, shape=Shape.ELLIPSOID, extinction_per_m=_SPOKES_PER_M)
    wheel_m = (_BICYCLE_WHEEL_M, thin_m, _BICYCLE_WHEEL_M)
    frame = partial(painted, detail=True, extinction_per_m=_TUBES_PER_M)
    return (
        wheel((apart_m / 2, 0, _BICYCLE_WHEEL_M / 2), wheel_m),
        wheel((-apart_m / 2, 0, _BICYCLE_WHEEL_M / 2), wheel_m),
        frame((0, 0, 0.6), (0.65, thin_m, 0.55)),
        painted((apart_m / 2 - 0.15, 0, 1.0), (0.12, 0.56, 0.06), detail=True),
        painted((-0.2, 0, 0.93), (0.25, 0.15, 0.08), detail=True),
    )


def motorcycle(draw: Generator) -> Body:
    """A motorcycle, or a motor scooter behind its leg shield."""
    scooter = draw.random() < 0.5
    long_m = draw.uniform(1.1, 1.25) if scooter else draw.uniform(1.35, 1.5)
    wheel_m = 0.45 if scooter else _MOTORCYCLE_WHEEL_M
    painted = _painted(Semantic.MOTORCYCLE, coat(draw))
    rubber = partial(_painted(Semantic.MOTORCYCLE, _RUBBER), shape=Shape.ELLIPSOID)
    disc_m = (wheel_m, 0.14, wheel_m)
    parts = [
        rubber((long_m / 2, 0, wheel_m / 2), disc_m),
        rubber((-long_m / 2, 0, wheel_m / 2), disc_m),
        painted((-0.3 * long_m, 0, 0.6), (0.7 * long_m, 0.28, 0.4), shape=Shape.ELLIPSOID),
        painted((0.35 * long_m, 0, 1.0), (0.1, 0.7, 0.08), detail=True),
    ]
    if scooter:
        parts.append(painted((0.3 * long_m, 0, 0.65), (0.12, 0.4, 0.7)))
    else:
        parts.append(painted((0.1, 0, 0.55), (0.6, 0.3, 0.6)))
    return tuple(parts)


@lru_cache
def recording_car() -> tuple[Primitive, ...]:
    """Roof and rack of the recording car, a station wagon, in the frame of the sensor.

    Source: thin boxes fitted to the shots without a return in all of 24 scans of KITTI: 6.4 % of
    all shots, in the lower 22 beams, mostly behind. They are outlines seen from the sensor, no
    surfaces, and so black that no sensor detects them.
    """
    look = (Semantic.EGO_VEHICLE, 1e-9)
    parts = []
    for x, y, long, wide, top, bottom in _RECORDING_CAR:
        at, half_size = (x, y, (top + bottom) / 2), (long / 2, wide / 2, (top - bottom) / 2)
        parts.append(Primitive(Shape.BOX, at, half_size, *look, material=Material.PAINT))
    return tuple(parts)

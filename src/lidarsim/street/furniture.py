"""Furniture of pavements: lamps, signs, bins, benches, bollards, cabinets, bicycles, bus stops.

Positions are street coordinates: ``s`` along, ``lateral`` to the left; ``side`` is 1 left and -1
right of the road. Heights matter up to some 3 m: the highest beam rises by less than 2 degrees.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from lidarsim.scene import Material, Semantic, Shape
from lidarsim.street.builder import FOOTING_M, Builder
from lidarsim.street.trees import LEAVES
from lidarsim.street.vehicles import DIRT, bicycle

# Lamps of roads stand on masts of 5 to 9 m, of paths and squares on 3.2 to 4.2 m; the foot
# of a mast, behind whose door the fuses are, is thicker up to 0.9 m.
_MAST_M, _LOW_MAST_M, _FOOT_M = (5.0, 9.0), (3.2, 4.2), (0.18, 0.9)
# Posts of signs are tubes of 60 or 76 mm; sheets have edges or diameters of 0.42 to 0.9 m and hang
# 2.0 to 2.3 m high, above heads (German rules); boards at the road's edge stand low.
_POSTS_M, _SHEET_M, _SHEET_HIGH_M = (0.06, 0.076), (0.42, 0.9), (2.0, 2.3)
_BOARD_M, _BOARD_HIGH_M = (0.04, 0.5, 0.5), 0.5
# A traffic light of three lamps of 200 mm and its visor; it hangs 2.1 m and higher over pavements.
_LIGHT_M, _LIGHT_HIGH_M = (0.32, 0.3, 0.95), (2.1, 2.4)
# Wheeled bins of 120, 240 and 1100 litres: depth, width, height (EN 840).
_BINS_M = ((0.55, 0.48, 0.94), (0.73, 0.58, 1.07), (1.07, 1.37, 1.45))
# Litter bins on a post or standing: diameter and height.
_LITTER_BIN_M = (0.4, 0.9)
# Benches: seats 0.45 m high; bollards; cabinets of telephone and power: along, across, up.
_SEAT_M, _BENCH_M = 0.45, (1.5, 2.0)
_BOLLARD_THICK_M, _BOLLARD_TALL_M, _BOLLARD_GAP_M = (0.08, 0.16), (0.75, 1.1), (1.2, 2.0)
_CABINET_M = ((0.6, 1.7), (0.3, 0.5), (0.9, 1.6))
_POST_BOX_M, _HYDRANT_M = (0.5, 0.35, 1.15), (0.22, 0.22, 0.85)
# Bicycles at stands: every 0.45 to 0.8 m.
_STAND_PITCH_M = (0.45, 0.8)
# Shelters: two or three panes of 1.3 m long, 1.4 to 1.7 m deep, eaves at 2.4 m.
_SHELTER_LONG_M, _SHELTER_DEEP_M, _EAVES_M = (2.7, 4.2), (1.4, 1.7), 2.4
# Advertising: cases with sheets of 1.2 m x 1.75 m on legs, and columns of 1.2 to 1.4 m.
_CASE_M, _CASE_HIGH_M, _COLUMN_M = (1.35, 0.2, 1.95), 0.55, (1.2, 1.4)
# Poles of overhead lines stand 8 to 10 m tall, of wood or concrete.
_POWER_POLE_THICK_M, _POWER_POLE_TALL_M = (0.22, 0.32), (7.0, 9.5)

_STEEL = (Material.PAINT, 0.15)


def street_lamp(builder: Builder, draw: Generator, s: float, lateral: float, side: float) -> None:
    """A lamp on a mast with an arm over the road; beside paths, a lantern on a low mast."""
    low = draw.random() < 0.25
    tall_m = draw.uniform(*(_LOW_MAST_M if low else _MAST_M))
    thick_m = draw.uniform(0.08, 0.12) if low else draw.uniform(0.11, 0.2)
    concrete = draw.random() < 0.2
    look = (Semantic.POLE, Material.CONCRETE if concrete else Material.PAINT, 0.15)
    mast = builder.new_instance()
    size = (thick_m, thick_m, tall_m + FOOTING_M)
    builder.solid(Shape.CYLINDER, (s, lateral), size, *look, mast, -FOOTING_M)
    if not concrete:
        foot_m, high_m = _FOOT_M[0] * draw.uniform(0.9, 1.2), _FOOT_M[1]
        size = (foot_m, foot_m, high_m)
        builder.solid(Shape.CYLINDER, (s, lateral), size, *look, mast, detail=True)
    lamp = (Semantic.LAMP, Material.PAINT, 0.15, builder.new_instance())
    if low:
        builder.solid(Shape.CYLINDER, (s, lateral), (0.4, 0.4, 0.5), *lamp, tall_m)
        return
    reach_m = draw.uniform(0.6, 2.0)
    at = (s, lateral - side * reach_m / 2)
    builder.solid(Shape.BOX, at, (0.07, reach_m, 0.07), *look, mast, tall_m - 0.07)
    at = (s, lateral - side * (reach_m + 0.3))
    builder.solid(Shape.BOX, at, (0.3, 0.7, 0.15), *lamp, tall_m - 0.1)


def sign(builder: Builder, draw: Generator, s: float, lateral: float, side: float) -> None:
    """One or two retro-reflecting sheets on a thin post, or a board low at the road's edge."""
    sheet = (Semantic.SIGN, Material.RETROREFLECTOR, 0.9)
    post = (Semantic.SMALL_POLE, *_STEEL, builder.new_instance())
    thick_m = draw.choice(_POSTS_M)
    # On the side of the post that drivers see first.
    before = s + side * (thick_m / 2 + 0.02)
    if draw.random() < 0.15:
        builder.solid(Shape.CYLINDER, (s, lateral), (thick_m, thick_m, 1.0), *post)
        at = (before, lateral)
        builder.solid(Shape.BOX, at, _BOARD_M, *sheet, builder.new_instance(), _BOARD_HIGH_M)
        return
    edge_m, high_m = draw.uniform(*_SHEET_M), draw.uniform(*_SHEET_HIGH_M)
    size = (thick_m, thick_m, high_m + edge_m + 0.05)
    builder.solid(Shape.CYLINDER, (s, lateral), size, *post)
    at = (before, lateral)
    instance = builder.new_instance()
    builder.solid(Shape.BOX, at, (0.03, edge_m, edge_m), *sheet, instance, high_m)
    if draw.random() < 0.3:
        size = (0.03, min(edge_m, 0.6), 0.33)
        builder.solid(Shape.BOX, at, size, *sheet, instance, high_m - 0.36, detail=True)


def traffic_light(builder: Builder, draw: Generator, s: float, lateral: float, side: float) -> None:
    """A traffic light on its mast with the request button of pedestrians; some hang from an arm."""
    mast = (Semantic.POLE, *_STEEL, builder.new_instance())
    arm = draw.random() < 0.25
    high_m = draw.uniform(*_LIGHT_HIGH_M)
    thick_m, tall_m = (0.2, 5.4) if arm else (0.11, high_m + _LIGHT_M[2] + 0.1)
    builder.solid(Shape.CYLINDER, (s, lateral), (thick_m, thick_m, tall_m), *mast)
    light = (Semantic.TRAFFIC_LIGHT, Material.PAINT, 0.06, builder.new_instance())
    before = s + side * (thick_m / 2 + _LIGHT_M[0] / 2)
    builder.solid(Shape.BOX, (before, lateral), _LIGHT_M, *light, high_m)
    # The lamps for pedestrians, at a right angle to the others, and the button.
    aside = (s, lateral - side * (thick_m / 2 + 0.13))
    builder.solid(Shape.BOX, aside, (0.28, 0.26, 0.6), *light, high_m, detail=True)
    builder.solid(Shape.BOX, aside, (0.15, 0.12, 0.25), *light, 0.95, detail=True)
    if arm:
        reach_m = draw.uniform(3.0, 4.5)
        at = (s, lateral - side * reach_m / 2)
        builder.solid(Shape.BOX, at, (0.14, reach_m, 0.14), *mast, tall_m - 0.14)
        at = (before, lateral - side * reach_m)
        builder.solid(Shape.BOX, at, _LIGHT_M, *light, tall_m - _LIGHT_M[2])


def bins(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """One to five wheeled bins in a row, as on the day of collection."""
    size = _BINS_M[int(draw.choice(3, p=[0.5, 0.42, 0.08]))]
    for place in range(int(draw.integers(1, 6))):
        if place and draw.random() < 0.3:
            size = _BINS_M[int(draw.integers(2))]
        look = (Semantic.TRASH_BIN, Material.PAINT, draw.uniform(0.05, 0.2))
        at = (s + size[1] / 2, lateral + draw.normal(0, 0.06))
        # Each stands with its front to the road or to the house.
        builder.solid(
            Shape.BOX, at, (size[1], size[0], size[2]), *look, builder.new_instance(), 0.0,
            draw.normal(0, 0.12),
        )  # fmt: skip
        s += size[1] + draw.uniform(0.06, 0.35)


def litter_bin(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A round bin on the ground or hung on a post."""
    thick_m, tall_m = _LITTER_BIN_M
    look = (Semantic.TRASH_BIN, Material.PAINT, draw.uniform(0.08, 0.2), builder.new_instance())
    hangs = draw.random() < 0.5
    if hangs:
        builder.solid(Shape.CYLINDER, (s, lateral), (0.07, 0.07, 1.2), *look)
        builder.solid(Shape.CYLINDER, (s + 0.22, lateral), (0.35, 0.35, 0.5), *look, 0.6)
    else:
        builder.solid(Shape.CYLINDER, (s, lateral), (thick_m, thick_m, tall_m), *look)


def bench(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A bench, mostly with a back, that faces the road or turns its back on it."""
    look = (Semantic.UNKNOWN_OBJECT, Material.WOOD, 0.14, builder.new_instance())
    long_m = draw.uniform(*_BENCH_M)
    back = draw.choice((-1, 1)) * 0.24
    # Legs of concrete or iron at both ends: of a block of which rays meet only the ends.
    legs_m, legs = (long_m, 0.4, _SEAT_M - 0.05), (long_m - 0.12, 0.12 / (long_m - 0.12))
    builder.solid(Shape.BOX, (s, lateral), legs_m, *look, slats=legs)
    builder.solid(Shape.BOX, (s, lateral), (long_m, 0.45, 0.06), *look, _SEAT_M - 0.05)
    if draw.random() < 0.75:
        at = (s, lateral + back)
        builder.solid(Shape.BOX, at, (long_m, 0.06, 0.4), *look, _SEAT_M)


def bollards(builder: Builder, draw: Generator, first: float, last: float, lateral: float) -> None:
    """Bollards of one make in a row, which keep cars off a pavement."""
    thick_m, tall_m = draw.uniform(*_BOLLARD_THICK_M), draw.uniform(*_BOLLARD_TALL_M)
    look = (Semantic.SMALL_POLE, Material.PAINT, draw.uniform(0.08, 0.2))
    size = (thick_m, thick_m, tall_m)
    for s in np.arange(first, last, draw.uniform(*_BOLLARD_GAP_M)):
        at = (float(s), lateral)
        builder.solid(Shape.CYLINDER, at, size, *look, builder.new_instance())


def cabinet(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A cabinet of the telephone or the power grid, or a post box."""
    look = (Semantic.BOX, Material.PAINT, draw.uniform(0.1, 0.22), builder.new_instance())
    kind = draw.random()
    if kind < 0.65:
        long_m, deep_m, tall_m = (draw.uniform(*interval) for interval in _CABINET_M)
        builder.solid(Shape.BOX, (s, lateral), (long_m, deep_m, tall_m), *look)
    elif kind < 0.85:
        builder.solid(Shape.BOX, (s, lateral), _POST_BOX_M, *look)
    else:
        builder.solid(Shape.BOX, (s, lateral), (0.1, 0.1, 0.7), *look)
        builder.solid(Shape.BOX, (s, lateral), (0.5, 0.35, 0.75), *look, 0.65)


def hydrant(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A hydrant above the ground, with its couplings."""
    look = (Semantic.UNKNOWN_OBJECT, Material.PAINT, 0.15, builder.new_instance())
    builder.solid(Shape.CYLINDER, (s, lateral), _HYDRANT_M, *look)
    yaw_rad = draw.uniform(0, math.pi)
    builder.solid(Shape.BOX, (s, lateral), (0.45, 0.14, 0.14), *look, 0.5, yaw_rad, detail=True)


def planter(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A tub of concrete or wood with a plant in it."""
    wide_m, tall_m = draw.uniform(0.6, 1.3), draw.uniform(0.4, 0.7)
    material = Material.WOOD if draw.random() < 0.4 else Material.CONCRETE
    shape = Shape.CYLINDER if draw.random() < 0.4 else Shape.BOX
    tub = (Semantic.UNKNOWN_OBJECT, material, draw.uniform(0.13, 0.2), builder.new_instance())
    builder.solid(shape, (s, lateral), (wide_m, wide_m, tall_m), *tub)
    high_m, broad_m = draw.uniform(0.4, 1.4), wide_m * draw.uniform(0.7, 1.1)
    builder.solid(
        Shape.ELLIPSOID, (s, lateral), (broad_m, broad_m, high_m), Semantic.VEGETATION,
        Material.FOLIAGE, LEAVES, builder.new_instance(), tall_m - 0.2 * high_m,
        extinction_per_m=draw.uniform(1.8, 3.5),
    )  # fmt: skip


def bicycles(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """One bicycle along the kerb, or a row of them aslant at stands."""
    if draw.random() < 0.5:
        turn = draw.choice((0.0, math.pi)) + draw.normal(0, 0.1)
        builder.body(bicycle(draw), (s, lateral), turn, builder.new_instance())
        return
    pitch_m = draw.uniform(*_STAND_PITCH_M)
    turn = draw.choice((0.6, 0.4)) * math.pi / 2
    stands = (Semantic.SMALL_POLE, *_STEEL)
    for place in range(int(draw.integers(3, 8))):
        at = (s + pitch_m * place, lateral)
        # Hoops of tube: two posts, with the gap between them along the bicycle.
        builder.solid(
            Shape.BOX, at, (0.7, 0.05, 0.8), *stands, builder.new_instance(), 0.0, turn,
            detail=True, slats=(0.65, 0.05 / 0.65),
        )  # fmt: skip
        if draw.random() < 0.7:
            beside = (at[0] + 0.2, lateral + draw.normal(0, 0.08))
            yaw_rad = turn + draw.choice((0.0, math.pi)) + draw.normal(0, 0.05)
            builder.body(bicycle(draw), beside, yaw_rad, builder.new_instance())


def bus_stop(builder: Builder, draw: Generator, s: float, lateral: float, side: float) -> None:
    """A bus stop: a flag on a post, mostly beside a shelter that is open to the road.

    ``lateral``: middle of the shelter. It has a back of glass, a side of glass and one with an
    advertisement, four posts, a roof and a bench.
    """
    instance = builder.new_instance()
    metal, glass = (Semantic.STOP, *_STEEL, instance), (Semantic.STOP, Material.GLASS, DIRT)
    long_m, deep_m = draw.uniform(*_SHELTER_LONG_M), draw.uniform(*_SHELTER_DEEP_M)
    flag = s + side * (long_m / 2 + 1.5)
    builder.solid(Shape.CYLINDER, (flag, lateral), (0.08, 0.08, 2.8), *metal)
    builder.solid(Shape.BOX, (flag, lateral - side * 0.3), (0.05, 0.5, 0.5), *metal, 2.3)
    builder.solid(Shape.BOX, (flag, lateral), (0.08, 0.4, 0.6), *metal, 1.2, detail=True)
    if draw.random() < 0.25:
        return
    back, half_m = lateral + side * deep_m / 2, long_m / 2
    builder.solid(Shape.BOX, (s, lateral), (long_m + 0.2, deep_m + 0.3, 0.12), *metal, _EAVES_M)
    # Three posts along the back and two along the front, each row as one slatted box.
    pitch_m, thin_m = (long_m - 0.08) / 2, 0.08
    size, slats = (long_m, thin_m, _EAVES_M), (pitch_m, thin_m / pitch_m)
    builder.solid(Shape.BOX, (s, back), size, *metal, slats=slats)
    size, slats = (long_m, thin_m, _EAVES_M), (2 * pitch_m, thin_m / pitch_m / 2)
    builder.solid(Shape.BOX, (s, lateral - side * deep_m / 4), size, *metal, slats=slats)
    pane_m = _EAVES_M - 0.35
    size = (long_m - 0.2, 0.02, pane_m)
    builder.solid(Shape.BOX, (s, back), size, *glass, instance, 0.2, detail=True)
    ends = (s - half_m, s + half_m) if draw.random() < 0.5 else (s + half_m, s - half_m)
    size = (0.02, 0.6 * deep_m, pane_m)
    side_at = lateral + side * 0.15 * deep_m
    builder.solid(Shape.BOX, (ends[0], side_at), size, *glass, instance, 0.2, detail=True)
    size = (0.18, 1.3, 1.9)
    builder.solid(Shape.BOX, (ends[1], side_at), size, *metal, 0.3)
    bench_at = (s, back - side * 0.35)
    builder.solid(Shape.BOX, bench_at, (0.6 * long_m, 0.4, 0.08), *metal, _SEAT_M - 0.08)


def poster(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """Advertising: a column, or a case on two legs that stands along or across the street."""
    look = (Semantic.UNKNOWN_OBJECT, Material.PAINT, draw.uniform(0.1, 0.2))
    instance = builder.new_instance()
    if draw.random() < 0.4:
        wide_m = draw.uniform(*_COLUMN_M)
        size = (wide_m, wide_m, draw.uniform(2.6, 3.6))
        builder.solid(Shape.CYLINDER, (s, lateral), size, *look, instance)
        return
    yaw_rad = draw.choice((0.0, math.pi / 2)) + draw.normal(0, 0.05)
    builder.solid(Shape.BOX, (s, lateral), _CASE_M, *look, instance, _CASE_HIGH_M, yaw_rad)
    apart_m, thin_m = 0.9, 0.1
    legs_m, legs = (apart_m + thin_m, thin_m, _CASE_HIGH_M), (apart_m, thin_m / apart_m)
    builder.solid(Shape.BOX, (s, lateral), legs_m, *look, instance, 0.0, yaw_rad, slats=legs)


def power_pole(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A pole of an overhead line, of wood or concrete, some with a cable box."""
    wood = draw.random() < 0.7
    look = (Semantic.POLE, Material.WOOD if wood else Material.CONCRETE, 0.15)
    thick_m = draw.uniform(*_POWER_POLE_THICK_M)
    instance = builder.new_instance()
    size = (thick_m, thick_m, draw.uniform(*_POWER_POLE_TALL_M) + FOOTING_M)
    builder.solid(Shape.CYLINDER, (s, lateral), size, *look, instance, -FOOTING_M)
    if draw.random() < 0.3:
        at = (s + thick_m * 0.6, lateral)
        box_m = (0.2, 0.3, 0.5)
        builder.solid(Shape.BOX, at, box_m, *look, instance, 1.2, detail=True)


def clutter(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """One small thing of a pavement: bins, bench, cabinet, planter, bicycles and the like."""
    kinds = (bins, litter_bin, bench, cabinet, hydrant, planter, bicycles, poster)
    shares = (0.22, 0.14, 0.10, 0.16, 0.05, 0.10, 0.18, 0.05)
    kinds[int(draw.choice(len(kinds), p=shares))](builder, draw, s, lateral)

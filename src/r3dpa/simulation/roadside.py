"""Roadside: houses and gardens, trees and hedges, parked cars, lamps, signs.

A builder of a block side fills ``BLOCK_M`` metres of street from ``start`` on one ``side`` of the
axis (1 left, -1 right), outwards from the lateral distance ``edge_m`` at which the plot begins.
Leaves, blades of grass and wire mesh are media, see ``Primitive``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from r3dpa.simulation.builder import FOOTING_M, Builder
from r3dpa.simulation.course import BLOCK_M
from r3dpa.simulation.scene import Material, Primitive, Semantic, Shape
from r3dpa.simulation.vehicles import DIRT, bicycle, coat, parked_vehicle, person

# Limits of a district's chance of a tree at each place along the kerb.
_STREET_TREES = (0.15, 0.65)
_LEAVES = 0.17
# Chance of a hit per metre of a crown: half the area of its leaves per volume, and more, as a beam
# of some centimetres seldom finds a gap.
_CROWN_PER_M = (0.8, 2.5)


def _tree(builder: Builder, draw: Generator, s: float, lateral: float, low: bool) -> None:
    """A trunk below one to four crowns; a low one in a garden, a high one in a street."""
    instance = builder.new_instance()
    trunk_m = draw.uniform(0.4, 1.3) if low else draw.uniform(2.1, 3.0)
    crown_m = draw.uniform(2.0, 4.5) if low else draw.uniform(4.0, 7.5)
    tall_m = crown_m * draw.uniform(0.8, 1.4)
    thick_m = draw.uniform(0.15, 0.25) if low else draw.uniform(0.2, 0.5)
    builder.solid(
        Shape.CYLINDER, (s, lateral), (thick_m, thick_m, trunk_m + 1.0 + FOOTING_M),
        Semantic.VEGETATION, Material.WOOD, 0.15, instance, -FOOTING_M,
    )  # fmt: skip
    extinction = draw.uniform(*_CROWN_PER_M)
    for crown in range(int(draw.choice([1, 2, 3, 4], p=[0.6, 0.27, 0.1, 0.03]))):
        ds, dl, dz = draw.normal(0.0, 0.22 * crown_m, 3) * (crown > 0)
        scale = 1.0 if crown == 0 else draw.uniform(0.6, 0.9)
        size = (crown_m * scale, crown_m * scale * draw.uniform(0.8, 1.2), tall_m * scale)
        builder.solid(
            Shape.ELLIPSOID, (s + ds, lateral + dl), size, Semantic.VEGETATION, Material.FOLIAGE,
            _LEAVES, instance, trunk_m + abs(dz), draw.uniform(0, math.pi), False, extinction,
        )  # fmt: skip


def _bush(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    width, height = draw.uniform(0.9, 3.2), draw.uniform(0.8, 2.6)
    builder.solid(
        Shape.ELLIPSOID, (s, lateral), (width, width * draw.uniform(0.7, 1.4), height),
        Semantic.VEGETATION, Material.FOLIAGE, _LEAVES, builder.new_instance(), -0.15 * height,
        draw.uniform(0, math.pi), False, draw.uniform(2.0, 6.0),
    )  # fmt: skip


def _wood(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """The edge of a wood: leaves from the ground to the tree tops."""
    instance, extinction = builder.new_instance(), draw.uniform(*_CROWN_PER_M)
    for along in (-0.3, 0.3):
        size = (BLOCK_M * draw.uniform(0.5, 0.8), draw.uniform(5, 10), draw.uniform(6, 12))
        at = (s + along * BLOCK_M, lateral + draw.normal(0, 1.5))
        builder.solid(
            Shape.ELLIPSOID, at, size, Semantic.VEGETATION, Material.FOLIAGE, _LEAVES, instance,
            -0.35 * size[2], draw.normal(0, 0.2), False, extinction,
        )  # fmt: skip


def _grass(builder: Builder, draw: Generator, side: float, edge_m: float) -> None:
    """A meadow: a thin layer of blades over the terrain."""
    course, section, deep_m = builder.course, builder.section, draw.uniform(0.15, 0.4)
    extinction = draw.uniform(1.5, 4.0)
    lateral = side * (edge_m + 10.5)
    x, y, z = section.on_chord(BLOCK_M / 2, lateral)
    z += course.surface_m(lateral)
    builder.primitives.append(
        Primitive(
            Shape.BOX, (x, y, z + deep_m / 2), (BLOCK_M / 2, 9.0, deep_m / 2), Semantic.TERRAIN,
            _LEAVES, section.heading_rad, material=Material.FOLIAGE,
            grade=(section.slope, section.cross + course.surface_cross(lateral)),
            extinction_per_m=extinction,
        )
    )  # fmt: skip


def _row(builder: Builder, draw: Generator, lateral: float, first: float, last: float) -> None:
    """A hedge, a fence or a low wall along the street between two values of s."""
    kind = draw.random()
    if kind < 0.5:
        look = (Semantic.VEGETATION, Material.FOLIAGE, _LEAVES)
        size, extinction = (0.7, draw.uniform(1.0, 2.1)), draw.uniform(2.0, 6.0)
    elif kind < 0.8:
        # Wire mesh lets most beams through, boards let none.
        wire = draw.random() < 0.5
        look = (Semantic.FENCE, Material.PAINT if wire else Material.WOOD, 0.14)
        size, extinction = (0.06, draw.uniform(0.9, 1.6)), 6.0 if wire else 0.0
    else:
        look, extinction = (Semantic.WALL, Material.BRICK, 0.14), 0.0
        size = (0.25, draw.uniform(0.6, 1.8))
    builder.solid(
        Shape.BOX, ((first + last) / 2, lateral), (last - first, size[0], size[1] + 0.1), *look,
        builder.new_instance(), -0.1, 0.0, True, extinction,
    )  # fmt: skip


def _building(
    builder: Builder,
    draw: Generator,
    centre_s: float,
    front_m: float,
    side: float,
    size: tuple[float, float, float],
) -> None:
    """A building whose front stands ``front_m`` from the axis, with bay, door, pipe and windows.

    Windows only on the ground floor: the highest beam rises by less than 2 degrees. A pane stands
    before its place in the wall, sometimes, as many are covered or dirty.
    """
    instance = builder.new_instance()
    brick = draw.random() < 0.25
    reflectivity = draw.uniform(0.11, 0.17) if brick else draw.uniform(0.13, 0.22)
    look = (Semantic.BUILDING, Material.BRICK if brick else Material.CONCRETE, reflectivity)
    width, depth, height = size
    builder.solid(
        Shape.BOX, (centre_s, side * (front_m + depth / 2)), (width, depth, height + FOOTING_M),
        *look, instance, -FOOTING_M,
    )  # fmt: skip
    if draw.random() < 0.35:
        at = (centre_s + draw.uniform(-0.4, 0.4) * width, side * (front_m + 0.1))
        bay = (draw.uniform(1.2, 3.0), draw.uniform(0.5, 1.0), draw.uniform(2.6, 5.0))
        builder.solid(Shape.BOX, at, bay, *look, instance, -0.2)
    if draw.random() < 0.6:
        at = (centre_s + draw.uniform(-0.35, 0.35) * width, side * (front_m - 0.03))
        door = (Semantic.BUILDING, Material.PAINT, coat(draw), instance)
        door_m = (draw.uniform(1.0, 3.2), 0.1, draw.uniform(2.0, 2.6))
        builder.solid(Shape.BOX, at, door_m, *door, detail=True)
    if draw.random() < 0.6:
        at = (centre_s + draw.choice((-0.5, 0.5)) * (width - 0.4), side * (front_m - 0.06))
        pipe = (Semantic.BUILDING, Material.CONCRETE, 0.15, instance, -FOOTING_M)
        builder.solid(Shape.CYLINDER, at, (0.1, 0.1, 5.0), *pipe, detail=True)
    places = int(width / 3)
    for place in np.flatnonzero(draw.random(places) < 0.3):
        at = (centre_s + width * ((place + 0.5) / places - 0.5), side * (front_m - 0.03))
        pane = (draw.uniform(1.0, 1.9), 0.02, draw.uniform(1.1, 1.6))
        glass = (Semantic.BUILDING, Material.GLASS, DIRT)
        builder.solid(Shape.BOX, at, pane, *glass, instance, 0.9, detail=True)


def _behind(builder: Builder, draw: Generator, start: float, lateral: float, woods: float) -> None:
    s = start + draw.uniform(0.3, 0.7) * BLOCK_M
    if draw.random() < woods:
        _wood(builder, draw, s, lateral)
    else:
        size = (draw.uniform(10, 20), 8.0, draw.uniform(5, 10) + FOOTING_M)
        look = (Semantic.BUILDING, Material.CONCRETE, draw.uniform(0.13, 0.22))
        builder.solid(Shape.BOX, (s, lateral), size, *look, builder.new_instance(), -FOOTING_M)


def _town(builder: Builder, draw: Generator, start: float, side: float, edge_m: float) -> None:
    """Facades in a row, now and then a passage with a yard behind it."""
    s, end = start, start + BLOCK_M
    while s < end - 4:
        width = min(draw.uniform(6, 20), end - s)
        if draw.random() < 0.85:
            size = (width, draw.uniform(8, 12), draw.uniform(7, 18))
            garden = draw.random() < 0.35
            front_m = edge_m + (draw.uniform(2.0, 4.0) if garden else draw.uniform(0.0, 0.8))
            _building(builder, draw, s + width / 2, front_m, side, size)
            if garden:
                _row(builder, draw, side * (edge_m + 0.5), s, s + width)
                if draw.random() < 0.6:
                    at = (s + draw.uniform(0.2, 0.8) * width, side * (edge_m + 1.6))
                    _bush(builder, draw, *at)
        elif draw.random() < 0.5:
            _bush(builder, draw, s + width / 2, side * (edge_m + draw.uniform(3, 7)))
        s += width
    if draw.random() < 0.3:
        _behind(builder, draw, start, side * (edge_m + 26), 0.3)


def _houses(builder: Builder, draw: Generator, start: float, side: float, edge_m: float) -> None:
    """A house with a drive beside it, in a garden behind a hedge, a fence or a low wall."""
    drive_m, setback_m = 4.0, draw.uniform(2.0, 6.5)
    drive_first = bool(draw.random() < 0.5)
    plot = start + drive_m * drive_first
    room_m = BLOCK_M - drive_m
    width = draw.uniform(8, 17)
    centre_s = plot + draw.uniform(width / 2, room_m - width / 2)
    size = (width, draw.uniform(8, 11), draw.uniform(4, 10))
    _building(builder, draw, centre_s, edge_m + setback_m, side, size)
    drive_s = start + (drive_m / 2 if drive_first else BLOCK_M - drive_m / 2)
    if draw.random() < 0.85:
        _row(builder, draw, side * (edge_m + 0.5), plot, plot + room_m)
    for _ in range(int(draw.poisson(1.3))):
        at = side * (edge_m + draw.uniform(1.8, max(1.9, setback_m - 0.5)))
        _bush(builder, draw, plot + draw.uniform(0, room_m), at)
    for _ in range(int(draw.poisson(0.8))):
        at = side * (edge_m + draw.uniform(2.0, max(2.1, setback_m - 1)))
        _tree(builder, draw, plot + draw.uniform(2, room_m - 2), at, True)
    if draw.random() < 0.4:
        _car_in_plot(builder, draw, drive_s, side, edge_m)
    if draw.random() < 0.8:
        _behind(builder, draw, start, side * (edge_m + draw.uniform(24, 32)), 0.6)


def _car_in_plot(builder: Builder, draw: Generator, s: float, side: float, edge_m: float) -> None:
    yaw_rad = draw.choice((-1, 1)) * math.pi / 2 + draw.normal(0, 0.04)
    at = (s, side * (edge_m + 4.0 + draw.uniform(0, 1)))
    builder.body(parked_vehicle(draw), at, yaw_rad, builder.new_instance())


def _green(builder: Builder, draw: Generator, start: float, side: float, edge_m: float) -> None:
    """A meadow with bushes and trees, sometimes behind a fence, often before a wood."""
    if draw.random() < 0.45:
        _row(builder, draw, side * (edge_m + 0.5), start, start + BLOCK_M)
    for _ in range(int(draw.poisson(2.5))):
        at = side * (edge_m + draw.uniform(1.8, 11))
        _bush(builder, draw, start + draw.uniform(0, BLOCK_M), at)
    for _ in range(int(draw.poisson(1.6))):
        at = side * (edge_m + draw.uniform(2, 16))
        _tree(builder, draw, start + draw.uniform(0, BLOCK_M), at, draw.random() < 0.6)
    if draw.random() < 0.9:
        _behind(builder, draw, start, side * (edge_m + draw.uniform(10, 28)), 0.85)
    if draw.random() < 0.6:
        _grass(builder, draw, side, edge_m)


def _yard(builder: Builder, draw: Generator, start: float, side: float, edge_m: float) -> None:
    """A wall or an open car park, with a hall at its back, some of polished steel."""
    if draw.random() < 0.4:
        _row(builder, draw, side * (edge_m + 0.5), start, start + BLOCK_M)
    else:
        for slot in range(8):
            if draw.random() < 0.35:
                _car_in_plot(builder, draw, start + 2.2 + 2.8 * slot, side, edge_m)
    if draw.random() < 0.75:
        size = (BLOCK_M, draw.uniform(10, 14), draw.uniform(5, 9))
        front_m = edge_m + draw.uniform(10, 18)
        _building(builder, draw, start + BLOCK_M / 2, front_m, side, size)
        if draw.random() < 0.25:
            at = (start + BLOCK_M / 2, side * (front_m - 0.05))
            steel = (Semantic.BUILDING, Material.POLISHED_METAL, 0.1)
            builder.solid(Shape.BOX, at, (10.0, 0.04, 4.0), *steel, builder.new_instance(), 0.2)


_DISTRICTS = (_town, _houses, _green, _yard)


def build_plots(builder: Builder, draw: Generator, side: float, district: Generator) -> None:
    """Plots on one side of a block; ``district`` is drawn for several blocks."""
    start = builder.section.block * BLOCK_M
    kerb = builder.course.kerb(side)
    weights = builder.course.character.districts
    build = _DISTRICTS[int(district.choice(len(_DISTRICTS), p=weights))]
    build(builder, draw, start, side, kerb.edge_m + max(kerb.pavement_m, 1.2))
    _build_kerbside(builder, draw, start, side, district)


def _build_kerbside(
    builder: Builder, draw: Generator, start: float, side: float, district: Generator
) -> None:
    """Parked cars, lamps, signs, street trees, bicycles and waiting people along the kerb."""
    kerb, character = builder.course.kerb(side), builder.course.character
    parked_share = district.uniform(*character.parked)
    tree_share = district.uniform(*_STREET_TREES)
    if kerb.parking:
        # Places every 5.5 to 7 m; in the rows here 6 m.
        for place in range(4):
            s = start + 3.0 + 6.0 * place + draw.uniform(-0.25, 0.25)
            if draw.random() < parked_share:
                yaw_rad = draw.normal(0.0, 0.02) + (math.pi if side > 0 else 0.0)
                at = (s, side * (kerb.edge_m - 1.05 + draw.normal(0, 0.06)))
                builder.body(parked_vehicle(draw), at, yaw_rad, builder.new_instance())
    by_kerb = side * (kerb.edge_m + 0.45)
    # A lamp every 20 to 40 m, on the left and on the right in turn.
    if (builder.section.block + (side > 0)) % 2 == 0 or draw.random() < 0.15:
        thick_m = draw.uniform(0.12, 0.24)
        at = (start + draw.uniform(4, 20), by_kerb)
        look = (Semantic.POLE, Material.CONCRETE, 0.15)
        size = (thick_m, thick_m, draw.uniform(5, 9))
        builder.solid(Shape.CYLINDER, at, size, *look, builder.new_instance())
    if draw.random() < 0.18:
        at = (start + draw.uniform(0, BLOCK_M), by_kerb)
        post = (Semantic.POLE, Material.PAINT, 0.15)
        builder.solid(Shape.CYLINDER, at, (0.07, 0.07, 2.9), *post, builder.new_instance())
        sheet = (Semantic.SIGN, Material.RETROREFLECTOR, 0.9)
        # On the side of the post that drivers see first.
        at = (at[0] + side * 0.06, by_kerb)
        builder.solid(Shape.BOX, at, (0.03, 0.65, 0.65), *sheet, builder.new_instance(), 2.15)
    if draw.random() < tree_share:
        for s in (start + draw.uniform(2, 9), start + draw.uniform(13, 21)):
            _tree(builder, draw, s, side * (kerb.edge_m + 0.9), False)
    if kerb.pavement_m and draw.random() < 0.12:
        at = (start + draw.uniform(1, 23), side * (kerb.edge_m + 0.3))
        builder.body(bicycle(draw), at, draw.normal(0, 0.1), builder.new_instance())
    if kerb.pavement_m and draw.random() < 0.15:
        at = (start + draw.uniform(0, BLOCK_M), side * (kerb.edge_m + 0.5))
        builder.body(person(draw), at, draw.uniform(0, 2 * math.pi), builder.new_instance())


def build_side_street(builder: Builder, draw: Generator, side: float) -> None:
    """Houses, parked cars and gardens along the opening of a side street, and its end."""
    start = builder.section.block * BLOCK_M
    edge_m = builder.course.kerb(side).edge_m + max(builder.course.kerb(side).pavement_m, 1.2)
    middle = start + BLOCK_M / 2
    town = draw.random() < builder.course.character.districts[0]
    for along in (-1.0, 1.0):
        wide = 5.5 if town else 4.0
        s = middle + along * (BLOCK_M - wide) / 2
        for house in range(2):
            front_m = edge_m + 19.0 * house + (0.3 if town else draw.uniform(2.5, 6.0))
            size = (wide, 18.5 if town else draw.uniform(9, 13), draw.uniform(5, 14))
            _building(builder, draw, s, front_m, side, size)
        if not town and draw.random() < 0.7:
            _bush(builder, draw, middle + along * 6.5, side * (edge_m + draw.uniform(2, 40)))
    for place in range(4):
        if draw.random() < 0.35:
            at = (middle - 3.6, side * (edge_m + 7 + 6.0 * place))
            yaw_rad = draw.choice((-1, 1)) * math.pi / 2
            builder.body(parked_vehicle(draw), at, yaw_rad, builder.new_instance())
    if draw.random() < 0.4:
        _behind(builder, draw, start, side * (edge_m + 56), 0.4)

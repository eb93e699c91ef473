"""Front gardens and verges: hedges, fences, walls and gates, shrubs, flower beds, tall grass.

Borders run along the street at one lateral distance between two values of s.
"""

from __future__ import annotations

import math

from numpy.random import Generator

from lidarsim.scene import Interval, Material, Semantic, Shape
from lidarsim.street.builder import FOOTING_M, Builder, Strip
from lidarsim.street.course import BLOCK_M
from lidarsim.street.trees import LEAVES, clump, garden_tree, grass, tuft

# A clipped hedge stops a beam within a decimetre, as in real scans; a free one within two or three.
_CLIPPED_PER_M, _FREE_PER_M = (5.5, 9.5), (2.1, 5.3)
# Openings for people and for cars.
_PATH_M, _DRIVE_M = (0.9, 1.3), (2.7, 3.4)
# Square metres of a front garden per plant, and its largest number of plants.
_PLANT_M2, _MOST_PLANTS = 4.0, 20
_TUFT_M2, _MOST_TUFTS = 8.0, 10
_WALL_M, _PILLAR_M = 0.22, 0.4
# Longer borders belong to two neighbours.
_PROPERTY_M = 18.0


def border(builder: Builder, draw: Generator, lateral: float, first: float, last: float) -> None:
    """A hedge, a fence or a low wall between two values of s, mostly with a gate or a gap."""
    if last - first > _PROPERTY_M:
        middle = first + (last - first) * draw.uniform(0.35, 0.65)
        border(builder, draw, lateral, first, middle)
        border(builder, draw, lateral, middle, last)
        return
    kind = draw.random()
    build = hedge if kind < 0.5 else fence if kind < 0.75 else garden_wall
    wide_m = draw.uniform(*(_PATH_M if draw.random() < 0.7 else _DRIVE_M))
    if last - first < wide_m + 3.0 or draw.random() < 0.25:
        build(builder, draw, lateral, first, last)
        return
    open_s = draw.uniform(first + 1.0, last - wide_m - 1.0)
    build(builder, draw, lateral, first, open_s)
    build(builder, draw, lateral, open_s + wide_m, last)
    if draw.random() < 0.6:
        gate(builder, draw, lateral, open_s, open_s + wide_m)


def hedge(builder: Builder, draw: Generator, lateral: float, first: float, last: float) -> None:
    """A clipped hedge in steps, or a free one of bulges, 0.7 to 2.2 m high, with gaps now and then.

    Heights: knee-high edgings are flower beds; the law of many places asks for 2 m at most.
    """
    instance, tall_m = builder.new_instance(), draw.uniform(0.7, 2.0)
    wide_m, clipped = draw.uniform(0.4, 0.9), draw.random() < 0.6
    if not clipped:
        size = (last - first, wide_m, 0.55 * tall_m)
        at = ((first + last) / 2, lateral)
        _leafy_box(builder, draw, at, size, instance, _FREE_PER_M)
    s = first
    while s < last - 0.4:
        long_m = min(draw.uniform(2.0, 7.0) if clipped else draw.uniform(1.4, 3.0), last - s)
        across_m, high_m = wide_m * draw.uniform(0.85, 1.15), tall_m * draw.uniform(0.88, 1.12)
        at = (s + long_m / 2, lateral + draw.normal(0, 0.03))
        if clipped:
            _leafy_box(builder, draw, at, (long_m, across_m, high_m), instance, _CLIPPED_PER_M)
        else:
            bulge = (
                1.25 * long_m,
                across_m * draw.uniform(1.1, 1.6),
                high_m * draw.uniform(1, 1.3),
            )
            builder.solid(
                Shape.ELLIPSOID, at, bulge, Semantic.VEGETATION, Material.FOLIAGE, LEAVES,
                instance, -0.15 * high_m, draw.normal(0, 0.2), False, draw.uniform(*_FREE_PER_M),
            )  # fmt: skip
        s += long_m
        if draw.random() < 0.15:
            s += draw.uniform(0.3, 0.8)


def _leafy_box(
    builder: Builder,
    draw: Generator,
    at: tuple[float, float],
    size: tuple[float, float, float],
    instance: int,
    per_m: Interval,
) -> None:
    builder.solid(
        Shape.BOX, at, (size[0], size[1], size[2] + 0.1), Semantic.VEGETATION, Material.FOLIAGE,
        LEAVES, instance, -0.1, 0.0, True, draw.uniform(*per_m),
    )  # fmt: skip


def fence(builder: Builder, draw: Generator, lateral: float, first: float, last: float) -> None:
    """A fence of pickets, railings, wire mesh, boards or rails, now and then overgrown."""
    kinds = (_pickets, _railings, _mesh, _boards, _rails)
    kind = kinds[int(draw.choice(len(kinds), p=(0.15, 0.15, 0.2, 0.35, 0.15)))]
    kind(builder, draw, lateral, first, last)
    if draw.random() < 0.25:
        for _ in range(int(draw.integers(1, 4))):
            size = (draw.uniform(0.8, 2.5), draw.uniform(0.3, 0.6), draw.uniform(0.6, 1.6))
            at = (draw.uniform(first, last), lateral)
            builder.solid(
                Shape.ELLIPSOID, at, size, Semantic.VEGETATION, Material.FOLIAGE, LEAVES,
                builder.new_instance(), -0.1, 0.0, False, draw.uniform(*_FREE_PER_M),
            )  # fmt: skip


def _strip(
    builder: Builder,
    look: tuple[Semantic, Material, float],
    lateral: float,
    along: Interval,
    heights: Interval,
    thick_m: float,
    instance: int,
    slats: tuple[float, float] = (0.0, 1.0),
    extinction_per_m: float = 0.0,
    detail: bool = False,
) -> None:
    """A thin upright box along the street between two heights."""
    size = (along[1] - along[0], thick_m, heights[1] - heights[0])
    at = (sum(along) / 2, lateral)
    builder.solid(
        Shape.BOX, at, size, *look, instance, heights[0], 0.0, True, extinction_per_m, detail, slats
    )


def _posts(
    builder: Builder,
    look: tuple[Semantic, Material, float],
    lateral: float,
    along: Interval,
    tall_m: float,
    instance: int,
    post_m: float = 0.08,
    apart_m: float = 2.3,
) -> None:
    """Posts at even distances: one solid, of which only slats as wide as a post are there."""
    num_gaps = max(round((along[1] - along[0]) / apart_m), 1)
    pitch_m = (along[1] - along[0] - post_m) / num_gaps
    slats = (pitch_m, post_m / pitch_m)
    _strip(builder, look, lateral, along, (-0.1, tall_m), post_m, instance, slats)


def _pickets(builder: Builder, draw: Generator, lateral: float, first: float, last: float) -> None:
    """Upright boards with gaps, 0.8 to 1.2 m high."""
    look = (Semantic.FENCE, Material.WOOD, draw.uniform(0.12, 0.3))
    instance, tall_m = builder.new_instance(), draw.uniform(0.8, 1.25)
    pickets = (draw.uniform(0.11, 0.16), draw.uniform(0.5, 0.75))
    along = (first, last)
    _strip(builder, look, lateral, along, (0.05, tall_m), 0.03, instance, pickets)
    rail_m = (0.7 * tall_m, 0.7 * tall_m + 0.08)
    _strip(builder, look, lateral, along, rail_m, 0.06, instance, detail=True)
    _posts(builder, look, lateral, along, tall_m, instance)


def _railings(builder: Builder, draw: Generator, lateral: float, first: float, last: float) -> None:
    """Iron bars every 11 to 13 cm, the law's limit for children's heads, on a low kerb of stone."""
    look = (Semantic.FENCE, Material.PAINT, draw.uniform(0.06, 0.2))
    instance, tall_m, along = builder.new_instance(), draw.uniform(0.9, 1.6), (first, last)
    base_m = draw.choice((0.05, 0.25, 0.4))
    bars = (draw.uniform(0.11, 0.13), draw.uniform(0.13, 0.22))
    _strip(builder, look, lateral, along, (base_m, tall_m), 0.025, instance, bars)
    _posts(builder, look, lateral, along, tall_m, instance)
    if base_m > 0.1:
        stone = (Semantic.WALL, Material.CONCRETE, 0.18)
        heights = (-0.1, base_m)
        _strip(builder, stone, lateral, along, heights, 0.2, builder.new_instance())


def _mesh(builder: Builder, draw: Generator, lateral: float, first: float, last: float) -> None:
    """Wire mesh, of which a beam meets a wire now and then, between thin posts."""
    look = (Semantic.FENCE, Material.PAINT, 0.14)
    instance, tall_m, along = builder.new_instance(), draw.uniform(0.9, 1.8), (first, last)
    wires_per_m = draw.uniform(1.0, 3.0)
    heights = (0.03, tall_m)
    _strip(builder, look, lateral, along, heights, 0.05, instance, extinction_per_m=wires_per_m)
    _posts(builder, look, lateral, along, tall_m, instance, post_m=0.06, apart_m=2.5)


def _boards(builder: Builder, draw: Generator, lateral: float, first: float, last: float) -> None:
    """Panels of boards 1.4 to 1.9 m high between posts that leave a gap now and then."""
    look = (Semantic.FENCE, Material.WOOD, draw.uniform(0.12, 0.25))
    instance, s = builder.new_instance(), first
    tall_m, panel_m = draw.uniform(1.3, 1.9), draw.uniform(1.7, 2.1)
    boards = (0.0, 1.0) if draw.random() < 0.6 else (draw.uniform(0.12, 0.2), 0.88)
    while s < last - 0.5:
        # Two or three panels of one height.
        run_m = min(panel_m * int(draw.integers(2, 4)), last - s)
        heights = (0.05, tall_m + draw.normal(0, 0.08))
        _strip(builder, look, lateral, (s, s + run_m), heights, 0.04, instance, boards)
        s += run_m + (draw.uniform(0.1, 0.5) if draw.random() < 0.1 else 0.0)
    _posts(builder, look, lateral, (first, last), tall_m + 0.1, instance, 0.1, panel_m)


def _rails(builder: Builder, draw: Generator, lateral: float, first: float, last: float) -> None:
    """Two rails between posts, as around paddocks."""
    look = (Semantic.FENCE, Material.WOOD, 0.17)
    instance, tall_m, along = builder.new_instance(), draw.uniform(0.9, 1.3), (first, last)
    for height in (0.45, 0.95):
        rail_m = (height * tall_m - 0.12, height * tall_m)
        _strip(builder, look, lateral, along, rail_m, 0.05, instance)
    _posts(builder, look, lateral, along, tall_m, instance, 0.12, 2.5)


def garden_wall(
    builder: Builder, draw: Generator, lateral: float, first: float, last: float
) -> None:
    """A wall of 0.4 to 1.6 m, half of them with pillars, low ones with bars or plants above."""
    look = (Semantic.WALL, Material.BRICK, draw.uniform(0.12, 0.2))
    instance, tall_m, along = builder.new_instance(), draw.uniform(0.35, 1.5), (first, last)
    _strip(builder, look, lateral, along, (-0.1, tall_m), _WALL_M, instance)
    top_m = tall_m
    if tall_m < 0.8 and draw.random() < 0.7:
        top_m = tall_m + draw.uniform(0.4, 0.9)
        if draw.random() < 0.5:
            bars = (Semantic.FENCE, Material.PAINT, 0.12)
            slats, heights = (0.12, draw.uniform(0.15, 0.5)), (tall_m, top_m)
            _strip(builder, bars, lateral, along, heights, 0.03, builder.new_instance(), slats)
        else:
            behind = lateral + math.copysign(0.45, lateral)
            hedge(builder, draw, behind, first, last)
    if draw.random() < 0.5:
        pillar_m = top_m + draw.uniform(0.1, 0.3)
        _posts(builder, look, lateral, along, pillar_m, instance, _PILLAR_M, 3.0)


def gate(builder: Builder, draw: Generator, lateral: float, first: float, last: float) -> None:
    """A gate between two posts: of bars or closed, one leaf or two, shut or open inwards."""
    wood = draw.random() < 0.5
    look = (Semantic.GATE, Material.WOOD if wood else Material.PAINT, draw.uniform(0.1, 0.25))
    bars = (0.12, draw.uniform(0.5, 0.8) if wood else draw.uniform(0.15, 0.3))
    slats = (0.0, 1.0) if draw.random() < 0.2 else bars
    tall_m, instance = draw.uniform(0.9, 1.6), builder.new_instance()
    leaves = 1 if last - first < 2.0 else 2
    leaf_m = (last - first) / leaves
    inwards = math.copysign(1.0, lateral)
    for leaf in range(leaves):
        hinge = first if leaf == 0 else last
        towards = 1.0 if leaf == 0 else -1.0
        open_rad = draw.uniform(0.9, 1.6) if draw.random() < 0.35 else 0.0
        along = towards * leaf_m / 2 * math.cos(open_rad)
        at = (hinge + along, lateral + inwards * leaf_m / 2 * math.sin(open_rad))
        yaw_rad = towards * inwards * open_rad
        builder.solid(
            Shape.BOX, at, (leaf_m, 0.05, tall_m - 0.06), *look, instance, 0.06, yaw_rad, True,
            0.0, False, slats,
        )  # fmt: skip
    for s in (first, last):
        thick_m = draw.uniform(0.1, 0.3)
        size = (thick_m, thick_m, tall_m + 0.2 + FOOTING_M)
        post = (Semantic.GATE, Material.CONCRETE, 0.17)
        builder.solid(Shape.BOX, (s, lateral), size, *post, instance, -FOOTING_M, detail=True)


def shrub(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A shrub: clipped, upright, sprawling, or a loose one of several clumps, 0.4 to 2.6 m high."""
    instance, habit = builder.new_instance(), draw.random()
    if habit < 0.15:
        wide_m = draw.uniform(0.5, 1.3)
        size = (wide_m, wide_m, wide_m * draw.uniform(0.9, 1.2))
        clump(builder, draw, (s, lateral), size, -0.1 * wide_m, instance, _CLIPPED_PER_M)
        return
    if habit < 0.3:
        wide_m, high_m = draw.uniform(0.4, 0.9), draw.uniform(1.0, 2.4)
        size = (wide_m, wide_m, 1.3 * high_m)
        clump(builder, draw, (s, lateral), size, -0.3 * high_m, instance, _CLIPPED_PER_M)
        return
    low = habit < 0.5
    wide_m = draw.uniform(0.9, 2.2)
    high_m = draw.uniform(0.3, 0.7) if low else draw.uniform(0.7, 2.2)
    for number in range(int(draw.integers(2, 5))):
        place = (s, lateral)
        scale = 1.0
        if number:
            spread_m = (0.9 if low else 0.6) * wide_m
            along = s + draw.uniform(-spread_m, spread_m)
            place = (along, lateral + draw.uniform(-spread_m, spread_m))
            scale = draw.uniform(0.4, 0.9)
        across_m, up_m = wide_m * scale, high_m * scale * draw.uniform(0.9, 1.2)
        size = (across_m, across_m * draw.uniform(0.7, 1.0), 1.4 * up_m)
        clump(builder, draw, place, size, -0.4 * up_m, instance, _FREE_PER_M, detail=number > 0)


def flower_bed(builder: Builder, draw: Generator, s: float, lateral: float, long_m: float) -> None:
    """A bed along the street: a low layer of leaves, and taller plants here and there."""
    instance, deep_m = builder.new_instance(), draw.uniform(0.5, 1.2)
    size = (long_m, deep_m, draw.uniform(0.15, 0.4))
    _leafy_box(builder, draw, (s, lateral), size, instance, _FREE_PER_M)
    for _ in range(min(int(draw.poisson(0.8 * long_m)), 6)):
        wide_m = draw.uniform(0.2, 0.5)
        plant_m = (wide_m, wide_m, draw.uniform(0.4, 1.1))
        at = (s + draw.uniform(-0.5, 0.5) * long_m, lateral + draw.uniform(-0.4, 0.4) * deep_m)
        clump(builder, draw, at, plant_m, -0.05, instance, _FREE_PER_M, detail=True)


def _pot(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A tub of 0.3 to 0.6 m with a plant in it."""
    wide_m, tall_m = draw.uniform(0.3, 0.6), draw.uniform(0.25, 0.6)
    clay = (Semantic.UNKNOWN_OBJECT, Material.BRICK, 0.18)
    size = (wide_m, wide_m, tall_m + 0.1)
    instance = builder.new_instance()
    builder.solid(Shape.CYLINDER, (s, lateral), size, *clay, instance, -0.1, detail=True)
    leaves_m = (1.5 * wide_m, 1.5 * wide_m, draw.uniform(0.4, 1.2))
    instance = builder.new_instance()
    clump(builder, draw, (s, lateral), leaves_m, tall_m - 0.1, instance, _FREE_PER_M, detail=True)


def _furniture(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A table of 0.75 m and two chairs of 0.9 m, on legs."""
    look = (Semantic.UNKNOWN_OBJECT, Material.WOOD, draw.uniform(0.12, 0.3))
    instance, yaw_rad = builder.new_instance(), draw.uniform(0, math.pi)
    wide_m = draw.uniform(0.7, 1.2)
    top_m = (1.3 * wide_m, wide_m, 0.05)
    builder.solid(Shape.BOX, (s, lateral), top_m, *look, instance, 0.7, yaw_rad, detail=True)
    leg_m = (0.15, 0.15, 0.8)
    builder.solid(Shape.CYLINDER, (s, lateral), leg_m, *look, instance, -0.1, detail=True)
    for sign in (-1.0, 1.0):
        out_m = sign * (0.65 * wide_m + 0.35)
        at = (s + out_m * math.cos(yaw_rad), lateral + out_m * math.sin(yaw_rad))
        seat_m, back_m = (0.45, 0.45, 0.45), (0.05, 0.45, 0.55)
        builder.solid(Shape.BOX, at, seat_m, *look, instance, 0.0, yaw_rad, detail=True)
        out_m += sign * 0.22
        at = (s + out_m * math.cos(yaw_rad), lateral + out_m * math.sin(yaw_rad))
        builder.solid(Shape.BOX, at, back_m, *look, instance, 0.4, yaw_rad, detail=True)


def _plant(builder: Builder, draw: Generator, s: float, lateral: float, room_m: float) -> None:
    """What stands at a place of a garden: a shrub, a bed, a tree where there is room, a pot."""
    kind = draw.random()
    if kind < 0.55:
        shrub(builder, draw, s, lateral)
    elif kind < 0.75:
        flower_bed(builder, draw, s, lateral, draw.uniform(1.0, 3.5))
    elif kind < 0.9 and room_m > 3.0:
        garden_tree(builder, draw, s, lateral)
    elif kind < 0.97:
        _pot(builder, draw, s, lateral)
    elif room_m > 4.0:
        _furniture(builder, draw, s, lateral)


def front_garden(builder: Builder, draw: Generator, strip: Strip) -> None:
    """Plants, a path and sometimes furniture between the pavement and the front of a house.

    The path to the door keeps clear of plants.
    """
    side, first, last, near_m, far_m = strip
    room_m = far_m - near_m
    path_s, half_m = draw.uniform(0.2, 0.8) * (last - first) + first, draw.uniform(0.5, 0.8)
    start = builder.section.block * BLOCK_M
    along = (path_s - half_m - start, path_s + half_m - start)
    paving = (Semantic.SIDEWALK, Material.PAVING, draw.uniform(0.15, 0.22))
    builder.slab(along, (side * near_m, side * far_m), *paving, sunk_m=-0.02)
    wanted = draw.poisson((last - first) * room_m / _PLANT_M2)
    for _ in range(min(int(wanted), _MOST_PLANTS)):
        s = draw.uniform(first + 0.5, last - 0.5)
        # Along the house and along the border rather than on the lawn between.
        share = draw.beta(0.6, 0.6)
        if abs(s - path_s) > half_m + 0.8:
            at = side * (near_m + 1.1 + share * max(room_m - 1.8, 0.0))
            _plant(builder, draw, s, at, room_m)


def verge(builder: Builder, draw: Generator, strip: Strip) -> None:
    """Tall grass with tufts and single tall weeds."""
    side, first, last, near_m, far_m = strip
    deep_m = draw.uniform(0.05, 0.14)
    across = (side * near_m, side * far_m)
    grass(builder, (first, last), across, deep_m, draw.uniform(1.2, 3.0))
    wanted = draw.poisson((last - first) * (far_m - near_m) / _TUFT_M2)
    for _ in range(min(int(wanted), _MOST_TUFTS)):
        s, lateral = draw.uniform(first, last), side * draw.uniform(near_m, far_m)
        if draw.random() < 0.7:
            tuft(builder, draw, s, lateral, draw.uniform(0.2, 0.65))
        else:
            weed_m = (0.25, 0.25, draw.uniform(0.5, 1.3))
            instance = builder.new_instance()
            clump(builder, draw, (s, lateral), weed_m, -0.1, instance, _FREE_PER_M, detail=True)

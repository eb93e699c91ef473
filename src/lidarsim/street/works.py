"""Building sites and scaffolding."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from lidarsim.scene import Material, Semantic, Shape
from lidarsim.street.builder import Builder, Strip
from lidarsim.street.buildings import Front

# Site fences: panels of mesh of 3.5 m x 2.0 m on feet of concrete; a panel holds up about every
# fourth beam: 6 cm of it, with this chance per metre.
_PANEL_M, _PANEL_TALL_M, _PANEL_DEEP_M, _MESH_PER_M = 3.5, 2.0, 0.06, 5.0
_FOOT_M = (0.7, 0.23, 0.15)
# Barriers: boards 0.25 m high at 0.75 to 1.0 m (German rules for works at roads), on posts.
_BOARD_M, _BOARD_HIGH_M = 0.25, 0.78
_CONE_M = (0.28, 0.75)
# Skips of 5 to 10 cubic metres, and site huts, which have the size of half a sea container.
_SKIP_M, _HUT_M = ((3.2, 4.2), (1.7, 1.9), (1.2, 1.7)), (4.5, 2.45, 2.6)
# Scaffolds (EN 12810): bays of 2.57 m, storeys of 2.0 m, 0.73 m deep, tubes of 48 mm.
_BAY_M, _STOREY_M, _DECK_M, _TUBE_M = 2.57, 2.0, 0.73, 0.06
_NET_PER_M = 25.0

_STEEL = (Material.PAINT, 0.15)


def building_site(builder: Builder, draw: Generator, strip: Strip) -> None:
    """A plot of works.

    A fence of mesh or a row of barriers with cones along the road; behind it heaps, pallets, a skip
    or a hut, sometimes a digger. Cones stand up to 0.8 m outside of the barriers.
    """
    side, first, last, near_m, far_m = strip
    middle_m = (near_m + far_m) / 2
    if draw.random() < 0.6:
        _mesh_fence(builder, draw, strip)
    else:
        _barriers(builder, draw, strip)
    deep_m = far_m - near_m
    places = list(np.arange(first + 3.3, last - 3.2, 5.0))
    draw.shuffle(places)
    for kind, s in enumerate(places):
        at = (float(s), side * (middle_m + draw.uniform(-0.1, 0.1) * deep_m))
        if kind == 0 and deep_m > 4.0 and draw.random() < 0.5:
            _digger(builder, draw, *at)
        elif draw.random() < 0.3:
            _container(builder, draw, *at)
        else:
            _heap(builder, draw, *at, min(0.6 * deep_m, 4.0))
            _pallets(builder, draw, at[0] + draw.uniform(-1.5, 1.5), side * (near_m + 0.8))


def scaffolding(builder: Builder, draw: Generator, front: Front, height_m: float) -> None:
    """A scaffold before a facade: two rows of standards, decks, rails.

    One in three has a net before it, from the first deck up.
    """
    side, first, last, front_m = front
    instance = builder.new_instance()
    tube = (Semantic.UNKNOWN_CONSTRUCTION, *_STEEL, instance)
    bays = max(1, int((last - first) / _BAY_M))
    long_m, s = bays * _BAY_M + _TUBE_M, (first + last) / 2
    inner, outer = side * (front_m - 0.25), side * (front_m - 0.25 - _DECK_M)
    standards = (_BAY_M, _TUBE_M / _BAY_M)
    for lateral in (inner, outer):
        size = (long_m, _TUBE_M, height_m)
        builder.solid(Shape.BOX, (s, lateral), size, *tube, slats=standards)
    deck = (Semantic.UNKNOWN_CONSTRUCTION, Material.WOOD, 0.14, instance)
    for up in np.arange(_STOREY_M, height_m - 0.5, _STOREY_M):
        size = (long_m, _DECK_M, 0.08)
        builder.solid(Shape.BOX, (s, (inner + outer) / 2), size, *deck, float(up))
        rail_m = (long_m, _TUBE_M, _TUBE_M)
        builder.solid(Shape.BOX, (s, outer), rail_m, *tube, float(up) + 1.0, detail=True)
    # A ladder to the first deck: two uprights.
    at = (first + draw.uniform(0.2, 0.8) * (last - first), (inner + outer) / 2)
    builder.solid(Shape.BOX, at, (0.4, 0.08, _STOREY_M), *tube, detail=True, slats=(0.34, 0.18))
    if draw.random() < 0.33 and height_m > _STOREY_M + 1.0:
        net = (Semantic.UNKNOWN_CONSTRUCTION, Material.CLOTH, 0.15, instance)
        size = (long_m, 0.05, height_m - _STOREY_M)
        at = (s, outer - side * 0.1)
        builder.solid(Shape.BOX, at, size, *net, _STOREY_M, extinction_per_m=_NET_PER_M)


def _mesh_fence(builder: Builder, draw: Generator, strip: Strip) -> None:
    """Panels of mesh between posts, not quite in line, one of them sometimes open."""
    side, first, last, near_m, _ = strip
    for s in np.arange(first + _PANEL_M / 2, last - _PANEL_M / 2 + 0.1, _PANEL_M):
        instance = builder.new_instance()
        at = (float(s), side * near_m + draw.normal(0, 0.1))
        yaw_rad = draw.normal(0, 0.05)
        if draw.random() < 0.1:
            at = (at[0], at[1] + side * 1.7)
            yaw_rad = draw.choice((-1, 1)) * draw.uniform(0.5, 1.2)
        metal = (Semantic.FENCE, *_STEEL, instance)
        size = (_PANEL_M, _PANEL_DEEP_M, _PANEL_TALL_M - 0.15)
        builder.solid(Shape.BOX, at, size, *metal, 0.15, yaw_rad, extinction_per_m=_MESH_PER_M)
        size, slats = (_PANEL_M, 0.05, _PANEL_TALL_M), (_PANEL_M - 0.05, 0.05 / (_PANEL_M - 0.05))
        builder.solid(Shape.BOX, at, size, *metal, 0.0, yaw_rad, slats=slats)
        foot_at = (float(s) - _PANEL_M / 2, at[1])
        concrete = (Semantic.FENCE, Material.CONCRETE, 0.18, instance)
        size = (_FOOT_M[1], _FOOT_M[0], _FOOT_M[2])
        builder.solid(Shape.BOX, foot_at, size, *concrete, detail=True)


def _barriers(builder: Builder, draw: Generator, strip: Strip) -> None:
    """Boards on posts along the road with cones before them."""
    side, first, last, near_m, _ = strip
    for s in np.arange(first + 1.1, last - 1.0, 2.2):
        instance = builder.new_instance()
        lateral = side * near_m + draw.normal(0, 0.05)
        look = (Semantic.FENCE, *_STEEL, instance)
        board_m, at = (2.0, 0.04, _BOARD_M), (float(s), lateral)
        yaw_rad = draw.normal(0, 0.04)
        builder.solid(Shape.BOX, at, board_m, *look, _BOARD_HIGH_M, yaw_rad)
        # Two posts, each with a foot, as one slatted box.
        post_m, slats = (1.7, 0.06, _BOARD_HIGH_M), (1.64, 0.06 / 1.64)
        builder.solid(Shape.BOX, at, post_m, *look, 0.0, yaw_rad, slats=slats)
        if draw.random() < 0.3:
            _cone(builder, float(s) + 0.6, lateral - side * 0.6)


def _cone(builder: Builder, s: float, lateral: float) -> None:
    """A traffic cone: a foot, and an ellipsoid whose lower half is in the ground."""
    wide_m, tall_m = _CONE_M
    look = (Semantic.UNKNOWN_OBJECT, Material.PAINT, 0.2, builder.new_instance())
    size = (wide_m, wide_m, 2 * tall_m)
    builder.solid(Shape.ELLIPSOID, (s, lateral), size, *look, -tall_m)


def _heap(builder: Builder, draw: Generator, s: float, lateral: float, wide_m: float) -> None:
    """A heap of earth, sand or rubble: ellipsoids whose lower halves are in the ground."""
    look = (Semantic.TERRAIN, Material.SOIL, draw.uniform(0.15, 0.22))
    for _ in range(int(draw.integers(1, 4))):
        broad_m = wide_m * draw.uniform(0.4, 0.9)
        tall_m = broad_m * draw.uniform(0.25, 0.45)  # an angle of repose of 30 to 40 degrees
        at = (s + draw.normal(0, 0.6), lateral + draw.normal(0, 0.2))
        size = (broad_m * draw.uniform(0.8, 1.4), broad_m, 2 * tall_m)
        builder.solid(Shape.ELLIPSOID, at, size, *look, 0, -tall_m, draw.uniform(0, math.pi))


def _pallets(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """Stacked stones, bags or boards on a pallet of 1.2 m x 0.8 m."""
    look = (Semantic.UNKNOWN_CONSTRUCTION, Material.CONCRETE, draw.uniform(0.12, 0.22))
    size = (1.2, 0.8, draw.uniform(0.3, 1.2))
    yaw_rad = draw.uniform(-0.3, 0.3)
    builder.solid(Shape.BOX, (s, lateral), size, *look, builder.new_instance(), 0.0, yaw_rad)


def _container(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A skip, open above and full, or a site hut."""
    instance = builder.new_instance()
    paint = draw.uniform(0.08, 0.22)
    yaw_rad = draw.normal(0, 0.06)
    if draw.random() < 0.35:
        hut = (Semantic.UNKNOWN_CONSTRUCTION, Material.PAINT, paint, instance)
        builder.solid(Shape.BOX, (s, lateral), _HUT_M, *hut, 0.1, yaw_rad)
        return
    long_m, wide_m, tall_m = (draw.uniform(*interval) for interval in _SKIP_M)
    skip = (Semantic.UNKNOWN_CONSTRUCTION, Material.PAINT, paint, instance)
    # Its ends rise outwards: two boxes, the lower one shorter.
    builder.solid(Shape.BOX, (s, lateral), (0.75 * long_m, wide_m, tall_m), *skip, 0.0, yaw_rad)
    builder.solid(
        Shape.BOX, (s, lateral), (long_m, wide_m, 0.6 * tall_m), *skip, 0.4 * tall_m, yaw_rad
    )
    rubble = (Semantic.UNKNOWN_CONSTRUCTION, Material.CONCRETE, 0.18, instance)
    size = (0.6 * long_m, 0.8 * wide_m, 2 * draw.uniform(0.15, 0.5))
    builder.solid(Shape.ELLIPSOID, (s, lateral), size, *rubble, tall_m - size[2] / 2, yaw_rad)


def _digger(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A small excavator of 5 to 8 t: tracks, a house with a cab, boom, stick and bucket."""
    look = (Semantic.TRUCK, Material.PAINT, draw.uniform(0.1, 0.25), builder.new_instance())
    yaw_rad = draw.uniform(-0.4, 0.4) + draw.choice((0.0, math.pi))
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)

    def part(ahead_m: float, left_m: float, size: tuple[float, float, float], up: float) -> None:
        at = (s + ahead_m * cosine - left_m * sine, lateral + ahead_m * sine + left_m * cosine)
        builder.solid(Shape.BOX, at, size, *look, up, yaw_rad)

    for aside in (-0.75, 0.75):
        part(0.0, aside, (2.4, 0.45, 0.7), 0.0)
    part(-0.3, 0.0, (2.0, 1.8, 0.9), 0.75)
    part(0.3, 0.5, (1.1, 0.8, 1.0), 1.6)
    # The boom rises before the cab, the stick falls to the bucket on the ground.
    part(1.1, -0.2, (1.2, 0.3, 0.4), 1.7)
    part(2.1, -0.2, (1.2, 0.3, 0.35), 2.1)
    part(2.8, -0.2, (0.35, 0.25, 2.0), 0.4)
    part(2.7, -0.2, (0.7, 0.8, 0.6), 0.0)

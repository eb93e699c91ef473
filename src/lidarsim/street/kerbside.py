"""Kerbside: parked cars, lamps, signs, street trees, people and clutter on the pavement."""

from __future__ import annotations

import math

from numpy.random import Generator

from lidarsim.scene import Material, Semantic, Shape
from lidarsim.street.builder import Builder
from lidarsim.street.course import BLOCK_M, PARKING_M
from lidarsim.street.furniture import (
    bicycles,
    bins,
    bollards,
    bus_stop,
    cabinet,
    clutter,
    power_pole,
    sign,
    street_lamp,
    traffic_light,
)
from lidarsim.street.people import group
from lidarsim.street.trees import street_tree
from lidarsim.street.vehicles import motorcycle, parked_vehicle

# Limits of a district's chance of a tree at each place along the kerb.
_STREET_TREES = (0.4, 0.9)
# Places for parked cars, every 5.5 to 7 m; in the rows here 6 m.
_PARKING_PLACE_M = 6.0
# From the kerb, metres: posts and lamps, the nearest clutter, and trees. Half a thing of clutter.
_POST_M, _CLUTTER_M, _TREE_M, _HALF_M = 0.38, 0.3, 0.6, 0.35
# Length and width of a traffic island, and its distance from a side street's middle: before the
# crossing. Reflectivity of its kerbstones.
_ISLAND_M, _TO_CROSSING_M, _KERBSTONE = (3.0, 0.7), 7.5, 0.18


def build_kerbside(builder: Builder, draw: Generator, side: float, district: Generator) -> None:
    """Everything along one side of a block; ``district`` is drawn for several blocks."""
    kerb, character = builder.course.kerb(side), builder.course.character
    start = builder.section.block * BLOCK_M
    parked_share = district.uniform(*character.parked)
    tree_share = district.uniform(*_STREET_TREES)
    if kerb.parking:
        _parked_row(builder, draw, side, parked_share)
    by_kerb = side * (kerb.edge_m + _POST_M)
    # A lamp every 20 to 40 m, on the left and on the right in turn.
    if (builder.section.block + (side > 0)) % 2 == 0 or draw.random() < 0.15:
        street_lamp(builder, draw, start + draw.uniform(4, 20), by_kerb, side)
    if draw.random() < 0.2:
        sign(builder, draw, start + draw.uniform(0, BLOCK_M), by_kerb, side)
    if draw.random() < tree_share:
        for s in (start + draw.uniform(2, 9), start + draw.uniform(13, 21)):
            street_tree(builder, draw, s, side * (kerb.edge_m + _TREE_M))
    if kerb.pavement_m:
        _pavement(builder, draw, side)
    elif draw.random() < 0.4:
        power_pole(builder, draw, start + draw.uniform(2, 22), side * (kerb.edge_m + 1.0))


def _parked_row(builder: Builder, draw: Generator, side: float, share: float) -> None:
    """Cars parked along the kerb, in the direction of the traffic on their side."""
    start, edge_m = builder.section.block * BLOCK_M, builder.course.kerb(side).edge_m
    oncoming = side > 0 and builder.course.lanes[1] > 0
    for place in range(int(BLOCK_M / _PARKING_PLACE_M)):
        s = start + _PARKING_PLACE_M * (place + 0.5) + draw.uniform(-0.25, 0.25)
        if draw.random() < share:
            yaw_rad = draw.normal(0.0, 0.02) + (math.pi if oncoming else 0.0)
            at = (s, side * (edge_m - PARKING_M / 2 + draw.normal(0, 0.06)))
            builder.body(parked_vehicle(draw), at, yaw_rad, builder.new_instance())


def _pavement(builder: Builder, draw: Generator, side: float) -> None:
    """Clutter and people on the pavement, by how busy the surroundings are."""
    kerb, character = builder.course.kerb(side), builder.course.character
    start = builder.section.block * BLOCK_M
    near_m = kerb.edge_m + _CLUTTER_M
    far_m = max(near_m, builder.course.walkway_m(side)[0] - _HALF_M)

    def somewhere() -> tuple[float, float]:
        """Between kerb and walkway; what yet reaches into the walkway is removed later."""
        return start + draw.uniform(1, BLOCK_M - 1), side * draw.uniform(near_m, far_m)

    for _ in range(int(draw.poisson(character.clutter))):
        clutter(builder, draw, *somewhere())
    if draw.random() < 0.25 * character.clutter:
        bicycles(builder, draw, *somewhere())
    if draw.random() < 0.05 * character.clutter:
        two_wheeler, at = motorcycle(draw), somewhere()
        builder.body(two_wheeler, at, draw.normal(0, 0.3), builder.new_instance())
    if draw.random() < 0.1 * character.clutter:
        first = start + draw.uniform(1, 10)
        bollards(builder, draw, first, first + draw.uniform(4, 12), side * (kerb.edge_m + 0.3))
    if draw.random() < 0.15:
        cabinet(builder, draw, *somewhere())
    if draw.random() < 0.05 and kerb.pavement_m > 2.0:
        bus_stop(builder, draw, start + draw.uniform(5, 19), side * (kerb.edge_m + 1.0), side)
    if draw.random() < character.people:
        group(builder, draw, *somewhere())
    if builder.course.collection_day:
        for s in (start + 4.0, start + 12.0, start + 20.0):
            if draw.random() < 0.7:
                bins(builder, draw, s + draw.uniform(-2, 2), side * (kerb.edge_m + 0.4))


def build_corner(builder: Builder, draw: Generator, side: float) -> None:
    """Signs, lights and bollards at the corners of a side street."""
    kerb = builder.course.kerb(side)
    middle = (builder.section.block + 0.5) * BLOCK_M
    lit = builder.course.character.lights and draw.random() < 0.6
    for corner in (-1.0, 1.0):
        at = (middle + corner * draw.uniform(5.0, 6.5), side * (kerb.edge_m + _POST_M))
        if lit:
            traffic_light(builder, draw, *at, side)
        elif draw.random() < 0.4:
            sign(builder, draw, *at, side)
        if draw.random() < 0.2:
            street_lamp(builder, draw, at[0] + corner, at[1], side)


def build_island(builder: Builder, draw: Generator) -> None:
    """Traffic islands with signs in the median, before and behind a crossing."""
    course = builder.course
    middle = (builder.section.block + 0.5) * BLOCK_M
    stone = (Semantic.SIDEWALK, Material.CONCRETE, _KERBSTONE)
    for s in (middle - _TO_CROSSING_M, middle + _TO_CROSSING_M):
        size = (_ISLAND_M[0], _ISLAND_M[1], course.kerb_m + 0.2)
        builder.solid(Shape.BOX, (s, 0.0), size, *stone, bottom_m=-0.2, inclined=True)
        sign(builder, draw, s, 0.0, -1.0)

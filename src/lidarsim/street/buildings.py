"""Buildings along a street: houses, blocks, garages and sheds.

Only what the beams can meet is built: the highest rises by 2 degrees, so that at 20 m it passes
2.4 m above the ground. Facades have their detail on the ground floor.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from lidarsim.scene import Material, Semantic, Shape
from lidarsim.street.builder import FOOTING_M, Builder, Place
from lidarsim.street.vehicles import DIRT, coat

# Diffuse reflectivity at 905 nm, and the share of brick houses: the rest is plastered.
_BRICK, _PLASTER = (0.11, 0.17), (0.13, 0.22)
_BRICK_SHARE = 0.25
# Width of the parts that a facade is stepped into, and how far a part may stand back.
_PART_M, _STEP_M = (2.8, 6.5), (0.4, 2.6)
# Sill and lintel of the ground floor above the pavement, and the reveal of its windows.
_SILL_M, _LINTEL_M = (0.75, 1.3), (2.1, 2.5)
_REVEAL_M = (0.12, 0.28)
# Clear panes let beams into the room behind; in the other facades curtains or blinds stop them.
_ROOM_M, _SEEN_INTO = (1.0, 3.5), 0.75
# Distance of windows, and the share of it that is wall.
_WINDOW_PITCH_M, _PIER_SHARE = (1.6, 3.0), (0.4, 0.62)
# Share of the windows whose pane is seen; the others have blinds, curtains or dirt.
_PANES = 0.3
# German garages: 3 m x 6 m outside, 2.5 m high.
_GARAGE_M = (3.0, 6.0, 2.5)


class Front(NamedTuple):
    """Where the foremost wall of a building stands.

    ``side``: 1 left of the axis, -1 right. ``first``, ``last``: values of s at its ends.
    ``away_m``: distance from the axis.
    """

    side: float
    first: float
    last: float
    away_m: float

    def at(self, s: float, behind_m: float) -> Place:
        """Place behind the wall; before it, where negative."""
        return s, self.side * (self.away_m + behind_m)

    def moved_back(self, back_m: float) -> Front:
        """Wall of the same ends, farther from the street."""
        return self._replace(away_m=self.away_m + back_m)


class Look(NamedTuple):
    """Class, material and reflectivity of walls, and their instance number."""

    semantic: Semantic
    material: Material
    reflectivity: float
    instance: int


def wall_look(builder: Builder, draw: Generator, semantic: Semantic = Semantic.BUILDING) -> Look:
    """Brick or plaster, as a new object."""
    instance = builder.new_instance()
    if draw.random() < _BRICK_SHARE:
        return Look(semantic, Material.BRICK, draw.uniform(*_BRICK), instance)
    return Look(semantic, Material.CONCRETE, draw.uniform(*_PLASTER), instance)


def building(
    builder: Builder,
    draw: Generator,
    front: Front,
    depth_m: float,
    height_m: float,
    stepped: float = 0.6,
) -> None:
    """A building in parts whose fronts step back, with its details.

    ``stepped``: chance of each part to stand behind the front.
    """
    look = wall_look(builder, draw)
    num_parts = max(1, round((front.last - front.first) / draw.uniform(*_PART_M)))
    borders = np.linspace(front.first, front.last, num_parts + 1)
    borders[1:-1] += draw.uniform(-0.8, 0.8, num_parts - 1)
    for first, last in pairwise(borders.tolist()):
        back_m = draw.uniform(*_STEP_M) if draw.random() < stepped else 0.0
        wall = front._replace(first=first, last=last).moved_back(back_m)
        _part(builder, draw, wall, depth_m - back_m, height_m, look)
    if draw.random() < 0.3:
        _bay(builder, draw, front, look)
    if draw.random() < 0.6:
        _entrance(builder, draw, front, look)
    if draw.random() < 0.5:
        _drainpipe(builder, draw, front, look)


def _part(
    builder: Builder, draw: Generator, wall: Front, depth_m: float, height_m: float, look: Look
) -> None:
    """One part of a facade: a body, and before it a wall whose windows lie behind a reveal."""
    s, wide_m = (wall.first + wall.last) / 2, wall.last - wall.first
    reveal_m = draw.uniform(*(_ROOM_M if draw.random() < _SEEN_INTO else _REVEAL_M))
    inside = wall.moved_back(reveal_m)
    size = (wide_m, depth_m - reveal_m, height_m + FOOTING_M)
    builder.solid(Shape.BOX, inside.at(s, size[1] / 2), size, *look, -FOOTING_M)
    sill_m, lintel_m = draw.uniform(*_SILL_M), draw.uniform(*_LINTEL_M)
    pitch_m, pier_share = draw.uniform(*_WINDOW_PITCH_M), draw.uniform(*_PIER_SHARE)
    piers, windows = (pitch_m, pier_share), (sill_m + FOOTING_M, lintel_m + FOOTING_M)
    at, size = wall.at(s, reveal_m / 2), (wide_m, reveal_m, height_m + FOOTING_M)
    builder.solid(Shape.BOX, at, size, *look, -FOOTING_M, slats=piers, open_m=windows)
    pane_m = ((1 - pier_share) * pitch_m, 0.02, lintel_m - sill_m)
    glass = (look.semantic, Material.GLASS, DIRT, look.instance)
    for window in range(int(wide_m / pitch_m)):
        if draw.random() < _PANES:
            at = inside.at(wall.first + (window + (1 + pier_share) / 2) * pitch_m, -0.02)
            builder.solid(Shape.BOX, at, pane_m, *glass, sill_m, detail=True)


def _bay(builder: Builder, draw: Generator, front: Front, look: Look) -> None:
    """A bay or a porch that stands before the front."""
    size = (draw.uniform(1.2, 3.0), draw.uniform(0.6, 1.4), draw.uniform(2.4, 5.0))
    at = front.at(draw.uniform(front.first, front.last), -0.2)
    builder.solid(Shape.BOX, at, size, *look, -0.2)


def _entrance(builder: Builder, draw: Generator, front: Front, look: Look) -> None:
    """A door with one to four steps before it, sometimes between two posts of a canopy."""
    is_wide = front.last - front.first > 2
    s = draw.uniform(front.first + 1.0, front.last - 1.0) if is_wide else front.first
    wide_m = draw.uniform(1.0, 1.6)
    num_steps = int(draw.integers(1, 5))
    door = (look.semantic, Material.PAINT, coat(draw), look.instance)
    builder.solid(Shape.BOX, front.at(s, -0.03), (wide_m, 0.1, 2.1), *door, 0.17 * num_steps)
    stone = (look.semantic, Material.CONCRETE, 0.16, look.instance)
    for step in range(num_steps):
        deep_m = 0.3 * (num_steps - step)
        at, size = front.at(s, -deep_m / 2), (wide_m + 0.4, deep_m, 0.17)
        builder.solid(Shape.BOX, at, size, *stone, 0.17 * step, detail=True)
    if draw.random() < 0.4:
        for along_m in (-wide_m / 2 - 0.2, wide_m / 2 + 0.2):
            at = front.at(s + along_m, -1.2)
            builder.solid(Shape.CYLINDER, at, (0.12, 0.12, 2.6), *stone)


def _drainpipe(builder: Builder, draw: Generator, front: Front, look: Look) -> None:
    """A pipe of 10 cm at one end of the front."""
    s = front.first + 0.2 if draw.random() < 0.5 else front.last - 0.2
    pipe = (look.semantic, Material.CONCRETE, 0.15, look.instance, -FOOTING_M)
    builder.solid(Shape.CYLINDER, front.at(s, -0.06), (0.1, 0.1, 5.0), *pipe, detail=True)


def row_houses(builder: Builder, draw: Generator, front: Front) -> None:
    """Houses of 5 to 8 m in a row, each a step before or behind its neighbour."""
    s = front.first
    depth_m, height_m = draw.uniform(8, 11), draw.uniform(5, 9)
    while s < front.last - 3:
        end = min(s + draw.uniform(5, 8), front.last)
        house = front._replace(first=s, last=end).moved_back(draw.choice((0.0, 0.0, 0.4, 1.2)))
        building(builder, draw, house, depth_m, height_m, 0.35)
        s = end


def garage(builder: Builder, draw: Generator, s: float, front_m: float, side: float) -> None:
    """A garage whose door lies behind a reveal."""
    look = wall_look(builder, draw, Semantic.GARAGE)
    wide_m, deep_m, height_m = _GARAGE_M
    at = (s, side * (front_m + deep_m / 2))
    builder.solid(Shape.BOX, at, (wide_m, deep_m, height_m + FOOTING_M), *look, -FOOTING_M)
    for along_m in (-1.4, 1.4):
        pier = (s + along_m, side * (front_m - 0.1))
        builder.solid(Shape.BOX, pier, (0.3, 0.2, height_m + FOOTING_M), *look, -FOOTING_M)


def carport(builder: Builder, draw: Generator, s: float, front_m: float, side: float) -> None:
    """A roof on six posts, over a caravan if need be; what stands below it is not part of it."""
    look = (Semantic.GARAGE, Material.WOOD, 0.15, builder.new_instance())
    for away_m in (0.0, 2.5, 5.0):
        for along_m in (-1.5, 1.5):
            at = (s + along_m, side * (front_m + away_m))
            builder.solid(Shape.BOX, at, (0.12, 0.12, 2.9 + FOOTING_M), *look, -FOOTING_M)
    roof = (3.4, 5.6, 0.2)
    builder.solid(Shape.BOX, (s, side * (front_m + 2.5)), roof, *look, 2.8)


def shed(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A garden shed of wood, 2 to 3.5 m wide and high."""
    look = (Semantic.BUILDING, Material.WOOD, draw.uniform(0.1, 0.2), builder.new_instance())
    size = (draw.uniform(2.0, 3.5), draw.uniform(1.8, 3.0), draw.uniform(2.0, 2.8) + FOOTING_M)
    builder.solid(Shape.BOX, (s, lateral), size, *look, -FOOTING_M, draw.uniform(-0.2, 0.2))


def hall(builder: Builder, draw: Generator, front: Front) -> None:
    """A hall or a supermarket, some with polished steel at the front, with gates and a ramp."""
    depth_m, height_m = draw.uniform(10, 14), draw.uniform(5, 9)
    building(builder, draw, front, depth_m, height_m, 0.3)
    middle = (front.first + front.last) / 2
    if draw.random() < 0.25:
        steel = (Semantic.BUILDING, Material.POLISHED_METAL, 0.1, builder.new_instance())
        builder.solid(Shape.BOX, front.at(middle, -0.05), (10.0, 0.04, 4.0), *steel, 0.2)
    if draw.random() < 0.5:
        ramp = (Semantic.BUILDING, Material.CONCRETE, 0.15, builder.new_instance())
        at = front.at(middle + draw.uniform(-6, 6), -1.5)
        builder.solid(Shape.BOX, at, (draw.uniform(4, 8), 3.0, 1.1), *ramp, -0.1)

"""Trees, bushes, woods and meadows along a street, and what fences gardens off.

Leaves, blades and wire mesh are media that let some beams in, see ``Primitive``.
"""

from __future__ import annotations

import math

import numpy as np

from r3dpa.simulation.builder import FOOTING_M, Builder
from r3dpa.simulation.course import BLOCK_M
from r3dpa.simulation.scene import Material, Primitive, Semantic, Shape

_LEAVES = 0.17
# Chance of a hit per metre of a crown: half the area of its leaves per volume, and more, as a beam
# of some centimetres seldom finds a gap.
_CROWN_PER_M = (0.8, 2.5)


def tree(builder: Builder, draw: np.random.Generator, s: float, lateral: float, low: bool) -> None:
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


def bush(builder: Builder, draw: np.random.Generator, s: float, lateral: float) -> None:
    """A bush that grows from the ground."""
    width, height = draw.uniform(0.9, 3.2), draw.uniform(0.8, 2.6)
    builder.solid(
        Shape.ELLIPSOID, (s, lateral), (width, width * draw.uniform(0.7, 1.4), height),
        Semantic.VEGETATION, Material.FOLIAGE, _LEAVES, builder.new_instance(), -0.15 * height,
        draw.uniform(0, math.pi), False, draw.uniform(2.0, 6.0),
    )  # fmt: skip


def wood(builder: Builder, draw: np.random.Generator, s: float, lateral: float) -> None:
    """The edge of a wood: leaves from the ground to the tree tops."""
    instance, extinction = builder.new_instance(), draw.uniform(*_CROWN_PER_M)
    for along in (-0.3, 0.3):
        size = (BLOCK_M * draw.uniform(0.5, 0.8), draw.uniform(5, 10), draw.uniform(6, 12))
        at = (s + along * BLOCK_M, lateral + draw.normal(0, 1.5))
        builder.solid(
            Shape.ELLIPSOID, at, size, Semantic.VEGETATION, Material.FOLIAGE, _LEAVES, instance,
            -0.35 * size[2], draw.normal(0, 0.2), False, extinction,
        )  # fmt: skip


def grass(builder: Builder, draw: np.random.Generator, side: float, edge_m: float) -> None:
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


def row(
    builder: Builder, draw: np.random.Generator, lateral: float, first: float, last: float
) -> None:
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

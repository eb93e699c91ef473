"""Trees, the edge of a wood, and meadows. Leaves and grass are media, see ``Primitive``.

A sensor that looks up by 2 degrees sees the lowest metre of a crown and what is below it, so that
is where trees have their parts: forks, drooping clumps of leaves with sky between them, stakes.
"""

from __future__ import annotations

import math

from numpy.random import Generator

from lidarsim.scene import Interval, Material, Primitive, Semantic, Shape
from lidarsim.street.builder import FOOTING_M, Builder, Place
from lidarsim.street.course import BLOCK_M

#: Diffuse reflectivity of leaves at 905 nm, as a beam sees it.
LEAVES = 0.17
_BARK = 0.15
# Chance of a hit per metre. Real crowns and edges of woods return from a shell whose neighbouring
# shots differ by a decimetre, but by more than 0.5 m in every seventh pair: clumps are dense, and
# single leaves and twigs stand around and between them.
_CLUMP_PER_M = (1.5, 4.1)
_TWIGS_PER_M = (0.12, 0.3)
_SCREEN_PER_M = (1.2, 2.4)
_NEEDLES_PER_M = (1.8, 4.7)
# Clear stems: 2.5 m above pavements where it is pruned, less where it is not.
_STREET_STEM_M, _LOW_STEM_M = (2.1, 3.0), (1.6, 2.1)
# A low crown is cut back at the kerb, where cars pass.
_LOW_CROWN_M = (1.8, 3.0)
# Per 18 m of the edge of a wood; of its trunks those before the leaves.
_WOOD_SCREENS, _WOOD_TRUNKS, _WOOD_CROWNS, _WOOD_SHRUBS = 2, 12, 8, 8
_TUFTS_PER_MEADOW = 7


def clump(
    builder: Builder,
    draw: Generator,
    at: Place,
    size: tuple[float, float, float],
    bottom_m: float,
    instance: int,
    per_m: Interval,
    detail: bool = False,
) -> None:
    """A clump of leaves of one density, turned at random; the unit of crowns and shrubs."""
    builder.solid(
        Shape.ELLIPSOID, at, size, Semantic.VEGETATION, Material.FOLIAGE, LEAVES, instance,
        bottom_m, draw.uniform(0, math.pi), False, draw.uniform(*per_m), detail,
    )  # fmt: skip


def grass(builder: Builder, along: Interval, across: Interval, deep_m: float, per_m: float) -> None:
    """A thin layer of blades over the terrain between two values of s and two lateral ones."""
    course, section = builder.course, builder.section
    lateral, start = sum(across) / 2, section.block * BLOCK_M
    x, y, z = section.on_chord(sum(along) / 2 - start, lateral)
    z += course.surface_m(lateral) + deep_m / 2
    half_size = ((along[1] - along[0]) / 2, abs(across[1] - across[0]) / 2, deep_m / 2)
    builder.primitives.append(
        Primitive(
            Shape.BOX, (x, y, z), half_size, Semantic.TERRAIN, LEAVES, section.heading_rad,
            material=Material.FOLIAGE, extinction_per_m=per_m,
            grade=(section.slope, section.cross + course.surface_cross(lateral)),
        )
    )  # fmt: skip


def tuft(builder: Builder, draw: Generator, s: float, lateral: float, tall_m: float) -> None:
    """A tuft of grass as wide as it is tall or up to three times as wide."""
    wide_m = tall_m * draw.uniform(1.0, 3.0)
    size = (wide_m, wide_m * draw.uniform(0.6, 1.0), 1.4 * tall_m)
    builder.solid(
        Shape.ELLIPSOID, (s, lateral), size, Semantic.TERRAIN, Material.FOLIAGE, LEAVES, 0,
        -0.4 * tall_m, draw.uniform(0, math.pi), False, draw.uniform(1.8, 4.7),
    )  # fmt: skip


def _stem(
    builder: Builder,
    at: Place,
    thick_m: float,
    span_m: Interval,
    instance: int,
    detail: bool = False,
) -> None:
    """An upright piece of trunk or branch between two heights."""
    builder.solid(
        Shape.CYLINDER, at, (thick_m, thick_m, span_m[1] - span_m[0]), Semantic.VEGETATION,
        Material.WOOD, _BARK, instance, span_m[0], detail=detail,
    )  # fmt: skip


def _trunk(
    builder: Builder, draw: Generator, at: Place, thick_m: float, fork_m: float, instance: int
) -> None:
    """A trunk, and above its fork two thinner stems apart from each other."""
    _stem(builder, at, thick_m, (-FOOTING_M, fork_m), instance)
    angle = draw.uniform(0, math.pi)
    for sign in (-1.0, 1.0):
        out_m = sign * thick_m * draw.uniform(0.5, 1.2)
        place = (at[0] + out_m * math.cos(angle), at[1] + out_m * math.sin(angle))
        above_m = fork_m + draw.uniform(0.8, 1.6)
        thin_m = thick_m * draw.uniform(0.45, 0.65)
        _stem(builder, place, thin_m, (fork_m - 0.3, above_m), instance, detail=True)


def _crown(
    builder: Builder,
    draw: Generator,
    at: Place,
    low_m: float,
    size: tuple[float, float],
    num_clumps: int,
    instance: int,
) -> None:
    """A crown of a width and a height: twigs all over it, and clumps in its lower part."""
    wide_m, tall_m = size
    clump(builder, draw, at, (wide_m, wide_m, tall_m), low_m, instance, _TWIGS_PER_M)
    first = draw.uniform(0, 2 * math.pi)
    for number in range(num_clumps):
        angle = first + 2 * math.pi * number / num_clumps + draw.normal(0, 0.25)
        out_m = wide_m * draw.uniform(0.12, 0.36)
        place = (at[0] + out_m * math.cos(angle), at[1] + out_m * math.sin(angle))
        across_m = wide_m * draw.uniform(0.22, 0.42)
        piece_m = (across_m, across_m * draw.uniform(0.7, 1.0), tall_m * draw.uniform(0.3, 0.5))
        bottom_m = low_m + tall_m * draw.uniform(0.0, 0.3)
        is_detail = number % 2 == 1
        clump(builder, draw, place, piece_m, bottom_m, instance, _CLUMP_PER_M, is_detail)


def _broadleaf(
    builder: Builder, draw: Generator, at: Place, stem_m: Interval, crown_m: Interval
) -> None:
    """A tree with a forked trunk and a round crown."""
    instance, low_m, wide_m = builder.new_instance(), draw.uniform(*stem_m), draw.uniform(*crown_m)
    thick_m = wide_m * draw.uniform(0.05, 0.08)
    _trunk(builder, draw, at, thick_m, low_m + draw.uniform(-0.3, 0.5), instance)
    size = (wide_m, wide_m * draw.uniform(0.7, 1.2))
    _crown(builder, draw, at, low_m, size, int(draw.integers(5, 8)), instance)
    if draw.random() < 0.2:
        # Ivy, or shoots at the foot.
        ivy_m = (thick_m + draw.uniform(0.2, 0.5), thick_m + 0.3, draw.uniform(0.8, 2.5))
        clump(builder, draw, at, ivy_m, -0.2, instance, _NEEDLES_PER_M)


def _young(builder: Builder, draw: Generator, at: Place) -> None:
    """A young tree: a thin stem between two or three stakes, with an egg of leaves."""
    instance, low_m = builder.new_instance(), draw.uniform(1.5, 2.2)
    _stem(builder, at, draw.uniform(0.06, 0.12), (-FOOTING_M, low_m + 0.8), instance)
    wide_m = draw.uniform(0.9, 2.0)
    size = (wide_m, wide_m, wide_m * draw.uniform(1.3, 2.0))
    clump(builder, draw, at, size, low_m, instance, _CLUMP_PER_M)
    side_m = (0.5 * wide_m, 0.5 * wide_m, 0.4 * size[2])
    beside = (at[0] + draw.normal(0, 0.3 * wide_m), at[1] + draw.normal(0, 0.3 * wide_m))
    clump(builder, draw, beside, side_m, low_m - 0.1, instance, _CLUMP_PER_M, detail=True)
    stakes, angle = int(draw.integers(1, 4)), draw.uniform(0, math.pi)
    for number in range(stakes):
        turn = angle + 2 * math.pi * number / stakes
        place = (at[0] + 0.35 * math.cos(turn), at[1] + 0.35 * math.sin(turn))
        tall_m = draw.uniform(1.2, 2.0)
        _stem(builder, place, 0.08, (-FOOTING_M, tall_m), instance, detail=True)


def _pollard(builder: Builder, draw: Generator, at: Place) -> None:
    """A pollard: a thick trunk and knobs of dense shoots at the height where it is cut."""
    instance, cut_m = builder.new_instance(), draw.uniform(2.0, 2.8)
    _stem(builder, at, draw.uniform(0.35, 0.65), (-FOOTING_M, cut_m), instance)
    for number in range(4):
        turn = math.pi / 2 * number + draw.normal(0, 0.3)
        out_m, wide_m = draw.uniform(0.4, 0.9), draw.uniform(0.7, 1.3)
        place = (at[0] + out_m * math.cos(turn), at[1] + out_m * math.sin(turn))
        size = (wide_m, wide_m, draw.uniform(0.8, 1.6))
        clump(builder, draw, place, size, cut_m - draw.uniform(0.0, 0.5), instance, _NEEDLES_PER_M)


def _conifer(builder: Builder, draw: Generator, at: Place, low_m: float) -> None:
    """A cone of three storeys of needles, the lowest branches at a height."""
    instance, wide_m = builder.new_instance(), draw.uniform(1.6, 3.8)
    _stem(builder, at, 0.06 * wide_m + 0.06, (-FOOTING_M, low_m + 1.0), instance)
    storey_m = wide_m * draw.uniform(0.7, 1.1)
    for storey in range(3):
        across_m = wide_m * (1 - 0.27 * storey)
        size = (across_m, across_m * draw.uniform(0.85, 1.0), 1.5 * storey_m)
        beside = (at[0] + draw.normal(0, 0.04 * wide_m), at[1] + draw.normal(0, 0.04 * wide_m))
        bottom_m = low_m + storey * storey_m
        clump(builder, draw, beside, size, bottom_m, instance, _NEEDLES_PER_M)


def _column(builder: Builder, draw: Generator, at: Place, low_m: float) -> None:
    """A narrow upright tree, such as a poplar or a cypress."""
    instance, wide_m = builder.new_instance(), draw.uniform(0.8, 1.8)
    _stem(builder, at, 0.1 + 0.08 * wide_m, (-FOOTING_M, low_m + 1.0), instance)
    size = (wide_m, wide_m, draw.uniform(3.0, 8.0))
    clump(builder, draw, at, size, low_m - 0.1 * size[2], instance, _NEEDLES_PER_M)
    beside = (at[0] + 0.25 * wide_m, at[1] - 0.2 * wide_m)
    size = (0.8 * wide_m, 0.7 * wide_m, 0.6 * size[2])
    clump(builder, draw, beside, size, low_m, instance, _CLUMP_PER_M, detail=True)


def _several_stems(builder: Builder, draw: Generator, at: Place) -> None:
    """A large shrub or small tree whose stems spread from the ground."""
    instance, wide_m = builder.new_instance(), draw.uniform(1.8, 3.5)
    low_m = draw.uniform(0.5, 1.3)
    for number in range(3):
        turn = 2 * math.pi * number / 3 + draw.normal(0, 0.4)
        place = (at[0] + 0.12 * wide_m * math.cos(turn), at[1] + 0.12 * wide_m * math.sin(turn))
        thick_m = draw.uniform(0.06, 0.14)
        _stem(builder, place, thick_m, (-FOOTING_M, low_m + 0.6), instance, detail=number > 0)
    size = (wide_m, wide_m * draw.uniform(0.8, 1.3))
    _crown(builder, draw, at, low_m, size, int(draw.integers(4, 6)), instance)


def street_tree(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A tree by the kerb: of a high or a low crown, young, cut back or narrow."""
    at, habit = (s, lateral), draw.random()
    if habit < 0.25:
        _broadleaf(builder, draw, at, _STREET_STEM_M, (3.5, 7.5))
    elif habit < 0.62:
        _broadleaf(builder, draw, at, _LOW_STEM_M, _LOW_CROWN_M)
    elif habit < 0.82:
        _young(builder, draw, at)
    elif habit < 0.92:
        _pollard(builder, draw, at)
    else:
        _column(builder, draw, at, draw.uniform(1.0, 2.0))


def garden_tree(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """A tree in a garden: fruit trees, conifers, several stems, narrow or young ones."""
    at, habit = (s, lateral), draw.random()
    if habit < 0.35:
        _broadleaf(builder, draw, at, (0.6, 1.6), (2.0, 4.5))
    elif habit < 0.58:
        _conifer(builder, draw, at, draw.uniform(-0.3, 0.6))
    elif habit < 0.78:
        _several_stems(builder, draw, at)
    elif habit < 0.88:
        _column(builder, draw, at, draw.uniform(0.0, 0.6))
    else:
        _young(builder, draw, at)


def wood_edge(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """The edge of a wood along a block: crowns, undergrowth and trunks before its dusk."""
    instance, away = builder.new_instance(), math.copysign(1.0, lateral)
    # A beam that finds a gap ends some metres inside.
    dusk_m = (1.1 * BLOCK_M, 12.0, 11.0)
    builder.solid(
        Shape.ELLIPSOID, (s, lateral + 6.5 * away), dusk_m, Semantic.VEGETATION, Material.FOLIAGE,
        LEAVES, instance, -4.0, extinction_per_m=draw.uniform(0.18, 0.36),
    )  # fmt: skip

    def place(number: int, count: int, inwards_m: float) -> Place:
        along = 0.75 * (number + draw.random()) / count - 0.375
        return s + BLOCK_M * along, lateral + away * inwards_m

    for number in range(_WOOD_SCREENS):
        size = (draw.uniform(6.0, 10.0), draw.uniform(2.0, 3.5), draw.uniform(5.0, 9.0))
        at, bottom_m = place(number, _WOOD_SCREENS, draw.uniform(0.0, 1.5)), draw.uniform(-2.5, 0.5)
        builder.solid(
            Shape.ELLIPSOID, at, size, Semantic.VEGETATION, Material.FOLIAGE, LEAVES, instance,
            bottom_m, draw.normal(0, 0.15), False, draw.uniform(*_SCREEN_PER_M),
        )  # fmt: skip
    for number in range(_WOOD_TRUNKS):
        at = place(number, _WOOD_TRUNKS, draw.uniform(-1.5, 0.5))
        _stem(builder, at, draw.uniform(0.12, 0.45), (-FOOTING_M, 6.0), instance)
    for number in range(_WOOD_CROWNS):
        at = place(number, _WOOD_CROWNS, draw.uniform(-3.5, 1.5))
        size = (draw.uniform(1.2, 3.0), draw.uniform(1.2, 3.0), draw.uniform(1.5, 4.0))
        bottom_m, is_detail = draw.uniform(0.3, 3.0), number % 2 == 1
        clump(builder, draw, at, size, bottom_m, instance, _CLUMP_PER_M, is_detail)
    for number in range(_WOOD_SHRUBS):
        at = place(number, _WOOD_SHRUBS, draw.uniform(-5.0, 0.0))
        size = (draw.uniform(0.8, 3.0), draw.uniform(1.0, 2.5), draw.uniform(1.0, 3.0))
        is_detail = number % 2 == 1
        clump(builder, draw, at, size, -0.3 * size[2], instance, _CLUMP_PER_M, is_detail)


def meadow(builder: Builder, draw: Generator, side: float, edge_m: float) -> None:
    """A meadow: a thin layer of blades over the terrain, and tufts that stand out of it."""
    start = builder.section.block * BLOCK_M
    across = (side * (edge_m + 1.5), side * (edge_m + 19.5))
    deep_m = draw.uniform(0.05, 0.15)
    grass(builder, (start, start + BLOCK_M), across, deep_m, draw.uniform(0.9, 2.4))
    for _ in range(int(draw.poisson(_TUFTS_PER_MEADOW))):
        place = (start + draw.uniform(0, BLOCK_M), side * (edge_m + draw.uniform(1.5, 14.0)))
        tuft(builder, draw, *place, deep_m + draw.uniform(0.15, 0.6))

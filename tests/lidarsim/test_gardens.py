import math
from collections import defaultdict

import numpy as np
import pytest
from sweeps import inside

from lidarsim.raycast import cast
from lidarsim.scene import Material, Pose, Semantic
from lidarsim.solids import NO_SURFACE, solids_of
from lidarsim.street.builder import Builder, Strip
from lidarsim.street.course import BLOCK_M, course_of
from lidarsim.street.gardens import (
    border,
    fence,
    flower_bed,
    front_garden,
    garden_wall,
    gate,
    hedge,
    shrub,
    verge,
)
from lidarsim.street.trees import garden_tree, meadow, street_tree, wood_edge

BLOCK = 14
START_M = BLOCK * BLOCK_M
COURSE = course_of(0, 1)
SECTION = COURSE.section_of(BLOCK)
GREEN = {Semantic.VEGETATION}
OBJECTS = {
    "hedge": (hedge, (12.0, START_M + 2, START_M + 14), GREEN),
    "fence": (fence, (12.0, START_M + 2, START_M + 14), GREEN | {Semantic.FENCE, Semantic.WALL}),
    "garden_wall": (
        garden_wall,
        (-12.0, START_M + 2, START_M + 14),
        GREEN | {Semantic.WALL, Semantic.FENCE},
    ),
    "gate": (gate, (-12.0, START_M + 2, START_M + 5), {Semantic.GATE}),
    "shrub": (shrub, (START_M + 9, 14.0), GREEN),
    "flower_bed": (flower_bed, (START_M + 9, 14.0, 3.0), GREEN),
    "street_tree": (street_tree, (START_M + 9, 8.0), GREEN),
    "garden_tree": (garden_tree, (START_M + 9, 14.0), GREEN),
    "wood_edge": (wood_edge, (START_M + 12, -25.0), GREEN),
    "verge": (verge, (Strip(-1.0, START_M, START_M + 20, 9.0, 11.0),), GREEN | {Semantic.TERRAIN}),
    "meadow": (meadow, (-1.0, 9.0), {Semantic.TERRAIN}),
}


# The same block without slopes.
LEVEL = SECTION._replace(slope=0.0, cross=0.0)


def built(name, seed, section=SECTION):
    """Solids of one object, with the details of scans from nearby."""
    build, arguments, _ = OBJECTS[name]
    builder = Builder(COURSE, section, 1)
    build(builder, np.random.default_rng(seed), *arguments)
    return [*builder.primitives, *builder.details]


def in_street(p):
    """Place of a solid's centre: s, lateral, and heights of bottom and top above the ground."""
    x, y = p.centre[0] - SECTION.x_m, p.centre[1] - SECTION.y_m
    cosine, sine = math.cos(SECTION.heading_rad), math.sin(SECTION.heading_rad)
    along, lateral = cosine * x + sine * y, cosine * y - sine * x
    ground_m = SECTION.on_chord(along, lateral)[2] + COURSE.surface_m(lateral)
    middle_m = p.centre[2] - ground_m
    return START_M + along, lateral, middle_m - p.half_size[2], middle_m + p.half_size[2]


@pytest.mark.parametrize("name", OBJECTS)
def test_objects_have_their_classes_and_stand_on_the_ground(name):
    for seed in range(30):
        solids = built(name, seed)
        assert {p.semantic for p in solids} <= OBJECTS[name][2]
        by_instance = defaultdict(list)
        for p in solids:
            by_instance[p.instance].append(p)
        for parts in by_instance.values():
            # The bars above a wall stand on the wall.
            lowest_m = min(in_street(p)[2] for p in parts)
            on_wall = name == "garden_wall" and parts[0].semantic == Semantic.FENCE
            assert lowest_m <= (0.8 if on_wall else 0.06)
        assert min(in_street(p)[3] for p in solids) > 0.05  # nothing is buried


def test_equal_seeds_give_equal_objects_and_others_differ():
    for name in OBJECTS:
        assert built(name, 3) == built(name, 3)
        assert built(name, 3) != built(name, 4)


def test_borders_keep_within_their_ends_and_half_of_them_have_a_gate():
    gates = 0
    for seed in range(60):
        builder = Builder(COURSE, SECTION, 1)
        border(builder, np.random.default_rng(seed), 12.0, START_M + 2, START_M + 16)
        solids = [*builder.primitives, *builder.details]
        for p in solids:
            s, lateral, _, top_m = in_street(p)
            assert START_M + 1 < s < START_M + 17
            assert 11.5 < lateral < 14.0
            assert top_m < 2.9
        gates += any(p.semantic == Semantic.GATE for p in solids)
    assert 15 < gates < 40


def share_of_rays_that_pass(name, seed):
    """Of a level beam 0.6 m above the ground, 6 m in front of a border from s = 2 m to 14 m."""
    x, y, z = LEVEL.on_chord(8.0, 6.0)
    z += COURSE.surface_m(12.0) + 0.6
    angle = np.linspace(0, 2 * np.pi, 8192, endpoint=False)
    direction = np.stack([np.cos(angle), np.sin(angle), 0 * angle])[:, None].astype(np.float32)
    solids = solids_of(tuple(built(name, seed, LEVEL)), Pose(x, y, z, LEVEL.heading_rad), z - 50)
    depth = np.random.default_rng(0).exponential(size=(1, 8192)).astype(np.float32)
    _, surface = cast(solids, np.zeros_like(direction), direction, 60.0, optical_depth=depth)
    # A metre within the ends.
    towards = np.abs(angle - np.pi / 2) < math.atan(5.0 / 6.0)
    return (surface[0, towards] == NO_SURFACE).mean()


def test_fences_let_rays_pass_and_hedges_hardly_any():
    fences = np.array([share_of_rays_that_pass("fence", seed) for seed in range(20)])
    # Not fences of boards, a third of all, and few rays of those that are seen at a slant.
    assert ((fences > 0.2) & (fences < 0.97)).sum() >= 8
    hedges = [share_of_rays_that_pass("hedge", seed) for seed in range(20)]
    assert np.median(hedges) < 0.1


def test_crowns_have_sky_between_their_clumps():
    """Dense clumps fill less than half of the box around them; the trunk is no medium."""
    for seed in range(5):
        tree = built("garden_tree", seed)
        leaves = [p for p in tree if p.extinction_per_m > 1]
        low = np.min([np.subtract(p.centre, p.half_size) for p in leaves], axis=0)
        high = np.max([np.add(p.centre, p.half_size) for p in leaves], axis=0)
        points = np.random.default_rng(0).uniform(low, high, (1000, 3))
        assert np.any([inside(p, points) for p in leaves], axis=0).mean() < 0.6
        assert any(p.material == Material.WOOD and p.extinction_per_m == 0 for p in tree)


def test_a_front_garden_lies_between_pavement_and_house_and_keeps_its_path_clear():
    kinds = set()
    for seed in range(40):
        builder = Builder(COURSE, SECTION, 1)
        draw = np.random.default_rng(seed)
        front_garden(builder, draw, Strip(1.0, START_M + 2, START_M + 20, 10.0, 15.0))
        (path,) = (p for p in builder.primitives if p.semantic == Semantic.SIDEWALK)
        path_s = in_street(path)[0]
        assert path.half_size[1] == pytest.approx(2.5)
        plants = [p for p in [*builder.primitives, *builder.details] if p is not path]
        for p in plants:
            s, lateral, _, _ = in_street(p)
            assert START_M + 0.5 < s < START_M + 21.5
            assert 8.4 < lateral < 16.6
        trunks = [p for p in plants if p.material == Material.WOOD and p.semantic in GREEN]
        assert all(abs(in_street(p)[0] - path_s) > path.half_size[0] for p in trunks)
        kinds |= {p.semantic for p in plants}
    assert kinds == {Semantic.VEGETATION, Semantic.UNKNOWN_OBJECT}

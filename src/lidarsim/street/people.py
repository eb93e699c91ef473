"""People and riders: figures of a trunk, a head and limbs."""

from __future__ import annotations

import math
from functools import partial

from numpy.random import Generator

from lidarsim.scene import Material, Semantic, Shape
from lidarsim.street.builder import Builder
from lidarsim.street.vehicles import Body, Part, bicycle

# Heights of adults (5th to 95th percentile of women and men, with shoes) and of children of four
# to eleven years, metres.
_ADULT_M, _CHILD_M = (1.55, 1.9), (1.0, 1.45)
# Proportions of a clothed body (NASA STD-3000, rounded), as shares of its height.
_LEG, _SHOULDER, _CHIN = 0.48, 0.82, 0.86
_BROAD, _DEEP, _LEG_THICK, _ARM_THICK = 0.25, 0.15, 0.095, 0.06
_HEAD_M = (0.2, 0.17)
# Half the distance between the feet in mid stride, as a share of the height; standing still.
_STRIDE, _STANCE = (0.05, 0.17), (0.0, 0.03)
_SKIN = 0.25


def person(draw: Generator) -> Body:
    """A walking adult, sometimes with a bag or a rucksack."""
    tall_m = draw.uniform(*_ADULT_M)
    return (*_figure(draw, tall_m, draw.uniform(*_STRIDE)), *_luggage(draw, tall_m))


def cyclist(draw: Generator) -> Body:
    """A rider on a bicycle, leaning to the handlebar, one foot down and one up."""
    tall_m = draw.uniform(*_ADULT_M)
    cloth, trousers = draw.uniform(0.08, 0.3), draw.uniform(0.06, 0.25)
    rider = partial(Part, semantic=Semantic.RIDER, material=Material.CLOTH)
    saddle_m, wide_m = 0.92, _BROAD * tall_m
    trunk_m = 0.34 * tall_m
    shin_m = 0.28 * tall_m
    leg_m = (_LEG_THICK * tall_m, _LEG_THICK * tall_m)
    left_up = draw.random() < 0.5
    parts = []
    for side, raised in ((1, left_up), (-1, not left_up)):
        foot_m = 0.4 if raised else 0.12
        at = (0.22 if raised else 0.02, 0.11 * side, foot_m + shin_m / 2)
        parts.append(rider(at, (*leg_m, shin_m), reflectivity=trousers, shape=Shape.CYLINDER))
        arm_at, arm_m = (0.25, 0.42 * wide_m * side, saddle_m + 0.6 * trunk_m), (0.4, 0.09, 0.14)
        parts.append(rider(arm_at, arm_m, reflectivity=cloth, detail=True))
    thighs_m = (0.5, 0.33, 0.22)
    trunk_at, trunk_size = (0.0, 0, saddle_m + trunk_m / 2), (0.36, wide_m, trunk_m * 1.1)
    head_at = (0.16, 0, saddle_m + trunk_m + 0.12)
    return (
        *bicycle(draw),
        *parts,
        rider((0.05, 0, 0.82), thighs_m, reflectivity=trousers, shape=Shape.ELLIPSOID),
        rider(trunk_at, trunk_size, reflectivity=cloth, shape=Shape.ELLIPSOID),
        rider(head_at, (0.25, 0.19, 0.26), reflectivity=_SKIN, shape=Shape.ELLIPSOID),
    )


def group(builder: Builder, draw: Generator, s: float, lateral: float) -> None:
    """Two to five people who stand in a circle and talk, now and then with children."""
    count = int(draw.integers(2, 6))
    # An arm's length between two neighbours.
    radius_m = max(0.4, 0.75 * count / (2 * math.pi)) + draw.uniform(0.0, 0.25)
    turn = draw.uniform(0, 2 * math.pi)
    for place in range(count):
        angle = turn + 2 * math.pi * place / count + draw.normal(0, 0.15)
        tall_m = draw.uniform(*(_CHILD_M if draw.random() < 0.15 else _ADULT_M))
        body = tuple(_figure(draw, tall_m, draw.uniform(*_STANCE)))
        at = (s + radius_m * math.cos(angle), lateral + radius_m * math.sin(angle))
        builder.body(body, at, angle + math.pi + draw.normal(0, 0.3), builder.new_instance())


def _figure(draw: Generator, tall_m: float, stride: float) -> list[Part]:
    """Trunk, head, arms and legs; ``stride``: half the distance of the feet by the height."""
    cloth, trousers = draw.uniform(0.08, 0.3), draw.uniform(0.06, 0.25)
    stout = draw.uniform(0.9, 1.2)
    someone = partial(Part, semantic=Semantic.PERSON, material=Material.CLOTH)
    limb = partial(someone, shape=Shape.CYLINDER)
    reach = stride * tall_m * draw.choice((-1, 1))
    leg_m, shoulder_m = _LEG * tall_m, _SHOULDER * tall_m
    thick_m, arm_m = _LEG_THICK * tall_m * stout, _ARM_THICK * tall_m * stout
    wide_m = _BROAD * tall_m * stout
    parts = []
    for side in (1, -1):
        leg_at = (side * reach, side * 0.23 * wide_m, leg_m / 2)
        parts.append(limb(leg_at, (thick_m, thick_m, leg_m), reflectivity=trousers))
        # An arm swings against the leg of its side, by less.
        at = (-0.7 * side * reach, side * (wide_m + arm_m) / 2, 0.62 * tall_m)
        parts.append(limb(at, (arm_m, arm_m, 0.4 * tall_m), reflectivity=cloth, detail=True))
    # The trunk reaches down over the hips, as a coat does.
    trunk_m = shoulder_m - 0.9 * leg_m
    trunk_size = (_DEEP * tall_m * stout, wide_m, trunk_m)
    head_m = tall_m - _CHIN * tall_m
    parts += [
        limb((0, 0, shoulder_m - trunk_m / 2), trunk_size, reflectivity=cloth),
        someone(
            (0, 0, tall_m - 0.6 * head_m), (*_HEAD_M, 1.2 * head_m),
            reflectivity=_SKIN, shape=Shape.ELLIPSOID,
        ),
    ]  # fmt: skip
    return parts


def _luggage(draw: Generator, tall_m: float) -> list[Part]:
    """A bag in the hand, a rucksack, or nothing; it belongs to the person who carries it."""
    kind = draw.random()
    look = (Semantic.PERSON, Material.CLOTH, draw.uniform(0.06, 0.25))
    if kind < 0.25:
        side = draw.choice((-1, 1))
        bag_m = (draw.uniform(0.3, 0.5), 0.16, draw.uniform(0.3, 0.45))
        return [Part((0, side * 0.2 * tall_m, 0.26 * tall_m), bag_m, *look, detail=True)]
    if kind < 0.45:
        return [Part((-0.15 * tall_m, 0, 0.68 * tall_m), (0.2, 0.32, 0.45), *look, detail=True)]
    return []

"""Solids and ground of one block, placed in street coordinates."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from lidarsim.scene import Interval, Material, Primitive, Puddle, Semantic, Shape
from lidarsim.street.course import BLOCK_M, Course, Section
from lidarsim.street.vehicles import Body

#: Walls and crowns reach into the ground, which falls away below them where the street is steep.
FOOTING_M = 0.6

#: Street coordinates (s, lateral).
Place = tuple[float, float]

_TERRAIN_M = 48.0
_SLAB_M = 1.0
# Above a walkway.
_HEADROOM_M = 2.0


class Strip(NamedTuple):
    """A piece of land along the street.

    ``side``: 1 left of the axis, -1 right. ``first``, ``last``: values of s between which it lies,
    ``near_m``, ``far_m``: distances from the axis.
    """

    side: float
    first: float
    last: float
    near_m: float
    far_m: float


class Builder:
    """Collects the solids of one block, given in street coordinates.

    ``details`` are solids that exist in scans from nearby only, ``puddles`` places of standing
    water on a wet road; instances are numbered from ``first_instance`` on. ``openings_m`` are the
    widths of side streets in the middle of the block, by side.
    """

    def __init__(self, course: Course, section: Section, first_instance: int) -> None:
        self.course = course
        self.section = section
        self.primitives: list[Primitive] = []
        self.details: list[Primitive] = []
        self.puddles: list[Puddle] = []
        self.num_objects = 0
        self.openings_m = {1.0: 0.0, -1.0: 0.0}
        self._first_instance = first_instance

    def new_instance(self) -> int:
        """Unique instance number within the block."""
        self.num_objects += 1
        return self._first_instance + self.num_objects - 1

    def solid(
        self,
        shape: Shape,
        at: Place,
        size: tuple[float, float, float],
        semantic: Semantic,
        material: Material,
        reflectivity: float,
        instance: int = 0,
        bottom_m: float = 0.0,
        yaw_rad: float = 0.0,
        inclined: bool = False,
        extinction_per_m: float = 0.0,
        detail: bool = False,
        slats: tuple[float, float] = (0.0, 1.0),
        open_m: tuple[float, float] = (0.0, math.inf),
    ) -> None:
        """Add a solid that stands on the ground.

        ``at``: centre (s, lateral). ``size``: along, across and up. ``bottom_m``: lowest point
        above the ground. ``yaw_rad``: against the street. ``inclined``: follows the slope of the
        street instead of standing level. ``detail``: only scans from nearby have it.
        ``extinction_per_m``, ``slats`` and ``open_m``: see ``Primitive``.
        """
        x, y, z = self.section.at(*at)
        z += self.course.surface_m(at[1]) + bottom_m + size[2] / 2
        half_size = (size[0] / 2, size[1] / 2, size[2] / 2)
        heading, still = self.section.heading_rad + yaw_rad, (0.0, 0.0)
        slopes = (self.section.slope, self.section.cross)
        grade = _turned(slopes, yaw_rad) if inclined else (0.0, 0.0)
        (self.details if detail else self.primitives).append(
            Primitive(
                shape, (x, y, z), half_size, semantic, reflectivity, heading, instance, material,
                still, grade, extinction_per_m, slats, open_m,
            )
        )  # fmt: skip

    def body(
        self,
        body: Body,
        at: Place,
        yaw_rad: float,
        instance: int,
        speed_m_s: float = 0.0,
        sunk_m: float = 0.0,
    ) -> None:
        """Add a vehicle or a person at (s, lateral), which moves along its heading.

        ``sunk_m``: of the ground there below the surface of the street, as of ``slab``.
        """
        x, y, z = self.section.at(*at)
        z += self.course.surface_m(at[1]) - sunk_m
        heading = self.section.heading_rad + yaw_rad
        cosine, sine = math.cos(heading), math.sin(heading)
        cross = self.section.cross + self.course.surface_cross(at[1])
        grade = _turned((self.section.slope, cross), yaw_rad)
        velocity = (speed_m_s * cosine, speed_m_s * sine) if speed_m_s else (0.0, 0.0)
        for part in body:
            ahead, left, up = part.centre
            up += grade[0] * ahead + grade[1] * left
            centre = (x + ahead * cosine - left * sine, y + ahead * sine + left * cosine, z + up)
            half_size = (part.size[0] / 2, part.size[1] / 2, part.size[2] / 2)
            primitive = Primitive(
                part.shape, centre, half_size, part.semantic, part.reflectivity, heading, instance,
                part.material, velocity, grade, part.extinction_per_m,
            )  # fmt: skip
            (self.details if part.detail else self.primitives).append(primitive)

    def slab(
        self,
        along: Interval,
        across: Interval,
        semantic: Semantic,
        material: Material,
        reflectivity: float,
        sunk_m: float = 0.0,
    ) -> None:
        """Add a piece of ground between two distances along the chord and two lateral ones.

        Its middle lies ``sunk_m`` below the surface of the street. At the ends of the block it
        reaches over the wedge that the bend of the street opens.
        """
        first, last = along
        widest = max(map(abs, across))
        if first == 0:
            first -= widest * abs(self.section.corner_before)
        if last == BLOCK_M:
            last += widest * abs(self.section.corner_after)
        lateral = sum(across) / 2
        x, y, z = self.section.on_chord((first + last) / 2, lateral)
        z += self.course.surface_m(lateral) - sunk_m
        half_size = ((last - first) / 2, abs(across[1] - across[0]) / 2, _SLAB_M / 2)
        grade = (self.section.slope, self.section.cross + self.course.surface_cross(lateral))
        self.primitives.append(
            Primitive(
                Shape.BOX, (x, y, z - _SLAB_M / 2), half_size, semantic, reflectivity,
                self.section.heading_rad, material=material, grade=grade,
            )
        )  # fmt: skip

    def clear_walkway(self, side: float) -> None:
        """Remove objects and parts of buildings that people would walk through; leaves stay."""
        solids = (*self.primitives, *self.details)
        in_the_way = [p for p in solids if p.instance and self._on_walkway(p, side)]
        parts = {p for p in in_the_way if p.semantic == Semantic.BUILDING}
        objects = {p.instance for p in in_the_way} - {p.instance for p in parts}
        # The plant of a tub is an object of its own at the same place.
        places = {p.centre[:2] for p in in_the_way}

        def stays(p: Primitive) -> bool:
            return not (p in parts or p.instance in objects or p.centre[:2] in places)

        self.primitives = [p for p in self.primitives if stays(p)]
        self.details = [p for p in self.details if stays(p)]

    def _on_walkway(self, solid: Primitive, side: float) -> bool:
        """Whether a solid without leaves reaches into the walkway, less than 2 m above it."""
        near_m, far_m = self.course.walkway_m(side)
        section, turn = self.section, solid.yaw_rad - self.section.heading_rad
        x, y = solid.centre[0] - section.x_m, solid.centre[1] - section.y_m
        cosine, sine = math.cos(section.heading_rad), math.sin(section.heading_rad)
        along, away_m = x * cosine + y * sine, side * (y * cosine - x * sine)
        half_long, half_wide, half_tall = solid.half_size
        reach_m = abs(half_long * math.sin(turn)) + abs(half_wide * math.cos(turn))
        ground_m = section.on_chord(along, side * away_m)[2] + self.course.surface_m(side * away_m)
        return (
            solid.material != Material.FOLIAGE
            and near_m < away_m + reach_m
            and away_m - reach_m < far_m
            and solid.centre[2] - half_tall < ground_m + _HEADROOM_M
        )

    def clear_places(self) -> None:
        """Remove people who stand inside something, and bins inside anything but people or bins."""
        solids = [p for p in (*self.primitives, *self.details) if p.instance]
        solids = [p for p in solids if p.material != Material.FOLIAGE]
        people = [p for p in solids if p.semantic == Semantic.PERSON]
        bins = [p for p in solids if p.semantic == Semantic.TRASH_BIN]
        others = [p for p in solids if p.semantic not in (Semantic.PERSON, Semantic.TRASH_BIN)]
        inside = _inside(people, others + bins) | _inside(bins, others)
        self.primitives = [p for p in self.primitives if p.instance not in inside]
        self.details = [p for p in self.details if p.instance not in inside]

    def puddle(self, draw: Generator, s: float, lateral: float) -> None:
        """Add a place of standing water on a wet road."""
        x, y, _ = self.section.at(s, lateral)
        self.puddles.append(Puddle(x, y, draw.uniform(0.3, 1.6)))


def _inside(things: list[Primitive], others: list[Primitive]) -> set[int]:
    """Instances of the things, taken for round, that reach into others."""
    if not (things and others):
        return set()
    here, there = (np.array([p.centre for p in solids]).T for solids in (things, others))
    half_here, half_there = (
        np.array([p.half_size for p in solids]).T for solids in (things, others)
    )
    yaw_rad = np.array([p.yaw_rad for p in others])
    x, y, z = here[:, :, None] - there[:, None]
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    along_m = np.abs(cosine * x + sine * y) - half_there[0]
    across_m = np.abs(cosine * y - sine * x) - half_there[1]
    radius_m = half_here[:2].mean(axis=0)[:, None]
    meets = np.hypot(along_m.clip(min=0), across_m.clip(min=0)) < radius_m
    meets &= np.abs(z) < half_here[2][:, None] + half_there[2]
    return {thing.instance for thing, met in zip(things, meets.any(axis=1), strict=True) if met}


def _turned(slopes: tuple[float, float], yaw_rad: float) -> tuple[float, float]:
    """Slopes along and across the street, along the axes of a turned solid."""
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    along, across = slopes
    return cosine * along + sine * across, cosine * across - sine * along


def build_ground(builder: Builder, draw: Generator, side: float, opening_m: float) -> None:
    """Roadway, pavement or verge, terrain; and a side street, ``opening_m`` wide (0: none)."""
    course, whole = builder.course, (0.0, BLOCK_M)
    edge_m, pavement_m = course.kerb(side).edge_m, course.kerb(side).pavement_m
    asphalt = (Semantic.ROAD, Material.ASPHALT, course.road_reflectivity)
    builder.slab(whole, (0.0, side * edge_m), *asphalt)
    paving = (Semantic.SIDEWALK, Material.PAVING, draw.uniform(0.15, 0.215))
    for _ in range(int(draw.poisson(0.7))):
        at = draw.uniform(0.5, edge_m) * side
        builder.puddle(draw, (builder.section.block + draw.random()) * BLOCK_M, at)
    pavement = (side * edge_m, side * (edge_m + pavement_m))
    beyond = (pavement[1], side * (edge_m + _TERRAIN_M))
    strips = (pavement, beyond) if pavement_m else (beyond,)
    builder.openings_m[side] = opening_m
    if opening_m:
        near, far = (0.0, (BLOCK_M - opening_m) / 2), ((BLOCK_M + opening_m) / 2, BLOCK_M)
        for strip in strips:
            builder.slab((near[1], far[0]), strip, *asphalt, course.step_up_m(side))
            builder.slab(near, strip, *paving)
            builder.slab(far, strip, *paving)
        return
    if pavement_m:
        builder.slab(whole, pavement, *paving)
    builder.slab(whole, beyond, Semantic.TERRAIN, Material.SOIL, draw.uniform(0.15, 0.22))

"""Puts solids on a street by street coordinates, and lays its ground."""

from __future__ import annotations

import math

import numpy as np

from r3dpa.simulation.course import BLOCK_M, Course, Section
from r3dpa.simulation.scene import Material, Primitive, Puddle, Semantic, Shape
from r3dpa.simulation.vehicles import Body

#: Walls and crowns reach into the ground, which falls away below them where the street is steep.
FOOTING_M = 0.6

_TERRAIN_M = 48.0
_SLAB_M = 1.0


class Builder:
    """Collects the solids of one block, given in street coordinates.

    Args:
        course: The drive's course.
        section: The block's section.
        first_instance: Number of the block's first object.

    Attributes:
        primitives: Solids that every scan has.
        details: Solids that only scans from nearby have.
        puddles: Where water can stand.
        num_objects: Numbers that were given away.
    """

    def __init__(self, course: Course, section: Section, first_instance: int) -> None:
        self.course = course
        self.section = section
        self.primitives: list[Primitive] = []
        self.details: list[Primitive] = []
        self.puddles: list[Puddle] = []
        self.num_objects = 0
        self._first_instance = first_instance

    def new_instance(self) -> int:
        """A number that no other object of the block has."""
        self.num_objects += 1
        return self._first_instance + self.num_objects - 1

    def solid(
        self,
        shape: Shape,
        at: tuple[float, float],
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
    ) -> None:
        """Add a solid that stands on the ground.

        Args:
            shape: Its shape.
            at: Its centre, (s, lateral).
            size: Along, across and up, metres.
            semantic: Its class.
            material: What it is made of.
            reflectivity: Of its surface.
            instance: Its number.
            bottom_m: Its lowest point above the ground.
            yaw_rad: Its turn against the street.
            inclined: Whether it follows the slope of the street, or stands level.
            extinction_per_m: Of foliage and wire mesh.
            detail: Whether only scans from nearby have it.
        """
        x, y, z = self.section.at(*at)
        z += self.course.surface_m(at[1]) + bottom_m + size[2] / 2
        slopes = (self.section.slope, self.section.cross)
        (self.details if detail else self.primitives).append(
            Primitive(
                shape,
                (x, y, z),
                (size[0] / 2, size[1] / 2, size[2] / 2),
                semantic,
                reflectivity,
                self.section.heading_rad + yaw_rad,
                instance,
                material,
                grade=_turned(slopes, yaw_rad) if inclined else (0.0, 0.0),
                extinction_per_m=extinction_per_m,
            )
        )

    def body(
        self,
        body: Body,
        at: tuple[float, float],
        yaw_rad: float,
        instance: int,
        speed_m_s: float = 0.0,
    ) -> None:
        """Add a vehicle or a person at (s, lateral), which moves the way it is turned."""
        x, y, z = self.section.at(*at)
        z += self.course.surface_m(at[1])
        heading = self.section.heading_rad + yaw_rad
        cosine, sine = math.cos(heading), math.sin(heading)
        cross = self.section.cross + self.course.surface_cross(at[1])
        grade = _turned((self.section.slope, cross), yaw_rad)
        velocity = (speed_m_s * cosine, speed_m_s * sine) if speed_m_s else (0.0, 0.0)
        for part in body:
            ahead, left, up = part.centre
            up += grade[0] * ahead + grade[1] * left
            primitive = Primitive(
                part.shape,
                (x + ahead * cosine - left * sine, y + ahead * sine + left * cosine, z + up),
                (part.size[0] / 2, part.size[1] / 2, part.size[2] / 2),
                part.semantic,
                part.reflectivity,
                heading,
                instance,
                part.material,
                velocity,
                grade,
            )
            (self.details if part.detail else self.primitives).append(primitive)

    def slab(
        self,
        along: tuple[float, float],
        across: tuple[float, float],
        semantic: Semantic,
        material: Material,
        reflectivity: float,
        sunk_m: float = 0.0,
    ) -> None:
        """Add a piece of ground between two distances along the chord and two lateral ones.

        It follows the surface of the street in its middle, ``sunk_m`` below it. At the ends of the
        block it reaches over the wedge that the bend of the street opens.
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
        self.primitives.append(
            Primitive(
                Shape.BOX,
                (x, y, z - _SLAB_M / 2),
                ((last - first) / 2, abs(across[1] - across[0]) / 2, _SLAB_M / 2),
                semantic,
                reflectivity,
                self.section.heading_rad,
                material=material,
                grade=(self.section.slope, self.section.cross + self.course.surface_cross(lateral)),
            )
        )

    def puddle(self, draw: np.random.Generator, s: float, lateral: float) -> None:
        """Add a place where water stands if the road is wet."""
        x, y, _ = self.section.at(s, lateral)
        self.puddles.append(Puddle(x, y, draw.uniform(0.3, 1.6)))


def _turned(slopes: tuple[float, float], yaw_rad: float) -> tuple[float, float]:
    """Slopes along and across the street, along the axes of a turned solid."""
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    along, across = slopes
    return cosine * along + sine * across, cosine * across - sine * along


def build_ground(builder: Builder, draw: np.random.Generator, side: float, opening: bool) -> None:
    """Roadway, pavement or verge, and terrain; with the opening of a side street."""
    course, whole = builder.course, (0.0, BLOCK_M)
    edge_m, pavement_m = course.kerb(side).edge_m, course.kerb(side).pavement_m
    asphalt = (Semantic.ROAD, Material.ASPHALT, course.road_reflectivity)
    builder.slab(whole, (0.0, side * edge_m), *asphalt)
    paving = (Semantic.SIDEWALK, Material.PAVING, draw.uniform(0.13, 0.19))
    for _ in range(int(draw.poisson(0.7))):
        at = draw.uniform(0.5, edge_m) * side
        builder.puddle(draw, (builder.section.block + draw.random()) * BLOCK_M, at)
    pavement = (side * edge_m, side * (edge_m + pavement_m))
    beyond = (pavement[1], side * (edge_m + _TERRAIN_M))
    strips = (pavement, beyond) if pavement_m else (beyond,)
    if opening:
        half_m = draw.uniform(2.8, 4.2)
        near, far = (0.0, BLOCK_M / 2 - half_m), (BLOCK_M / 2 + half_m, BLOCK_M)
        for strip in strips:
            builder.slab((near[1], far[0]), strip, *asphalt, course.kerb_m)
            builder.slab(near, strip, *paving)
            builder.slab(far, strip, *paving)
        return
    if pavement_m:
        builder.slab(whole, pavement, *paving)
    soil = (Semantic.TERRAIN, Material.SOIL, draw.uniform(0.15, 0.22))
    builder.slab(whole, beyond, *soil)

"""Endless streets; every block, actor and pose is a function of (seed, drive, scan)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from numbers import Integral
from typing import NamedTuple

from numpy.random import Generator

from lidarsim.draws import generator_for
from lidarsim.scene import (
    Conditions,
    EgoMotion,
    Pose,
    Primitive,
    Puddle,
    Scene,
    check_fields,
    draw_weather,
)
from lidarsim.street.builder import Builder, build_ground
from lidarsim.street.course import BLOCK_M, SCAN_PERIOD_S, Course, course_of
from lidarsim.street.kerbside import build_corner, build_island, build_kerbside
from lidarsim.street.people import cyclist, person
from lidarsim.street.plots import build_plots, build_side_street
from lidarsim.street.vehicles import Body, recording_car, vehicle

# Blocks behind and ahead of the car's own that are built: beyond lies less than 1 % of the
# returns of real scans.
_BLOCKS_BEHIND, _BLOCKS_AHEAD = 3, 3
# Details (licence plates, seats, panes) exist up to here.
_DETAIL_M = 25.0
# One character of the surroundings (town, houses, ...) per side lasts this many blocks.
_BLOCKS_PER_DISTRICT = 6
# Width of the roadway of a side street.
_SIDE_STREET_M = (5.6, 8.4)
# Weather lasts this many scans.
_SCANS_PER_WEATHER = 100
# A day of driving; the course of a drive is followed from its start.
#: Largest number of a scan in a drive.
LAST_SCAN = 1_000_000
# Instance numbers of blocks repeat after 200 blocks = 4.8 km, of actors of one kind in one lane
# after 1000.
_MAX_OBJECTS_PER_BLOCK = 256
_STATIC_BLOCKS = 200
_ACTORS_PER_STREAM = 1000
_FIRST_ACTOR = 1 + _STATIC_BLOCKS * _MAX_OBJECTS_PER_BLOCK
# The level ground lies this far below the lowest road of a scene.
_LEVEL_GROUND_M = 4.0


@dataclass(frozen=True)
class Street:
    """An endless street along which one drive is recorded.

    The axis bends gently and rises and falls; ``s`` runs along it, the lateral coordinate points
    to the left. Road, plots with houses and gardens, and the kerbside with parked cars, trees and
    street furniture stand still in blocks of 24 m. Vehicles, cyclists and people move in lanes. The
    recording car advances 1.0 to 1.4 m per scan or stands for a while. By its number and
    the seed a drive leads through a dense town, a suburb, a green edge of town, along an arterial
    road, past row houses, or through fields, see ``course.CHARACTERS``.

    Args:
        seed: Seed of the data set, 0 or greater.
        drive: Number of the drive, 0 or greater; each has a street of its own.
        weather: Weather of all scans; None draws another one every 100 scans.
    """

    seed: int
    drive: int
    weather: Conditions | None = None

    def __post_init__(self) -> None:
        check_fields(self, "be a whole number, 0 or greater", "seed", "drive")

    def scene(self, scan: int, sensor_height_m: float = 1.73) -> Scene:
        """Solids within 72 to 96 m along the street, pose and motion, weather and puddles.

        Args:
            scan: Number of the scan in the drive, 0 to 1,000,000.
            sensor_height_m: Frame origin of the sensor above the road.
        """
        weather = self.weather_of(scan)
        course = course_of(self.seed, self.drive)
        s = course.position(scan)
        ego_block = math.floor(s / BLOCK_M)
        primitives: list[Primitive] = []
        details: list[Primitive] = []
        puddles: list[Puddle] = []
        for number in range(ego_block - _BLOCKS_BEHIND, ego_block + _BLOCKS_AHEAD + 1):
            block = _block(self.seed, self.drive, number)
            primitives += block.primitives
            details += block.details
            puddles += block.puddles
        for builder in _actors(course, scan):
            primitives += builder.primitives
            details += builder.details
        pose = _pose(course, scan, sensor_height_m)
        speed_m_s = course.speed_m_s(scan) * course.section(s).stretch(course.ego_lateral_m)
        here = (pose.x_m, pose.y_m)
        near, far = list[Primitive](), list[Primitive]()
        for detail in details:
            (near if math.dist(detail.centre[:2], here) < _DETAIL_M else far).append(detail)
        primitives += near
        around = range(ego_block - _BLOCKS_BEHIND, ego_block + _BLOCKS_AHEAD + 2)
        return Scene(
            tuple(primitives),
            pose,
            EgoMotion(speed_m_s, course.speed_m_s(scan) * course.smooth(s)[1]),
            weather,
            tuple(puddles) if weather.water_film_mm > 0 else (),
            recording_car(),
            min(course.section_of(number).z_m for number in around) - _LEVEL_GROUND_M,
            course.road_reflectivity,
            unseen=tuple(far),
        )

    def weather_of(self, scan: int) -> Conditions:
        """The weather of one scan."""
        if not (isinstance(scan, Integral) and 0 <= scan <= LAST_SCAN):
            raise ValueError(f"scan must be a whole number in 0..{LAST_SCAN}, got {scan}")
        if self.weather is not None:
            return self.weather
        stretch = scan // _SCANS_PER_WEATHER
        return draw_weather(generator_for(self.seed, "weather", self.drive, stretch))


@lru_cache(maxsize=256)
def _block(seed: int, drive: int, block: int) -> Builder:
    """Static solids of one block of 24 m, in world coordinates; shared, do not modify."""
    course = course_of(seed, drive)
    first_instance = 1 + block % _STATIC_BLOCKS * _MAX_OBJECTS_PER_BLOCK
    builder = Builder(course, course.section_of(block), first_instance)
    draw = generator_for(seed, "block", drive, block)
    crosses = block % course.crossing_every == 0
    only_side = draw.choice((-1.0, 0.0, 1.0))  # 0: a crossing, else a T
    for side in (1.0, -1.0):
        stretch = block // _BLOCKS_PER_DISTRICT
        district = generator_for(seed, "district", drive, stretch, int(side > 0))
        opens = crosses and only_side in (0.0, side)
        opening_m = draw.uniform(*_SIDE_STREET_M) if opens else 0.0
        build_ground(builder, draw, side, opening_m)
        if opens:
            build_side_street(builder, draw, side, opening_m)
            build_corner(builder, draw, side)
        else:
            build_plots(builder, draw, side, district)
            build_kerbside(builder, draw, side, district)
        if course.kerb(side).pavement_m:
            builder.clear_walkway(side)
    builder.clear_places()
    if crosses and course.median_m:
        build_island(builder, draw)
    assert builder.num_objects < _MAX_OBJECTS_PER_BLOCK, f"block {block} has too many objects"
    return builder


def _pose(course: Course, scan: int, sensor_height_m: float) -> Pose:
    """Pose of the sensor: it follows the road, and the body of the car rocks a little."""
    s, lateral = course.position(scan), course.ego_lateral_m
    x, y, z = course.section(s).at(s, lateral)
    heading, _, slope = course.smooth(s)
    cross = course.section(s).cross + course.surface_cross(lateral)
    rocking = generator_for(course.seed, "tilt", course.drive, scan).normal(0.0, 0.002, 2)
    height_m = z + course.surface_m(lateral) + sensor_height_m
    pitch_rad = course.mount_pitch_rad - math.atan(slope) + rocking[0]
    # Uphill to the left means: the right side is down.
    roll_rad = course.mount_roll_rad + math.atan(cross) + rocking[1]
    return Pose(x, y, height_m, heading, pitch_rad, roll_rad)


class _Stream(NamedTuple):
    """Actors of one kind in one lane, all of one speed and at uneven distances."""

    kind: Callable[[Generator], Body]
    lateral_m: float
    direction: int  # 1 with the recording car, -1 against it
    speed_m_s: float | None  # None in the lane of the recording car: its speed
    gap_m: float


@lru_cache(maxsize=32)
def _streams(seed: int, drive: int) -> tuple[_Stream, ...]:
    course = course_of(seed, drive)
    character = course.character
    draw = generator_for(seed, "streams", drive)
    streams = []
    for lane in range(course.lanes[0]):
        is_ego_lane = lane == course.ego_lane
        speed_m_s = None if is_ego_lane else 10 * course.step_m * draw.uniform(0.85, 1.15)
        lateral = -course.lane_lateral_m(lane)
        streams.append(_Stream(vehicle, lateral, 1, speed_m_s, draw.uniform(*character.car_gap_m)))
    for lane in range(course.lanes[1]):
        lateral = course.lane_lateral_m(lane)
        gap_m = draw.uniform(*character.car_gap_m)
        streams.append(_Stream(vehicle, lateral, -1, draw.uniform(9, 15), gap_m))
    for side in (-1, 1):
        kerb = course.kerb(side)
        if course.lanes[side > 0]:
            speed_m_s, gap_m = draw.uniform(3.5, 6.5), draw.uniform(80, 300)
            streams.append(_Stream(cyclist, side * (kerb.lanes_m - 0.35), -side, speed_m_s, gap_m))
        if kerb.pavement_m:
            lateral = side * sum(course.walkway_m(side)) / 2
            # As many people as with one stream for each direction, who would meet.
            gap_m = draw.uniform(*character.people_gap_m) / 2
            speed_m_s, direction = draw.uniform(0.9, 1.7), draw.choice((-1, 1))
            streams.append(_Stream(person, lateral, direction, speed_m_s, gap_m))
    return tuple(streams)


@lru_cache(maxsize=1024)
def _actor(seed: int, drive: int, stream: int, number: int) -> tuple[float, float, Body]:
    """Offset of an actor from its regular place, along and across, and its body."""
    draw = generator_for(seed, "actor", drive, stream, number)
    kind = _streams(seed, drive)[stream].kind
    return draw.uniform(-0.3, 0.3), draw.normal(0.0, 0.08), kind(draw)


def _in_opening(course: Course, s: float, lateral: float) -> bool:
    """Whether a place beside the road lies in a side street."""
    number, along_m = divmod(s, BLOCK_M)
    opening_m = _block(course.seed, course.drive, int(number)).openings_m[math.copysign(1, lateral)]
    return abs(along_m - BLOCK_M / 2) < opening_m / 2


def _actors(course: Course, scan: int) -> Iterator[Builder]:
    own_s = course.position(scan)
    behind_m, ahead_m = (_BLOCKS_BEHIND - 0.1) * BLOCK_M, (_BLOCKS_AHEAD - 0.1) * BLOCK_M
    for index, stream in enumerate(_streams(course.seed, course.drive)):
        speed_m_s = course.speed_m_s(scan) if stream.speed_m_s is None else stream.speed_m_s
        moved_m = stream.direction * speed_m_s * SCAN_PERIOD_S * scan
        if stream.speed_m_s is None:
            moved_m = own_s
        first = math.ceil((own_s - behind_m - moved_m) / stream.gap_m)
        last = math.floor((own_s + ahead_m - moved_m) / stream.gap_m)
        for number in range(first, last + 1):
            if stream.speed_m_s is None and number == 0:
                continue  # the recording car itself
            # Keys must not be negative.
            along, across, body = _actor(course.seed, course.drive, index, number + 2**24)
            s = moved_m + stream.gap_m * (number + along)
            section = course.section(s)
            instance = _FIRST_ACTOR + index * _ACTORS_PER_STREAM + number % _ACTORS_PER_STREAM
            builder = Builder(course, section, instance)
            yaw_rad = 0.0 if stream.direction > 0 else math.pi
            lateral = stream.lateral_m + across
            speed = speed_m_s * section.stretch(lateral)
            sunk_m = 0.0
            if stream.kind is person and _in_opening(course, s, lateral):
                sunk_m = course.step_up_m(lateral)
            builder.body(body, (s, lateral), yaw_rad, instance, speed, sunk_m)
            yield builder

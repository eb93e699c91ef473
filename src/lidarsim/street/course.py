"""Course of a drive: axis and slope of the street, motion of the recording car."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lidarsim.draws import generator_for
from lidarsim.scene import Interval

#: The street is built block by block of this length.
BLOCK_M = 24.0
#: The street begins this far before the first scan.
START_M = 10 * BLOCK_M
SCAN_PERIOD_S = 0.1

_CAMBER = 0.02
# Lanes and pavements of German residential streets.
_LANE_M, _PAVEMENT_M = (2.75, 3.25), (1.6, 3.2)
_GUTTER_M = (0.5, 0.9)
#: Width of the places for parked cars.
PARKING_M = 2.1
# Between the lanes of both directions on roads with traffic islands.
_MEDIAN_M = 1.4
# People walk between these distances from the plots.
_WALKWAY_M = (1.1, 0.1)
# Bins are emptied on one working day of five.
_COLLECTION_DAYS = 0.2
_RISE = (-0.022, 0.03)
# A cross slope that bends on a hill have left dies away by this factor from block to block.
_LEVELLING = 0.93
_BLOCKS_PER_TABLE = 32
# Tables that one call makes, each from the one before: Python limits the depth of recursion.
_TABLES_PER_CALL = 100

#: Amplitude, length and phase.
Wave = tuple[float, float, float]


class Character(NamedTuple):
    """Surroundings of a drive; pairs are intervals to draw from.

    ``lanes``: possible numbers of lanes ahead and towards us. ``districts``: weights of town, row
    houses, houses, blocks of flats, green, yards and fields. ``parked``: share of taken places.
    ``parking``, ``pavement``: chance. ``clutter``: mean number of small things on 24 m of
    pavement. ``people``: chance of people who stand there. ``lights``: whether crossings have
    traffic lights. ``island``: chance of a median with traffic islands at its crossings.

    Shares of parked cars and clutter were chosen for the depth edges of recorded streets, see
    ``tests/bench/street_fullness.py``.
    """

    lanes: tuple[tuple[int, int], ...]
    districts: tuple[float, float, float, float, float, float, float]
    parked: tuple[float, float]
    parking: float
    pavement: float
    clutter: float
    people: float
    lights: bool
    island: float
    car_gap_m: tuple[float, float]
    people_gap_m: tuple[float, float]
    crossing_every: tuple[int, int]
    slope: float


_TOWN = Character(
    lanes=((1, 1), (1, 1), (1, 0)), districts=(0.6, 0.15, 0.0, 0.1, 0.1, 0.05, 0.0),
    parked=(0.17, 0.45), parking=0.8, pavement=1.0, clutter=1.1, people=0.52, lights=True,
    island=0.3, car_gap_m=(40, 90), people_gap_m=(40, 90), crossing_every=(3, 6), slope=0.01,
)  # fmt: skip
_ROW_HOUSES = Character(
    lanes=((1, 1), (1, 0)), districts=(0.1, 0.55, 0.2, 0.1, 0.05, 0.0, 0.0),
    parked=(0.21, 0.57), parking=0.8, pavement=0.95, clutter=2.4, people=0.22, lights=False,
    island=0.1, car_gap_m=(60, 140), people_gap_m=(50, 140), crossing_every=(4, 8), slope=0.02,
)  # fmt: skip
_SUBURB = Character(
    lanes=((1, 1), (1, 0)), districts=(0.05, 0.15, 0.65, 0.05, 0.1, 0.0, 0.0),
    parked=(0.18, 0.54), parking=0.75, pavement=0.95, clutter=2.2, people=0.22, lights=False,
    island=0.1, car_gap_m=(60, 140), people_gap_m=(60, 160), crossing_every=(4, 8), slope=0.025,
)  # fmt: skip
_GREEN = Character(
    lanes=((1, 1),), districts=(0.05, 0.05, 0.15, 0.1, 0.55, 0.1, 0.0),
    parked=(0.17, 0.48), parking=0.4, pavement=0.6, clutter=0.4, people=0.08, lights=False,
    island=0.2, car_gap_m=(60, 140), people_gap_m=(80, 200), crossing_every=(6, 10), slope=0.025,
)  # fmt: skip
_ARTERIAL = Character(
    lanes=((2, 2), (2, 1), (2, 2)), districts=(0.1, 0.05, 0.15, 0.2, 0.4, 0.1, 0.0),
    parked=(0.21, 0.52), parking=0.5, pavement=0.8, clutter=3.1, people=0.15, lights=True,
    island=0.5, car_gap_m=(40, 70), people_gap_m=(60, 160), crossing_every=(5, 9), slope=0.015,
)  # fmt: skip
_COUNTRY = Character(
    lanes=((1, 1),), districts=(0.0, 0.0, 0.2, 0.0, 0.3, 0.05, 0.45),
    parked=(0.12, 0.5), parking=0.2, pavement=0.3, clutter=0.6, people=0.04, lights=False,
    island=0.2, car_gap_m=(60, 160), people_gap_m=(120, 300), crossing_every=(8, 12), slope=0.025,
)  # fmt: skip

#: Surroundings by the number of the drive, in turn: KITTI-360 leads mostly through suburbs.
CHARACTERS = (_TOWN, _SUBURB, _GREEN, _ARTERIAL, _ROW_HOUSES, _SUBURB, _COUNTRY)


class Kerb(NamedTuple):
    """One side of the road, as lateral distances."""

    lanes_m: float
    edge_m: float
    pavement_m: float  # width, 0 for a verge
    parking: bool
    rise: float  # of the terrain beyond, per metre away from the road


class Section(NamedTuple):
    """The street in one block: a straight piece of a chain whose pieces meet at their ends.

    Positions are the distance ``s`` along the chain and the lateral distance, positive to the
    left. Heights follow a plane; on the bisectors of the corners neighbouring planes meet to
    within 2 cm over the width of the road.
    """

    block: int
    x_m: float  # of the start
    y_m: float
    z_m: float
    heading_rad: float
    slope: float  # rise per metre along
    cross: float  # rise per metre to the left
    corner_before: float  # tangent of half the turn at the start
    corner_after: float  # and at the end

    def at(self, s: float, lateral: float) -> tuple[float, float, float]:
        """World position on the plane; lines of equal lateral go on in the next block."""
        along = s - self.block * BLOCK_M
        first = lateral * self.corner_before
        last = BLOCK_M - lateral * self.corner_after
        return self.on_chord(first + (last - first) * along / BLOCK_M, lateral)

    def on_chord(self, along: float, lateral: float) -> tuple[float, float, float]:
        """World position on the plane, ``along`` metres from the start of the block."""
        cosine, sine = math.cos(self.heading_rad), math.sin(self.heading_rad)
        return (
            self.x_m + along * cosine - lateral * sine,
            self.y_m + along * sine + lateral * cosine,
            self.z_m + self.slope * along + self.cross * lateral,
        )

    def stretch(self, lateral: float) -> float:
        """Metres in the world per metre of ``s``, at a lateral distance."""
        return 1 - lateral * (self.corner_before + self.corner_after) / BLOCK_M


class Course(NamedTuple):
    """Constants of a drive; lengths in metres, angles in radians."""

    seed: int
    drive: int
    character: Character
    lane_m: float
    lanes: tuple[int, int]
    median_m: float  # between the lanes of both directions, 0 without traffic islands
    ego_lane: int
    kerbs: tuple[Kerb, Kerb]  # right, left
    kerb_m: float
    crossing_every: int
    collection_day: bool  # bins stand at the kerb
    road_reflectivity: float
    mount_pitch_rad: float
    mount_roll_rad: float
    step_m: float
    sway_m: float
    sway_period: float
    sway_phase: float
    stop_every: int
    stop_from: int
    stop_scans: int
    bends: tuple[Wave, ...]
    slopes: tuple[Wave, ...]

    @property
    def ego_lateral_m(self) -> float:
        """Lateral distance of the recording car from the axis; it drives on the right."""
        return -self.lane_lateral_m(self.ego_lane)

    def lane_lateral_m(self, lane: int) -> float:
        """Distance of the middle of a lane from the axis; lane 0 is the innermost."""
        return self.median_m / 2 + (lane + 0.5) * self.lane_m

    def kerb(self, side: float) -> Kerb:
        """The right (-1) or left (1) side of the road."""
        return self.kerbs[1 if side > 0 else 0]

    def walkway_m(self, side: float) -> Interval:
        """Distances from the axis between which people walk on the pavement of one side."""
        kerb = self.kerb(side)
        far_m = kerb.edge_m + kerb.pavement_m
        return far_m - _WALKWAY_M[0], far_m - _WALKWAY_M[1]

    def step_up_m(self, lateral: float) -> float:
        """Height of the kerb on one side of the road; a verge begins without one."""
        return self.kerb_m if self.kerb(lateral).pavement_m else 0.0

    def surface_m(self, lateral: float) -> float:
        """Height of road, pavement or terrain above the plane of the section.

        The road falls by 2 % from the axis to both kerbs; the pavement is level.
        """
        kerb = self.kerb(lateral)
        if abs(lateral) < kerb.edge_m:
            return -_CAMBER * abs(lateral)
        beyond_m = max(abs(lateral) - kerb.edge_m - kerb.pavement_m, 0.0)
        return self.step_up_m(lateral) - _CAMBER * kerb.edge_m + kerb.rise * beyond_m

    def surface_cross(self, lateral: float) -> float:
        """Rise of that surface per metre to the left, above the plane of the section."""
        kerb = self.kerb(lateral)
        if abs(lateral) < kerb.edge_m:
            return math.copysign(_CAMBER, -lateral)
        if abs(lateral) < kerb.edge_m + kerb.pavement_m:
            return 0.0
        return kerb.rise * math.copysign(1.0, lateral)

    def _moving(self, scan: int) -> tuple[int, bool]:
        """Number of earlier scans in which the car moved, and whether it waits in this one."""
        if not self.stop_scans or scan < self.stop_from:
            return scan, False
        stops, since = divmod(scan - self.stop_from, self.stop_every)
        stood = stops * self.stop_scans + min(since, self.stop_scans)
        return scan - stood, since < self.stop_scans

    def position(self, scan: int) -> float:
        """Position of the recording car along the axis: 1.0 to 1.4 m further each scan, or waiting.

        It sometimes waits for some scans, as at traffic lights; braking is not modelled.
        """
        moved, _ = self._moving(scan)
        phase = 2 * math.pi * moved / self.sway_period + self.sway_phase
        return START_M + self.step_m * moved + self.sway_m * math.sin(phase)

    def speed_m_s(self, scan: int) -> float:
        """Its speed along the axis: derivative of the position, 0 while it waits."""
        moved, waits = self._moving(scan)
        if waits:
            return 0.0
        rate = 2 * math.pi / self.sway_period
        sway = self.sway_m * rate * math.cos(rate * moved + self.sway_phase)
        return (self.step_m + sway) / SCAN_PERIOD_S

    def section(self, s: float) -> Section:
        """The section in which ``s`` lies."""
        return self.section_of(math.floor(s / BLOCK_M))

    def section_of(self, block: int) -> Section:
        """The section of a block, 0 or greater."""
        table, place = divmod(block, _BLOCKS_PER_TABLE)
        return _sections(self, table)[place]

    def smooth(self, s: float) -> tuple[float, float, float]:
        """Heading, its change per metre, and slope: even between the middles of the blocks."""
        before = math.floor(s / BLOCK_M - 0.5)
        share = s / BLOCK_M - 0.5 - before
        first, second = self.section_of(before), self.section_of(before + 1)
        turn = second.heading_rad - first.heading_rad
        slope = (1 - share) * first.slope + share * second.slope
        return first.heading_rad + share * turn, turn / BLOCK_M, slope


@lru_cache(maxsize=32)
def course_of(seed: int, drive: int) -> Course:
    """The course of a drive; neighbouring drives lead through places of different character."""
    draw = generator_for(seed, "course", drive)
    character = CHARACTERS[(drive + seed) % len(CHARACTERS)]
    lane_m = draw.uniform(*_LANE_M)
    lanes = character.lanes[int(draw.integers(len(character.lanes)))]
    # From a generator of its own, so that the chance of islands changes no other course.
    has_islands = lanes[1] > 0 and generator_for(seed, "islands", drive).random() < character.island
    median_m = _MEDIAN_M if has_islands else 0.0
    kerbs = []
    for count in lanes:
        parking = bool(draw.random() < character.parking)
        lanes_m = median_m / 2 + count * lane_m + draw.uniform(*_GUTTER_M)
        pavement_m = draw.uniform(*_PAVEMENT_M) if draw.random() < character.pavement else 0.0
        edge_m, rise = lanes_m + parking * PARKING_M, draw.uniform(*_RISE)
        kerbs.append(Kerb(lanes_m, edge_m, pavement_m, parking, rise))
    period = draw.uniform(40.0, 90.0)
    # Sums of two waves: (amplitude, length, phase) of the heading and of the slope.
    tall = draw.uniform(0.1, 0.28, 2)
    bends = _waves(tall, draw.uniform([260, 420], [400, 700]), draw.uniform(0, 6.28, 2))
    steepest = np.full(2, draw.uniform(0.2, 0.5) * character.slope)
    slopes = _waves(steepest, draw.uniform([240, 520], [300, 800]), draw.uniform(0, 6.28, 2))
    return Course(
        seed=seed,
        drive=drive,
        character=character,
        lane_m=lane_m,
        lanes=lanes,
        median_m=median_m,
        ego_lane=int(draw.integers(lanes[0])),
        kerbs=(kerbs[0], kerbs[1]),
        kerb_m=draw.uniform(0.08, 0.15),
        crossing_every=int(draw.integers(*character.crossing_every, endpoint=True)),
        collection_day=bool(draw.random() < _COLLECTION_DAYS),
        road_reflectivity=draw.uniform(0.15, 0.215),
        mount_pitch_rad=draw.normal(0.009, 0.003),
        mount_roll_rad=draw.normal(0.0, 0.004),
        step_m=draw.uniform(1.12, 1.28),
        sway_m=draw.uniform(0.02, 0.08) * period / (2 * math.pi),
        sway_period=period,
        sway_phase=draw.uniform(0, 2 * math.pi),
        stop_every=int(draw.integers(150, 400)),
        stop_from=int(draw.integers(20, 150)),
        stop_scans=int(draw.integers(10, 50)) if draw.random() < 0.7 else 0,
        bends=bends,
        slopes=slopes,
    )


def _waves(sizes: np.ndarray, lengths: np.ndarray, phases: np.ndarray) -> tuple[Wave, ...]:
    return tuple(zip(sizes.tolist(), lengths.tolist(), phases.tolist(), strict=True))


def _sum(waves: tuple[Wave, ...], s: float) -> float:
    return sum(size * math.sin(2 * math.pi * s / length + phase) for size, length, phase in waves)


@lru_cache(maxsize=256)
def _sections(course: Course, table: int) -> tuple[Section, ...]:
    sections: list[Section] = []
    for earlier in range(0, table, _TABLES_PER_CALL):
        _sections(course, earlier)
    last = _sections(course, table - 1)[-1] if table else None
    first = table * _BLOCKS_PER_TABLE
    for block in range(first, first + _BLOCKS_PER_TABLE):
        middle = (block + 0.5) * BLOCK_M
        heading, slope = _sum(course.bends, middle), _sum(course.slopes, middle)
        after = math.tan((_sum(course.bends, middle + BLOCK_M) - heading) / 2)
        if last is None:
            section = Section(block, 0.0, 0.0, 0.0, heading, slope, 0.0, 0.0, after)
        else:
            corner = math.tan((heading - last.heading_rad) / 2)
            # Without levelling both planes would rise exactly alike on the bisector.
            cross = _LEVELLING * last.cross - corner * (last.slope + slope)
            end = last.on_chord(BLOCK_M, 0.0)
            section = Section(block, *end, heading, slope, cross, corner, after)
        sections.append(section)
        last = section
    return tuple(sections)

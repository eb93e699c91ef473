"""Seeded endless streets: every block, car and pose follows from (seed, drive, scan) alone."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from r3dpa.simulation.effects import DetectionLimit, Effect, LambertianReflection
from r3dpa.simulation.roadside import (
    BLOCK_M,
    DISTRICTS,
    KERB_M,
    Builder,
    Frame,
    build_kerbside,
    build_side_street,
)
from r3dpa.simulation.scene import Pose, Primitive, Scene, Semantic

# Blocks behind and ahead of the car's own that are built: beyond lies less than 1 % of the
# returns of real scans.
_BLOCKS_BEHIND, _BLOCKS_AHEAD = 4, 4
# One character of the surroundings (town, houses, ...) per side lasts this many blocks.
_BLOCKS_PER_DISTRICT = 8
_TERRAIN_M = 0.15
_MAX_OBJECTS_PER_BLOCK = 80
_STATIC_BLOCKS = 700  # instance numbers of blocks repeat after 700 blocks = 14 km
_MOVING_INSTANCES = 1 + _STATIC_BLOCKS * _MAX_OBJECTS_PER_BLOCK
_CAR_GAP_M = 34.0

_DRY_EFFECTS: tuple[Effect, ...] = (LambertianReflection(), DetectionLimit())


def generator_for(*key: int | str) -> np.random.Generator:
    """Random generator of a key of numbers (0 or greater) and words; equal keys, equal draws."""
    words = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(words)))


@dataclass(frozen=True)
class Street:
    """An endless street along which one drive is recorded.

    The axis bends gently; s runs along it, the lateral coordinate points to the left. Roadway,
    pavements, buildings, parked cars, lamps, signs, trees, hedges, fences and people stand still
    in blocks of 20 m, cars move in two lanes, and the recording car advances 1.0 to 1.4 m a scan.

    Args:
        seed: Seed of the data set.
        drive: Number of the drive; each has a street of its own.

    Raises:
        ValueError: If the seed or the drive is negative.
    """

    seed: int
    drive: int

    def __post_init__(self) -> None:
        """Check the values."""
        if self.seed < 0 or self.drive < 0:
            raise ValueError(
                f"seed and drive must be 0 or greater, got {self.seed} and {self.drive}"
            )

    def scene(self, scan: int, sensor_height_m: float = 1.73) -> Scene:
        """The scene of one scan; scans of a drive may be asked for in any order.

        Args:
            scan: Number of the scan in the drive, 0 or greater.
            sensor_height_m: Frame origin of the sensor above the road.

        Returns:
            Standing and moving primitives within about 90 m, the pose, and the effects of a dry
            scene: Lambertian reflection and the detection limit.

        Raises:
            ValueError: If ``scan`` is negative.
        """
        if scan < 0:
            raise ValueError(f"scan must be 0 or greater, got {scan}")
        plan = _plan(self)
        s = plan.position(scan)
        block = math.floor(s / BLOCK_M)
        blocks = range(block - _BLOCKS_BEHIND, block + _BLOCKS_AHEAD + 1)
        primitives = [primitive for b in blocks for primitive in _block(self, b)]
        primitives += _traffic(self, plan, scan)
        x, y, heading = _frame(plan, s)(s, -plan.lane_m)
        tilt = generator_for(self.seed, "tilt", self.drive, scan).normal(0.0, 0.002, 2)
        pose = Pose(
            x, y, sensor_height_m, heading, plan.pitch_rad + tilt[0], plan.roll_rad + tilt[1]
        )
        return Scene(tuple(primitives), pose, _DRY_EFFECTS, plan.road_reflectivity)


class _Plan(NamedTuple):
    """What stays the same along a drive; lengths in metres, angles in radians."""

    half_road_m: float
    pavement_m: float
    lane_m: float  # lateral distance of each lane's centre from the axis
    crossing_every: int
    road_reflectivity: float
    pitch_rad: float
    roll_rad: float
    step_m: float
    sway_m: float
    sway_period: float
    sway_phase: float
    bends: NDArray[np.float64]  # (2, 3): amplitude, length, phase of the axis' heading

    def position(self, scan: float) -> float:
        """Where along the axis the recording car is at a scan; grows by 1.0 to 1.4 m a scan."""
        phase = 2 * math.pi * scan / self.sway_period + self.sway_phase
        return self.step_m * scan + self.sway_m * math.sin(phase)

    def heading(self, s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Direction of the axis at s, radians."""
        amplitude, length, phase = self.bends.T[:, :, None]
        return (amplitude * np.sin(2 * np.pi * s / length + phase)).sum(axis=0)


@lru_cache(maxsize=32)
def _plan(street: Street) -> _Plan:
    draw = generator_for(street.seed, "plan", street.drive)
    half_road_m = draw.uniform(5.0, 6.2)
    period = draw.uniform(40.0, 90.0)
    bends = np.stack(
        [draw.uniform(0.1, 0.2, 2), draw.uniform([260, 450], [400, 800]), draw.uniform(0, 6.28, 2)],
        axis=1,
    )
    return _Plan(
        half_road_m=half_road_m,
        pavement_m=draw.uniform(1.8, 3.6),
        lane_m=(half_road_m - 2.2) / 2,
        crossing_every=int(draw.integers(5, 10)),
        road_reflectivity=draw.uniform(0.12, 0.18),
        pitch_rad=draw.normal(0.0, 0.006),
        roll_rad=draw.normal(0.0, 0.006),
        step_m=draw.uniform(1.1, 1.3),
        sway_m=draw.uniform(0.3, 1.0) * 0.1 * period / (2 * math.pi),
        sway_period=period,
        sway_phase=draw.uniform(0, 2 * math.pi),
        bends=bends,
    )


def _frame(plan: _Plan, s_block: float) -> Frame:
    """Street to world coordinates in the block that holds ``s_block``.

    The axis is a chain of chords, one a block; its corners are summed from block 0 on, so that
    each block lies at the same place in every scan. The heading follows the smooth bend.
    """
    block = math.floor(s_block / BLOCK_M)
    sign = 1 if block >= 0 else -1
    before = np.arange(block) if block >= 0 else np.arange(-1, block - 1, -1)
    chords = plan.heading((before + 0.5) * BLOCK_M)
    x = sign * BLOCK_M * float(np.cos(chords).cumsum()[-1]) if block else 0.0
    y = sign * BLOCK_M * float(np.sin(chords).cumsum()[-1]) if block else 0.0
    chord = _chord(plan, block)
    cos_chord, sin_chord = math.cos(chord), math.sin(chord)

    def world(s: float, lateral: float) -> tuple[float, float, float]:
        along = s - block * BLOCK_M
        heading = float(plan.heading(np.array([s]))[0])
        return (
            x + along * cos_chord - lateral * sin_chord,
            y + along * sin_chord + lateral * cos_chord,
            heading,
        )

    return world


def _chord(plan: _Plan, block: int) -> float:
    """Direction of the straight piece of axis in a block, radians."""
    return float(plan.heading(np.array([(block + 0.5) * BLOCK_M]))[0])


@lru_cache(maxsize=256)
def _block(street: Street, block: int) -> tuple[Primitive, ...]:
    """Standing primitives of one block of 20 m, in world coordinates."""
    plan = _plan(street)
    start = block * BLOCK_M
    first_instance = 1 + block % _STATIC_BLOCKS * _MAX_OBJECTS_PER_BLOCK
    builder = Builder(_frame(plan, start + BLOCK_M / 2), _chord(plan, block), first_instance)
    # Blocks behind the start of the drive have negative numbers; keys must not.
    key = block + 1000
    draw = generator_for(street.seed, "block", street.drive, key)
    crossing = key % plan.crossing_every == 0
    for side in (1.0, -1.0):
        district = generator_for(
            street.seed, "district", street.drive, key // _BLOCKS_PER_DISTRICT, int(side > 0)
        )
        edge_m = plan.half_road_m + plan.pavement_m
        if crossing:
            build_side_street(builder, draw, start, side, plan.half_road_m)
        else:
            size = (BLOCK_M + 1.0, plan.pavement_m, KERB_M)
            lateral = side * (plan.half_road_m + plan.pavement_m / 2)
            builder.box((start + BLOCK_M / 2, lateral), size, Semantic.SIDEWALK, 0.25)
            size = (BLOCK_M + 3.0, 50.0, _TERRAIN_M)
            builder.box((start + BLOCK_M / 2, side * (edge_m + 25.0)), size, Semantic.TERRAIN, 0.3)
            build_district = DISTRICTS[int(district.integers(len(DISTRICTS)))]
            build_district(builder, draw, start, side, edge_m)
            build_kerbside(builder, draw, start, side, plan.half_road_m, plan.pavement_m, district)
    assert builder.num_objects < _MAX_OBJECTS_PER_BLOCK, f"block {block} has too many objects"
    return tuple(builder.primitives)


def _traffic(street: Street, plan: _Plan, scan: int) -> list[Primitive]:
    """Cars in motion: the own lane keeps its distance, the other one comes towards us."""
    primitives: list[Primitive] = []
    own_s = plan.position(scan)
    reach_m = _BLOCKS_AHEAD * BLOCK_M
    oncoming_m = -1.1 * plan.step_m * scan
    for lane, (moved, lateral) in enumerate(((own_s, -plan.lane_m), (oncoming_m, plan.lane_m))):
        first = math.ceil((own_s - reach_m - moved) / _CAR_GAP_M)
        last = math.floor((own_s + reach_m - moved) / _CAR_GAP_M)
        for number in range(first, last + 1):
            # Number 0 of the own lane is the recording car itself.
            draw = generator_for(street.seed, "car", street.drive, lane, number + 2**24)
            jitter = draw.uniform(-0.35, 0.35)
            if draw.random() < 0.5 or (lane == 0 and number == 0):
                continue
            s = moved + _CAR_GAP_M * (number + jitter)
            frame = _frame(plan, s)
            heading = frame(s, 0.0)[2]
            instance = _MOVING_INSTANCES + 2 * (number % 500) + lane
            builder = Builder(frame, heading, instance)
            yaw_rad = 0.0 if lane == 0 else math.pi
            builder.car((s, lateral + draw.normal(0, 0.12)), draw, yaw_rad, instance)
            primitives += builder.primitives
    return primitives

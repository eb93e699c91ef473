"""Plots beside a street: what stands where, by district.

A builder of a block side fills ``BLOCK_M`` metres of street from ``start`` on one ``side`` of the
axis (1 left, -1 right), outwards from the lateral distance ``edge_m`` at which the plot begins.
"""

from __future__ import annotations

import math

from numpy.random import Generator

from lidarsim.scene import Material, Semantic
from lidarsim.street.builder import Builder, Strip
from lidarsim.street.buildings import Front, building, carport, garage, hall, row_houses, shed
from lidarsim.street.course import BLOCK_M, PARKING_M
from lidarsim.street.furniture import bicycles, bins, poster
from lidarsim.street.gardens import border, fence, front_garden, hedge, shrub, verge
from lidarsim.street.trees import garden_tree, meadow, wood_edge
from lidarsim.street.vehicles import parked_vehicle
from lidarsim.street.works import building_site, scaffolding

# A drive beside a house, wide enough for a garage, and long enough for a van before it.
_DRIVE_M, _DRIVE_LONG_M = 4.0, 8.6
# Metres of street per tree behind the houses.
_BACK_TREE_M = 4.0
# Trees in the front garden of a detached house, on average.
_FRONT_TREES = 1.7
# Parked at right angles on a car park: places of 2.5 m and some room.
_SLOT_M = 2.8
# Depth of a car park along the street: a row of cars and the lane behind it.
_CAR_PARK_M = 10.0


def build_plots(builder: Builder, draw: Generator, side: float, district: Generator) -> None:
    """Plots on one side of a block; ``district`` is drawn for several blocks."""
    start = builder.section.block * BLOCK_M
    kerb = builder.course.kerb(side)
    weights = builder.course.character.districts
    build = _DISTRICTS[int(district.choice(len(_DISTRICTS), p=weights))]
    build(builder, draw, start, side, kerb.edge_m + max(kerb.pavement_m, 1.2))


def _town(builder: Builder, draw: Generator, start: float, side: float, edge_m: float) -> None:
    """Facades in a row, some behind a narrow garden, now and then a passage with a yard."""
    s, end = start, start + BLOCK_M
    while s < end - 4:
        last = min(s + draw.uniform(6, 16), end)
        kind = draw.random()
        if kind < 0.5:
            front_m = edge_m + draw.uniform(0.0, 0.8)
            front = Front(side, s, last, front_m)
            building(builder, draw, front, draw.uniform(8, 12), 12.0)
        elif kind < 0.85:
            front_m = edge_m + draw.uniform(2.0, 4.5)
            front = Front(side, s, last, front_m)
            building(builder, draw, front, draw.uniform(8, 12), 10.0)
            if draw.random() < 0.08:
                scaffolding(builder, draw, front, 6.0)
            border(builder, draw, side * (edge_m + 0.4), s, last)
            front_garden(builder, draw, Strip(side, s, last, edge_m + 0.8, front_m))
        else:
            _passage(builder, draw, s, last, side, edge_m)
        s = last
    if draw.random() < 0.5:
        _behind(builder, draw, start, side * (edge_m + 22), 0.8)


def _passage(
    builder: Builder, draw: Generator, s: float, last: float, side: float, edge_m: float
) -> None:
    """A gap between houses: a gate, parked cars or a yard with bins, greenery at the back."""
    middle = (s + last) / 2
    if draw.random() < 0.4:
        fence(builder, draw, side * (edge_m + 0.3), s, last)
    if draw.random() < 0.5:
        _car_in_plot(builder, draw, middle, side, edge_m)
    bins(builder, draw, s + 0.8, side * (edge_m + draw.uniform(1.5, 6)))
    for away_m in (9.0, 14.0):
        shrub(builder, draw, draw.uniform(s, last), side * (edge_m + away_m))
    garden_tree(builder, draw, middle, side * (edge_m + draw.uniform(12, 18)))


def _row_houses(
    builder: Builder, draw: Generator, start: float, side: float, edge_m: float
) -> None:
    """Row houses behind front gardens, each with its border and bins."""
    end = start + BLOCK_M
    setback_m = draw.uniform(2.5, 5.0)
    front = Front(side, start, end - draw.choice((0.0, 2.5)), edge_m + setback_m)
    row_houses(builder, draw, front)
    for first, last in ((start, start + 8), (start + 8, start + 16), (start + 16, end)):
        if draw.random() < 0.75:
            border(builder, draw, side * (edge_m + 0.4), first, last - 1.3)
        front_garden(builder, draw, Strip(side, first, last, edge_m + 0.8, edge_m + setback_m))
        if draw.random() < 0.5:
            bins(builder, draw, last - 1.2, side * (edge_m + draw.uniform(0.5, setback_m - 1)))
    for _ in range(int(draw.poisson(_FRONT_TREES))):
        at = side * (edge_m + draw.uniform(1.2, setback_m - 0.8))
        garden_tree(builder, draw, draw.uniform(start + 1, end - 1), at)
    if draw.random() < 0.8:
        _behind(builder, draw, start, side * (edge_m + draw.uniform(15, 23)), 0.95)


def _houses(builder: Builder, draw: Generator, start: float, side: float, edge_m: float) -> None:
    """A detached house with a drive beside it, in a garden behind a border."""
    drive_first = bool(draw.random() < 0.5)
    plot = start + _DRIVE_M * drive_first
    plot_end = plot + BLOCK_M - _DRIVE_M
    drive_s = start + (_DRIVE_M / 2 if drive_first else BLOCK_M - _DRIVE_M / 2)
    setback_m, wide_m = draw.uniform(2.5, 6.5), draw.uniform(8, 14)
    first = draw.uniform(plot + 0.5, plot_end - wide_m - 0.5)
    front_m, size = edge_m + setback_m, (draw.uniform(8, 11), draw.uniform(4, 9))
    building(builder, draw, Front(side, first, first + wide_m, front_m), *size)
    if draw.random() < 0.9:
        border(builder, draw, side * (edge_m + 0.4), plot, plot_end)
    front_garden(builder, draw, Strip(side, plot, plot_end, edge_m + 0.9, front_m))
    for _ in range(int(draw.poisson(_FRONT_TREES))):
        at = side * (edge_m + draw.uniform(1.5, max(1.6, setback_m - 1.0)))
        garden_tree(builder, draw, draw.uniform(plot + 1, plot_end - 1), at)
    # Beside the house one looks between the plots into the gardens behind.
    for gap_first, gap_last in ((plot, first), (first + wide_m, plot_end)):
        _side_garden(builder, draw, side, gap_first, gap_last, front_m)
    _drive(builder, draw, drive_s, side, edge_m)
    if draw.random() < 0.8:
        _behind(builder, draw, start, side * (edge_m + draw.uniform(15, 23)), 0.95)


def _side_garden(
    builder: Builder, draw: Generator, side: float, first: float, last: float, front_m: float
) -> None:
    """What is seen through the gap beside a house: shrubs, a fence, a shed, trees."""
    wide_m = last - first
    if wide_m < 1.5:
        return
    for away_m in draw.uniform(1, 16, 5):
        shrub(builder, draw, draw.uniform(first, last), side * (front_m + away_m))
    for away_m in (draw.uniform(1, 4), draw.uniform(5, 14)):
        if draw.random() < 0.6:
            fence(builder, draw, side * (front_m + away_m), first, last)
    if wide_m > 3 and draw.random() < 0.4:
        shed(builder, draw, (first + last) / 2, side * (front_m + draw.uniform(10, 14)))
    for _ in range(1 + int(draw.poisson(wide_m / _BACK_TREE_M))):
        at = side * (front_m + draw.uniform(6, 18))
        garden_tree(builder, draw, draw.uniform(first, last), at)


def _drive(builder: Builder, draw: Generator, s: float, side: float, edge_m: float) -> None:
    """A drive that ends at a garage, a carport or in the garden, sometimes with a car on it."""
    kind = draw.random()
    if kind < 0.45:
        garage(builder, draw, s, edge_m + _DRIVE_LONG_M, side)
    elif kind < 0.65:
        carport(builder, draw, s, edge_m + 5.5, side)
    else:
        shrub(builder, draw, s, side * (edge_m + 16))
    if draw.random() < 0.45:
        _car_in_plot(builder, draw, s, side, edge_m)


def _blocks(builder: Builder, draw: Generator, start: float, side: float, edge_m: float) -> None:
    """A block of flats on a lawn with shrubs and trees, bins and parked cars before it."""
    end, setback_m = start + BLOCK_M, draw.uniform(5.0, 9.0)
    front_m = edge_m + setback_m
    front = Front(side, start, end - draw.choice((0.0, 8.0)), front_m)
    building(builder, draw, front, 11.0, 14.0)
    front_garden(builder, draw, Strip(side, start, end, edge_m + 0.8, front_m - 0.5))
    if draw.random() < 0.5:
        hedge(builder, draw, side * (edge_m + 0.5), start, end - draw.uniform(2, 10))
    for _ in range(2 + int(draw.poisson(2.5))):
        garden_tree(
            builder, draw, draw.uniform(start, end), side * (edge_m + draw.uniform(2, setback_m))
        )
    bins(builder, draw, draw.uniform(start + 2, end - 4), side * (front_m - 1.2))
    bicycles(builder, draw, draw.uniform(start + 2, end - 4), side * (front_m - 2.5))


def _green(builder: Builder, draw: Generator, start: float, side: float, edge_m: float) -> None:
    """A meadow or a park with shrubs and trees, sometimes behind a border, often before a wood."""
    if draw.random() < 0.4:
        border(builder, draw, side * (edge_m + 0.5), start, start + BLOCK_M)
    else:
        verge(builder, draw, Strip(side, start, start + BLOCK_M, edge_m, edge_m + 3.0))
    for _ in range(int(draw.poisson(8.0))):
        at = side * (edge_m + draw.uniform(4, 26))
        shrub(builder, draw, start + draw.uniform(0, BLOCK_M), at)
    for _ in range(int(draw.poisson(15.0))):
        at = side * (edge_m + draw.uniform(4, 26))
        garden_tree(builder, draw, start + draw.uniform(0, BLOCK_M), at)
    _behind(builder, draw, start, side * (edge_m + draw.uniform(10, 28)), 0.85)
    if draw.random() < 0.6:
        meadow(builder, draw, side, edge_m)
    if draw.random() < 0.6:
        border(builder, draw, side * (edge_m + draw.uniform(9, 18)), start, start + BLOCK_M)


def _yard(builder: Builder, draw: Generator, start: float, side: float, edge_m: float) -> None:
    """A wall, an open car park or a building site, with a hall at its back."""
    kind = draw.random()
    end = start + BLOCK_M
    if kind < 0.35:
        border(builder, draw, side * (edge_m + 0.5), start, end)
    elif kind < 0.9:
        car_park = (side * edge_m, side * (edge_m + _CAR_PARK_M))
        tar = (Semantic.PARKING, Material.ASPHALT, builder.course.road_reflectivity)
        builder.slab((0.0, BLOCK_M), car_park, *tar, sunk_m=-0.02)
        for slot in range(8):
            if draw.random() < 0.4:
                _car_in_plot(builder, draw, start + 2.2 + _SLOT_M * slot, side, edge_m)
        poster(builder, draw, start + draw.uniform(1, 4), side * (edge_m + 0.6))
    else:
        building_site(builder, draw, Strip(side, start, end, edge_m + 0.5, edge_m + 9.0))
    if draw.random() < 0.75:
        # Its ramp keeps clear of the cars in front of it.
        hall(builder, draw, Front(side, start, end, edge_m + draw.uniform(11, 18)))
    else:
        _behind(builder, draw, start, side * (edge_m + 22), 0.85)


def _fields(builder: Builder, draw: Generator, start: float, side: float, edge_m: float) -> None:
    """Open fields behind a verge of tall grass, single trees and poles, a wood far away."""
    verge(builder, draw, Strip(side, start, start + BLOCK_M, edge_m, edge_m + 2.5))
    meadow(builder, draw, side, edge_m)
    for _ in range(int(draw.poisson(3.5))):
        at = side * (edge_m + draw.uniform(1.5, 24))
        garden_tree(builder, draw, start + draw.uniform(0, BLOCK_M), at)
    for _ in range(int(draw.poisson(7.0))):
        at = side * (edge_m + draw.uniform(8, 28))
        shrub(builder, draw, start + draw.uniform(0, BLOCK_M), at)
    if draw.random() < 0.3:
        hedge(builder, draw, side * (edge_m + 4.0), start, start + BLOCK_M)
    for away_m in (3.0, 12.0, 18.0):
        if draw.random() < 0.35:
            fence(builder, draw, side * (edge_m + away_m), start, start + BLOCK_M)
    if draw.random() < 0.6:
        _behind(builder, draw, start, side * (edge_m + draw.uniform(25, 38)), 1.0)


_DISTRICTS = (_town, _row_houses, _houses, _blocks, _green, _yard, _fields)


def _behind(builder: Builder, draw: Generator, start: float, lateral: float, woods: float) -> None:
    """What closes the view behind a plot: the edge of a wood (with chance ``woods``) or a house."""
    s, side = start + draw.uniform(0.3, 0.7) * BLOCK_M, math.copysign(1.0, lateral)
    if draw.random() < woods:
        wood_edge(builder, draw, s, lateral)
        return
    half_m, front_m = draw.uniform(5, 10), abs(lateral) - 4.5
    front = Front(side, s - half_m, s + half_m, front_m)
    building(builder, draw, front, 9.0, draw.uniform(5, 12))
    for _ in range(5):
        at = side * (front_m - draw.uniform(1.0, 7))
        garden_tree(builder, draw, s + draw.uniform(-10, 10), at)
        shrub(builder, draw, s + draw.uniform(-10, 10), at)


def _car_in_plot(builder: Builder, draw: Generator, s: float, side: float, edge_m: float) -> None:
    """A car at right angles to the street, beyond the pavement."""
    yaw_rad = draw.choice((-1, 1)) * math.pi / 2 + draw.normal(0, 0.04)
    at = (s, side * (edge_m + 4.0 + draw.uniform(0, 1)))
    builder.body(parked_vehicle(draw), at, yaw_rad, builder.new_instance())


def build_side_street(builder: Builder, draw: Generator, side: float, opening_m: float) -> None:
    """Houses and gardens around the corners of a side street, its parked cars, and its end."""
    start = builder.section.block * BLOCK_M
    kerb = builder.course.kerb(side)
    edge_m = kerb.edge_m + max(kerb.pavement_m, 1.2)
    middle = start + BLOCK_M / 2
    character = builder.course.character
    town = draw.random() < character.districts[0] + character.districts[1]
    wide_m = 5.5 if town else 4.0
    for first, last in ((start, start + wide_m), (start + BLOCK_M - wide_m, start + BLOCK_M)):
        for house in range(2):
            front_m = edge_m + 19.0 * house + (0.3 if town else draw.uniform(2.5, 6.0))
            depth_m = 18.5 if town else draw.uniform(9, 13)
            front = Front(side, first, last, front_m)
            building(builder, draw, front, depth_m, draw.uniform(5, 12))
        if not town:
            border(builder, draw, side * (edge_m + 0.4), first, last)
    for corner in (-1.0, 1.0):
        if town:
            continue
        for away_m in (2.0, 10.0, 20.0, 32.0):
            if draw.random() < 0.7:
                at = middle + corner * draw.uniform(6.3, 8.0)
                shrub(builder, draw, at, side * (edge_m + away_m + draw.uniform(0, 6)))
    for place in range(4):
        if draw.random() < 0.45:
            place_of_car = (middle - (opening_m - PARKING_M) / 2, side * (edge_m + 7 + 6.0 * place))
            yaw_rad = draw.choice((-1, 1)) * math.pi / 2
            sunk_m = builder.course.step_up_m(side)
            builder.body(
                parked_vehicle(draw), place_of_car, yaw_rad, builder.new_instance(), sunk_m=sunk_m
            )
    _behind(builder, draw, start, side * (edge_m + 56), 0.8)

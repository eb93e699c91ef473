import math
from collections import defaultdict
from functools import cache

import numpy as np
import pytest
from sweeps import inside

from lidarsim import Material, Semantic, Shape, Street
from lidarsim.scene import Conditions, draw_weather
from lidarsim.street import streets as street_module
from lidarsim.street.course import BLOCK_M, course_of

GROUND = (Semantic.ROAD, Semantic.SIDEWALK, Semantic.TERRAIN)
DRY = Conditions()


def standing(scene):
    return {p for p in scene.primitives if not any(p.velocity_m_s)}


@cache
def many_scenes():
    """Scenes of all drives, by drive and scan."""
    return {
        (drive, scan): Street(0, drive, DRY).scene(scan)
        for drive in range(11)
        for scan in range(0, 600, 200)
    }


def turned(points, angle_rad):
    """Points (..., 3) turned about the vertical axis."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return points @ [[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]


def top_at(primitive, x_m, y_m):
    """Height of the top plane of a box at a place."""
    x, y = x_m - primitive.centre[0], y_m - primitive.centre[1]
    cosine, sine = np.cos(primitive.yaw_rad), np.sin(primitive.yaw_rad)
    grade_x, grade_y = primitive.grade
    rise = grade_x * (cosine * x + sine * y) + grade_y * (cosine * y - sine * x)
    return primitive.centre[2] + primitive.half_size[2] + rise


def test_scans_of_a_drive_share_geometry():
    street = Street(0, 3, DRY)
    here, next_one, far = (standing(street.scene(scan)) for scan in (100, 101, 400))
    # One scan on, at most one of the seven blocks and a few details have been exchanged.
    assert len(here & next_one) > 0.8 * len(here)
    assert not here & far


def test_scenes_do_not_depend_on_the_order_or_on_what_was_made_before():
    first = Street(2, 5).scene(77)
    for cached in (street_module._block, street_module._actor, street_module._streams, course_of):
        cached.cache_clear()
    Street(2, 5).scene(3)
    Street(2, 6).scene(77)
    assert Street(2, 5).scene(77) == first


@pytest.mark.parametrize("drive", [0, 6])
def test_motion_agrees_with_the_poses(drive):
    """The car advances by 1.0 to 1.4 m a scan or stands; speed and yaw rate are the differences."""
    street = Street(1, drive, DRY)
    course = course_of(1, drive)
    along = np.diff([course.position(scan) for scan in range(500)])
    moves = along > 0
    assert (along >= 0).all()
    assert (along[moves].min() >= 1.0) & (along[moves].max() <= 1.4)
    for scan in range(0, 300, 3):
        scene, after = street.scene(scan), street.scene(scan + 1)
        step = np.subtract((after.pose.x_m, after.pose.y_m), (scene.pose.x_m, scene.pose.y_m))
        if not moves[scan]:
            assert np.linalg.norm(step) == 0
            assert scene.motion.speed_m_s == scene.motion.yaw_rate_rad_s == 0
            continue
        # The speed changes a little within the scan, and the chain of chords bends at its corners.
        assert np.linalg.norm(step) == pytest.approx(0.1 * scene.motion.speed_m_s, rel=0.02)
        assert math.atan2(step[1], step[0]) == pytest.approx(scene.pose.heading_rad, abs=0.09)
        turned = after.pose.heading_rad - scene.pose.heading_rad
        # Halfway along a block the turn per metre changes.
        assert turned == pytest.approx(0.1 * scene.motion.yaw_rate_rad_s, abs=0.009)


def test_the_sensor_is_at_mount_height_above_the_road_and_tilts_with_it():
    for drive in range(4):
        street = Street(3, drive, DRY)
        for scan in range(0, 400, 57):
            scene = street.scene(scan, sensor_height_m=1.8)
            pose = scene.pose
            under = np.array([[pose.x_m, pose.y_m, pose.z_m - 1.8 - 0.3]])
            roads = [
                p for p in scene.primitives if p.semantic == Semantic.ROAD and inside(p, under)[0]
            ]
            heights = [top_at(p, pose.x_m, pose.y_m) for p in roads]
            # Where two slabs overlap at a corner, either may be the higher by millimetres.
            np.testing.assert_allclose(heights, pose.z_m - 1.8, atol=0.005)
            assert heights
            ahead = np.array([np.cos(pose.heading_rad), np.sin(pose.heading_rad)])
            slope = top_at(roads[0], pose.x_m + ahead[0], pose.y_m + ahead[1]) - heights[0]
            assert pose.pitch_rad == pytest.approx(-math.atan(slope), abs=0.04)


def test_neighbouring_ground_boxes_meet_without_a_step():
    def top_of(block, x, y):
        for p in street_module._block(0, drive, block).primitives:
            top_m = top_at(p, x, y)
            if p.semantic == Semantic.ROAD and inside(p, [[x, y, top_m - p.half_size[2]]])[0]:
                return top_m
        raise AssertionError("no road")

    steps = []
    for drive in range(2):
        course = course_of(0, drive)
        for block in range(1, 32):
            for side in (1, -1):
                # Right at the kerb, where the planes differ most.
                lateral = side * 0.98 * course.kerb(side).edge_m
                x, y, _ = course.section_of(block).at((block + 1) * BLOCK_M, lateral)
                here = course.section_of(block + 1).at((block + 1) * BLOCK_M, lateral)
                np.testing.assert_allclose((x, y), here[:2], atol=1e-9)
                steps.append(top_of(block + 1, x, y) - top_of(block, x, y))
    assert np.abs(steps).max() < 0.02
    assert max(abs(course_of(0, 1).section_of(b).slope) for b in range(200)) > 0.005


def test_nothing_stands_in_the_lane_of_the_recording_car():
    """No standing solid reaches into a tunnel of 2 m x 2 m that the car drives through."""
    across, height = np.meshgrid([-1.0, -0.5, 0.0, 0.5, 1.0], [0.3, 0.9, 1.5, 2.0])
    for drive in range(2):
        course = course_of(0, drive)
        at = course.ego_lateral_m + across.ravel()
        up = height.ravel() + [course.surface_m(lateral) for lateral in at]
        for block in range(12, 36):
            section = course.section_of(block)
            tunnel = [
                np.add(section.at((block + ahead) * BLOCK_M, lateral), (0, 0, above))
                for ahead in np.arange(0, 1, 1 / 16)
                for lateral, above in zip(at, up, strict=True)
            ]
            for p in street_module._block(0, drive, block).primitives:
                if p.semantic not in GROUND:
                    assert not inside(p, tunnel).any(), (drive, block, p)


def test_traffic_keeps_clear_of_the_recording_car():
    for key, scene in many_scenes().items():
        body = np.array([[x, y, 0] for x in (-2, -1, 0, 1, 2) for y in (-0.9, 0.9)])
        points = turned(body, scene.pose.heading_rad)
        points += (scene.pose.x_m, scene.pose.y_m, scene.pose.z_m - 1.0)
        for p in scene.primitives:
            if any(p.velocity_m_s):
                assert not inside(p, points).any(), (key, p)


def test_no_car_stands_in_a_building_or_a_garage():
    corners = np.array([[a, b, 0] for a in (1, -1) for b in (1, -1)]) * 0.95
    cars = 0
    for key, scene in list(many_scenes().items())[::3]:
        bodies = [p for p in scene.primitives if p.semantic in (Semantic.CAR, Semantic.TRUCK)]
        points = []
        for p in bodies:
            points += [*(turned(corners * p.half_size, p.yaw_rad) + p.centre), p.centre]
        for wall in scene.primitives:
            built = wall.semantic in (Semantic.BUILDING, Semantic.GARAGE)
            if built and wall.material != Material.GLASS:
                assert not inside(wall, points).any(), (key, wall)
        cars += len(bodies)
    assert cars > 800


def test_nobody_walks_through_things():
    walkers = 0
    for key, scene in list(many_scenes().items())[::3]:
        solids = (*scene.primitives, *scene.unseen)
        moving = [p for p in solids if p.semantic == Semantic.PERSON and any(p.velocity_m_s)]
        trunks = [p.centre for p in moving]
        walkers += len(moving)
        for p in solids if moving else ():
            if not (any(p.velocity_m_s) or p.extinction_per_m or p.semantic in GROUND):
                assert not inside(p, trunks).any(), (key, p)
    assert walkers > 200


def test_walkers_cross_side_streets_on_the_road():
    crossing = 0
    for (drive, scan), scene in many_scenes().items():
        ground = [p for p in scene.primitives if p.semantic in GROUND]
        for builder in street_module._actors(course_of(0, drive), scan):
            foot = min(builder.primitives, key=lambda p: p.centre[2] - p.half_size[2])
            if foot.semantic != Semantic.PERSON:
                continue
            x, y, z = foot.centre
            tops = [(top_at(p, x, y), p.semantic) for p in ground]
            below = [
                top
                for top, p in zip(tops, ground, strict=True)
                if inside(p, [(x, y, top[0] - 0.1)])
            ]
            if below:  # people walk a little beyond the last block
                height_m, semantic = max(below)
                assert abs(z - foot.half_size[2] - height_m) < 0.03, (drive, scan)
                crossing += semantic == Semantic.ROAD
    assert crossing > 4


def test_nobody_stands_in_things_and_no_bin_in_others():
    counts = {Semantic.PERSON: 0, Semantic.TRASH_BIN: 0}
    for drive in range(7):
        for block in range(12):
            builder = street_module._block(0, drive, block)
            solids = [p for p in (*builder.primitives, *builder.details) if p.instance]
            solids = [p for p in solids if p.material != Material.FOLIAGE]
            for semantic in counts:
                centres = [p.centre for p in solids if p.semantic == semantic]
                others = [p for p in solids if p.semantic not in (semantic, Semantic.PERSON)]
                counts[semantic] += len(centres)
                assert not any(inside(p, centres).any() for p in others if centres)
    assert counts[Semantic.PERSON] > 300
    assert counts[Semantic.TRASH_BIN] > 100


def test_cars_park_in_the_direction_of_the_traffic_on_their_side():
    sides = {True: 0, False: 0}
    for drive in range(14):
        course = course_of(0, drive)
        for block in range(1, course.crossing_every):
            section = course.section_of(block)
            for p in street_module._block(0, drive, block).primitives:
                turn = math.remainder(p.yaw_rad - section.heading_rad, math.tau)
                dx, dy = p.centre[0] - section.x_m, p.centre[1] - section.y_m
                left_m = dy * math.cos(section.heading_rad) - dx * math.sin(section.heading_rad)
                if p.semantic != Semantic.CAR or abs(left_m) > course.kerb(left_m).edge_m:
                    continue
                oncoming = left_m > 0 and course.lanes[1] > 0
                assert (abs(turn) > 2) == oncoming, (drive, block)
                sides[course.lanes[1] > 0] += left_m > 0
    assert min(sides.values()) > 20


def test_no_lane_leads_through_a_traffic_island():
    islands = 0
    for drive in range(24):
        course = course_of(0, drive)
        streams = street_module._streams(0, drive)
        lanes = [s.lateral_m for s in streams if s.kind is street_module.vehicle]
        for block in range(0, 4 * course.crossing_every, course.crossing_every):
            section = course.section_of(block)
            wheels = [
                np.add(
                    section.at(s, lateral + side),
                    (0, 0, course.surface_m(lateral + side) + 0.02),
                )
                for s in np.arange(block * BLOCK_M, (block + 1) * BLOCK_M, 0.5)
                for lateral in lanes
                for side in (-1.25, 1.25)  # half a bus
            ]
            for p in street_module._block(0, drive, block).primitives:
                if p.semantic == Semantic.SIDEWALK and p.half_size[1] < 0.5:
                    assert not inside(p, wheels).any(), (drive, block)
                    islands += 1
    assert islands > 12


def test_cars_parked_in_side_streets_stand_on_the_road():
    parked = 0
    for drive in range(7):
        every = course_of(0, drive).crossing_every
        for block in range(0, 12 * every, every):
            builder = street_module._block(0, drive, block)
            across = builder.section.heading_rad + np.array([-math.pi / 2, math.pi / 2])
            roads = [p for p in builder.primitives if p.semantic == Semantic.ROAD]
            for p in builder.details:
                # Cars on plots stand at right angles to the street too, but not exactly.
                if p.semantic != Semantic.CAR or np.abs(across - p.yaw_rad).min() > 1e-9:
                    continue
                x, y, z = p.centre
                heights = [top_at(road, x, y) for road in roads]
                roads_below = [
                    inside(r, [(x, y, h - 0.1)])[0] for r, h in zip(roads, heights, strict=True)
                ]
                above_m = z - p.half_size[2] - max(np.array(heights)[roads_below])
                assert above_m > -0.001  # wheels, the lowest parts, stand on the road
                parked += above_m < 0.001
    assert parked > 40


def test_actors_move_as_their_velocity_says():
    compared = 0
    for drive in (0, 3):
        street = Street(0, drive, DRY)
        for scan in range(20, 100, 16):
            # Equal parts, such as two wheels, are in the same order in both scans, unless a detail
            # has come or gone.
            parts = defaultdict(lambda: ([], []))
            for after in (0, 1):
                for p in street.scene(scan + after).primitives:
                    key = (p.instance, p.semantic, p.half_size, p.centre[2] > 1, p.yaw_rad)
                    parts[key][after].append(p)
            for before, later in parts.values():
                if len(before) != len(later):
                    continue
                for p, moved_part in zip(before, later, strict=True):
                    if any(p.velocity_m_s):
                        moved = np.subtract(moved_part.centre[:2], p.centre[:2])
                        expected = 0.1 * np.array(p.velocity_m_s)
                        np.testing.assert_allclose(moved, expected, atol=0.03)
                        compared += 1
    assert compared > 100


def test_an_object_has_one_instance_number():
    """Instance numbers of a scene are unique: the solids of one lie close together."""
    for drive in range(4):
        by_instance = defaultdict(list)
        for p in Street(4, drive, DRY).scene(20).primitives:
            by_instance[p.instance].append(p)
        del by_instance[0]  # of what has no number
        assert len(by_instance) > 50
        for parts in by_instance.values():
            centres = np.array([p.centre[:2] for p in parts])
            assert np.ptp(centres, axis=0).max() < BLOCK_M
            classes = {p.semantic for p in parts}
            ridden = {Semantic.RIDER, Semantic.BICYCLE}
            pushed = {Semantic.PERSON, Semantic.UNKNOWN_OBJECT}
            assert len(classes) == 1 or classes in (ridden, pushed)


def test_every_class_and_material_occurs():
    solids = []
    for scene in many_scenes().values():
        solids += [*scene.primitives, *scene.ego_body]
        tops = (p.centre[2] + p.half_size[2] for p in scene.primitives if p.semantic in GROUND)
        assert scene.ground_m < min(tops)
    assert {p.semantic for p in solids} == set(Semantic) - {Semantic.UNLABELED}
    assert {p.material for p in solids} == set(Material)
    assert {p.shape for p in solids} == set(Shape)


def test_shares_and_ranges_of_the_weather():
    """5000 draws; bounds of five standard deviations of a binomial share."""
    drawn = [draw_weather(np.random.default_rng(number)) for number in range(5000)]
    dry = [
        w for w in drawn if w.water_film_mm == 0 and math.isinf(w.visibility_m) and not w.snow_mm_h
    ]
    wet = [w for w in drawn if w.water_film_mm and not w.rain_mm_h]
    fog, rain, snow = bad = [
        [w for w in drawn if w.visibility_m < math.inf],
        [w for w in drawn if w.rain_mm_h],
        [w for w in drawn if w.snow_mm_h],
    ]
    for group, share in ((dry, 0.85), (wet, 0.10), *((kind, 0.05 / 3) for kind in bad)):
        bound = 5 * math.sqrt(share * (1 - share) / len(drawn))
        assert len(group) / len(drawn) == pytest.approx(share, abs=bound)
    assert len(dry) + len(wet) + sum(map(len, bad)) == len(drawn)
    assert all(30 <= w.visibility_m <= 1000 for w in fog)
    assert all(1 <= w.rain_mm_h <= 30 and 0.1 <= w.water_film_mm <= 1.5 for w in rain)
    assert all(0.5 <= w.snow_mm_h <= 3 for w in snow)
    assert np.mean([w.clear_sky for w in dry]) == pytest.approx(0.6, abs=0.04)
    assert not any(w.clear_sky for group in (wet, *bad) for w in group)
    elevation = np.array([w.sun_elevation_deg for w in drawn])
    assert (-18 < elevation.min() < -17) and (61 < elevation.max() < 62)  # noqa: PT018


def test_weather_lasts_and_puddles_lie_on_wet_roads():
    street = Street(5, 2)
    stretches = [street.weather_of(100 * stretch) for stretch in range(40)]
    assert all(street.weather_of(100 * s + 99) == stretches[s] for s in range(40))
    assert len(set(stretches)) == 40
    dry, wet = (Street(5, 2, Conditions(water_film_mm=film)).scene(60) for film in (0.0, 0.5))
    assert not dry.puddles
    assert wet.puddles
    assert wet.primitives == dry.primitives
    # Puddles stay where they are.
    assert set(wet.puddles) & set(Street(5, 2, Conditions(water_film_mm=1.0)).scene(65).puddles)


@pytest.mark.parametrize("number", [-1, 0.5, "1"])
def test_negative_and_broken_numbers_are_refused(number):
    with pytest.raises(ValueError, match=f"seed must be a whole number, 0 .*, got {number}"):
        Street(number, 0)
    with pytest.raises(ValueError, match=f"scan must be a whole number in .*, got {number}"):
        Street(0, 0).scene(number)


def test_a_drive_lasts_a_million_scans():
    street = Street(0, 0)
    assert street.scene(1_000_000).primitives
    with pytest.raises(ValueError, match=r"in 0\.\.1000000, got 1000001"):
        street.scene(1_000_001)


def test_a_pavement_lies_a_kerb_above_the_gutter_and_a_verge_begins_level_with_it():
    steps = {True: [], False: []}
    for drive in range(40):
        course = course_of(0, drive)
        for side in (-1.0, 1.0):
            kerb = course.kerb(side)
            inside, outside = (course.surface_m(side * (kerb.edge_m + x)) for x in (-1e-6, 1e-6))
            steps[kerb.pavement_m > 0].append((outside - inside) / course.kerb_m)
    np.testing.assert_allclose(steps[True], 1.0, atol=1e-3)
    np.testing.assert_allclose(steps[False], 0.0, atol=1e-3)
    assert min(map(len, steps.values())) > 3


def test_the_ground_beyond_a_pavement_rises_or_falls_as_its_slope_says():
    for drive in range(20):
        course = course_of(0, drive)
        for lateral in (-20.0, 20.0):
            rise = course.surface_m(lateral + 0.5) - course.surface_m(lateral - 0.5)
            assert course.surface_cross(lateral) == pytest.approx(rise)

import math
from collections import defaultdict

import numpy as np
import pytest

from r3dpa.simulation import Material, Semantic, Shape, Street, Weather, WeatherPrior
from r3dpa.simulation import street as street_module
from r3dpa.simulation.course import BLOCK_M, course_of

GROUND = (Semantic.ROAD, Semantic.SIDEWALK, Semantic.TERRAIN)
DRY = Weather()


def standing(scene):
    return {p for p in scene.primitives if not any(p.velocity_m_s)}


def inside(primitive, points):
    """Which of the points (N, 3) lie in a solid, by the definition of its shape."""
    x, y, z = (points - primitive.centre).T
    cosine, sine = np.cos(primitive.yaw_rad), np.sin(primitive.yaw_rad)
    x, y = cosine * x + sine * y, cosine * y - sine * x
    z = z - primitive.grade[0] * x - primitive.grade[1] * y
    u = np.abs([x, y, z] / np.array(primitive.half_size)[:, None])
    if primitive.shape == Shape.BOX:
        return u.max(axis=0) <= 1
    if primitive.shape == Shape.CYLINDER:
        return (np.hypot(u[0], u[1]) <= 1) & (u[2] <= 1)
    return np.linalg.norm(u, axis=0) <= 1


def corners(primitive, share=1.0):
    """Corners and centre (9, 3) of a box, drawn in by ``share``."""
    signs = np.array([[a, b, c] for a in (1, -1) for b in (1, -1) for c in (1, -1)] + [[0, 0, 0]])
    x, y, z = (share * signs * primitive.half_size).T
    z = z + primitive.grade[0] * x + primitive.grade[1] * y
    cosine, sine = np.cos(primitive.yaw_rad), np.sin(primitive.yaw_rad)
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1) + primitive.centre


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


@pytest.mark.parametrize("drive", [0, 3, 6, 9])
def test_motion_agrees_with_the_poses(drive):
    """The car advances by 1.0 to 1.4 m a scan or stands; speed and yaw rate are the differences."""
    street = Street(1, drive, DRY)
    course = course_of(1, drive)
    scans = range(500)
    along = np.diff([course.position(scan) for scan in scans])
    moves = along > 0
    assert (along >= 0).all()
    assert along[moves].min() >= 1.0
    assert along[moves].max() <= 1.4
    scenes = [street.scene(scan) for scan in scans[:300:3]]
    for scan, scene in zip(scans[:300:3], scenes, strict=True):
        after = street.scene(scan + 1)
        step = np.subtract((after.pose.x_m, after.pose.y_m), (scene.pose.x_m, scene.pose.y_m))
        if not moves[scan]:
            assert np.linalg.norm(step) == 0
            assert scene.motion.speed_m_s == 0
            assert scene.motion.yaw_rate_rad_s == 0
            continue
        # The speed changes a little within the scan, and the chain of chords bends at its corners.
        assert np.linalg.norm(step) == pytest.approx(0.1 * scene.motion.speed_m_s, rel=0.02)
        direction = math.atan2(step[1], step[0])
        assert direction == pytest.approx(scene.pose.heading_rad, abs=0.09)
        turned = after.pose.heading_rad - scene.pose.heading_rad
        # Halfway along a block the turn per metre changes.
        assert turned == pytest.approx(0.1 * scene.motion.yaw_rate_rad_s, abs=0.009)


def test_the_sensor_is_at_mount_height_above_the_road_and_tilts_with_it():
    for drive in range(4):
        street = Street(3, drive, DRY)
        for scan in range(0, 400, 37):
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
    steps = []
    for drive in range(4):
        course = course_of(0, drive)
        for block in range(1, 60):
            before, after = (
                [
                    p
                    for p in street_module._block(0, drive, b).primitives
                    if p.semantic == Semantic.ROAD
                ]
                for b in (block, block + 1)
            )
            for side in (1, -1):
                # Right at the kerb, where the planes differ most.
                lateral = side * 0.98 * course.kerb(side).edge_m
                x, y, _ = course.section_of(block).at((block + 1) * BLOCK_M, lateral)
                here = course.section_of(block + 1).at((block + 1) * BLOCK_M, lateral)
                np.testing.assert_allclose((x, y), here[:2], atol=1e-9)
                tops = []
                for roads in (before, after):
                    half = next(p for p in roads if inside(p, np.array([[x, y, _z(p, x, y)]]))[0])
                    tops.append(top_at(half, x, y))
                steps.append(abs(tops[1] - tops[0]))
    assert max(steps) < 0.02
    assert max(abs(course_of(0, 1).section_of(b).slope) for b in range(200)) > 0.005


def _z(primitive, x, y):
    return top_at(primitive, x, y) - primitive.half_size[2]


def test_nothing_stands_in_the_lane_of_the_recording_car():
    """No standing solid reaches into a tunnel of 2 m x 2 m that the car drives through."""
    across, height = np.meshgrid([-1.0, -0.5, 0.0, 0.5, 1.0], [0.3, 0.9, 1.5, 2.0])
    for drive in range(4):
        course = course_of(0, drive)
        for s in np.arange(12.5, 60) * BLOCK_M:
            block = int(s // BLOCK_M)
            solids = [
                p
                for p in street_module._block(0, drive, block).primitives
                if p.semantic not in GROUND
            ]
            points = []
            for along in np.arange(0, BLOCK_M, 1.5):
                for lateral, up in zip(across.ravel(), height.ravel(), strict=True):
                    at = course.ego_lateral_m + lateral
                    x, y, z = course.section_of(block).at(block * BLOCK_M + along, at)
                    points.append((x, y, z + course.surface_m(at) + up))
            points = np.array(points)
            for p in solids:
                if math.dist(p.centre[:2], points[len(points) // 2, :2]) < 40:
                    assert not inside(p, points).any(), (drive, block, p)


def test_traffic_keeps_clear_of_the_recording_car():
    for drive in range(11):
        for scan in range(0, 600, 90):
            scene = Street(0, drive, DRY).scene(scan)
            body = np.array([[x, y, 0] for x in (-2, -1, 0, 1, 2) for y in (-0.9, 0.9)])
            cosine, sine = np.cos(scene.pose.heading_rad), np.sin(scene.pose.heading_rad)
            points = body @ [[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]
            points += (scene.pose.x_m, scene.pose.y_m, scene.pose.z_m - 1.0)
            for p in scene.primitives:
                if any(p.velocity_m_s):
                    assert not inside(p, points).any(), (drive, scan, p)


def test_no_car_stands_in_a_building():
    cars = 0
    for drive in range(11):
        for scan in (50, 350, 650):
            solids = Street(0, drive, DRY).scene(scan).primitives
            walls = [
                p
                for p in solids
                if p.semantic == Semantic.BUILDING and p.material != Material.GLASS
            ]
            bodies = [p for p in solids if p.semantic in (Semantic.CAR, Semantic.TRUCK)]
            cars += len(bodies)
            points = np.concatenate([corners(p, 0.95) for p in bodies])
            for wall in walls:
                assert not inside(wall, points).any(), (drive, scan, wall)
    assert cars > 1000


def test_actors_move_as_their_velocity_says():
    compared = 0
    for drive in (0, 3):
        street = Street(0, drive, DRY)
        for scan in range(20, 100, 16):
            here, after = (
                {
                    (p.instance, p.semantic, p.half_size, p.centre[2] > 1): p
                    for p in scene.primitives
                }
                for scene in (street.scene(scan), street.scene(scan + 1))
            )
            for key, p in here.items():
                q = after.get(key)
                if q is None or not any(p.velocity_m_s) or p.yaw_rad != q.yaw_rad:
                    continue
                moved = np.subtract(q.centre[:2], p.centre[:2])
                np.testing.assert_allclose(moved, 0.1 * np.array(p.velocity_m_s), atol=0.03)
                compared += 1
    assert compared > 100


def test_an_object_has_one_instance_number():
    """Instance numbers of a scene are unique: the solids of one lie close together."""
    for drive in range(4):
        by_instance = defaultdict(list)
        for p in Street(4, drive, DRY).scene(20).primitives:
            if p.instance:
                by_instance[p.instance].append(p)
        assert len(by_instance) > 50
        for parts in by_instance.values():
            centres = np.array([p.centre[:2] for p in parts])
            assert np.ptp(centres, axis=0).max() < 20
            classes = {p.semantic for p in parts}
            assert len(classes) == 1 or classes == {Semantic.RIDER, Semantic.BICYCLE}


def test_every_class_and_material_occurs():
    semantics, materials, shapes = set(), set(), set()
    for drive in range(11):
        for scan in range(0, 600, 50):
            scene = Street(0, drive, DRY).scene(scan)
            for p in (*scene.primitives, *scene.ego_body):
                semantics.add(p.semantic)
                materials.add(p.material)
                shapes.add(p.shape)
            assert scene.ground_m < min(
                p.centre[2] + p.half_size[2] for p in scene.primitives if p.semantic in GROUND
            )
    assert semantics == set(Semantic) - {Semantic.UNLABELED}
    assert materials == set(Material)
    assert shapes == set(Shape)


def test_weather_follows_the_prior():
    """2000 draws; bounds of five standard deviations of a binomial share."""
    prior = WeatherPrior()
    drawn = [prior.draw(np.random.default_rng(number)) for number in range(2000)]
    dry = [
        w for w in drawn if w.water_film_mm == 0 and math.isinf(w.visibility_m) and not w.snow_mm_h
    ]
    wet = [w for w in drawn if w.water_film_mm and not w.rain_mm_h]
    bad = [
        [w for w in drawn if w.visibility_m < math.inf],
        [w for w in drawn if w.rain_mm_h],
        [w for w in drawn if w.snow_mm_h],
    ]
    for group, share in ((dry, 0.85), (wet, 0.10), *((kind, 0.05 / 3) for kind in bad)):
        bound = 5 * math.sqrt(share * (1 - share) / len(drawn))
        assert len(group) / len(drawn) == pytest.approx(share, abs=bound)
    assert len(dry) + len(wet) + sum(map(len, bad)) == len(drawn)
    worst = WeatherPrior(clear_dry=0.0, wet=0.0)
    drawn = [worst.draw(np.random.default_rng(number)) for number in range(1000)]
    for share in (
        np.mean([w.rain_mm_h > 0 for w in drawn]),
        np.mean([w.snow_mm_h > 0 for w in drawn]),
    ):
        assert share == pytest.approx(1 / 3, abs=5 * math.sqrt(2 / 9 / 1000))
    assert all(30 <= w.visibility_m <= 1000 for w in bad[0])
    assert all(1 <= w.rain_mm_h <= 30 and w.water_film_mm >= 0.1 for w in bad[1])
    assert all(0.5 <= w.snow_mm_h <= 3 for w in bad[2])
    assert not any(w.clear_sky for group in (wet, *bad) for w in group)
    elevation = np.array([w.sun_elevation_deg for w in drawn])
    assert (elevation < 0).any()
    assert ((elevation > 0) & (elevation < 6)).any()


def test_weather_lasts_and_puddles_lie_on_wet_roads():
    street = Street(5, 2)
    stretches = [street.weather_of(100 * stretch) for stretch in range(40)]
    assert all(street.weather_of(100 * s + 99) == stretches[s] for s in range(40))
    assert len(set(stretches)) == 40
    dry, wet = (Street(5, 2, Weather(water_film_mm=film)).scene(60) for film in (0.0, 0.5))
    assert not dry.puddles
    assert wet.puddles
    assert wet.primitives == dry.primitives
    # Puddles stay where they are.
    assert set(wet.puddles) & set(Street(5, 2, Weather(water_film_mm=1.0)).scene(65).puddles)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"clear_dry": 1.2}, "clear_dry must lie"),
        ({"clear_dry": 0.6, "wet": 0.6}, "add up to 1 or less"),
        ({"rain_mm_h": (5.0, 1.0)}, "rain_mm_h must be a finite interval"),
        ({"visibility_m": (0.0, 100.0)}, "visibility_m must be"),
    ],
)
def test_impossible_priors_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        WeatherPrior(**values)


def test_negative_numbers_are_refused():
    with pytest.raises(ValueError, match="seed must be 0 or greater"):
        Street(-1, 0)
    with pytest.raises(ValueError, match="scan must be 0 or greater, got -1"):
        Street(0, 0).scene(-1)

from dataclasses import replace

import numpy as np
import pytest
from sweeps import inside

from lidarsim import load_sensor, raycast
from lidarsim.drive_files import velodyne_to_world
from lidarsim.raycast import cast, cast_single, normals
from lidarsim.scene import Conditions, EgoMotion, Pose, Primitive, Scene, Semantic, Shape
from lidarsim.sensors import hdl64e
from lidarsim.sensors.spinning import Rays
from lidarsim.solids import GROUND, NO_SURFACE, Windows, level, solids_of

REACH_M = 120.0


def compass(z):
    """One beam of eight shots, 45 degrees apart, slightly downwards or upwards."""
    angles = np.arange(8) * np.pi / 4
    direction = np.stack([np.cos(angles), np.sin(angles), np.full(8, z)])[:, None]
    direction /= np.linalg.norm(direction, axis=0)
    return Rays(np.zeros((3, 1, 8), np.float32), direction.astype(np.float32))


def solid(shape, centre, half_size, yaw_rad=0.0):
    return Primitive(shape, centre, half_size, Semantic.CAR, 0.4, yaw_rad, 7)


BOX = solid(Shape.BOX, (0, 0, 0), (1, 1, 1))


class Hits:
    """Ranges, surfaces and incidence of a scene under some rays, each (beams, shots)."""

    def __init__(self, scene, rays, **motion):
        self.solids = solids_of(scene.primitives, scene.pose, scene.ground_m)
        origin, direction = (level(array, scene.pose) for array in rays)
        self.range_m, self.surface = cast(self.solids, origin, direction, REACH_M, **motion)
        hit = np.isfinite(self.range_m)
        position = origin[:, hit] + self.range_m[hit] * direction[:, hit]
        time_s = motion["actor_time_s"][hit] if "actor_time_s" in motion else None
        self.normal = np.full(direction.shape, np.nan)
        self.normal[:, hit] = normals(self.solids, self.surface[hit], position, time_s)
        self.cos_incidence = np.abs((self.normal * direction).sum(axis=0))


def test_ground_range_and_incidence():
    hits = Hits(Scene(pose=Pose(z_m=2.0)), compass(-0.2))
    # A ray that falls 0.2 per metre reaches the ground 10 m away; its length is 10 sqrt(1.04).
    np.testing.assert_allclose(hits.range_m, 10 * np.sqrt(1.04), rtol=1e-6)
    np.testing.assert_allclose(hits.cos_incidence, 0.2 / np.sqrt(1.04), rtol=1e-6)
    assert (hits.surface == GROUND).all()
    # A solid around the sensor is not seen from inside.
    around = solid(Shape.ELLIPSOID, (0, 0, 2), (3, 3, 3))
    lower = Hits(Scene((around,), Pose(z_m=2.0), ground_m=-1.0), compass(-0.2))
    np.testing.assert_allclose(lower.range_m, 15 * np.sqrt(1.04), rtol=1e-6)
    for z in (0.1, -0.01):  # into the sky, and beyond reach: to the ground at 200 m
        hits = Hits(Scene(pose=Pose(z_m=2.0)), compass(z))
        assert (hits.surface == NO_SURFACE).all()
        assert np.isinf(hits.range_m).all()


def test_box_cylinder_and_ellipsoid_on_the_axes():
    primitives = (
        solid(Shape.BOX, (10, 0, 2), (1, 2, 3)),
        solid(Shape.CYLINDER, (0, 10, 2), (0.5, 0.5, 3)),
        solid(Shape.ELLIPSOID, (-10, 0, 2), (2, 1, 1)),
        solid(Shape.BOX, (0, -10, 2), (1, 4, 1), np.pi / 2),
    )
    hits = Hits(Scene(primitives, Pose(z_m=2.0)), compass(0.0))
    np.testing.assert_allclose(hits.range_m[0, ::2], [9, 9.5, 8, 9], rtol=1e-6)
    np.testing.assert_array_equal(hits.surface[0, ::2], [0, 1, 2, 3])
    towards_sensor = [[-1, 0, 0], [0, -1, 0], [1, 0, 0], [0, 1, 0]]
    np.testing.assert_allclose(hits.normal[:, 0, ::2].T, towards_sensor, atol=1e-6)
    assert (hits.surface[0, 1::2] == NO_SURFACE).all()


def test_incidence_on_a_turned_wall_and_on_the_cap_of_a_cylinder():
    # A wall turned by 60 degrees is met at 60 degrees.
    wall = solid(Shape.BOX, (10, 0, 2), (0.5, 30, 3), np.radians(60))
    hits = Hits(Scene((wall,), Pose(z_m=2.0)), compass(0.0))
    assert hits.cos_incidence[0, 0] == pytest.approx(0.5, abs=1e-5)
    assert hits.range_m[0, 0] == pytest.approx(10 - 0.5 / np.cos(np.radians(60)), abs=1e-5)
    pipe = solid(Shape.CYLINDER, (10, 0, 0.5), (3, 3, 0.5))  # its top is 1 m below the sensor
    hits = Hits(Scene((pipe,), Pose(z_m=2.0)), compass(-0.1))
    assert hits.range_m[0, 0] == pytest.approx(10 * np.sqrt(1.01))
    assert hits.cos_incidence[0, 0] == pytest.approx(0.1 / np.sqrt(1.01))


def test_a_slope_rises_away_from_the_sensor_and_its_walls_stay_upright():
    slope = replace(solid(Shape.BOX, (20, 0, 0), (10, 5, 0.5)), grade=(0.1, 0.0))
    hits = Hits(Scene((slope,), Pose(z_m=2.0), ground_m=-9), compass(-0.05))
    # Its top is z = -1.5 + 0.1 (x - 20); the ray z = -0.05 x meets it at x = 3.5 / 0.15.
    assert hits.range_m[0, 0] == pytest.approx(3.5 / 0.15 * np.sqrt(1 + 0.05**2), rel=1e-5)
    upward = np.array([-0.1, 0, 1]) / np.sqrt(1.01)
    np.testing.assert_allclose(hits.normal[:, 0, 0], upward, atol=1e-5)
    steep = replace(slope, centre=(20, 0, 3), half_size=(10, 5, 3))
    front = Hits(Scene((steep,), Pose(z_m=2.0), ground_m=-9), compass(0.0))
    assert front.range_m[0, 0] == pytest.approx(10)
    np.testing.assert_allclose(front.normal[:, 0, 0], [-1, 0, 0], atol=1e-6)


def test_a_moving_solid_is_met_where_it_is_at_that_time():
    car = replace(solid(Shape.BOX, (10, 0, 2), (1, 2, 1)), velocity_m_s=(20.0, 0.0))
    late, scene = np.full((1, 8), 0.05, dtype=np.float32), Scene((car,), Pose(z_m=2.0))
    here, there = (Hits(scene, compass(0.0), actor_time_s=t) for t in (0 * late, late))
    assert here.range_m[0, 0] == pytest.approx(9)
    assert there.range_m[0, 0] == pytest.approx(10)
    # The velocity is given in the world frame and turns with the heading.
    turned = solids_of((car,), Pose(z_m=2.0, heading_rad=0.3), 0.0).velocity[0]
    np.testing.assert_allclose(turned, [20 * np.cos(0.3), -20 * np.sin(0.3)], rtol=1e-6)


def test_rays_get_into_foliage_as_deep_as_drawn_or_through_it():
    crown = replace(solid(Shape.ELLIPSOID, (10, 0, 2), (2, 2, 2)), extinction_per_m=0.5)
    wall = solid(Shape.BOX, (20, 0, 2), (1, 5, 3))
    for depth, expected in ((0.0, 8), (0.6, 9.2), (1.9, 11.8), (2.1, 19)):
        drawn = np.full((1, 8), depth, dtype=np.float32)
        hits = Hits(Scene((crown, wall), Pose(z_m=2.0)), compass(0.0), optical_depth=drawn)
        assert hits.range_m[0, 0] == pytest.approx(expected, rel=1e-5)
    closed = Hits(Scene((crown, wall), Pose(z_m=2.0)), compass(0.0))
    assert closed.range_m[0, 0] == pytest.approx(8)


def brute_force(scene, rays):
    """Range and surface by a search in float64: march, then bisect each entry."""
    origin = rays.origin.reshape(3, -1).astype(float).T
    direction = rays.direction.reshape(3, -1).astype(float).T
    matrix = velodyne_to_world(scene.pose)
    origin = origin @ matrix[:, :3].T + matrix[:, 3]
    direction = direction @ matrix[:, :3].T

    steps = np.linspace(0, 40, 801)
    best = np.full(len(origin), np.inf)
    surface = np.full(len(origin), NO_SURFACE)
    falling = direction[:, 2] < 0
    best[falling] = -origin[falling, 2] / direction[falling, 2]
    surface[best <= 40] = GROUND
    best[best > 40] = np.inf
    for index, primitive in enumerate(scene.primitives):
        hit = inside(primitive, origin[:, None] + steps[:, None] * direction[:, None])
        rows = np.flatnonzero(hit.any(axis=1))
        first = hit[rows].argmax(axis=1)
        low, high = steps[first - 1], steps[first]
        for _ in range(30):
            middle = (low + high) / 2
            entered = inside(primitive, origin[rows] + middle[:, None] * direction[rows])
            low, high = np.where(entered, low, middle), np.where(entered, middle, high)
        nearer = high < best[rows]
        best[rows[nearer]] = high[nearer]
        surface[rows[nearer]] = index
    return best.reshape(rays.origin.shape[1:]), surface.reshape(rays.origin.shape[1:])


def crowd(seed, num=120, speed_m_s=0.0):
    """Solids all around, from below the sensor's nose to out of reach."""
    draw = np.random.default_rng(seed)
    primitives = []
    for _ in range(num):
        angle, distance = draw.uniform(0, 2 * np.pi), draw.exponential(25) + 2
        centre = (distance * np.cos(angle), distance * np.sin(angle), draw.uniform(-1, 4))
        shape = Shape(int(draw.integers(3)))
        primitive = solid(shape, centre, tuple(draw.uniform(0.05, 3, 3)), draw.uniform(0, 6))
        velocity = draw.normal(0, speed_m_s, 2) if speed_m_s else (0.0, 0.0)
        grade = tuple(draw.uniform(-0.1, 0.1, 2))
        primitives.append(replace(primitive, velocity_m_s=tuple(velocity), grade=grade))
    return Scene(tuple(primitives), Pose(pitch_rad=0.02, roll_rad=-0.03))


def test_cast_equals_a_search_along_the_rays():
    scene = replace(crowd(1, num=40), pose=Pose(0.3, -0.2, 1.7, 2.0, 0.02, -0.03))
    sensor = hdl64e(shots=60)
    # 8 of the 64 beams: the search takes 801 steps a ray.
    rays = Rays(sensor.rays.origin[:, ::8], sensor.rays.direction[:, ::8])
    expected_range, expected_surface = brute_force(scene, rays)
    hits = Hits(scene, rays)
    near = expected_range < 39.9
    agree = (hits.surface == expected_surface)[near]
    # Rays that graze an edge within one 5 cm step are missed by the search, not by the cast.
    assert agree.mean() > 0.99
    assert (hits.surface[near] >= 0).sum() > 50
    np.testing.assert_allclose(hits.range_m[near][agree], expected_range[near][agree], atol=2e-4)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_windows_never_cut_a_solid(monkeypatch, seed, moving):
    scene = crowd(seed, speed_m_s=15.0 if moving else 0.0)
    sensor = hdl64e(shots=180)
    rays, motion = sensor.rays, {}
    if moving:  # the sensor moves by up to 1 m and turns by up to 2 degrees
        shift = np.stack([20 * sensor.time_s, 2 * sensor.time_s, 0 * sensor.time_s])
        turn = 0.7 * sensor.time_s
        (x, y, z), cosine, sine = rays.direction, np.cos(turn), np.sin(turn)
        direction = np.stack([cosine * x - sine * y, sine * x + cosine * y, z])
        rays, motion = Rays(rays.origin + shift, direction), {"actor_time_s": sensor.time_s}
    assert_windows_cut_nothing(monkeypatch, scene, rays, **motion)


@pytest.mark.parametrize(("speed_m_s", "aside_m"), [(30, 3), (40, 2.5)])  # the latter: all around
def test_windows_follow_a_sensor_that_moves_while_it_sees_a_wall(monkeypatch, speed_m_s, aside_m):
    """All beams of a column fire at once, so that nothing but the path widens the windows."""
    places = [(x, y, 1) for x in (-4, 0, 4) for y in (-aside_m, aside_m)]
    walls = [solid(Shape.BOX, place, (1.6, 0.1, 1)) for place in places]
    lasers = replace(hdl64e().lasers, azimuth_offset_rad=(0.0,) * 64)
    sensor = replace(hdl64e(shots=1440), lasers=lasers)
    shift = np.stack([speed_m_s * sensor.time_s, 0 * sensor.time_s, 0 * sensor.time_s])
    rays = Rays(sensor.rays.origin + shift, sensor.rays.direction)
    scene = Scene(tuple(walls), Pose(z_m=1.7))
    assert_windows_cut_nothing(monkeypatch, scene, rays)


@pytest.mark.parametrize("seed", [47, 48, 58, 131])
def test_windows_follow_a_sensor_whose_turn_ends_behind_it(monkeypatch, seed):
    """There the place of the sensor jumps: it moves by 5 m between the first shot and the last."""
    sensor = replace(load_sensor("os0_32"), shots=360)
    shift = np.stack([50 * sensor.time_s, 0 * sensor.time_s, 0 * sensor.time_s])
    rays = Rays(sensor.rays.origin + shift, sensor.rays.direction)
    draw = np.random.default_rng(seed)
    angle, distance = np.pi + draw.normal(0, 0.4), draw.uniform(1.5, 9)
    centre = (distance * np.cos(angle), distance * np.sin(angle), draw.uniform(0, 2))
    half_size = draw.uniform((0.1, 0.3, 0.2), (2, 4, 1.5))
    wall = solid(Shape.BOX, centre, half_size, draw.uniform(0, 3))
    assert_windows_cut_nothing(monkeypatch, Scene((wall,), Pose(z_m=1.7)), rays)


def assert_windows_cut_nothing(monkeypatch, scene, rays, **motion):
    """Every ray meets what it meets when all rays are tested against all solids."""
    windowed = Hits(scene, rays, **motion)

    def everything(solids, origin, direction, max_range_m, actor_time_s=None):
        num, beams_shots = len(solids.shape), np.array([[0, 0], origin.shape[1:]])
        beams, shots = (np.tile(column, (num, 1)) for column in beams_shots.T)
        return Windows(beams, shots, np.zeros(num), np.arange(num))

    monkeypatch.setattr(raycast, "windows_of", everything)
    whole = Hits(scene, rays, **motion)
    assert (whole.surface >= 0).sum() > 100
    np.testing.assert_array_equal(windowed.range_m, whole.range_m)
    np.testing.assert_array_equal(windowed.surface, whole.surface)


def test_single_rays_see_what_the_turn_sees():
    scene = crowd(7, speed_m_s=10.0)
    fences = [replace(p, slats=(0.3, 0.5)) for p in scene.primitives[::2]]
    scene = replace(scene, primitives=(*fences, *scene.primitives[1::2]))
    sensor = hdl64e(shots=90)
    turn = Hits(scene, sensor.rays, actor_time_s=sensor.time_s)
    origin, direction = (level(a, scene.pose).reshape(3, -1) for a in sensor.rays)
    none, reach = (np.full(origin.shape[1], value) for value in (NO_SURFACE, REACH_M))
    rays = origin, direction, sensor.time_s.reshape(-1)
    range_m, surface = cast_single(turn.solids, *rays, reach, none, none)
    np.testing.assert_array_equal(surface, turn.surface.reshape(-1))
    seen = np.isfinite(range_m)
    np.testing.assert_allclose(range_m[seen], turn.range_m.reshape(-1)[seen], rtol=1e-6)


def test_single_rays_leave_out_and_look_inside():
    house = solid(Shape.BOX, (10, 0, 2), (4, 5, 3))
    pane = solid(Shape.BOX, (5.98, 0, 2), (0.01, 1, 1))
    solids = solids_of((house, pane), Pose(z_m=2.0), 0.0)
    start = np.array([[5.97], [0], [0]], dtype=np.float32)
    ahead = np.array([[1], [0], [0]], dtype=np.float32)
    time_s, reach = np.zeros(1, dtype=np.float32), np.array([100.0])

    def one(*excluded_and_hollow):
        surfaces = (np.array([surface]) for surface in excluded_and_hollow)
        range_m, found = cast_single(solids, start, ahead, time_s, reach, *surfaces)
        return range_m[0], found[0]

    # The front of the house is 0.03 m away, its back wall 8 m behind that.
    assert one(1, NO_SURFACE) == (pytest.approx(0.03, abs=1e-5), 0)
    assert one(1, 0) == (pytest.approx(8.03), 0)
    assert one(0, NO_SURFACE) == (np.inf, NO_SURFACE)


NAN = float("nan")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: replace(BOX, half_size=(1, 0, 1)), "half_size must be positive"),
        (lambda: replace(BOX, centre=(0, NAN, 0)), "must be finite"),
        (lambda: replace(BOX, velocity_m_s=(float("inf"), 0.0)), "must be finite"),
        (lambda: replace(BOX, yaw_rad=NAN), "must be finite"),
        (lambda: replace(BOX, reflectivity=1.5), "reflectivity must lie in"),
        (lambda: replace(BOX, instance=65536), "16 bits"),
        (lambda: replace(BOX, extinction_per_m=-1), "extinction_per_m"),
        (lambda: replace(BOX, grade=(0, 0.3)), "grade"),
        (lambda: Scene(pose=Pose(z_m=1.0), ground_m=1.0), "above the ground"),
        (lambda: Pose(pitch_rad=0.3), r"0\.2 rad"),
        (lambda: Pose(x_m=NAN), "x_m must be finite, got nan"),
        (lambda: EgoMotion(yaw_rate_rad_s=NAN), "yaw_rate_rad_s must be finite"),
        (lambda: Conditions(visibility_m=0.001), "visibility_m must be 1 or greater"),
        (lambda: Conditions(visibility_m=NAN), "visibility_m"),
        (lambda: Conditions(snow_mm_h=-1), "snow_mm_h"),
        (lambda: Conditions(sun_elevation_deg=91), "sun_elevation_deg"),
    ],
)
def test_impossible_scenes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def fan(num_beams=5, num_shots=720):
    """Beams from 10 degrees below to 10 degrees above the horizon, shots every half degree."""
    azimuth = 2 * np.pi / num_shots * np.arange(num_shots)
    inclination = np.radians(np.linspace(10, -10, num_beams))[:, None]
    direction = np.stack(
        [
            np.cos(inclination) * np.cos(azimuth),
            np.cos(inclination) * np.sin(azimuth),
            np.sin(inclination) * np.ones(num_shots),
        ]
    )
    return Rays(np.zeros((3, num_beams, num_shots), np.float32), direction.astype(np.float32))


def test_rays_pass_between_the_slats_of_a_fence():
    """Slats of 0.5 m every 2 m, 10 m ahead: the first begins at the left end, y = 4 m."""
    fence = replace(solid(Shape.BOX, (10, 0, 2), (4, 0.01, 3), -np.pi / 2), slats=(2.0, 0.25))
    hits = Hits(Scene((fence,), Pose(z_m=2.0), ground_m=-50), fan())
    shots = np.arange(-43, 44)
    met = hits.surface[2, shots] == 0
    across_m = 4 - 9.99 * np.tan(np.radians(shots / 2))
    inside_slat = across_m % 2
    sure = np.abs(inside_slat - 0.5) > 1e-3
    assert met[sure].tolist() == (inside_slat < 0.5)[sure].tolist()
    assert 0.15 < met.mean() < 0.35


def test_a_wall_with_windows_is_open_between_sill_and_lintel_alone():
    """At 10 m the beams of -10, -5, 0, 5 and 10 degrees pass at 0.24, 1.13, 2, 2.87 and 3.76 m."""
    wall = solid(Shape.BOX, (10, 0, 2), (4, 0.01, 2), -np.pi / 2)
    windows = replace(wall, slats=(2.0, 0.25), open_m=(1.0, 2.5))
    scene = Scene((windows,), Pose(z_m=2.0), ground_m=-50)
    shots = np.arange(-40, 41)
    share = (Hits(scene, fan()).surface[:, shots] == 0).mean(axis=1)
    np.testing.assert_allclose(share[[0, 1, 4]], 1)
    assert (share[2:4] < 0.4).all()


@pytest.mark.parametrize("constant", ["_SMALL_WINDOW", "_MOSTLY_OPEN"])
def test_solids_cast_together_are_hit_as_one_by_one(constant, monkeypatch):
    draw = np.random.default_rng(3)
    primitives = []
    for number in range(60):
        place = (*draw.uniform(-20, 20, 2), draw.uniform(0, 3))
        one = solid(Shape(number % 3), place, tuple(draw.uniform(0.05, 2, 3)), draw.uniform(0, 6))
        medium = {"extinction_per_m": 2.0} if number % 4 == 0 else {"slats": (0.3, 0.4)}
        velocity = (1.0, -2.0) if number % 5 == 0 else (0.0, 0.0)
        primitives.append(replace(one, velocity_m_s=velocity, **medium))
    scene, rays = Scene(tuple(primitives), Pose(z_m=2.0)), fan(16)
    motion = {
        "actor_time_s": draw.uniform(-0.05, 0.05, (16, 720)).astype(np.float32),
        "optical_depth": draw.exponential(size=(16, 720)).astype(np.float32),
    }
    results = []
    for value in (0, 10**9):
        monkeypatch.setattr(raycast, constant, value)
        results.append(Hits(scene, rays, **motion))
    np.testing.assert_array_equal(results[0].surface, results[1].surface)
    np.testing.assert_allclose(results[0].range_m, results[1].range_m, rtol=1e-6)
    assert len(np.unique(results[0].surface)) > 30

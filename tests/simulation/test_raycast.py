import numpy as np
import pytest

from r3dpa.simulation import HDL64E, Pose, Primitive, Scene, Semantic, Shape, Street, cast, raycast
from r3dpa.simulation.raycast import GROUND, MAX_RANGE_M, NO_SURFACE
from r3dpa.simulation.sensor import Rays


def rays_towards(*directions, origin=(0.0, 0.0, 0.0)):
    """One beam; the shots must be given by growing azimuth and fill the turn evenly."""
    direction = np.array(directions, dtype=float).T
    direction /= np.linalg.norm(direction, axis=0)
    start = np.broadcast_to(np.array(origin)[:, None], direction.shape)
    return Rays(start[:, None].astype(np.float32), direction[:, None].astype(np.float32))


# Eight shots, 45 degrees apart, slightly downwards or upwards.
def compass(z):
    angles = np.arange(8) * np.pi / 4
    return rays_towards(*[(np.cos(a), np.sin(a), z) for a in angles])


def solid(shape, centre, half_size, yaw_rad=0.0):
    return Primitive(shape, centre, half_size, Semantic.CAR, 0.4, yaw_rad, 7)


def test_ground_range_and_incidence():
    returns = cast(Scene(pose=Pose(z_m=2.0)), compass(-0.2))
    # A ray that falls 0.2 per metre reaches the ground 10 m away; its length is 10 sqrt(1.04).
    np.testing.assert_allclose(returns.range_m, 10 * np.sqrt(1.04), rtol=1e-6)
    np.testing.assert_allclose(returns.cos_incidence, 0.2 / np.sqrt(1.04), rtol=1e-6)
    assert (returns.surface == GROUND).all()
    assert (returns.semantic == Semantic.ROAD).all()


def test_rays_to_the_sky_and_beyond_reach_come_back_without_a_surface():
    for z in (0.1, -0.01):  # 2 m above ground: the second would hit at 200 m
        returns = cast(Scene(pose=Pose(z_m=2.0)), compass(z))
        assert (returns.surface == NO_SURFACE).all()
        assert np.isinf(returns.range_m).all()
        assert (returns.semantic == 0).all()
    assert MAX_RANGE_M == 120


def test_box_cylinder_and_ellipsoid_on_the_axes():
    primitives = (
        solid(Shape.BOX, (10, 0, 2), (1, 2, 3)),
        solid(Shape.CYLINDER, (0, 10, 2), (0.5, 0.5, 3)),
        solid(Shape.ELLIPSOID, (-10, 0, 2), (2, 1, 1)),
        solid(Shape.BOX, (0, -10, 2), (1, 4, 1), np.pi / 2),
    )
    returns = cast(Scene(primitives, Pose(z_m=2.0)), compass(0.0))
    np.testing.assert_allclose(returns.range_m[0, ::2], [9, 9.5, 8, 9], rtol=1e-6)
    np.testing.assert_array_equal(returns.surface[0, ::2], [0, 1, 2, 3])
    np.testing.assert_allclose(returns.cos_incidence[0, ::2], 1, atol=1e-6)
    assert (returns.surface[0, 1::2] == NO_SURFACE).all()
    assert (returns.semantic[0, ::2] == Semantic.CAR).all()
    assert (returns.instance[0, ::2] == 7).all()


def test_nearest_surface_hides_the_others_in_any_order():
    boxes = tuple(solid(Shape.BOX, (x, 0, 2), (1, 1, 1)) for x in (20, 10, 30))
    returns = cast(Scene(boxes, Pose(z_m=2.0)), compass(0.0))
    assert returns.range_m[0, 0] == pytest.approx(9)
    assert returns.surface[0, 0] == 1


def test_incidence_on_a_turned_wall():
    # A wall turned by 60 degrees is met at 60 degrees.
    wall = solid(Shape.BOX, (10, 0, 2), (0.5, 30, 3), np.radians(60))
    returns = cast(Scene((wall,), Pose(z_m=2.0)), compass(0.0))
    assert returns.cos_incidence[0, 0] == pytest.approx(0.5, abs=1e-5)
    assert returns.range_m[0, 0] == pytest.approx(10 - 0.5 / np.cos(np.radians(60)), abs=1e-5)


def test_incidence_on_the_cap_of_a_cylinder():
    pipe = solid(Shape.CYLINDER, (10, 0, 0.5), (3, 3, 0.5))  # its top is 1 m below the sensor
    returns = cast(Scene((pipe,), Pose(z_m=2.0)), compass(-0.1))
    assert returns.range_m[0, 0] == pytest.approx(10 * np.sqrt(1.01))
    assert returns.cos_incidence[0, 0] == pytest.approx(0.1 / np.sqrt(1.01))


def test_a_solid_around_the_sensor_is_not_seen_from_inside():
    around = solid(Shape.ELLIPSOID, (0, 0, 2), (3, 3, 3))
    returns = cast(Scene((around,), Pose(z_m=2.0)), compass(-0.2))
    assert (returns.surface == GROUND).all()


def brute_force(scene, rays):
    """Range and surface by a search in float64: march, then bisect each entry."""
    origin = rays.origin.reshape(3, -1).astype(float).T
    direction = rays.direction.reshape(3, -1).astype(float).T
    pose = scene.pose
    roll = np.array(
        [
            [1, 0, 0],
            [0, np.cos(pose.roll_rad), -np.sin(pose.roll_rad)],
            [0, np.sin(pose.roll_rad), np.cos(pose.roll_rad)],
        ]
    )
    pitch = np.array(
        [
            [np.cos(pose.pitch_rad), 0, np.sin(pose.pitch_rad)],
            [0, 1, 0],
            [-np.sin(pose.pitch_rad), 0, np.cos(pose.pitch_rad)],
        ]
    )
    heading = np.array(
        [
            [np.cos(pose.heading_rad), -np.sin(pose.heading_rad), 0],
            [np.sin(pose.heading_rad), np.cos(pose.heading_rad), 0],
            [0, 0, 1],
        ]
    )
    turn = heading @ pitch @ roll
    origin = origin @ turn.T + [pose.x_m, pose.y_m, pose.z_m]
    direction = direction @ turn.T

    def inside(primitive, points):
        offset = points - primitive.centre
        c, s = np.cos(primitive.yaw_rad), np.sin(primitive.yaw_rad)
        u = np.stack(
            [
                c * offset[..., 0] + s * offset[..., 1],
                c * offset[..., 1] - s * offset[..., 0],
                offset[..., 2],
            ],
            axis=-1,
        ) / np.array(primitive.half_size)
        if primitive.shape == Shape.BOX:
            return np.abs(u).max(axis=-1) <= 1
        if primitive.shape == Shape.CYLINDER:
            return (u[..., 0] ** 2 + u[..., 1] ** 2 <= 1) & (np.abs(u[..., 2]) <= 1)
        return (u**2).sum(axis=-1) <= 1

    steps = np.linspace(0, 40, 2001)
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


@pytest.mark.parametrize("seed", range(3))
def test_cast_equals_a_search_along_the_rays(seed):
    draw = np.random.default_rng(seed)
    primitives = []
    for _ in range(25):
        angle, distance = draw.uniform(0, 2 * np.pi), draw.uniform(5, 30)
        half_size = tuple(draw.uniform(0.3, 2.5, 3))
        centre = (distance * np.cos(angle), distance * np.sin(angle), draw.uniform(-1, 4))
        shape = Shape(int(draw.integers(3)))
        primitives.append(solid(shape, centre, half_size, draw.uniform(0, 6)))
    pose = Pose(0.3, -0.2, 1.7, draw.uniform(0, 6), draw.normal(0, 0.03), draw.normal(0, 0.03))
    scene = Scene(tuple(primitives), pose)
    sensor = HDL64E(shots=60)
    # 8 of the 64 beams: the search takes 2001 steps a ray.
    rays = Rays(sensor.rays.origin[:, ::8], sensor.rays.direction[:, ::8])
    expected_range, expected_surface = brute_force(scene, rays)
    returns = cast(scene, rays)
    near = expected_range < 39.9
    agree = (returns.surface == expected_surface)[near]
    # Rays that graze an edge within one 2 cm step are missed by the search, not by the cast.
    assert agree.mean() > 0.99
    assert (returns.surface[near] >= 0).sum() > 50
    np.testing.assert_allclose(returns.range_m[near][agree], expected_range[near][agree], atol=2e-4)


def test_windows_never_cut_a_solid(monkeypatch):
    scene = Street(5, 3).scene(40)
    rays = HDL64E(shots=180).rays
    windowed = cast(scene, rays)
    windows_of = raycast._windows

    def everything(solids, levelled):
        found = windows_of(solids, levelled)
        beams, shots = np.zeros_like(found.beams), np.zeros_like(found.shots)
        beams[:, 1], shots[:, 1] = levelled.shape[2:]
        order = np.arange(len(beams))
        return raycast._Windows(beams, shots, np.zeros(len(beams)), order)

    monkeypatch.setattr(raycast, "_windows", everything)
    whole = cast(scene, rays)
    np.testing.assert_array_equal(windowed.range_m, whole.range_m)
    np.testing.assert_array_equal(windowed.semantic, whole.semantic)


def test_primitive_and_pose_are_checked():
    with pytest.raises(ValueError, match="half_size must be positive"):
        solid(Shape.BOX, (0, 0, 0), (1, 0, 1))
    with pytest.raises(ValueError, match="reflectivity must lie in"):
        Primitive(Shape.BOX, (0, 0, 0), (1, 1, 1), Semantic.CAR, 1.5)
    with pytest.raises(ValueError, match="16 bits"):
        Primitive(Shape.BOX, (0, 0, 0), (1, 1, 1), Semantic.CAR, 0.5, 0.0, 65536)
    with pytest.raises(ValueError, match="above the ground"):
        Pose(z_m=0)
    with pytest.raises(ValueError, match=r"0\.2 rad"):
        Pose(pitch_rad=0.3)

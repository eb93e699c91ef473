"""Rolling shutter, moving actors, foliage and the recording car, against hand-made figures."""

from dataclasses import replace

import numpy as np
import pytest
import sweeps
from scipy.special import ndtr
from sweeps import applied, box

from lidarsim.effects import (
    EgoOcclusion,
    FoliageOcclusion,
    MovingActors,
    RollingShutter,
    motion,
)
from lidarsim.scan import simulate_scan
from lidarsim.scene import EgoMotion, Material, Pose, Primitive, Scene, Semantic, Shape
from lidarsim.sensors import hdl64e, load_sensor
from lidarsim.solids import EGO_BODY
from lidarsim.street.vehicles import recording_car
from lidarsim.sweep import Origin, Sweep

SENSOR = replace(hdl64e(), range_sigma_m=0.0, weak_range_sigma_m=0.0, range_step_m=0.0)
PLAIN = {"laser_calibration": "off"}
LEVEL = 5  # a beam within 0.3 degrees of the horizon


def wall(x, y, half_size, **changes):
    return box((x, y, 2), half_size, **changes)


def room(distance_m=20.0):
    """Walls ahead, behind, left and right, their faces at the same distance."""
    d, thick = distance_m + 0.5, 0.5
    across = [wall(x, 0, (thick, 60, 9)) for x in (d, -d)]
    return (*across, *(wall(0, y, (60, thick, 9)) for y in (d, -d)))


def swept(scene, *effects):
    return sweeps.swept(scene, SENSOR, before=effects)


def azimuth_of(sweep):
    _, direction = sweep.sensor.rays
    return np.arctan2(direction[1], direction[0])


def horizontal_range(sweep):
    slope = sweep.sensor.rays.direction[2, LEVEL, 0]
    return sweep.grid(sweep.first.range_m)[LEVEL] * np.sqrt(1 - slope**2)


def test_rolling_shutter_at_50_km_h_steps_by_139_cm_behind_the_car():
    scene = Scene(room(), motion=EgoMotion(50 / 3.6))
    sweep = swept(scene, RollingShutter())
    azimuth, distance = azimuth_of(sweep)[LEVEL], horizontal_range(sweep)
    time_s = sweep.sensor.time_s[LEVEL]
    behind = np.abs(np.abs(azimuth) - np.pi) < np.radians(15)
    x = -distance[behind] * np.cos(azimuth[behind])  # seen distance to the wall behind
    early, late = time_s[behind] < 0, time_s[behind] > 0
    # At the start of the sweep the car is 0.69 m back, at its end 0.69 m ahead.
    assert x[late].max() - x[early].min() == pytest.approx(50 / 3.6 * 0.1, abs=0.02)
    assert x[early].min() == pytest.approx(20 - 0.694, abs=0.03)
    # The head looks ahead in the middle of the sweep, where nothing has moved.
    ahead = np.abs(time_s).argmin()
    assert distance[ahead] * np.cos(azimuth[ahead]) == pytest.approx(20, abs=0.03)
    left = np.abs(azimuth - np.pi / 2).argmin()
    assert distance[left] * np.sin(azimuth[left]) == pytest.approx(20, abs=1e-3)


def test_rolling_shutter_while_turning_rotates_what_is_seen():
    rate = np.radians(30)
    sweep = swept(Scene(room(), motion=EgoMotion(0.0, rate)), RollingShutter())
    still = swept(Scene(room()))
    true = np.arctan2(*sweep.grid(sweep.direction)[1::-1])
    turned = (true - azimuth_of(sweep) + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turned, rate * sweep.sensor.time_s, atol=2e-6)
    # On a curve the car ends beside its tangent by v w t^2 / 2.
    curve = applied(Sweep(Scene((), motion=EgoMotion(10.0, rate)), SENSOR), RollingShutter())
    late = int(curve.time_s.argmax())
    moved = curve.start[:, late] - still.start[:, late]
    t = curve.time_s[late]
    lateral = sweep.sensor.lasers.lateral_m[0]
    assert moved[0] == pytest.approx(10 * t, abs=abs(lateral) * rate * t + 2e-3)
    assert moved[1] == pytest.approx(10 * rate * t**2 / 2, abs=abs(lateral) * rate * t + 2e-3)


def test_an_actor_that_crosses_is_sheared():
    """Shear = v * (width in azimuth) / (2 pi) * 0.1 s, for a truck seen broadside."""
    truck = wall(0, 10, (6, 1, 1.5), velocity_m_s=(10.0, 0.0))
    away = wall(0, 10, (6, 1, 1.5), velocity_m_s=(0.0, 10.0))
    moving, still = (swept(Scene((truck,)), *effects) for effects in ((MovingActors(),), ()))

    def ends(sweep):
        hit = np.flatnonzero(sweep.grid(sweep.first.surface)[LEVEL] == 0)
        return azimuth_of(sweep)[LEVEL][hit[[0, -1]]]

    first, last = ends(still)
    assert last - first == pytest.approx(2 * np.arctan(6 / 9), abs=0.01)
    # Each end of the truck is met when the head looks there, at azimuth / (2 pi) * 0.1 s.
    for edge, was, corner in zip(ends(moving), (first, last), (6, -6), strict=True):
        expected = np.arctan2(9, corner + 10 * was / (2 * np.pi) * 0.1)
        assert edge == pytest.approx(expected, abs=0.012)
    # Driving away, its face is sheared: the end seen later is farther by v * (time between).
    sweep = swept(Scene((away,)), MovingActors())
    hit = np.flatnonzero(sweep.grid(sweep.first.surface)[LEVEL] == 0)[2:-2]
    depth = sweep.grid(sweep.position(np.arange(sweep.num_rays)))[1, LEVEL, hit]
    width = azimuth_of(sweep)[LEVEL][hit[-1]] - azimuth_of(sweep)[LEVEL][hit[0]]
    assert depth[-1] - depth[0] == pytest.approx(10 * width / (2 * np.pi) * 0.1, abs=2e-3)


def test_foliage_lets_rays_in_by_one_over_the_extinction():
    """Mean penetration 1 / k of a deep medium; of a thin one, the share of depths beyond it.

    Depths are -ln(1 - Phi(r g + sqrt(1 - r^2) n)) exp(a g), scaled to the mean 1 / k.
    """
    k, alike = 1.25, motion._ALIKE
    g, n = np.random.default_rng(0).standard_normal((2, 400_000))
    drawn = -np.log(ndtr(-alike * g - np.sqrt(1 - alike**2) * n)) * np.exp(motion._CLUMP_SPREAD * g)
    drawn /= k * drawn.mean()
    deep = wall(30, 0, (15, 60, 9), extinction_per_m=k)
    sweep = swept(Scene((deep,)), FoliageOcclusion())
    straight = np.abs(azimuth_of(sweep)[LEVEL]) < np.radians(40)
    hit = sweep.grid(sweep.first.surface)[LEVEL] == 0
    slope = sweep.sensor.rays.direction[:, LEVEL]
    depth = sweep.grid(sweep.first.range_m)[LEVEL] - 15 / slope[0]
    depth = depth[straight & hit]
    assert len(depth) > 400
    # Some 8 rays of one clump are alike.
    error = drawn.std() / np.sqrt(len(depth) / 8)
    assert depth.mean() == pytest.approx(1 / k, abs=3 * error)
    assert (sweep.grid(sweep.first.origin)[LEVEL][hit] == Origin.FOLIAGE).all()

    thin = wall(10, 0, (0.5, 60, 9), extinction_per_m=k)
    sweep = swept(Scene((thin, *room(30))), FoliageOcclusion())
    ahead = np.abs(azimuth_of(sweep)) < np.radians(5)
    ahead[28:] = False  # lower beams meet the ground
    through = (sweep.grid(sweep.first.surface) != 0)[ahead].mean()
    expected = (drawn > 1).mean()
    assert through == pytest.approx(expected, abs=4 * np.sqrt(0.25 / (ahead.sum() / 8)))


def test_the_recording_car_hides_the_same_rays_in_every_scene():
    roof = Primitive(Shape.BOX, (0.0, 0, -0.6), (1.6, 1.4, 0.2), Semantic.CAR, 0.3)
    mask = []
    for scene in (Scene(room()), Scene((), Pose(pitch_rad=0.02, z_m=1.8))):
        with_car = replace(scene, ego_body=(roof,))
        sweep = swept(with_car)
        before, rays = sweep.first.range_m.copy(), EgoOcclusion().rays(sweep)
        applied(sweep, EgoOcclusion())
        mask.append(rays)
        assert (sweep.first.surface[rays] == EGO_BODY).all()
        assert (sweep.reflectivity[rays] == np.float32(0.3)).all()
        assert (sweep.material[rays] == Material.CONCRETE).all()
        outside = np.setdiff1d(np.arange(sweep.num_rays), rays)
        np.testing.assert_array_equal(sweep.first.range_m[outside], before[outside])
        # Nothing nearer than the instrument's limit is reported: the roof leaves a hole.
        points = simulate_scan(with_car, SENSOR, (0,), PLAIN).points
        assert np.linalg.norm(points[:, :3], axis=1).min() > 1.4
    np.testing.assert_array_equal(*mask)
    # The roof's top is 0.4 m below the frame and reaches 1.4 m to the left: from an optical centre
    # at height h, beams steeper than atan((h + 0.4) / 1.4) meet it straight to the left.
    lasers = SENSOR.lasers
    left = np.abs(azimuth_of(sweep) - np.pi / 2).argmin(axis=1)
    hidden = np.zeros(sweep.shape, dtype=bool)
    hidden.reshape(-1)[mask[0]] = True
    steep = -np.tan(lasers.inclination_rad) * 1.4 > np.array(lasers.height_m) + 0.4
    expected = hidden[np.arange(64), left]
    assert (steep == expected).mean() > 0.96  # the lateral offset moves a beam or two
    assert steep.any()


def test_share_of_shots_that_the_recording_car_hides():
    """In all of 24 scans of KITTI 6.4 % of the shots are lost, of beams 42 to 64."""
    sensor = hdl64e()
    scene = Scene(room(), ego_body=recording_car())
    hidden = np.zeros(sensor.rays.direction.shape[1:], dtype=bool)
    hidden.reshape(-1)[EgoOcclusion().rays(Sweep(scene, sensor))] = True
    assert hidden.mean() == pytest.approx(0.064, abs=0.004)
    assert not hidden[:41].any()


@pytest.mark.parametrize("name", ["hdl64e", "hdl32e", "os1_64"])
def test_shots_that_the_recording_car_hides_are_lost(name):
    sensor = load_sensor(name)
    scene = Scene(room(), ego_body=recording_car())
    hidden = EgoOcclusion().rays(Sweep(scene, sensor))
    scan = simulate_scan(scene, sensor, (0,))
    assert len(hidden) > 1000
    assert not (scan.labels == Semantic.EGO_VEHICLE).any()
    assert len(scan.points) <= sensor.num_beams * sensor.shots - len(hidden)

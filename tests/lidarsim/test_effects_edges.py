"""Beams of finite width at edges, against hand-made figures and a cast of every rim."""

from dataclasses import replace

import numpy as np
import pytest
import sweeps
from sweeps import box, pole

from lidarsim.draws import generator_for
from lidarsim.effects import (
    DiffuseReflection,
    DualReturn,
    FoliageOcclusion,
    MixedPixels,
    MovingActors,
    RollingShutter,
)
from lidarsim.raycast import cast
from lidarsim.scene import EgoMotion, Material, Pose, Primitive, Scene, Semantic, Shape
from lidarsim.sensors import hdl64e
from lidarsim.solids import EGO_BODY, NO_SURFACE
from lidarsim.sweep import Origin

SENSOR = hdl64e()
LEVEL = 5  # a beam within 0.3 degrees of the horizon
SHOT = 40
RING = np.sqrt(2 / 3) * SENSOR.divergence_rad / 2
PATH = (DiffuseReflection(), MixedPixels())


def swept(scene, sensor=SENSOR, before=(), after=PATH):
    return sweeps.swept(scene, sensor, before=before, after=after)


def assert_same_state(plain, sweep):
    """All echoes and all arrays of the rays."""

    def arrays_of(sweep):
        arrays = [sweep.cos_incidence, sweep.reflectivity, sweep.material, sweep.min_power]
        echoes = [array for echoes in sweep.echoes() for array in echoes.columns()]
        return [*echoes, *arrays, sweep.start, sweep.direction]

    for before, after in zip(arrays_of(plain), arrays_of(sweep), strict=True):
        np.testing.assert_array_equal(before, after)


def beside_ray(near_m, far_m, offset):
    """Walls at two distances; the nearer one covers all that lies left of ``offset`` ring radii
    to the left of one ray. None for a distance leaves that wall out."""
    ray = LEVEL * SENSOR.shots + SHOT
    start, towards = (array.reshape(3, -1)[:, ray].astype(float) for array in SENSOR.rays)
    left = np.array([-towards[1], towards[0]]) / np.hypot(*towards[:2])
    ahead = towards[:2] / np.hypot(*towards[:2])
    yaw = float(np.arctan2(ahead[1], ahead[0]))

    def wall(distance_m, edge_m):
        centre = start[:2] + (distance_m + 0.05) * ahead + (edge_m + 10) * left
        return box((*centre, 0), (0.05, 10, 30), yaw_rad=yaw)

    walls = [wall(near_m, offset * RING * near_m)]
    if far_m is not None:
        walls.append(wall(far_m, -9))
    return Scene(tuple(walls), Pose(z_m=0.0), ground_m=-1000), ray, 1 / np.hypot(*towards[:2])


def test_echoes_within_a_pulse_merge_to_their_energy_weighted_range():
    """Left of -0.2 radii lie the axis and three points of the ring: 1/4 + 3/8 of the power."""
    scene, ray, slant = beside_ray(10.0, 10.5, -0.2)
    plain, sweep = swept(scene, after=PATH[:1]), swept(scene)
    assert plain.first.range_m[ray] == pytest.approx(10 * slant, rel=1e-5)
    near, far = 5 / 8 / 10.0**2, 3 / 8 / 10.5**2
    expected = slant * (10 * near + 10.5 * far) / (near + far)
    # 1e-4: the points of the ring meet the wall at slightly other angles.
    assert sweep.first.range_m[ray] == pytest.approx(expected, rel=1e-4)
    assert sweep.first.power[ray] == pytest.approx(0.5 * (near + far), rel=2e-3)
    assert sweep.first.origin[ray] == Origin.MIXED
    assert sweep.first.surface[ray] == 0


def test_a_wall_that_the_axis_misses():
    """Three points of the ring meet it."""
    scene, ray, slant = beside_ray(10.0, None, 0.2)
    assert swept(scene, after=PATH[:1]).first.surface[ray] == NO_SURFACE
    sweep = swept(scene)
    assert sweep.first.range_m[ray] == pytest.approx(10 * slant, rel=1e-5)
    assert sweep.first.power[ray] == pytest.approx(3 / 8 * 0.5 / 100, rel=2e-3)
    assert sweep.material[ray] == Material.PAINT


@pytest.mark.parametrize(("offset", "on_axis", "rest_m"), [(-0.2, 10.0, 12.0), (0.2, 12.0, 10.0)])
def test_echoes_farther_apart_stay_apart(offset, on_axis, rest_m):
    """The axis keeps its range bitwise and 5/8 of its power; the other side is the second echo."""
    scene, ray, slant = beside_ray(10.0, 12.0, offset)
    dual = replace(SENSOR, return_mode="dual")
    plain, sweep = (swept(scene, dual, (DualReturn(),), after) for after in (PATH[:1], PATH))
    echoes = {on_axis: 5 / 8 * 0.5 / on_axis**2, rest_m: 3 / 8 * 0.5 / rest_m**2}
    ranked = sorted(echoes, key=lambda there_m: -echoes[there_m])
    for found, there_m in zip(sweep.echoes(), ranked, strict=True):
        assert found.range_m[ray] == pytest.approx(there_m * slant, rel=1e-4)
        assert found.power[ray] == pytest.approx(echoes[there_m], rel=3e-3)
        assert found.origin[ray] == Origin.SURFACE
        if there_m == on_axis:
            assert found.range_m[ray] == plain.first.range_m[ray]


def test_pulse_length_decides_what_merges():
    """c tau / 2 is 0.6 m at 4 ns and 1.5 m at 10 ns."""
    scene, ray, _ = beside_ray(10.0, 11.0, -0.2)
    for pulse_s, origin in ((4e-9, Origin.SURFACE), (10e-9, Origin.MIXED)):
        sweep = swept(scene, replace(SENSOR, pulse_s=pulse_s))
        assert sweep.first.origin[ray] == origin


def test_steps_below_the_edge_change_nothing():
    scene, _, _ = beside_ray(10.0, 10.25, -0.2)
    plain, sweep = swept(scene, after=PATH[:1]), swept(scene)
    inner = np.abs(plain.grid(plain.first.surface)).max(axis=0) <= 1
    for before, after in zip(plain.first.columns(), sweep.first.columns(), strict=True):
        # All shots whose footprint lies on the two walls.
        columns = np.flatnonzero(inner)[2:-2]
        np.testing.assert_array_equal(plain.grid(before)[:, columns], sweep.grid(after)[:, columns])


def crowd(seed):
    generator = generator_for("edges", seed)
    solids = []
    for _ in range(60):
        bearing, distance = generator.uniform(0, 2 * np.pi), generator.uniform(6, 60)
        half_size = tuple(generator.uniform((0.02, 0.02, 0.5), (1.5, 1.5, 3.0)))
        centre = (distance * np.cos(bearing), distance * np.sin(bearing), half_size[2] + 0.3)
        velocity = tuple(generator.uniform(-10, 10, 2) * (generator.random() < 0.3))
        shape, yaw_rad = Shape(int(generator.integers(3))), generator.uniform(0, 3)
        solid = box(centre, half_size, yaw_rad=yaw_rad, velocity_m_s=velocity)
        solids.append(replace(solid, shape=shape, material=Material.CONCRETE))
    return Scene(tuple(solids), motion=EgoMotion(12.0, 0.2))


def test_edges_are_those_of_a_cast_of_every_rim():
    """Of the rays whose rim, cast through the whole scene, meets an edge, 95 % are found; of those
    that change, 98 % have one, and what their whole footprint returns is the same."""
    scene, moving = crowd(0), (RollingShutter(), MovingActors())
    plain, sweep = swept(scene, SENSOR, moving, PATH[:1]), swept(scene, SENSOR, moving)
    own, own_m = plain.first.surface, plain.first.range_m
    direction = sweep.direction
    left = np.stack([-direction[1], direction[0], np.zeros_like(direction[0])])
    left /= np.linalg.norm(left, axis=0)
    above = np.cross(direction, left, axis=0)
    edge = np.zeros(sweep.num_rays, dtype=bool)
    kept = np.full(sweep.num_rays, 2 / 8)
    for angle in np.arange(6) * np.pi / 3:
        aside = direction + RING * (np.cos(angle) * left + np.sin(angle) * above)
        start, towards = sweep.grid(sweep.start), sweep.grid(aside.astype(np.float32))
        times = sweep.grid(sweep.actor_time_s)
        found = cast(sweep.solids, start, towards, SENSOR.max_range_m, times)
        rim_m, rim = (array.reshape(-1) for array in found)
        kept += (rim == own) / 8
        nearer = np.where(own_m < rim_m, own, rim)
        with np.errstate(invalid="ignore"):
            edge |= (rim != own) & (nearer >= 0) & ~(np.abs(rim_m - own_m) <= 0.3)
    changed = (sweep.first.power != plain.first.power) | (sweep.first.range_m != own_m)
    assert edge.sum() > 500
    assert (edge & changed).sum() > 0.95 * edge.sum()
    assert (edge & changed).sum() > 0.98 * changed.sum()
    alone = changed & (sweep.first.surface == own) & (sweep.first.origin == Origin.SURFACE)
    share = sweep.first.power[alone] / plain.first.power[alone]
    assert alone.sum() > 200
    assert (np.abs(share - kept[alone]) < 1e-3).mean() > 0.95


@pytest.mark.parametrize("speed_m_s", [0.0, 9.0])
def test_thin_solids_that_all_axes_miss(speed_m_s):
    """A rod of 2 mm, 60 m away, stands at one point of a rim when its shot is fired: 1/8 of the
    power at normal incidence."""
    ray = LEVEL * SENSOR.shots + 1000  # nearly behind, where the sweep ends
    start, towards = (array.reshape(3, -1)[:, ray].astype(float) for array in SENSOR.rays)
    left = np.array([-towards[1], towards[0]]) / np.hypot(*towards[:2])
    x, y = start[:2] + 60 * (towards[:2] + RING * left)
    fired_s = SENSOR.time_s.reshape(-1)[ray]
    at, velocity = (x, y - speed_m_s * fired_s, 0.0), (0, speed_m_s)
    rod = pole(at, 1e-3, 30.0, reflectivity=0.8, material=Material.PAINT, velocity_m_s=velocity)
    scene = Scene((rod,), Pose(z_m=0.0), ground_m=-1000)
    assert swept(scene, SENSOR, (MovingActors(),), PATH[:1]).first.surface[ray] == NO_SURFACE
    sweep = swept(scene, SENSOR, (MovingActors(),))
    assert sweep.first.surface[ray] == 0
    assert sweep.first.range_m[ray] == pytest.approx(60, rel=1e-4)
    # The axis of the rod is met to within a third of its radius.
    assert sweep.first.power[ray] == pytest.approx(0.8 / 60**2 / 8, rel=0.06)
    assert sweep.material[ray] == Material.PAINT


def test_a_beam_meets_no_more_of_a_fence_than_its_pickets():
    """Pickets of 8 in 13 cm before a wall, as one solid with gaps and as single boxes."""
    wall = box((18, 0, 2), (0.1, 30, 4), material=Material.CONCRETE)
    fence = box((12, 0, 0), (6, 0.02, 30), yaw_rad=np.pi / 2)
    pickets = [
        box((12, left, 0), (0.04, 0.02, 30), yaw_rad=np.pi / 2)
        for left in np.arange(-5.96, 6, 0.13)
    ]
    shares = []
    for solids in ((replace(fence, slats=(0.13, 8 / 13)),), pickets):
        sweep = swept(Scene((*solids, wall), Pose(z_m=0.0), ground_m=-1000))
        azimuth = np.arctan2(sweep.direction[1], sweep.direction[0])
        ahead = np.abs(azimuth) < np.arctan(5 / 12)
        shares.append((sweep.first.surface[ahead] < len(solids)).mean())
    assert 8 / 13 < shares[0] < shares[1] < 0.9


def test_tiles_of_ground_do_not_mix():
    """A pavement of tiles that meet at grazing incidence, with a step of 12 cm."""
    paving = {"semantic": Semantic.SIDEWALK, "reflectivity": 0.2, "material": Material.PAVING}
    tiles = tuple(
        box((5.0 * number, 0, 0.06 * (number % 2)), (2.5, 50, 0.06), **paving)
        for number in range(-8, 9)
    )
    plain, sweep = swept(Scene(tiles), after=PATH[:1]), swept(Scene(tiles))
    assert_same_state(plain, sweep)


def test_leaves_fill_the_beam():
    crown = Primitive(
        Shape.ELLIPSOID, (12.0, 0, 2.5), (2, 2, 2), Semantic.VEGETATION, 0.5,
        material=Material.FOLIAGE, extinction_per_m=0.8,
    )  # fmt: skip
    scene = Scene((crown,))
    foliage = (FoliageOcclusion(),)
    plain, sweep = swept(scene, before=foliage, after=PATH[:1]), swept(scene, before=foliage)
    assert (plain.first.origin == Origin.FOLIAGE).sum() > 100
    assert_same_state(plain, sweep)
    # A pole before the crown takes its share of the leaves behind it.
    before_it = pole((8.0, 0.0, 2.0), 0.1, 3.0, reflectivity=0.3)
    both = swept(Scene((crown, before_it)), before=foliage, after=PATH[:1])
    mixed = swept(Scene((crown, before_it)), before=foliage)
    less = (both.first.origin == Origin.FOLIAGE) & (mixed.first.power != both.first.power)
    assert less.sum() > 3


def test_diverted_rays_and_the_recording_car_keep_their_echoes():
    sweep = swept(crowd(4), after=PATH[:1])
    mirrored, car, kept = np.array_split(MixedPixels().rays(sweep), 3)
    sweep.first.origin[mirrored] = Origin.MIRROR
    sweep.first.surface[car] = EGO_BODY
    rays = MixedPixels().rays(sweep)
    assert not np.isin(rays, mirrored).any()
    assert not np.isin(rays, car).any()
    assert np.isin(rays, kept).any()

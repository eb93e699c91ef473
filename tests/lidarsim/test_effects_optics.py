"""Glass, polished metal and water, against hand-made figures."""

import numpy as np
import pytest
import sweeps
from sweeps import applied, box

from lidarsim.effects import (
    DiffuseReflection,
    Glass,
    MovingActors,
    PolishedMetal,
    WetGround,
)
from lidarsim.effects.surface import fresnel_reflectance
from lidarsim.scene import Conditions, Material, Pose, Puddle, Scene, Semantic
from lidarsim.sensors import hdl64e
from lidarsim.sweep import Origin

SENSOR = hdl64e(shots=720)


def pane(centre, half_size, **values):
    return box(centre, half_size, material=Material.GLASS, reflectivity=1e-4, **values)


WALL = box((10.5, 0, 3), (0.5, 30, 3))
PANE = pane((5.01, 0, 3), (0.01, 2, 3))


def swept(*primitives, effects=(), **others):
    """A sweep after the ray cast, diffuse reflection and some effects."""
    scene = Scene(primitives, **others)
    return sweeps.swept(scene, SENSOR, after=(DiffuseReflection(), *effects))


def with_origin(sweep, origin):
    seen = np.isfinite(sweep.first.range_m)
    return np.flatnonzero(seen & (sweep.first.origin == origin))


def image(sweep, rays):
    """Where the instrument believes the points of these rays."""
    return sweep.start[:, rays] + sweep.first.range_m[rays] * sweep.direction[:, rays]


def surface_reflectance(cosine, index):
    """Fresnel's equations in Snell's angles."""
    angle = np.arccos(cosine.astype(float))
    inner = np.arcsin(np.sin(angle) / index)
    across = (np.sin(angle - inner) / np.sin(angle + inner)) ** 2
    along = (np.tan(angle - inner) / np.tan(angle + inner)) ** 2
    return (across + along) / 2


def pane_transmittance(cosine):
    """The sum over all inner reflections, not the closed form."""
    surface = surface_reflectance(cosine, 1.52)
    return sum((1 - surface) ** 2 * surface ** (2 * n) for n in range(60))


def test_power_behind_a_pane_and_dirt_of_one_before_nothing():
    plain, sweep = swept(WALL), swept(WALL, PANE, effects=[Glass()])
    rays = with_origin(sweep, Origin.GLASS)
    rays = rays[sweep.first.surface[rays] == 0]
    assert len(rays) > 500
    np.testing.assert_allclose(sweep.first.range_m[rays], plain.first.range_m[rays], rtol=1e-5)
    ratio = sweep.first.power[rays] / plain.first.power[rays]
    cosine = sweep.cos_incidence[rays]
    np.testing.assert_allclose(ratio, pane_transmittance(cosine.clip(max=1 - 1e-6)) ** 2, rtol=1e-3)
    assert cosine.max() > 0.9999
    assert ratio[cosine.argmax()] == pytest.approx(0.843, abs=5e-4)

    plain, sweep = swept(PANE), swept(PANE, effects=[Glass()])
    upward = np.flatnonzero((plain.first.surface == 0) & (plain.direction[2] > 0))
    assert len(upward) > 100
    assert (sweep.first.origin[upward] == Origin.SURFACE).all()
    assert (sweep.first.power[upward] == plain.first.power[upward]).all()
    assert (sweep.first.range_m[upward] == plain.first.range_m[upward]).all()


@pytest.mark.parametrize(
    ("of_house", "of_window", "gap_m", "seen_at"),
    [(7, 7, 0.02, 16.0), (0, 0, 0.02, 6.0), (7, 8, 0.02, 6.0), (7, 7, 1.0, 6.0)],
)
def test_a_window_shows_the_back_wall_of_its_own_house_only(of_house, of_window, gap_m, seen_at):
    house = box((11.0, 0, 3), (5.0, 30, 3), instance=of_house)
    at = (6 - gap_m - 0.01, 0, 3)
    window = pane(at, (0.01, 2, 3), instance=of_window)
    sweep = swept(house, window, effects=[Glass()])
    rays = with_origin(sweep, Origin.GLASS)
    # The room is 30 m wide and 6 m high: the rest sees its side walls, ceiling and the floor.
    level = rays[(np.abs(sweep.direction[2, rays]) < 0.1) & (sweep.direction[0, rays] > 0.9)]
    assert len(level) > 200
    assert (sweep.first.surface[level] == 0).all()
    np.testing.assert_allclose(image(sweep, level)[0], seen_at, rtol=1e-4)


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (0.0, 20.0)])
def test_a_cabin_is_crossed_by_two_panes(velocity):
    cabin = pane((6, 0, 3), (1, 4, 3), instance=3, velocity_m_s=velocity)
    of_cabin = {"instance": 3, "velocity_m_s": velocity}
    seat = box((6, 1, 1.2), (0.2, 0.4, 0.5), material=Material.CLOTH, **of_cabin)
    effects = {"before": [MovingActors()], "after": [DiffuseReflection()]}
    solids = ((WALL, seat), (WALL, cabin, seat))
    plain, sweep = (sweeps.swept(Scene(each), SENSOR, **effects) for each in solids)
    # In by the front and out by the back, which is parallel to it.
    rays = Glass().rays(sweep)
    front = np.abs(sweep.position(rays)[0] - 5) < 1e-3
    inside_y = np.abs(image(plain, rays)[1] * 7 / 10 - sweep.time_s[rays] * velocity[1]) < 3.9
    low = sweep.direction[2, rays] < 0.1
    rays = rays[front & inside_y & low & (plain.first.range_m[rays] < 15)]
    cosine = sweep.cos_incidence[rays]
    applied(sweep, Glass())
    rays, cosine = (a[sweep.first.origin[rays] == Origin.GLASS] for a in (rays, cosine))
    passed = pane_transmittance(cosine.clip(max=1 - 1e-6)) ** 2
    ratio = sweep.first.power[rays] / plain.first.power[rays]
    on_wall = (sweep.first.surface[rays] == 0) & (plain.first.surface[rays] == 0)
    on_seat = (sweep.first.surface[rays] == 2) & (plain.first.surface[rays] == 1)
    assert on_wall.sum() > 100
    assert on_seat.sum() > 20
    np.testing.assert_allclose(ratio[on_wall], passed[on_wall] ** 2, rtol=2e-3)
    np.testing.assert_allclose(ratio[on_seat], passed[on_seat], rtol=2e-3)


def test_glass_mirrors_at_grazing_incidence():
    """A long pane beside the street shows the wall at its end behind itself."""
    long_pane = pane((20, 2.01, 3), (15, 0.01, 3))
    wall = box((40.5, -10, 3), (0.5, 11, 3), reflectivity=0.8)
    sweep = swept(long_pane, wall, effects=[Glass()])
    rays = with_origin(sweep, Origin.MIRROR)
    rays = rays[sweep.first.surface[rays] == 1]
    x, y, _ = image(sweep, rays)
    # Mirrored at y = 2, the wall's face from y = -21 to 1 lies from 3 to 25, and its side at 3.
    assert ((y > 3 - 1e-3) & (y < 25)).all()
    face = y > 3 + 1e-3
    assert face.sum() > 20
    np.testing.assert_allclose(x[face], 40, rtol=1e-5)
    rays = rays[face]
    reflectance = 1 - pane_transmittance(sweep.cos_incidence[rays])
    expected = reflectance**2 * 0.8 * sweep.direction[0, rays] / sweep.first.range_m[rays] ** 2
    np.testing.assert_allclose(sweep.first.power[rays], expected, rtol=2e-3)


def test_image_in_a_metal_mirror():
    # The mirror's face goes through (10, 0), turned by 45 degrees: it swaps x - 10 and y.
    at, thick = np.array([10.0, 0.0]), 0.02
    normal = np.array([-1.0, 1.0]) / np.sqrt(2)
    centre = (*(at - thick * normal), 2.0)
    metal = {"material": Material.POLISHED_METAL, "reflectivity": 0.2}
    mirror = box(centre, (2, thick, 2), yaw_rad=np.pi / 4, **metal)
    wall = box((10, 8.5, 3), (6, 0.5, 3), reflectivity=0.6)
    plain = swept(mirror, wall)
    sweep = swept(mirror, wall, effects=[PolishedMetal()])
    rays = with_origin(sweep, Origin.MIRROR)
    rays = rays[sweep.first.surface[rays] == 1]
    assert len(rays) > 100
    x, y, _ = image(sweep, rays)
    # Its face y = 8 shows at x = 18.
    np.testing.assert_allclose(x, 18, rtol=1e-4)
    assert (np.abs(y) < 6).all()
    expected = 0.81 * 0.6 * sweep.direction[0, rays] / sweep.first.range_m[rays] ** 2
    np.testing.assert_allclose(sweep.first.power[rays], expected, rtol=1e-3)
    direct = np.flatnonzero((plain.first.surface == 0) & (sweep.first.origin == Origin.SURFACE))
    assert len(direct) > 10
    np.testing.assert_allclose(sweep.first.power[direct], plain.first.power[direct] / 10, rtol=1e-5)


def test_wet_ground_loses_power():
    plain = swept(effects=[])
    ground = plain.on_ground()
    for film_mm, share in ((1.2, 1.0), (5.0, 1.0), (0.3, 0.25)):
        wet = swept(effects=[WetGround()], weather=Conditions(water_film_mm=film_mm))
        ratio = wet.first.power[ground] / plain.first.power[ground]
        degrees = np.degrees(np.arccos(wet.cos_incidence[ground]))
        at_88 = ratio[np.abs(degrees - 88).argmin()]
        assert np.abs(degrees - 88).min() < 0.2
        assert at_88 == pytest.approx(1 - share + share * 0.2**2 / 1.77, abs=0.005)
        passed = 1 - surface_reflectance(wet.cos_incidence[ground], 1.33)
        np.testing.assert_allclose(ratio, 1 - share + share * passed**2 / 1.33**2, rtol=1e-3)


@pytest.mark.parametrize(("heading_rad", "pitch_rad"), [(0.0, 0.0), (2.0, 0.02)])
def test_image_in_a_puddle(heading_rad, pitch_rad):
    """A wall 15 m ahead shows upside down; the puddle lies 10 m ahead and 1 m to the left."""
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    here = np.array([100.0, 50.0])
    wall = box((*(turn @ [15.5, 0] + here), 2), (0.5, 20, 2), yaw_rad=heading_rad)
    puddle = Puddle(*(turn @ [10, 1] + here), 2.0)
    pose = Pose(*here, 1.73, heading_rad, pitch_rad)
    wet = {"pose": pose, "weather": Conditions(water_film_mm=2.0)}
    sweep = swept(wall, puddles=(puddle,), effects=[WetGround()], **wet)
    dry = swept(wall, effects=[WetGround()], **wet)
    rays = with_origin(sweep, Origin.MIRROR)
    assert len(rays) > 20
    x, _, z = image(sweep, rays)
    np.testing.assert_allclose(x, 15, rtol=1e-3)
    # Below the ground, and no deeper than the wall is high.
    assert ((z < -1.73) & (z > -1.73 - 4)).all()
    legs = image(dry, rays)
    assert (np.hypot(legs[0] - 10, legs[1] - 1) < 2.001).all()
    reflectance = fresnel_reflectance(np.abs(sweep.direction[2, rays]), 1.33)
    expected = reflectance**2 * 0.5 * sweep.direction[0, rays] / sweep.first.range_m[rays] ** 2
    np.testing.assert_allclose(sweep.first.power[rays], expected, rtol=1e-3)


def test_water_stands_level_on_a_slope():
    asphalt = {"semantic": Semantic.ROAD, "reflectivity": 0.1, "material": Material.ASPHALT}
    road = box((10, 0, -0.2), (6, 6, 0.3), grade=(0.08, 0.0), **asphalt)
    wall = box((20.5, 0, 3), (0.5, 20, 3))
    wet = {"weather": Conditions(water_film_mm=2.0), "puddles": (Puddle(10.0, 0.0, 2.0),)}
    dry, sweep = swept(road, wall), swept(road, wall, effects=[WetGround()], **wet)
    rays = with_origin(sweep, Origin.MIRROR)
    assert len(rays) > 20
    assert (dry.first.surface[rays] == 0).all()
    down, ahead = np.abs(sweep.direction[2, rays]), sweep.direction[0, rays]
    expected = surface_reflectance(down, 1.33) ** 2 * 0.5 * ahead / sweep.first.range_m[rays] ** 2
    np.testing.assert_allclose(sweep.first.power[rays], expected, rtol=1e-3)
    np.testing.assert_allclose(image(sweep, rays)[0], 20, rtol=1e-5)

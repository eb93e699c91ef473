"""What holds for every effect: properties over random scenes, and limits."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from random_scenes import random_case
from sweeps import box, pole

from lidarsim import scan
from lidarsim.draws import Draws
from lidarsim.effects import (
    EFFECTS,
    RAY_EFFECTS,
    Blooming,
    PolishedMetal,
    RetroReflection,
    Spray,
    SunGlare,
    SurfaceTexture,
)
from lidarsim.scan import effect_name, simulate_scan
from lidarsim.scene import (
    Conditions,
    EgoMotion,
    Material,
    Primitive,
    Puddle,
    Scene,
    Semantic,
    Shape,
)
from lidarsim.sensors import Lasers, hdl64e
from lidarsim.sweep import Echoes, Sweep

# No effect warns, whatever the scene.
pytestmark = pytest.mark.filterwarnings("error")

SEEDS = range(48)
NAMES = [effect_name(effect) for effect in EFFECTS]
each_effect = pytest.mark.parametrize("name", NAMES)


WALL = box((30.5, 0.0, 2.0), (0.5, 40.0, 6.0), material=Material.BRICK)
POLE = pole((9.0, -2.0, 2.0), 0.05, 4.0)
CAR = box(
    (12.0, 3.0, 0.95), (2.0, 0.9, 0.75), instance=7, material=Material.PAINT, velocity_m_s=(20.0, 0)
)
CROWN = Primitive(
    Shape.ELLIPSOID, (-8.0, 6.0, 2.0), (2.0, 2.0, 2.0), Semantic.VEGETATION, 0.5,
    material=Material.FOLIAGE, velocity_m_s=(30.0, 30.0), extinction_per_m=0.8,
)  # fmt: skip
PANE = box((8.0, -6.0, 1.5), (2.0, 0.02, 1.5), reflectivity=0.02, material=Material.GLASS)
METAL = box((7.0, 2.5, 0.8), (0.1, 1.5, 0.8), reflectivity=0.2, material=Material.POLISHED_METAL)
SHEET = box((9.0, -3.0, 1.5), (0.02, 1.0, 3.0), material=Material.RETROREFLECTOR)
ROOF = box((0.0, 0.0, -0.6), (1.6, 1.4, 0.2), material=Material.CONCRETE)
PUDDLES = (Puddle(15.0, 2.0, 4.0), Puddle(0.0, 4.0, 1.0))
SUNNY = Conditions(water_film_mm=0.8, sun_elevation_deg=3.0, sun_azimuth_deg=100.0)
_LASERS = [getattr(hdl64e().lasers, field.name)[::2] for field in fields(Lasers)]
SENSOR = replace(hdl64e(shots=1080), lasers=Lasers(*_LASERS), weak_share=0.0)


def scanned(seed, switches=None):
    return simulate_scan(*random_case(seed), ("property", seed), switches)


def differs(one, other):
    columns = ("points", "labels", "origins")
    return any(getattr(one, c).tobytes() != getattr(other, c).tobytes() for c in columns)


def test_random_scenes_call_for_every_effect_and_do_without_it():
    touched, idle = dict.fromkeys(NAMES, 0), dict.fromkeys(NAMES, 0)
    for seed in SEEDS:
        found = scanned(seed)
        assert np.isfinite(found.points).all()
        assert [record.name for record in found.effects] == NAMES
        for record in found.effects:
            assert record.reason
            assert record.rays == 0 or record.status == "ran", record
            touched[record.name] += record.rays > 0
            idle[record.name] += record.status == "not_called"
    assert min(touched.values()) >= 1, touched
    base = [effect_name(e) for e in EFFECTS if e.called_by(Scene(), SENSOR) == "base"]
    assert [name for name, count in idle.items() if count < 6] == base


def test_each_effect_has_draws_of_its_own_whichever_others_run(monkeypatch):
    keys = []

    class Recorded(Draws):
        def __init__(self, num_rays, *key):
            super().__init__(num_rays, *key)
            keys.append(key)

    monkeypatch.setattr(scan, "Draws", Recorded)
    for seed in SEEDS[:8]:
        keys.clear()
        scanned(seed)
        assert len(set(keys)) == len(keys)
        for off in NAMES[::2], NAMES[1::2]:
            keys.clear()
            scanned(seed, dict.fromkeys(off, "off"))
            assert keys
            assert set(keys) <= {("property", seed, name) for name in NAMES}


def test_the_number_of_a_ray_does_not_depend_on_the_other_rays():
    some = np.array([3, 90, 17])
    for kind in ("uniform", "normal", "exponential"):
        one, other = (getattr(Draws(100, "key", 1), kind) for _ in range(2))
        assert one(some).tobytes() == other(slice(None))[some].tobytes()
        assert one(some).tobytes() == other(np.arange(100))[some].tobytes()


def case(*solids, sensor=SENSOR, instead=None, **scene):
    """Scene, sensor, and an effect to be used instead of the one of its class, or None."""
    return Scene(solids, **scene), sensor, instead


def weather(**values):
    return case(WALL, CAR, weather=Conditions(**values))


def changed(**values):
    return replace(SENSOR, **values)


def roof(x):
    return (replace(ROOF, half_size=tuple(x * half for half in ROOF.half_size)),) if x else ()


def lasers(x):
    bias = tuple(x * value for value in SENSOR.lasers.range_bias_m)
    gain = tuple(value**x for value in SENSOR.lasers.intensity_gain)
    return replace(SENSOR.lasers, range_bias_m=bias, intensity_gain=gain)


# Cases of each effect by a parameter x: at 1 it matters, as x falls it vanishes, at 0 it is gone.
LIMITS = {
    # No parameter of its own: second echoes vanish with the width of the beam that finds them.
    "dual_return": lambda x: case(
        WALL, POLE, CAR, sensor=changed(return_mode="dual", divergence_rad=0.01 * x)
    ),
    "rolling_shutter": lambda x: case(WALL, CAR, motion=EgoMotion(15.0 * x, 0.8 * x)),
    "moving_actors": lambda x: case(WALL, replace(CAR, velocity_m_s=(5.0 * x, -30.0 * x))),
    # As leaves grow dense the crown becomes a surface, its range; leaves have no incidence.
    "foliage_occlusion": lambda x: case(
        WALL,
        replace(CROWN, extinction_per_m=1 / x if x else 0.0),
        sensor=changed(min_power=1e-20, divergence_rad=0.0),
    ),
    "ego_occlusion": lambda x: case(WALL, ego_body=roof(x)),
    # Base: it cannot vanish, but where everything is detected it leaves the ranges alone.
    "diffuse_reflection": lambda x: case(
        WALL, POLE, sensor=changed(min_power=1e-2 * x or 1e-30, divergence_rad=0.0)
    ),
    "surface_texture": lambda x: case(WALL, CROWN, instead=SurfaceTexture(0.36 * x, 0.86 * x)),
    "wet_ground": lambda x: case(WALL, weather=Conditions(water_film_mm=x), puddles=PUDDLES),
    "retro_reflection": lambda x: case(SHEET, instead=RetroReflection(retroreflection=70 * x)),
    # What a pane shows or mirrors is dark: one sees the pane, as without the effect.
    "glass": lambda x: case(
        replace(WALL, reflectivity=0.5 * x or 1e-6),
        PANE,
        ground_reflectivity=0.5 * x or 1e-6,
        sensor=changed(min_power=1e-20),
    ),
    "polished_metal": lambda x: case(WALL, METAL, CAR, instead=PolishedMetal(reflectance=0.9 * x)),
    "mixed_pixels": lambda x: case(WALL, POLE, CAR, sensor=changed(divergence_rad=0.01 * x)),
    "fog": lambda x: weather(visibility_m=40 / x if x else math.inf),
    "rain": lambda x: weather(rain_mm_h=50 * x),
    "snow": lambda x: weather(snow_mm_h=5 * x),
    "spray": lambda x: case(
        *(WALL, CAR), weather=Conditions(water_film_mm=1.0), instead=Spray(0.2 * x)
    ),
    "sun_glare": lambda x: case(WALL, weather=SUNNY, instead=SunGlare(rise=3e3 * x, noise=x)),
    "blooming": lambda x: case(SHEET, instead=Blooming(halo_deg=1.0, spill=0.5 * x)),
    "soft_raydrop": lambda x: case(
        WALL, CAR, sensor=changed(threshold_spread=0.5 * x, min_power=1e-4)
    ),
    "detection_limit": lambda x: case(
        WALL,
        POLE,
        sensor=changed(min_power=1e-2 * x or 1e-30, min_range_m=5 * x, threshold_spread=0.0),
    ),
    "lost_shots": lambda x: case(WALL, CAR, sensor=changed(lost_share=0.09 * x)),
    "range_noise": lambda x: case(
        WALL, CAR, sensor=changed(range_sigma_m=0.1 * x, weak_range_sigma_m=x, range_step_m=0.1 * x)
    ),
    "laser_calibration": lambda x: case(WALL, CAR, sensor=changed(lasers=lasers(x))),
    "weak_patches": lambda x: case(WALL, sensor=changed(weak_share=0.09 * x)),
}

# Where powers differ even in the limit, see there.
RANGES_ALONE = ("foliage_occlusion", "diffuse_reflection")


@each_effect
def test_an_effect_that_grows_weak_tends_to_none_and_without_strength_changes_no_bit(
    name, monkeypatch
):
    strong, weak = (changed_share(name, x, monkeypatch) for x in (1, 1e-6))
    assert strong > 0.001
    assert weak < 0.02 * strong
    with_it, without = on_and_off(name, 0, monkeypatch, [])
    if name == "diffuse_reflection":
        assert with_it.points[:, :3].tobytes() == without.points[:, :3].tobytes()
    else:
        assert not differs(with_it, without)


def on_and_off(name, x, monkeypatch, sweeps):
    """The scan with the effect on and the one with it off; their sweeps go to ``sweeps``."""

    class Kept(Sweep):
        def __init__(self, scene, sensor):
            super().__init__(scene, sensor)
            sweeps.append(self)

    scene, sensor, instead = LIMITS[name](x)
    effects = [instead if type(effect) is type(instead) else effect for effect in EFFECTS]
    with monkeypatch.context() as context:
        context.setattr(scan, "RAY_EFFECTS", tuple(effects[: len(RAY_EFFECTS)]))
        context.setattr(scan, "ECHO_EFFECTS", tuple(effects[len(RAY_EFFECTS) :]))
        context.setattr(scan, "Sweep", Kept)
        return [simulate_scan(scene, sensor, ("limit",), {name: s}) for s in ("auto", "off")]


def changed_share(name, x, monkeypatch):
    """Share of the shots whose echoes change their range by 1 cm or their power by 2 %."""
    sweeps = []
    on_and_off(name, x, monkeypatch, sweeps)
    (range_m, power), (range_off_m, power_off) = map(recorded, sweeps)
    same = np.isclose(range_m, range_off_m, rtol=0, atol=0.01)
    if name not in RANGES_ALONE:
        same &= np.isclose(power, power_off, rtol=0.02, atol=0)
    return 1 - same.all(axis=0).mean()


def recorded(sweep):
    """Ranges and powers of both echoes, each ``(2, R)``, infinite where there is none."""
    second = sweep.second or Echoes.none(sweep.num_rays)
    range_m = np.stack([sweep.first.range_m, second.range_m])
    power = np.stack([sweep.first.power, second.power])
    return range_m, np.where(np.isfinite(range_m), power, np.inf)

import numpy as np
import pytest

from r3dpa.simulation import (
    HDL64E,
    DetectionLimit,
    LambertianReflection,
    Pose,
    Primitive,
    Scene,
    Semantic,
    Shape,
    cast,
    generator_for,
)
from r3dpa.simulation.effects import MIN_POWER
from r3dpa.simulation.sensor import Rays


def ahead(num_shots=8):
    """One level beam around the turn; shot 0 looks along +x."""
    angle = 2 * np.pi * np.arange(num_shots) / num_shots
    direction = np.stack([np.cos(angle), np.sin(angle), 0 * angle])[:, None].astype(np.float32)
    return Rays(np.zeros_like(direction), direction)


def power_of_wall(distance_m, tilt_deg=0.0):
    centre = (distance_m + 0.5 / np.cos(np.radians(tilt_deg)), 0, 2)
    wall = Primitive(Shape.BOX, centre, (0.5, 40, 4), Semantic.WALL, 0.6, np.radians(tilt_deg))
    returns = cast(Scene((wall,), Pose(z_m=2.0)), ahead())
    assert returns.range_m[0, 0] == pytest.approx(distance_m, rel=1e-5)
    return LambertianReflection()(returns, Scene(), generator_for(0)).power[0, 0]


def test_power_of_a_wall():
    assert power_of_wall(10.0) == pytest.approx(0.6 / 100, rel=1e-5)
    assert power_of_wall(10.0) / power_of_wall(20.0) == pytest.approx(4, rel=1e-4)
    assert power_of_wall(10.0, 60) / power_of_wall(10.0) == pytest.approx(0.5, rel=1e-4)


def test_no_surface_gives_no_power():
    returns = LambertianReflection()(cast(Scene(), ahead()), Scene(), generator_for(0))
    assert (returns.power == 0).all()


@pytest.mark.parametrize("height_m", [1.0, 1.73, 2.5])
def test_last_ground_return(height_m):
    """The farthest ground return lies where reflectivity h / R^3 meets the detection limit."""
    slope = -height_m / np.linspace(20, 80, 2000)
    direction = np.stack([np.ones_like(slope), 0 * slope, slope])
    direction /= np.linalg.norm(direction, axis=0)
    # Beams by shots: a column of beams, seen by 8 equal shots (ground has no windows).
    direction = np.repeat(direction[:, :, None], 8, axis=2).astype(np.float32)
    rays = Rays(np.zeros_like(direction), direction)
    scene = Scene(pose=Pose(z_m=height_m), ground_reflectivity=0.1)
    returns = cast(scene, rays)
    for effect in (LambertianReflection(), DetectionLimit()):
        returns = effect(returns, scene, generator_for(0))
    farthest = returns.range_m[np.isfinite(returns.range_m)].max()
    # The beams are 3 cm apart on the ground.
    assert farthest == pytest.approx((0.1 * height_m / MIN_POWER) ** (1 / 3), abs=0.05)
    if height_m == 1.73:
        assert farthest == pytest.approx(50.0, abs=0.1)


def test_range_limits_and_untouched_argument():
    wall = Primitive(Shape.BOX, (0.9, 0, 2), (0.5, 0.2, 1), Semantic.WALL, 0.6)
    before = cast(Scene((wall,), Pose(z_m=2.0)), ahead())
    assert before.range_m[0, 0] == pytest.approx(0.4)
    after = DetectionLimit()(before, Scene(), generator_for(0))
    assert np.isinf(after.range_m[0, 0])
    assert before.range_m[0, 0] == pytest.approx(0.4)
    near = DetectionLimit(min_range_m=0.1)(before, Scene(), generator_for(0))
    assert near.range_m[0, 0] == pytest.approx(0.4)
    far = DetectionLimit(min_range_m=0.1, max_range_m=0.3)(before, Scene(), generator_for(0))
    assert np.isinf(far.range_m).all()


def test_effects_are_in_the_order_of_their_stages():
    Scene(effects=(LambertianReflection(), DetectionLimit()))
    with pytest.raises(ValueError, match=r"DetectionLimit \(stage 7\), LambertianReflection"):
        Scene(effects=(DetectionLimit(), LambertianReflection()))


def test_limits_are_checked():
    with pytest.raises(ValueError, match="min_power"):
        DetectionLimit(min_power=-1.0)
    with pytest.raises(ValueError, match="min_range_m < max_range_m"):
        DetectionLimit(min_range_m=5, max_range_m=4)


def test_without_effects_the_geometry_is_bare():
    returns = cast(Scene(), HDL64E(shots=16).rays)
    assert (returns.power == 1).all()
    assert (np.isfinite(returns.range_m) == (returns.surface == -1)).all()

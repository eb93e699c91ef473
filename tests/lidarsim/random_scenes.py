"""Random scenes and instruments: every parameter drawn on its own, odd values among them."""

import math
from dataclasses import replace

import numpy as np
from sweeps import box

from lidarsim.scene import (
    Conditions,
    EgoMotion,
    Material,
    Pose,
    Primitive,
    Puddle,
    Scene,
    Semantic,
    Shape,
)
from lidarsim.sensors import hdl64e, load_sensor

# Usual values of an instrument twice or more, and odd ones.
INSTRUMENT = {
    "shots": (8, 60, 64, 64, 90, 120),
    "spin_hz": (10.0, 10.0, 20.0, 1.0),
    "min_power": (1.43e-5, 1.43e-5, 1e-20, 1e-7, 1e-3),
    "min_range_m": (1.45, 1.45, 0.0, 5.0),
    "max_range_m": (120.0, 120.0, 20.0, 400.0),
    "divergence_rad": (2e-3, 2e-3, 0.0, 1e-5, 3e-2),
    "pulse_s": (5e-9, 5e-9, 0.0, 1e-7),
    "overlap_range_m": (5.0, 5.0, 1e-2, 50.0),
    "threshold_spread": (0.3, 0.3, 0.0, 1e-3, 2.0),
    "lost_share": (1e-3, 1e-3, 0.0, 0.09),
    "weak_share": (0.06, 0.0, 1e-6, 0.09),
    "return_mode": ("strongest", "strongest", "dual"),
}
NOISE = {
    "range_sigma_m": (0.008, 0.0, 0.5),
    "weak_range_sigma_m": (0.05, 0.0, 1.0),
    "range_step_m": (0.002, 0.0, 0.1),
}


class Dice:
    """Draws of one scene."""

    def __init__(self, seed):
        self.generator = np.random.Generator(np.random.Philox(seed))

    def chance(self, probability):
        return self.generator.random() < probability

    def among(self, *values):
        return values[self.generator.integers(len(values))]

    def even(self, low, high):
        return float(self.generator.uniform(low, high))

    def magnitude(self, low, high):
        """Even on a logarithmic scale."""
        return math.exp(self.even(math.log(low), math.log(high)))


def random_case(seed):
    """Scene and sensor of a seed; a scan of them takes some milliseconds."""
    dice = Dice(seed)
    sensor = dice.among(hdl64e(), hdl64e(), hdl64e(), load_sensor("hdl32e"), load_sensor("vls128"))
    table = INSTRUMENT | ({} if dice.chance(0.25) else NOISE)
    if table.keys().isdisjoint(NOISE):
        sensor = replace(sensor, **dict.fromkeys(NOISE, 0.0))
    sensor = replace(sensor, **{name: dice.among(*values) for name, values in table.items()})
    num = sensor.num_beams
    if dice.chance(0.3):
        exact = replace(sensor.lasers, range_bias_m=(0.0,) * num, intensity_gain=(1.0,) * num)
        sensor = replace(sensor, lasers=exact)
    return _scene(dice), sensor


def _scene(dice):
    ground_m = dice.among(0.0, 0.0, 0.0, dice.even(-3, 0), -1e4)
    height_m = dice.among(1.73, 1.73, 1.73, dice.magnitude(0.3, 30))
    x_m, y_m = (dice.among(0.0, dice.even(-1e3, 1e3)) for _ in range(2))
    tilts = (dice.among(0.0, dice.even(-0.14, 0.14)) for _ in range(2))
    heading_rad = dice.among(0.0, dice.even(-9, 9))
    pose = Pose(x_m, y_m, height_m + max(ground_m, -3.0), heading_rad, *tilts)
    # Few kinds at a time, so that what the others bring is not called for.
    materials = [m for m in Material if dice.chance(0.3)] or [Material.CONCRETE]
    moving, leafy = dice.chance(0.4), dice.chance(0.3)
    count = 0 if dice.chance(0.05) else int(dice.generator.integers(1, 26))
    puddles = (
        Puddle(x_m + dice.even(-12, 12), y_m + dice.even(-12, 12), dice.even(0.01, 8))
        for _ in range(dice.among(0, 0, 1, 4))
    )
    body = (
        box(
            (dice.even(-2, 2), dice.even(-1, 1), dice.even(-1.2, -0.2)),
            (dice.even(0.05, 1.5), dice.even(0.05, 1.2), dice.even(0.02, 0.3)),
            yaw_rad=dice.among(0.0, dice.even(-1, 1)),
            material=dice.among(*Material),
        )
        for _ in range(dice.among(0, 0, 1, 3))
    )
    return Scene(
        tuple(_primitive(dice, pose, materials, moving, leafy) for _ in range(count)),
        pose,
        EgoMotion(
            dice.among(0.0, 0.0, 0.0, 1e-6, dice.even(-15, 40)),
            dice.among(0.0, 0.0, 0.0, 1e-6, dice.even(-1.5, 1.5)),
        ),
        _weather(dice),
        tuple(puddles),
        tuple(body),
        ground_m,
        dice.among(0.15, 1.0, 1e-3, dice.even(0.05, 0.6)),
    )


def _weather(dice):
    clear_air = dice.chance(0.4)

    def some(*values):
        return 0.0 if clear_air or dice.chance(0.4) else dice.among(*values)

    visibility_m = dice.among(math.inf, 1.0, 1e5, 1e60, dice.magnitude(5, 2e3))
    return Conditions(
        math.inf if clear_air else visibility_m,
        some(1e-6, 100.0, dice.magnitude(0.1, 50)),
        some(1e-6, 100.0, dice.magnitude(0.1, 10)),
        dice.among(0.0, 0.0, 0.0, 1e-9, 5.0, dice.even(0.05, 2)),
        dice.chance(0.8),
        dice.among(-90.0, -1e-6, 0.0, 1e-6, 90.0, *(dice.even(0, 15) for _ in range(5))),
        dice.even(-400, 400),
    )


def _primitive(dice, pose, materials, moving, leafy):
    azimuth, distance_m = dice.even(-math.pi, math.pi), dice.magnitude(0.5, 60)
    size = dice.among(
        (dice.even(0.2, 3), dice.even(0.2, 3), dice.even(0.2, 3)),
        (dice.even(0.5, 12), dice.magnitude(1e-3, 0.3), dice.even(0.3, 5)),
        (dice.magnitude(1e-3, 0.2), dice.magnitude(1e-3, 0.2), dice.even(0.5, 4)),
        (dice.even(5, 60), dice.even(5, 60), dice.magnitude(1e-3, 0.5)),
    )
    up_m = dice.among(-1.7, -1.7 + size[2], dice.even(-2, 4))
    at = (distance_m * math.cos(azimuth), distance_m * math.sin(azimuth), up_m)
    speed = dice.among(0.0, 1e-9, 10.0, 200.0, dice.even(0, 60)) if moving else 0.0
    course = dice.even(-math.pi, math.pi)
    return Primitive(
        dice.among(*Shape),
        tuple(np.add(at, (pose.x_m, pose.y_m, pose.z_m)).tolist()),
        size,
        dice.among(*Semantic),
        dice.among(dice.even(0.01, 1), 1.0, 1e-4),
        dice.among(0.0, dice.even(-9, 9)),
        dice.among(0, 1, 2, 0xFFFF),
        dice.among(*materials),
        (speed * math.cos(course), speed * math.sin(course)),
        dice.among((0.0, 0.0), (dice.even(-0.2, 0.2), dice.even(-0.2, 0.2))),
        dice.among(0.0, 0.0, dice.magnitude(0.2, 3), 1e-3, 1e3) if leafy else 0.0,
    )

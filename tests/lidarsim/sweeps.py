"""Solids and sweeps that the tests of the effects share."""

import numpy as np

from lidarsim import Material, Primitive, Semantic, Shape, Sweep
from lidarsim.draws import Draws


def organised_turn(beams=8, shots=500, low_deg=-14.0, high_deg=14.0):
    """Points ``(beams, shots, 3)`` of a wavy wall 9 to 11 m away."""
    inclination = np.radians(np.linspace(high_deg, low_deg, beams))[:, None]
    azimuth = 2 * np.pi * np.arange(shots) / shots
    directions = [
        np.cos(inclination) * np.cos(azimuth),
        np.cos(inclination) * np.sin(azimuth),
        np.sin(inclination) * np.ones(shots),
    ]
    range_m = 10 + np.sin(5 * azimuth)
    return (range_m[:, None] * np.stack(directions, axis=-1)).astype(np.float32)


def box(centre, half_size, **values):
    """A painted wall of reflectivity 0.5, but for what is given."""
    wall = {"semantic": Semantic.WALL, "reflectivity": 0.5, "material": Material.PAINT}
    return Primitive(Shape.BOX, centre, half_size, **wall | values)


def pole(centre, radius_m, half_height_m, **values):
    size = (radius_m, radius_m, half_height_m)
    upright = {"semantic": Semantic.POLE, "reflectivity": 0.5}
    return Primitive(Shape.CYLINDER, centre, size, **upright | values)


def inside(primitive, points):
    """Which of the points (..., 3) lie in a solid, by the definition of its shape."""
    x, y, z = np.moveaxis(np.subtract(points, primitive.centre), -1, 0)
    cosine, sine = np.cos(primitive.yaw_rad), np.sin(primitive.yaw_rad)
    x, y = cosine * x + sine * y, cosine * y - sine * x
    z = z - primitive.grade[0] * x - primitive.grade[1] * y
    x, y, z = (np.abs(u) / half for u, half in zip((x, y, z), primitive.half_size, strict=True))
    if primitive.shape == Shape.BOX:
        return (x <= 1) & (y <= 1) & (z <= 1)
    if primitive.shape == Shape.CYLINDER:
        return (x**2 + y**2 <= 1) & (z <= 1)
    return x**2 + y**2 + z**2 <= 1


def applied(sweep, *effects, key="test"):
    for effect in effects:
        rays = effect.rays(sweep)
        if isinstance(rays, slice) or len(rays):
            effect.apply(sweep, rays, Draws(sweep.num_rays, key, type(effect).__name__))
    return sweep


def swept(scene, sensor, *, before=(), after=()):
    """A sweep after some effects, the ray cast, and more effects."""
    sweep = applied(Sweep(scene, sensor), *before)
    sweep.cast()
    return applied(sweep, *after)

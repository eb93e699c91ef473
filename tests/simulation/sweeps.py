"""Solids and sweeps that the tests of the effects share."""

from r3dpa.simulation import Material, Primitive, Semantic, Shape, Sweep
from r3dpa.simulation.draws import Draws


def box(centre, half_size, **values):
    """A painted wall of reflectivity 0.5, but for what is given."""
    wall = {"semantic": Semantic.WALL, "reflectivity": 0.5, "material": Material.PAINT}
    return Primitive(Shape.BOX, centre, half_size, **wall | values)


def pole(centre, radius_m, half_height_m, **values):
    size = (radius_m, radius_m, half_height_m)
    upright = {"semantic": Semantic.POLE, "reflectivity": 0.5}
    return Primitive(Shape.CYLINDER, centre, size, **upright | values)


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

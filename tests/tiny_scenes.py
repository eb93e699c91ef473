"""A generator of tiny scenes, whose networks have random weights.

A fresh SiT predicts zero velocity and a fresh decoder a nearly constant image, so all weights are
drawn at random: scenes then differ from each other, and hold pixels with and without return.
"""

from __future__ import annotations

from tiny_networks import tiny_networks

from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import (
    LidarSensor,
    RangeCodec,
    ScanGeometry,
    SphericalProjection,
)

SENSOR = LidarSensor(beams=16, columns=64, range_min_m=2.0, range_max_m=40.0)
GEOMETRY = ScanGeometry(SphericalProjection(SENSOR), RangeCodec(), (2, 8))
ODE, SDE = SamplerConfig("heun", steps=3), SamplerConfig("euler_maruyama", steps=4)


def generator(sampler=ODE, precision="fp32", geometry=GEOMETRY, path="linear"):
    return SceneGenerator(*tiny_networks(), geometry, sampler, path, precision)


LATENT_SHAPE = (4, 4, 16)

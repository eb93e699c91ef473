"""What happens between the ray cast and the stored scan.

Each effect is a frozen dataclass with its equation in the docstring. A scene is a description;
each effect reads from it whether it is called for, picks its rays, and changes nothing else.
"""

from r3dpa.simulation.effects.base import Draws, Effect, Stage, Switch
from r3dpa.simulation.effects.detection import DetectionLimit, SoftRaydrop
from r3dpa.simulation.effects.edges import MixedPixels
from r3dpa.simulation.effects.measurement import DualReturn, LaserCalibration, RangeNoise
from r3dpa.simulation.effects.medium import Fog, Spray
from r3dpa.simulation.effects.motion import (
    EgoOcclusion,
    FoliageOcclusion,
    MovingActors,
    RollingShutter,
)
from r3dpa.simulation.effects.optics import Glass, PolishedMetal, WetGround
from r3dpa.simulation.effects.precipitation import Rain, Snow
from r3dpa.simulation.effects.retro import Blooming, RetroReflection
from r3dpa.simulation.effects.sun import SunGlare
from r3dpa.simulation.effects.surface import (
    DiffuseReflection,
    SurfaceTexture,
    surface_power,
)

#: Every effect, in the order in which they are applied.
EFFECTS: tuple[Effect, ...] = (
    DualReturn(),
    RollingShutter(),
    MovingActors(),
    FoliageOcclusion(),
    EgoOcclusion(),
    DiffuseReflection(),
    SurfaceTexture(),
    WetGround(),
    RetroReflection(),
    Glass(),
    PolishedMetal(),
    MixedPixels(),
    Fog(),
    Rain(),
    Snow(),
    Spray(),
    SunGlare(),
    Blooming(),
    SoftRaydrop(),
    DetectionLimit(),
    RangeNoise(),
    LaserCalibration(),
)

__all__ = [
    "EFFECTS",
    "Blooming",
    "DetectionLimit",
    "DiffuseReflection",
    "Draws",
    "DualReturn",
    "Effect",
    "EgoOcclusion",
    "Fog",
    "FoliageOcclusion",
    "Glass",
    "LaserCalibration",
    "MixedPixels",
    "MovingActors",
    "PolishedMetal",
    "Rain",
    "RangeNoise",
    "RetroReflection",
    "RollingShutter",
    "Snow",
    "SoftRaydrop",
    "Spray",
    "Stage",
    "SunGlare",
    "SurfaceTexture",
    "Switch",
    "WetGround",
    "surface_power",
]

"""Physical effects between the ray cast and the stored scan.

Each effect is a frozen dataclass with its equation in the docstring. It decides from the scene
whether it runs, selects its rays, and changes nothing else.
"""

from lidarsim.effects.edges import MixedPixels
from lidarsim.effects.instrument import (
    Blooming,
    DetectionLimit,
    DualReturn,
    LaserCalibration,
    LostShots,
    RangeNoise,
    SoftRaydrop,
    SunGlare,
)
from lidarsim.effects.medium import Fog, Rain, Snow, Spray
from lidarsim.effects.motion import (
    EgoOcclusion,
    FoliageOcclusion,
    MovingActors,
    RollingShutter,
)
from lidarsim.effects.surface import (
    DiffuseReflection,
    Glass,
    PolishedMetal,
    RetroReflection,
    SurfaceTexture,
    WetGround,
    surface_power,
)
from lidarsim.sweep import Effect

#: Effects on the rays, in the order in which they are applied before the rays are cast.
RAY_EFFECTS: tuple[Effect, ...] = (
    DualReturn(),
    RollingShutter(),
    MovingActors(),
    FoliageOcclusion(),
)

#: Effects on the echoes of the cast, in order: surfaces, the optical path, the air, detection, and
#: measurement.
ECHO_EFFECTS: tuple[Effect, ...] = (
    *(EgoOcclusion(), DiffuseReflection(), SurfaceTexture(), WetGround(), RetroReflection()),
    *(Glass(), PolishedMetal(), MixedPixels()),
    *(Fog(), Rain(), Snow(), Spray()),
    *(SunGlare(), Blooming(), SoftRaydrop(), DetectionLimit(), LostShots()),
    *(RangeNoise(), LaserCalibration()),
)
EFFECTS = (*RAY_EFFECTS, *ECHO_EFFECTS)

__all__ = ["ECHO_EFFECTS", "EFFECTS", "RAY_EFFECTS", "surface_power"]

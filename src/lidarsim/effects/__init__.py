"""Physical effects between the ray cast and the stored scan.

Each effect is a class with its equation in the docstring, a frozen dataclass if it has parameters.
It decides from the scene whether it runs, selects its rays, and changes nothing else.

======================================================= ============================================
effects                                                 called for by
======================================================= ============================================
``rolling_shutter``, ``moving_actors``                  a moving sensor, moving traffic
``foliage_occlusion``, ``ego_occlusion``                leaves, grass, wire mesh; the recording car
``diffuse_reflection``, ``surface_texture``             surfaces
``wet_ground``                                          water on the road
``retro_reflection``, ``blooming``                      signs and plates
``glass``, ``polished_metal``                           panes and cabins; steel
``mixed_pixels``                                        edges within a beam
``weak_patches``                                        the instrument
``fog``, ``rain``, ``snow``                             weather
``spray``, ``sun_glare``                                a fast car on a wet road; a low sun
``soft_raydrop``, ``detection_limit``, ``lost_shots``   the instrument
``range_noise``, ``laser_calibration``, ``dual_return`` the instrument
======================================================= ============================================
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
    WeakPatches,
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
    EgoOcclusion(), DiffuseReflection(), SurfaceTexture(), WetGround(), RetroReflection(),
    Glass(), PolishedMetal(), MixedPixels(), WeakPatches(),
    Fog(), Rain(), Snow(), Spray(),
    SunGlare(), Blooming(), SoftRaydrop(), DetectionLimit(), LostShots(),
    RangeNoise(), LaserCalibration(),
)  # fmt: skip
EFFECTS = (*RAY_EFFECTS, *ECHO_EFFECTS)

__all__ = ["ECHO_EFFECTS", "EFFECTS", "RAY_EFFECTS", "surface_power"]

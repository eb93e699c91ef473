"""LiDAR scene generation with 3D representation alignment (R3DPA)."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidarsim import RecordedScan, Simulator
    from lidarsim.weather import Weather
    from r3dpa.editing import SceneEditor
    from r3dpa.generation import SceneGenerator
    from r3dpa.scene_vae import SceneVAE

__version__ = "0.1.0"
__all__ = [
    "RecordedScan",
    "SceneEditor",
    "SceneGenerator",
    "SceneVAE",
    "Simulator",
    "Weather",
    "__version__",
]

_MODULES = {
    "RecordedScan": "lidarsim.recorded",
    "SceneEditor": "r3dpa.editing",
    "SceneGenerator": "r3dpa.generation",
    "SceneVAE": "r3dpa.scene_vae",
    "Simulator": "lidarsim",
    "Weather": "lidarsim.weather",
}


def __getattr__(name: str) -> Any:
    """Import a public class on first use: torch takes seconds."""
    if name not in _MODULES:
        raise AttributeError(f"module 'r3dpa' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    """Names to complete after ``r3dpa.``, without importing them."""
    return sorted(__all__)

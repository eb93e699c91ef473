"""Base class of the effects."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Literal

from r3dpa.simulation.draws import Draws, RayIndex
from r3dpa.simulation.scene import Scene
from r3dpa.simulation.sensor import SpinningLidar
from r3dpa.simulation.sweep import Sweep

Switch = Literal["auto", "on", "off"]


class Effect(ABC):
    """One physical effect: the condition under which it runs, its rays, and the change to them.

    ``apply`` depends on the scene and the sensor only: an effect that is switched on in a scene
    that does not call for it changes no bit of the scan.
    """

    @abstractmethod
    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """Reason why the scene or the instrument calls for the effect; None if neither does."""

    def rays(self, sweep: Sweep) -> RayIndex:
        """Rays that the effect may change, by default all."""
        return slice(None)

    @abstractmethod
    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Change these rays of the sweep."""

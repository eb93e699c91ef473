"""What an effect is and when it runs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Literal

from r3dpa.simulation.draws import Draws, RayIndex
from r3dpa.simulation.scene import Scene
from r3dpa.simulation.sensor import SpinningLidar
from r3dpa.simulation.sweep import Sweep

Switch = Literal["auto", "on", "off"]


class Effect(ABC):
    """One physical effect: what calls for it, which rays it touches, what it does to them.

    ``apply`` computes from the scene and the sensor alone, so that an effect that is switched on
    in a scene that does not call for it changes no bit of the scan.
    """

    @abstractmethod
    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """Why the scene, or the instrument, calls for the effect; None if neither does."""

    def rays(self, sweep: Sweep) -> RayIndex:
        """The rays that the effect may change, by default all; the others are left alone."""
        return slice(None)

    @abstractmethod
    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Change these rays of the sweep."""

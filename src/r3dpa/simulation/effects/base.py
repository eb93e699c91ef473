"""What an effect is, when it runs, and where its random numbers come from."""

from __future__ import annotations

from enum import IntEnum
from typing import ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from r3dpa.simulation.draws import generator_for
from r3dpa.simulation.scene import Scene
from r3dpa.simulation.sensor import SpinningLidar
from r3dpa.simulation.sweep import RayIndex, Sweep

Switch = Literal["auto", "on", "off"]


class Stage(IntEnum):
    """Place of an effect in the fixed order of a scan; the rays are cast after ``RAYS``."""

    RAYS = 2
    SURFACE = 4
    OPTICAL_PATH = 5
    MEDIUM = 6
    DETECTION = 7
    MEASUREMENT = 8


class Draws:
    """Random numbers of one effect in one scan, one per ray.

    A counter-based generator (Philox) of its own per key; each call draws for all rays of the turn
    and returns those asked for, so that a ray's number depends neither on which other rays are
    touched nor on any other effect.

    Args:
        num_rays: Shots of the turn.
        key: Seed, scan and name of the effect, see ``generator_for``.
    """

    def __init__(self, num_rays: int, *key: int | str) -> None:
        self._generator = generator_for(*key)
        self._num_rays = num_rays

    def uniform(self, rays: RayIndex) -> NDArray[np.float32]:
        """Uniform in [0, 1)."""
        return self._generator.random(self._num_rays, dtype=np.float32)[rays]

    def normal(self, rays: RayIndex) -> NDArray[np.float32]:
        """Standard normal."""
        return self._generator.standard_normal(self._num_rays, dtype=np.float32)[rays]

    def exponential(self, rays: RayIndex) -> NDArray[np.float32]:
        """Exponential of mean 1."""
        return self._generator.standard_exponential(self._num_rays, dtype=np.float32)[rays]


class Effect(Protocol):
    """One physical effect: who calls for it, which rays it touches, what it does to them.

    ``apply`` computes from the scene and the sensor alone, so that an effect that is switched on
    in a scene that does not call for it changes no bit of the scan.
    """

    stage: ClassVar[Stage]

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        """Why the scene, or the instrument, calls for the effect; None where it does not."""

    def rays(self, sweep: Sweep) -> RayIndex:
        """The rays that the effect may change; all others are left alone."""

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Change these rays of the sweep."""

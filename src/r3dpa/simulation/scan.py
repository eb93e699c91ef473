"""One simulated scan: rays, cast, effects, and the points as KITTI-360 stores them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from r3dpa.simulation.raycast import cast
from r3dpa.simulation.scene import Scene
from r3dpa.simulation.sensor import HDL64E
from r3dpa.simulation.street import generator_for


@dataclass(frozen=True)
class SimulatedScan:
    """A scan and its labels.

    Args:
        points: ``(P, 4)`` float32, x forward, y left, z up in the sensor frame in metres, and the
            intensity in [0, 0.99] in steps of 0.01; beam after beam from the highest to the
            lowest, in each beam by growing azimuth in [0, 2 pi).
        labels: ``(P,)`` uint32, semantic class in the lower 16 bits, instance in the upper.
    """

    points: NDArray[np.float32]
    labels: NDArray[np.uint32]


def simulate_scan(scene: Scene, sensor: HDL64E, key: tuple[int | str, ...]) -> SimulatedScan:
    """Scan a scene.

    Args:
        scene: Solids, pose and effects.
        sensor: Instrument; its mount height is not used, the pose holds the height.
        key: Seed of the effects' random draws, see ``generator_for``. The name of its class is
            added for each effect, so that no effect moves the draws of another.

    Returns:
        The points that came back.
    """
    returns = cast(scene, sensor.rays)
    for effect in scene.effects:
        returns = effect(returns, scene, generator_for(*key, type(effect).__name__))
    seen = np.isfinite(returns.range_m)
    origin, direction = (array[:, seen] for array in returns.rays)
    points = np.empty((origin.shape[1], 4), dtype=np.float32)
    points[:, :3] = (origin + returns.range_m[seen] * direction).T
    points[:, 3] = calibrated_intensity(returns.power[seen], returns.range_m[seen])
    labels = returns.semantic | returns.instance.astype(np.uint32) << np.uint32(16)
    order = _storage_order(points, np.nonzero(seen)[0])
    return SimulatedScan(points[order], labels[seen][order])


def calibrated_intensity(
    power: NDArray[np.float32], range_m: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Intensity as KITTI stores it: corrected for range, 0 to 0.99 in steps of 0.01.

    The square root stands for the instrument's gain control, which lifts weak returns::

        intensity = sqrt(power * range^2)

    Args:
        power: Received power of the returns, m^-2, any shape.
        range_m: Their ranges, metres, same shape.

    Returns:
        Float32 of the same shape.
    """
    return np.round(np.sqrt(power * range_m**2).clip(0, 0.99), 2)


def _storage_order(points: NDArray[np.float32], beams: NDArray[np.int64]) -> NDArray[np.int64]:
    """Order by beam, then by azimuth in [0, 2 pi), so that a beam ends where azimuth falls."""
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % np.float32(2 * np.pi)
    return np.argsort(7.0 * beams + azimuth, kind="stable")

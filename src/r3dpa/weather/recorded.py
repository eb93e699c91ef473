"""A scan as its file holds it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# No lidar on a car reaches so far.
_FARTHEST_M = 1000.0


@dataclass(frozen=True)
class RecordedScan:
    """One scan of any spinning lidar, in the order of its file.

    Args:
        points: ``(P, 3)`` float32, x forward, y left, z up in the sensor frame, metres.
        intensity: ``(P,)`` in the units of the file; None if it has none.
        ring: ``(P,)`` laser of each point as stored; None if it is not stored.
        time_s: ``(P,)`` seconds from any moment; None if it is not stored.
        labels: ``(P,)`` uint32; None without labels.

    Raises:
        ValueError: If there are no points, a column has another length, or points cannot be used.
    """

    points: NDArray[np.float32]
    intensity: NDArray | None = None
    ring: NDArray | None = None
    time_s: NDArray | None = None
    labels: NDArray[np.uint32] | None = None

    def __post_init__(self) -> None:
        shape = self.points.shape
        if len(shape) != 2 or shape[1] != 3 or not len(self.points):
            raise ValueError(f"points must be (P, 3) with at least one point, got {shape}")
        for name in ("intensity", "ring", "time_s", "labels"):
            column = getattr(self, name)
            if column is not None and column.shape != (len(self),):
                raise ValueError(
                    f"{name} must have one value for each of {len(self)} points, "
                    f"got the shape {column.shape}"
                )
        finite = np.isfinite(self.points).all(axis=1)
        if self.intensity is not None:
            finite &= np.isfinite(self.intensity)
        if num_bad := np.count_nonzero(~finite):
            raise ValueError(
                f"{num_bad} of {len(self)} points are NaN or infinite: drop them first"
            )
        farthest_m = float(np.abs(self.points).max())
        if farthest_m > _FARTHEST_M:
            raise ValueError(
                f"points reach {farthest_m:.0f} m, farther than {_FARTHEST_M:g}: give metres"
            )

    def __len__(self) -> int:
        return len(self.points)


def angles(points: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Inclination and azimuth in [0, 2 pi) of points ``(P, 3)``, each ``(P,)`` radians."""
    x, y, z = points.T.astype(float)
    return np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x) % (2 * np.pi)

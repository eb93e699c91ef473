"""A scan as its file holds it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

#: Ranges above are no metres; no lidar on a car reaches so far.
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
        table: Every column of the file as read, by its name, each ``(P,)``.

    Raises:
        ValueError: If there are no points, a column has another length, or points cannot be used.
    """

    points: NDArray[np.float32]
    intensity: NDArray | None = None
    ring: NDArray | None = None
    time_s: NDArray | None = None
    labels: NDArray[np.uint32] | None = None
    table: dict[str, NDArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape = self.points.shape
        if len(shape) != 2 or shape[1] != 3 or not len(self.points):
            raise ValueError(f"points must be (P, 3) with at least one point, got {shape}")
        columns = {"intensity": self.intensity, "ring": self.ring, "time_s": self.time_s}
        for name, column in {**columns, "labels": self.labels, **self.table}.items():
            if column is not None and column.shape != (len(self),):
                raise ValueError(
                    f"{name} must have one value for each of {len(self)} points, "
                    f"got the shape {column.shape}"
                )
        if bad := int((~np.isfinite(self.points).all(axis=1)).sum()):
            raise ValueError(f"{bad} of {len(self)} points are NaN or infinite: drop them first")
        farthest_m = float(np.abs(self.points).max())
        if farthest_m > _FARTHEST_M:
            raise ValueError(
                f"points reach {farthest_m:.0f} m, farther than {_FARTHEST_M:g}: give metres"
            )
        if self.intensity is not None and not np.isfinite(self.intensity).all():
            raise ValueError("intensity holds NaN or infinite values: drop these points first")

    def __len__(self) -> int:
        return len(self.points)

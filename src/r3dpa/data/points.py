"""Scans as points, prepared for a network on points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.data import Dataset

from r3dpa.data.scans import Scan, ScanError, read_beside, read_scan
from r3dpa.geometry import LidarSensor


class PointSample(NamedTuple):
    """One scan for a network on points.

    Attributes:
        scan: Where it comes from.
        num_bytes: Size of its file.
        points: ``(P, 4)`` x, y, z in metres, intensity 0..1.
        prepared: What the preparation made of it.
    """

    scan: Scan
    num_bytes: int
    points: Tensor
    prepared: Any


class PointDataset(Dataset[PointSample]):
    """Points of each scan and what a network's preparation makes of them, in loader processes.

    Args:
        scans: The scans, in the order of the indices.
        sensor: At least one point of a scan must lie within its range limits.
        prepare: Function of the points, and of their labels where it needs them.
        needs_labels: Call ``prepare(points, labels)`` with ``(P,)`` int64 labels of the simulator,
            see :func:`r3dpa.data.read_beside`.
    """

    def __init__(
        self,
        scans: Sequence[Scan],
        sensor: LidarSensor,
        prepare: Callable[..., Any],
        needs_labels: bool = False,
    ) -> None:
        self.scans, self.sensor = list(scans), sensor
        self.prepare, self.needs_labels = prepare, needs_labels

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.scans)

    def __getitem__(self, index: int) -> PointSample:
        """One scan.

        Raises:
            ScanError: If it cannot be used, or has no labels where they are needed; the message
                names the file.
        """
        scan = self.scans[index]
        points = torch.from_numpy(read_scan(scan.path, self.sensor))
        arguments = [points]
        if self.needs_labels:
            labels = read_beside(scan.path, "labels")
            if labels is None:
                raise ScanError(
                    f"{scan.path} has no labels (labels/{scan.frame}.label beside data/): only "
                    "simulated scans have them; choose features that need none"
                )
            arguments.append(torch.from_numpy(labels.astype("int64")))
        return PointSample(scan, points.nbytes, points, self.prepare(*arguments))


def list_collate(samples: Sequence[PointSample]) -> list[PointSample]:
    """A batch of scans, which differ in length, as a list."""
    return list(samples)

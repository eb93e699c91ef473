"""What an evaluation keeps of a set of scenes while they stream by.

Letters: F feature width, G groups, n kept scenes, H x W range image.
"""

from __future__ import annotations

import hashlib
import heapq
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy
from itertools import islice
from typing import Generic, Self, TypeVar

import torch
from torch import Tensor

from r3dpa.geometry import points_of
from r3dpa.metrics.functional import Moments
from r3dpa.metrics.protocol import Protocol
from r3dpa.metrics.scene import EvaluationScene, through_sensor
from r3dpa.metrics.scene_features import SceneFeatures

#: Width of the bins of ranges, metres.
RANGE_BIN_M = 0.1

Item = TypeVar("Item")
Value = TypeVar("Value")


class Chosen(Generic[Value]):
    """Up to ``limit`` of all scenes offered, chosen by the hash of their names.

    The choice is as good as a random one, but depends neither on the order nor on interruptions.

    Args:
        limit: How many are kept.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._heap: list[tuple[int, int, str, Value]] = []  # the highest hash first

    def __len__(self) -> int:
        """Scenes kept."""
        return len(self._heap)

    def offer(self, name: str, place: int, value: Value) -> None:
        """Keep a scene if its hash is among the lowest; ``place`` settles ties."""
        item = (-_rank(name), -place, name, value)
        if len(self) < self.limit:
            heapq.heappush(self._heap, item)
        elif self.limit and item[:2] > self._heap[0][:2]:
            heapq.heapreplace(self._heap, item)

    def items(self) -> list[tuple[str, int, Value]]:
        """Name, place and value of the scenes kept, by place."""
        found = [(name, -place, value) for _, place, name, value in self._heap]
        return sorted(found, key=lambda item: item[1])


class SceneSet:
    """Moments, features, histograms and range images of a set of scenes.

    Memory does not grow with the scenes beyond ``max_rows`` and ``max_images``.

    Args:
        protocol: How scenes are prepared.
        widths: Feature width by space.
        max_rows: Scenes whose features are kept.
        max_images: Scenes whose range images are kept.
        num_groups: Groups that the histograms are counted in, scene after scene; a bootstrap
            resamples them.

    Attributes:
        count: Scenes seen.
        moments: Of all features, by space.
        rows: Features ``(F,)`` by space, of chosen scenes.
        images: Range images ``(H, W)`` of chosen scenes.
        cells: ``(G, cells)`` int32, scenes that occupy each cell seen from above.
        ranges: ``(G, bins)`` int64, returns by range.
    """

    def __init__(
        self,
        protocol: Protocol,
        widths: Mapping[str, int],
        max_rows: int,
        max_images: int,
        num_groups: int = 1,
    ) -> None:
        self.protocol, self.widths = protocol, dict(widths)
        self.count = 0
        self.moments = {name: _no_moments(width) for name, width in widths.items()}
        self.rows: Chosen[dict[str, Tensor]] = Chosen(max_rows)
        self.images: Chosen[Tensor] = Chosen(max_images)
        self.cells = torch.zeros(num_groups, math.prod(protocol.grid.shape), dtype=torch.int32)
        bins = math.ceil(protocol.sensor.range_max_m / RANGE_BIN_M)
        self.ranges = torch.zeros(num_groups, bins, dtype=torch.int64)

    def add(self, scenes: Sequence[EvaluationScene], features: Mapping[str, Tensor]) -> None:
        """Count scenes in.

        Args:
            scenes: As :func:`through_sensor` makes them, B of them.
            features: ``(B, F)`` by space.

        Raises:
            ValueError: If no point of a scene lies on the grid seen from above; it is named.
        """
        if not scenes:
            return
        grid = self.protocol.grid
        occupied = [grid.cells(_points(scene), scene.name) for scene in scenes]
        for name, values in features.items():
            self.moments[name] = self.moments[name].merge(Moments.of(values, name))
        for index, (scene, cells) in enumerate(zip(scenes, occupied, strict=True)):
            assert scene.range_m is not None
            group = self.count % len(self.cells)
            self.cells[group, cells] += 1
            returns = scene.range_m[scene.range_m > 0]
            bins = (returns / RANGE_BIN_M).long().clamp(max=self.ranges.shape[1] - 1)
            self.ranges[group] += torch.bincount(bins, minlength=self.ranges.shape[1])
            row = {name: values[index].clone() for name, values in features.items()}
            self.rows.offer(scene.name, self.count, row)
            self.images.offer(scene.name, self.count, scene.range_m)
            self.count += 1

    def features(self, space: str) -> Tensor:
        """Features ``(n, F)`` float32 of the chosen scenes."""
        rows = [row[space] for _, _, row in self.rows.items()]
        return torch.stack(rows) if rows else torch.zeros(0, self.widths[space])

    def clouds(self, places: Iterable[int]) -> Iterator[Tensor]:
        """Points ``(P, 3)`` of the chosen range images, those at ``places`` among them."""
        projection, corner = self.protocol.projection, self.protocol.corner
        kept = self.images.items()
        return (points_of(kept[place][2], projection, corner) for place in places)

    def with_images(self, limit: int) -> Self:
        """The same with at most ``limit`` range images: those kept if the limit had been this."""
        fewer = copy(self)
        fewer.images = Chosen(limit)
        for name, place, image in self.images.items():
            fewer.images.offer(name, place, image)
        return fewer

    def merge(self, other: Self) -> Self:
        """Both sets together, in one group; what is kept are the scenes kept in either."""
        rows, images = self.rows.limit + other.rows.limit, self.images.limit + other.images.limit
        both = type(self)(self.protocol, self.widths, rows, images)
        both.count = self.count + other.count
        both.moments = {key: self.moments[key].merge(other.moments[key]) for key in self.widths}
        both.cells = self.cells.sum(0, keepdim=True) + other.cells.sum(0, keepdim=True)
        both.ranges = self.ranges.sum(0, keepdim=True) + other.ranges.sum(0, keepdim=True)
        for part, first in ((self, 0), (other, self.count)):
            for name, place, row in part.rows.items():
                both.rows.offer(name, first + place, row)
            for name, place, image in part.images.items():
                both.images.offer(name, first + place, image)
        return both


def usable_scenes(
    scenes: Iterable[EvaluationScene],
    protocol: Protocol,
    bad: list[str] | None = None,
    advice: str = "",
) -> Iterator[EvaluationScene]:
    """Scenes through the sensor, as long as every metric can use them.

    Args:
        scenes: As files or a generator give them.
        protocol: How they are prepared.
        bad: Takes the messages of the scenes that are left out. Where None, the first one stops.
        advice: Added to the message that stops.

    Raises:
        ValueError: As :func:`through_sensor`, or if nothing lies on the grid seen from above.
    """
    for scene in scenes:
        try:
            seen = through_sensor(scene, protocol)
            protocol.grid.kept(_points(seen), seen.name)
        except ValueError as error:
            if bad is None:
                raise ValueError(f"{error}{advice}") from error
            bad.append(str(error))
        else:
            yield seen


def add_scenes(
    scenes: Iterable[EvaluationScene], spaces: Sequence[SceneFeatures], batch_size: int
) -> Iterator[tuple[list[EvaluationScene], dict[str, Tensor]]]:
    """Batches of :func:`usable_scenes`, and their features by space: what ``add`` takes."""
    stream = iter(scenes)
    while batch := list(islice(stream, batch_size)):
        yield batch, {space.name: space(batch) for space in spaces}


def _points(scene: EvaluationScene) -> Tensor:
    assert scene.points is not None
    return scene.points


def _no_moments(width: int) -> Moments:
    numbers = torch.zeros(1 + width + width**2, dtype=torch.float64)
    return Moments.unpack(numbers)


def _rank(name: str) -> int:
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")

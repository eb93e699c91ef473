"""Settings, scans, features and judges of ``r3dpa bench control``.

Letters: P points, H beams, W columns, N tokens, F feature width.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import torch
from torch import Tensor
from tqdm import tqdm

from r3dpa.data import (
    Extractor,
    PointSample,
    Scan,
    kitti360_scans,
    pooled_grids,
    read_beside,
    read_scan,
)
from r3dpa.data.labels import read_labels
from r3dpa.data.scans import evenly
from r3dpa.editing import EditSettings
from r3dpa.generation import SceneGenerator
from r3dpa.geometry import points_of, range_image
from r3dpa.geometry.regions import box3d
from r3dpa.metrics.probe import logistic_regression

__all__ = [
    "CAR",
    "Bench",
    "ClassProbe",
    "ControlSettings",
    "Part",
    "Place",
    "ScanDesk",
    "View",
    "cell_cosine",
    "free_place",
    "points_inside",
    "shown",
]

Part = Literal["strength", "guided", "mix", "inpaint", "complete", "round_trip", "cost"]
T = TypeVar("T")

CAR = 26  # as KITTI-360 numbers classes
_PROBE_POINTS = 500  # of each scan that the probe is fitted on

# A car's body, from 0.25 m above the road: what is lower may be road.
_BODY_M = (4.2, 1.8, 1.3)
_GROUND_Z_M = -1.73
_BODY_Z_M = _GROUND_Z_M + 0.25 + _BODY_M[2] / 2
_NEAREST_M, _FARTHEST_M = 6.0, 14.0
_SEEN_SHARE = 0.9  # of the rays through a free place that end behind its near side
_TRIES = 400


@dataclass(frozen=True)
class ControlSettings:
    """How much is measured.

    Args:
        parts: What is measured, in this order.
        scenes: Scenes of ``guided`` and ``mix``.
        cases: Scans of ``inpaint`` and ``complete``.
        round_trips: Scans of ``round_trip``, and scenes of each row of ``strength``.
        nfe: Evaluations of one way, of the rows of ``round_trip``.
        probe_scans: Training scans that the probe is fitted on, and scans it is tested on.
        rounds: Of the timing.
        edit: Solver and guidance. Its solver must run both ways in ``inpaint``.
        complete_start: Time that a completion starts from.
        seed: Of the noises, and of the places of cars.
    """

    parts: Sequence[Part] = get_args(Part)
    scenes: int = 64
    cases: int = 32
    round_trips: int = 16
    nfe: Sequence[int] = (8, 16, 32, 64)
    probe_scans: int = 40
    rounds: int = 20
    edit: EditSettings = field(default_factory=EditSettings)
    complete_start: float = 0.3
    seed: int = 0

    def quick(self) -> ControlSettings:
        """The same with as little of everything as makes an interval."""
        few = replace(self, scenes=2, cases=2, round_trips=2, probe_scans=4, rounds=2)
        return replace(few, nfe=(2, 4), edit=replace(self.edit, steps=2))


@dataclass(frozen=True)
class View:
    """A scan: its file, points ``(P, 4)`` and range image ``(H, W)``."""

    scan: Scan
    points: Tensor
    range_m: Tensor


@dataclass(frozen=True)
class Place:
    """A box where a car may stand: its centre in metres, and the pixels whose rays meet it."""

    centre_m: tuple[float, float, float]
    pixels: Tensor


@dataclass(frozen=True)
class ScanDesk:
    """Reads scans and describes them as a model was trained to.

    Args:
        generator: Gives the projection and the size of the feature grids.
        extractor: That of the checkpoint.
    """

    generator: SceneGenerator
    extractor: Extractor

    def read(self, scan: Scan) -> View:
        """A scan and its range image."""
        projection = self.generator.geometry.projection
        points = torch.from_numpy(read_scan(scan.path, projection.sensor))
        return View(scan, points, range_image(points[:, :3], projection)[0])

    def target(self, view: View) -> Tensor:
        """Feature grid ``(N, F)`` of the points of a scan, as a training sees it."""
        labels = []
        if getattr(self.extractor, "needs_labels", False):
            known = read_beside(view.scan.path, "labels")
            if known is None:
                raise ValueError(f"{view.scan.path} has no labels, which the features read")
            labels.append(torch.from_numpy(known.astype("int64")))
        return self._grid(view.scan, view.points, *labels)

    def again(self, range_m: Tensor) -> Tensor:
        """Feature grid ``(N, F)`` of the points of a range image, whose intensity is 0.

        Generated and given scenes are both described so where they are compared.

        Raises:
            ValueError: If the extractor reads labels, which a range image does not have.
        """
        scan = Scan("", "generated", Path("generated"))
        return self._grid(scan, self._points(range_m))

    def classes(self, range_m: Tensor, probe: ClassProbe) -> tuple[Tensor, Tensor]:
        """Points ``(P, 3)`` of a range image, and whether a probe takes each for its class."""
        points = self._points(range_m)
        values = self._values(points)
        return points[:, :3], probe(values).cpu()

    def fit_probe(self, scans: Sequence[Scan], label: int = CAR) -> ClassProbe:
        """A linear probe of one class, on points of the range images of labelled scans.

        It meets what it will judge: points that are as sparse as generated ones and know no
        intensity.

        Args:
            scans: Scans with labels.
            label: The class that is told from all others.

        Raises:
            ValueError: If the scans hold no labelled point, or none of the class.
        """
        generator = torch.Generator().manual_seed(0)
        features, targets = [], []
        for scan in scans:
            points, own = self.labelled(scan, label)
            values = self._values(points)
            # All points of the class, which is rare, would bias the probe towards it.
            chosen = torch.randperm(len(points), generator=generator)[:_PROBE_POINTS]
            features.append(values[chosen.to(values.device)])
            targets.append(own[chosen].long())
        truth = torch.cat(targets)
        if not truth.any():
            raise ValueError(
                f"none of the {len(scans)} scans that the probe is fitted on shows class {label}"
            )
        weight, bias = logistic_regression(torch.cat(features), truth.to(features[0].device), 2)
        return ClassProbe(weight[:, 1] - weight[:, 0], bias[1] - bias[0])

    def labelled(self, scan: Scan, label: int) -> tuple[Tensor, Tensor]:
        """Points ``(P, 4)`` of the range image of a scan, and whether they are of a class."""
        view = self.read(scan)
        projection = self.generator.geometry.projection
        known = torch.from_numpy(read_labels(scan.path, view.points.numpy())) & 0xFFFF
        classes = range_image(view.points[:, :3], projection, known[:, None].float())[1]
        assert classes is not None
        order = projection.column_order()
        image = view.range_m[:, order]
        return self._points(view.range_m), classes[0][:, order][image > 0] == label

    def _points(self, range_m: Tensor) -> Tensor:
        points = points_of(range_m, self.generator.geometry.projection)
        if not len(points):
            raise ValueError(
                "a scene has no return at all: the checkpoint gives nothing to measure"
            )
        return torch.cat([points, points.new_zeros(len(points), 1)], dim=1)

    @torch.no_grad()
    def _values(self, points: Tensor) -> Tensor:
        return self.extractor.point_features([self.extractor.prepare(points)])[0].float()

    @torch.no_grad()
    def _grid(self, scan: Scan, points: Tensor, *labels: Tensor) -> Tensor:
        prepared: Any = self.extractor.prepare(points, *labels)
        sample = PointSample(scan, points.nbytes, points, prepared)
        size = self.generator.sit.grid_size
        projection = self.generator.geometry.projection
        return pooled_grids(self.extractor, [sample], projection, [size])[size][0]


@dataclass(frozen=True)
class ClassProbe:
    """A linear classifier of point features: weights ``(F,)`` and bias."""

    weight: Tensor
    bias: Tensor

    def __call__(self, features: Tensor) -> Tensor:
        """Whether each of ``(P, F)`` is taken for the class, ``(P,)`` bool."""
        return features @ self.weight + self.bias > 0


@dataclass(frozen=True)
class Bench:
    """What all parts share.

    Args:
        desk: Networks and features.
        car: ``(F,)`` feature that inpainting is guided towards.
        data: Root of the scans.
        settings: How much is measured.
    """

    desk: ScanDesk
    car: Tensor
    data: Path
    settings: ControlSettings

    @property
    def generator(self) -> SceneGenerator:
        """The networks."""
        return self.desk.generator

    def scans(self, split: Literal["train", "val"], num: int) -> list[Scan]:
        """Up to ``num`` scans of a split, evenly spread.

        Raises:
            ValueError: If there are fewer than two.
        """
        scans = evenly(kitti360_scans(self.data, split), num)
        if len(scans) < 2:
            raise ValueError(f"{self.data} has {len(scans)} scans of split {split}; 2 are needed")
        return scans

    def views(self, split: Literal["train", "val"], num: int) -> list[View]:
        """The same, read."""
        return [self.desk.read(scan) for scan in self.scans(split, num)]


def cell_cosine(first: Tensor, second: Tensor, tokens: Tensor | None = None) -> float:
    """Mean cosine of two feature grids ``(N, F)`` over the cells that neither has empty.

    Args:
        first: One grid; zero in empty cells.
        second: The other.
        tokens: ``(N,)`` bool, cells that count; all where None.

    Returns:
        NaN where there is no such cell.
    """
    both = (first != 0).any(dim=1) & (second != 0).any(dim=1)
    if tokens is not None:
        both &= tokens
    return torch.cosine_similarity(first[both].double(), second[both].double(), dim=1).mean().item()


def free_place(
    view: View, generator: torch.Generator, scenes: SceneGenerator, smallest: int = 8
) -> Place | None:
    """A place on the road around the sensor where a car could stand and be seen.

    Drawn evenly over azimuths and over distances of 6 to 14 m, until nothing of the scan stands in
    it and nothing hides it.

    Args:
        view: The scan.
        generator: Source of the draws.
        scenes: Gives the projection.
        smallest: Pixels that the place must have.

    Returns:
        None where no draw of several hundred is free.
    """
    projection = scenes.geometry.projection
    xyz = view.points[:, :3]
    for _ in range(_TRIES):
        azimuth, share = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
        far = _NEAREST_M + share * (_FARTHEST_M - _NEAREST_M)
        centre = far * math.cos(math.tau * azimuth), far * math.sin(math.tau * azimuth), _BODY_Z_M
        if points_inside(xyz, centre).any():
            continue
        pixels = box3d(projection, centre, _BODY_M)
        nearest = math.hypot(
            *(max(abs(c) - s / 2, 0) for c, s in zip(centre, _BODY_M, strict=True))
        )
        ranges = view.range_m[pixels]
        if len(ranges) >= smallest and ((ranges > nearest) | (ranges <= 0)).double().mean() >= (
            _SEEN_SHARE
        ):
            return Place(centre, pixels)
    return None


def points_inside(points: Tensor, centre_m: Sequence[float]) -> Tensor:
    """Which of the points ``(P, 3)`` lie in the body of a car that stands along x there."""
    apart = (points.double() - torch.tensor(centre_m, dtype=torch.float64)).abs()
    return (apart <= torch.tensor(_BODY_M, dtype=torch.float64) / 2).all(dim=1)


def shown(items: Sequence[T], what: str) -> Iterable[T]:
    """The items, with a bar that tells how many are done."""
    return tqdm(items, desc=what, disable=None)

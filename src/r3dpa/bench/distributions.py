"""How far sets of samples are from data as distributions, at equal numbers, with real floors.

Letters: N samples, D dimensions, F feature width.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from r3dpa.bench.mixture import GaussianMixture
from r3dpa.bench.problems import Solved
from r3dpa.data.scans import find_scans, read_scan
from r3dpa.geometry import LidarSensor
from r3dpa.metrics.bootstrap import Interval, bootstrap_interval
from r3dpa.metrics.distances import Resampling, histogram_rows
from r3dpa.metrics.evaluation import gather
from r3dpa.metrics.feature_distances import FeatureSample, feature_rows
from r3dpa.metrics.functional import frechet_distance_of
from r3dpa.metrics.protocol import DEFAULT
from r3dpa.metrics.protocol import Protocol as SceneProtocol
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.scene import EvaluationScene
from r3dpa.metrics.scene_features import FREE_SPACES, scene_features
from r3dpa.metrics.scene_set import SceneSet

__all__ = ["Distances", "SceneDistances", "SlicedDistance", "sliced_wasserstein"]

_NO_INTERVALS = Resampling(num_resamples=0)
_PROJECTIONS = 64
_KEPT = ("", " KID")  # Fréchet distance and kernel distance of each space


class Distances(Protocol):
    """Distances of samples from data.

    Attributes:
        floors: What data reach against other data, by name of the distance.
        main: Name of the distance that pictures show.
    """

    floors: dict[str, float]
    main: str

    def prepare(self, solved: Solved) -> Any:
        """What the distances are computed from, worth keeping."""
        ...

    def values(self, prepared: Any) -> dict[str, float]:
        """All distances by name."""
        ...

    def difference(self, one: Any, other: Any, resamples: int) -> dict[str, Interval]:
        """Distances of one set minus those of another, paired by sample, with intervals."""
        ...


def sliced_wasserstein(a: Tensor, b: Tensor, generator: torch.Generator) -> float:
    """Root of the mean squared 2-Wasserstein distance along random directions.

    Source: Bonneel et al., "Sliced and Radon Wasserstein barycenters of measures", 2015.

    Args:
        a: ``(N, D)``.
        b: ``(N, D)``, as many.
        generator: Of the 64 directions.

    Raises:
        ValueError: If the numbers differ.
    """
    if a.shape != b.shape:
        raise ValueError(f"sets of {tuple(a.shape)} and {tuple(b.shape)}; give as many of each")
    directions = torch.randn(a.shape[1], _PROJECTIONS, generator=generator, dtype=a.dtype)
    directions = directions / directions.norm(dim=0)
    apart = (a @ directions).sort(dim=0).values - (b @ directions).sort(dim=0).values
    return apart.square().mean().sqrt().item()


class SlicedDistance:
    """Sliced 2-Wasserstein distance from draws of a mixture.

    Args:
        mixture: Data.
        num: Samples that will be compared.
    """

    main = "sliced W2"

    def __init__(self, mixture: GaussianMixture, num: int) -> None:
        generator = torch.Generator().manual_seed(1)
        self._data, other = (mixture.sample(num, generator) for _ in range(2))
        self.floors = {self.main: self._distance(other)}

    def _distance(self, samples: Tensor) -> float:
        generator = torch.Generator().manual_seed(2)
        return sliced_wasserstein(samples.to(self._data), self._data, generator)

    def prepare(self, solved: Solved) -> Tensor:
        """The samples themselves."""
        return solved.latents

    def values(self, prepared: Tensor) -> dict[str, float]:
        """The one distance."""
        return {self.main: self._distance(prepared)}

    def difference(self, one: Tensor, other: Tensor, resamples: int) -> dict[str, Interval]:
        """The same samples are drawn of both."""

        def apart(a: Tensor, b: Tensor) -> float:
            return self._distance(one[a]) - self._distance(other[b])

        return {self.main: _paired(apart, len(one), resamples)}


class SceneDistances:
    """FWID, FGEO, their kernel distances, JSD and W1 of ranges, from real scans.

    Args:
        source: File of ``r3dpa reference``, or folder of scans.
        sensor: Of the generated range images.
        num: Scenes that will be compared.
        device: Where the networks compute.

    Raises:
        ValueError: If the file is of another sensor or of spaces that need weights, or the scans
            cannot be used.
    """

    def __init__(self, source: Path, sensor: LidarSensor, num: int, device: str) -> None:
        if source.is_dir():
            protocol = DEFAULT.with_sensor(sensor)
            self._spaces = [scene_features(name, None, protocol, device) for name in FREE_SPACES]
            reference = _reference_of(source, self._spaces, protocol)
        else:
            reference = ReferenceStatistics.load(source)
            protocol = reference.protocol
            if protocol.sensor != sensor:
                raise ValueError(
                    f"{source} is of a sensor of {protocol.sensor.beams} x "
                    f"{protocol.sensor.columns} pixels, but the checkpoint makes {sensor.beams} "
                    f"x {sensor.columns}; give a folder of scans, or a reference for this sensor"
                )
            names = [name for name in reference.spaces if name in FREE_SPACES]
            if not names:
                raise ValueError(
                    f"{source} has no features of {' or '.join(FREE_SPACES)}; make one that has"
                )
            self._spaces = [scene_features(name, None, protocol, device) for name in names]
        self._protocol, self._real = protocol, reference.whole
        self.main = self._spaces[0].label
        self.about = reference.describe()
        first, second = reference.halves
        self.floors = self._between(second, first, min(num, first.count))

    def _between(self, real: SceneSet, generated: SceneSet, num: int) -> dict[str, float]:
        rows = [r for r in histogram_rows(real, generated, _NO_INTERVALS) if r.name != "TV"]
        for space in self._spaces:
            sample = FeatureSample.of(generated, space.name)
            if len(sample.rows) > num:
                sample = sample.subset(num, _NO_INTERVALS.generator())
            found = feature_rows(
                space.label, FeatureSample.of(real, space.name), sample, _NO_INTERVALS
            )
            rows += [row for row in found if row.name.removeprefix(space.label) in _KEPT]
        return {row.name: row.value for row in rows if row.value is not None}

    def prepare(self, solved: Solved) -> SceneSet:
        """Features and histograms of the scenes."""
        assert solved.range_m is not None
        scenes = (
            EvaluationScene(f"{index:06d}", None, range_m)
            for index, range_m in enumerate(solved.range_m)
        )
        return gather(scenes, self._spaces, self._protocol)[0]

    def values(self, prepared: SceneSet) -> dict[str, float]:
        """All distances."""
        return self._between(self._real, prepared, prepared.count)

    def difference(self, one: SceneSet, other: SceneSet, resamples: int) -> dict[str, Interval]:
        """Of the Fréchet distances; the same scenes are drawn of both."""
        found = {}
        for space in self._spaces:
            real = FeatureSample.of(self._real, space.name).rows
            rows = [FeatureSample.of(part, space.name).rows for part in (one, other)]

            def apart(a: Tensor, b: Tensor, real: Tensor = real, rows: Any = rows) -> float:
                return frechet_distance_of(real, rows[0][a]) - frechet_distance_of(real, rows[1][b])

            found[space.label] = _paired(apart, one.count, resamples)
        return found


def _paired(statistic: Callable[..., float], count: int, resamples: int) -> Interval:
    generator = torch.Generator().manual_seed(0)
    return bootstrap_interval(
        statistic, (count, count), generator, paired=True, num_resamples=resamples
    )


def _reference_of(
    folder: Path, spaces: Sequence[Any], protocol: SceneProtocol
) -> ReferenceStatistics:
    scans = find_scans(folder)
    names = [scan.name for scan in scans]
    statistics = ReferenceStatistics.prepare(spaces, protocol, names, {"data": folder.name})

    def scenes() -> Iterator[EvaluationScene]:
        for scan in scans:
            points = torch.from_numpy(read_scan(scan.path, protocol.sensor))
            yield EvaluationScene(scan.name, points)

    statistics.update(scenes(), spaces)
    return statistics


def verdict(difference: Interval, floor: float) -> str:
    """``better``, ``worse`` or ``tie`` of one set against another; less is better.

    Args:
        difference: One minus the other.
        floor: Differences up to it are a tie.
    """
    if abs(difference.value) <= floor or difference.low <= 0 <= difference.high:
        return "tie"
    return "better" if difference.value < 0 else "worse"


def verdicts(
    differences: Mapping[str, Interval], floors: Mapping[str, float]
) -> dict[str, dict[str, Any]]:
    """Differences by name as plain values, each with its :func:`verdict`."""
    return {
        name: {
            "difference": found.value,
            "low": found.low,
            "high": found.high,
            "verdict": verdict(found, floors.get(name, 0.0)),
        }
        for name, found in differences.items()
    }

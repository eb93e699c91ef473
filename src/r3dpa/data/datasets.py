"""Scans as training samples: range images or cached latents, or points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NotRequired, Protocol, TypedDict

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from lidarsim.scan_files import ScanError, out_of_range
from lidarsim.weather import WeatherPrior
from r3dpa.data.labels import find_labels, read_labels
from r3dpa.data.scans import Scan
from r3dpa.data.store import CachedTensors, ItemKey
from r3dpa.features.voxels import MaskedScan
from r3dpa.geometry import (
    LidarSensor,
    Pixels,
    Projection,
    RangeCodec,
    in_range,
    points_of,
    project_pixels,
    range_image,
    values_at_returns,
)
from r3dpa.geometry.semantics import UNKNOWN_CLASS, classes_of

WEATHER_STREAM = 2  # of the draws of an item; those for its view have stream 1

#: Function of the points ``(P, 4)`` of a scan.
Change = Callable[[np.ndarray], np.ndarray]


class LidarBatch(TypedDict):
    """Batch of the training modules.

    ``range_image`` ``(B, C, H, W)`` float32, the channels of :class:`r3dpa.geometry.RangeCodec`,
    and ``valid_mask`` ``(B, 1, H, W)`` bool, True where a pixel has a return; where they are
    cached, instead ``posterior_moments`` ``(B, 2C, h, w)`` float32, means, then log-variances of
    the raw latents, see :class:`r3dpa.nn.Posterior`. ``feature_grid`` ``(B, N, D)`` float32, empty
    cells zero, absent where no grids are used; ``noise`` ``(B, C, H, W)`` that a generated image
    was made of, absent for scans; ``index`` ``(B,)`` int64 position in the data set; ``name`` B
    strings.
    """

    range_image: NotRequired[Tensor]
    valid_mask: NotRequired[Tensor]
    posterior_moments: NotRequired[Tensor]
    feature_grid: NotRequired[Tensor]
    noise: NotRequired[Tensor]
    index: Tensor
    name: list[str]


class CachedImages(Protocol):
    """Images that scans are read from, safe to hand to loader processes."""

    @property
    def projection(self) -> Projection:
        """Projection that the images were made with."""

    def read(self, scan: Any, /) -> Pixels:
        """Pixels ``(H, W)`` of a scan."""


@dataclass(eq=False, repr=False)
class LidarDataset(Dataset[dict[str, Any]]):
    """Range image and mask, or cached posterior, and feature grid of each scan; nothing random."""

    scans: list[Scan]
    projection: Projection
    codec: RangeCodec
    grids: CachedTensors[Scan] | None = None
    posteriors: CachedTensors[Scan] | None = None  #: ``(2C, h, w)``, in place of image and mask
    images: CachedImages | None = None  #: which the scans are read from, in place of their files

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return self.sample(index)

    def sample(self, index: int, change: Change | None = None) -> dict[str, Any]:
        """Sample of a scan whose points ``change`` has changed, unless its image is cached."""
        scan = self.scans[index]
        sample: dict[str, Any]
        if self.posteriors is not None:
            sample = {"posterior_moments": self.posteriors.read(scan)}
        else:
            image = self.codec.to_image(*self._project(scan, change))
            sample = {"range_image": image, "valid_mask": self.codec.returns_of(image)}
        sample |= {"index": index, "name": scan.name}
        if self.grids is not None:
            sample["feature_grid"] = self.grids.read(scan)
        return sample

    def range_m(self, index: int) -> Tensor:
        """Range image ``(H, W)`` of a scan in metres, -1 without a return."""
        return self._project(self.scans[index]).range_m

    def ranges_m(self, batch_size: int) -> Iterator[Tensor]:
        """Range images ``(B, H, W)`` of all scans in order."""
        for first in range(0, len(self), batch_size):
            last = min(first + batch_size, len(self))
            yield torch.stack([self.range_m(index) for index in range(first, last)])

    def _project(self, scan: Scan, change: Change | None = None) -> Pixels:
        """Ranges and, where the codec takes them, intensities and classes."""
        if self.images is not None:
            return self.images.read(scan)
        read, codec = scan.read(), self.codec
        has_intensity = codec.reflectance or codec.intensity_channel
        if has_intensity:
            _check_intensities(scan.path, read)
        points = torch.from_numpy(read if change is None else change(read))
        # Labels are of the points as they were read: a data module refuses both together.
        labels = torch.from_numpy(read_labels(scan.path, len(read))) if codec.num_classes else None
        try:
            if has_intensity or codec.num_classes:
                pixels = project_pixels(points, self.projection, labels)
            else:
                pixels = Pixels(range_image(points[:, :3], self.projection)[0])
        except ValueError as error:
            raise ScanError(f"{scan.path}: cannot be projected: {error}") from error
        if not (pixels.range_m > 0).any():
            if change is None:
                raise out_of_range(scan.path, self.projection.sensor)
            self._project(scan)  # without the change, to blame a file that shows nothing by itself
            raise _lost_in_weather(scan.path, self.projection.sensor)
        return pixels


class PointSample(NamedTuple):
    """Scan, its key in a store, its points ``(P, 4)``, and the preparation of these."""

    scan: Scan
    key: ItemKey
    points: Tensor
    prepared: Any


@dataclass(eq=False, repr=False)
class PointDataset(Dataset[Any]):
    """Points of each scan, prepared for a network by the loader processes.

    Where ``images`` are given, the points lie at the centres of their pixels.

    Raises:
        ScanError: For a scan without a point within the range limits of ``sensor``.
    """

    scans: Sequence[Any]
    sensor: LidarSensor
    prepare: Callable[..., Any]
    images: CachedImages | None = None

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, index: int) -> PointSample:
        scan = self.scans[index]
        key = scan.cache_key
        points = self.points(scan)
        return PointSample(scan, key, points, self.prepare(points))

    def points(self, scan: Any) -> Tensor:
        """Points ``(P, 4)`` of a scan or of its cached image."""
        if self.images is None:
            return torch.from_numpy(scan.read(self.sensor))
        return points_at_pixels(self.images.read(scan), self.images.projection)


@dataclass(eq=False, repr=False)
class DrawnPoints(PointDataset):
    """Random preparation of points, ``prepare(points, generator)``.

    An item ``(epoch, index)``, or ``index`` of epoch 0, is a function of these and ``seed`` alone.
    ``weather`` changes the points of an item of an epoch.
    """

    seed: int = 0
    weather: WeatherPrior | None = None

    def __getitem__(self, key: tuple[int, int] | int) -> Any:
        epoch, index = key if isinstance(key, tuple) else (0, key)
        points = self.points(self.scans[index])
        if self.weather is not None and isinstance(key, tuple):
            changed = self.weather.points(points.numpy(), (self.seed, epoch, index, WEATHER_STREAM))
            points = torch.from_numpy(changed)
            if not in_range(points[:, :3], self.sensor).any():
                raise _lost_in_weather(self.scans[index].path, self.sensor)
        return self.prepare(points, np.random.default_rng((self.seed, epoch, index)))


class LabelledPoints(DrawnPoints):
    """Masked scans with the classes of their points, all unknown in a scan without labels."""

    def __getitem__(self, key: tuple[int, int] | int) -> Any:
        masked: MaskedScan = super().__getitem__(key)
        scan = self.scans[key[1] if isinstance(key, tuple) else key]
        classes = self._classes(scan, len(masked.scan.upsample))
        if classes is None:
            unknown = torch.full((len(masked.hidden),), UNKNOWN_CLASS)
            return masked._replace(classes=unknown)
        return masked._replace(classes=classes[masked.scan.kept])

    def _classes(self, scan: Scan, num_points: int) -> Tensor | None:
        """Classes ``(P,)`` of all points of a scan; None for a scan without labels."""
        if self.images is not None:
            pixels = self.images.read(scan)
            if pixels.classes is None:
                return None
            return values_at_returns(pixels.classes, pixels.range_m, self.images.projection)
        labels = find_labels(scan.path, num_points)
        # The upper bits of a label are the object.
        return None if labels is None else classes_of(torch.from_numpy(labels & 0xFFFF))


def points_at_pixels(pixels: Pixels, projection: Projection) -> Tensor:
    """Points ``(P, 4)`` at the centres of the pixels with a return; intensity 0 if not known."""
    intensity = pixels.intensity
    if intensity is None:
        intensity = torch.zeros_like(pixels.range_m)
    return points_of(pixels.range_m, projection, intensity=intensity)


def _check_intensities(path: Path, points: np.ndarray) -> None:
    """Refuse points ``(P, 4)`` whose intensities are all 0, as of a file without any."""
    if not points[:, 3].any():
        raise ScanError(
            f"{path}: has no intensities, which images with a channel of intensity need: set "
            "codec.intensity_channel and codec.reflectance to false, or name the column of the "
            "intensity with --data.init_args.columns"
        )


def _lost_in_weather(path: Path, sensor: LidarSensor) -> ScanError:
    """Error of a sound scan in a weather that leaves no point within the range limits."""
    return ScanError(
        f"{out_of_range(path, sensor)} in the weather drawn for it: give the WeatherPrior a "
        "greater visibility_m"
    )

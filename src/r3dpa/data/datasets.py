"""Scans as training samples: range images, cached latents, or points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple, NotRequired, TypedDict

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from r3dpa.data.scans import Scan, ScanError, out_of_range, read_scan
from r3dpa.data.store import CachedTensors, ItemKey, TensorCache
from r3dpa.geometry import LidarSensor, Projection, RangeCodec, projection_to_dict, range_image


class LidarBatch(TypedDict):
    """Batch of the training modules.

    ``range_image`` ``(B, 1, H, W)`` float32 in [-1, 1]; ``valid_mask`` ``(B, 1, H, W)`` bool, True
    where a pixel has a return; ``feature_grid`` ``(B, N, D)`` float32, empty cells zero, absent
    where no grids are used; ``index`` ``(B,)`` int64 position in the data set; ``name`` list of B
    scan names.
    """

    range_image: Tensor
    valid_mask: Tensor
    feature_grid: NotRequired[Tensor]
    index: Tensor
    name: list[str]


class LatentBatch(TypedDict):
    """Replaces a :class:`LidarBatch` where the posteriors of the VAE are cached.

    ``posterior_moments`` ``(B, 2C, h, w)`` float32, means, then log-variances of the raw latents,
    see :class:`r3dpa.nn.Posterior`; the rest is that of :class:`LidarBatch`.
    """

    posterior_moments: Tensor
    feature_grid: NotRequired[Tensor]
    index: Tensor
    name: list[str]


class LidarDataset(Dataset[dict[str, Any]]):
    """Range image, mask and feature grid of each scan as it is; nothing random.

    Args:
        scans: The scans, in the order of the indices.
        projection: Points to pixels; its sensor sets the image size and range limits.
        codec: Metres to [-1, 1].
        grids: Feature grids of the scans, if any.
        images: Range images of the scans, made with this projection and codec, if they are cached;
            the scans themselves are then not read.
    """

    def __init__(
        self,
        scans: Sequence[Scan],
        projection: Projection,
        codec: RangeCodec,
        grids: CachedTensors[Scan] | None = None,
        images: CachedTensors[Scan] | None = None,
    ) -> None:
        self.scans = list(scans)
        self.projection = projection
        self.codec = codec
        self.grids = grids
        self.images = images

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, index: int) -> dict[str, Any]:
        scan = self.scans[index]
        image = self._project(scan) if self.images is None else self.images.read(scan)
        sample = {
            "range_image": image,
            "valid_mask": self.codec.valid_mask(image),
            "index": index,
            "name": scan.name,
        }
        if self.grids is not None:
            sample["feature_grid"] = self.grids.read(scan)
        return sample

    def _project(self, scan: Scan) -> Tensor:
        points = torch.from_numpy(read_scan(scan.path))
        try:
            range_m, _ = range_image(points[:, :3], self.projection)
        except ValueError as error:
            raise ScanError(f"{scan.path}: cannot be projected: {error}") from error
        if not (range_m > 0).any():
            raise out_of_range(scan.path, self.projection.sensor)
        return self.codec.encode(range_m)[None]


class LatentDataset(Dataset[dict[str, Any]]):
    """Posterior of a frozen VAE and feature grid of each scan; range images are not read.

    Args:
        scans: The scans, in the order of the indices.
        posteriors: Moments ``(2C, h, w)`` of the scans.
        grids: Feature grids of the scans, if any.
    """

    def __init__(
        self,
        scans: Sequence[Scan],
        posteriors: CachedTensors[Scan],
        grids: CachedTensors[Scan] | None = None,
    ) -> None:
        self.scans, self.posteriors, self.grids = list(scans), posteriors, grids

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, index: int) -> dict[str, Any]:
        scan = self.scans[index]
        sample: dict[str, Any] = {
            "posterior_moments": self.posteriors.read(scan),
            "index": index,
            "name": scan.name,
        }
        if self.grids is not None:
            sample["feature_grid"] = self.grids.read(scan)
        return sample


class PointSample(NamedTuple):
    """One scan for a network on points.

    Attributes:
        scan: Where it comes from.
        key: Key of its rows in a store.
        points: ``(P, 4)`` x, y, z in metres, intensity 0..1.
        prepared: What the network's preparation returned for them.
    """

    scan: Scan
    key: ItemKey
    points: Tensor
    prepared: Any


class PointDataset(Dataset[PointSample]):
    """Points of each scan and their preparation for a network, done in loader processes.

    Args:
        scans: The scans, in the order of the indices.
        sensor: At least one point of a scan must lie within its range limits.
        prepare: Function of the points.
    """

    def __init__(
        self, scans: Sequence[Scan], sensor: LidarSensor, prepare: Callable[[Tensor], Any]
    ) -> None:
        self.scans, self.sensor, self.prepare = list(scans), sensor, prepare

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, index: int) -> PointSample:
        scan = self.scans[index]
        key = scan.cache_key
        points = torch.from_numpy(read_scan(scan.path, self.sensor))
        return PointSample(scan, key, points, self.prepare(points))


class DrawnPoints(Dataset[Any]):
    """Random preparation of the points of each scan: a function of seed, epoch and index alone.

    Args:
        scans: The scans, in the order of the indices.
        sensor: At least one point of a scan must lie within its range limits.
        prepare: Function of the points ``(P, 4)`` and a generator.
        seed: Seed of the draws.
    """

    def __init__(
        self,
        scans: Sequence[Scan],
        sensor: LidarSensor,
        prepare: Callable[[Tensor, np.random.Generator], Any],
        seed: int,
    ) -> None:
        self.scans, self.sensor, self.prepare, self.seed = list(scans), sensor, prepare, seed

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, key: tuple[int, int] | int) -> Any:
        epoch, index = key if isinstance(key, tuple) else (0, key)
        points = torch.from_numpy(read_scan(self.scans[index].path, self.sensor))
        return self.prepare(points, np.random.default_rng((self.seed, epoch, index)))


def list_collate(samples: Sequence[Any]) -> list[Any]:
    """A batch of scans, which differ in length, as a list."""
    return list(samples)


def range_image_cache(
    root: str | Path, projection: Projection, codec: RangeCodec
) -> TensorCache[Scan]:
    """Place of the encoded range images ``(1, H, W)`` of a projection and codec."""
    settings = {"projection": projection_to_dict(projection), "codec": asdict(codec)}
    sensor = projection.sensor
    return TensorCache(Path(root), "range_images", settings, (1, sensor.beams, sensor.columns))


def write_range_images(
    scans: Sequence[Scan],
    projection: Projection,
    codec: RangeCodec,
    root: str | Path,
    *,
    workers: int = 0,
) -> int:
    """Project the scans whose range images are missing; another process that does is waited for.

    Args:
        scans: Scans, of any number of drives.
        projection: Points to pixels.
        codec: Metres to [-1, 1].
        root: Folder of caches.
        workers: Processes that project; 0 for none.

    Returns:
        Number of range images made. ``StoreError`` or ``ScanError`` names what cannot be used.
    """
    cache = range_image_cache(root, projection, codec)
    if not cache.missing(scans):
        return 0  # a complete cache may lie on a read-only disk
    with cache.lock():
        todo = cache.missing(scans)  # another process may have made some
        keys = [scan.cache_key for scan in todo]
        loader = DataLoader(
            LidarDataset(todo, projection, codec),
            batch_size=8,
            num_workers=workers,
            generator=torch.Generator(),  # the default draws from the global random state
        )
        with cache.writer() as writer:
            for batch in tqdm(loader, desc="range images", disable=None):
                writer.add([keys[index] for index in batch["index"]], batch["range_image"])
    return len(todo)

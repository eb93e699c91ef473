"""Simulated scans as cached range images, for training sets too large to keep their points."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, cast
from zlib import crc32

import torch
from lightning.pytorch.utilities.rank_zero import rank_zero_info
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from r3dpa.data.datamodules import SimulatedDataModule
from r3dpa.data.datasets import PointSample
from r3dpa.data.feature_grids import GridSettings, pooled_grids
from r3dpa.data.loaders import at_least
from r3dpa.data.store import CachedTensors, ItemKey, Store, tensor_cache
from r3dpa.geometry import (
    Projection,
    SphericalProjection,
    points_of,
    projection_to_dict,
    range_image,
)
from r3dpa.io import only_writer
from r3dpa.simulation import SIMULATOR_VERSION, TRAIN_DRIVES, VAL_DRIVES, Simulator, split_scans


@dataclass(frozen=True, order=True)
class SimulatedImage:
    """Range image of scan ``number`` of a simulated drive.

    ``request`` is a checksum of all that it depends on beside these, ``path`` the folder of the
    cache.
    """

    drive: str
    number: int
    request: int
    path: Path = field(compare=False)

    @property
    def name(self) -> str:
        """``drive/number``."""
        return f"{self.drive}/{self.number:010d}"

    @property
    def cache_key(self) -> ItemKey:
        """Name and request, in the place of the size of a file."""
        return self.name, self.request, 0


class SimulatedImageDataModule(SimulatedDataModule):
    """Simulated streets whose range images are cached in float16, 131 kB each; points are dropped.

    Images are made before the first use, and so are feature grids if there is an extractor: those
    that are missing only. Ranges are rounded to 11 bits, 1 cm at 20 m.

    Args:
        root: Folder of the caches.
        every: Take every this many scans of a drive; neighbours are 0.1 s apart.
        kwargs: Arguments of :class:`SimulatedDataModule`; only ``projection: spherical``.
    """

    def __init__(self, root: str, every: int = 1, **kwargs: Any) -> None:
        super().__init__(root, **kwargs)
        at_least(1, every=every)
        if self.projection_kind != "spherical":
            raise ValueError("projection must be spherical: the points are not kept to fit rings")
        self.every = every

    def split(self) -> tuple[list[Any], list[Any]]:
        """Images of the official training and validation drives."""
        counts = split_scans(self.num_scans, (*TRAIN_DRIVES, *VAL_DRIVES))
        store = self._store
        request = crc32(store.settings.encode())
        train, val = (
            [
                SimulatedImage(drive, number * self.every, request, store.folder)
                for drive in drives
                for number in range(counts.get(drive, 0))
            ]
            for drives in (TRAIN_DRIVES, VAL_DRIVES)
        )
        return train, val

    def prepare_data(self) -> None:
        """Simulate what is missing, and make its feature grids."""
        train, val, projection = self._scans_and_projection()
        stores = [self._store]
        if self.features_dir is not None and self.extractor is not None:
            extractor = cast(Any, self.extractor.eval())
            stores.append(
                GridSettings.of(extractor, projection, self.grid_size).store(self.features_dir)
            )
        with only_writer(Path(self.root) / ".lock", f"simulates into {self.root}", wait=True):
            lacking: set[Any] = {item for store in stores for item in store.missing(train + val)}
            if lacking:
                self._simulate(sorted(lacking), projection, stores)

    @cached_property
    def images(self) -> CachedTensors[Any]:
        """Cached range images ``(H, W)`` in metres."""
        train, val, _ = self._scans_and_projection()
        return CachedTensors(self._store, sorted(train + val))

    def points(self, scan: Any) -> torch.Tensor:
        """Points ``(P, 3)`` at the centres of the pixels."""
        return points_of(self.images.read(scan), SphericalProjection(self.sensor))

    @property
    def _store(self) -> Store:
        request = {
            "simulator_version": SIMULATOR_VERSION,
            "seed": self.simulation_seed,
            "sensor": self.simulation_sensor,
            "effects": self.effects,
            "weather": None if self.weather is None else asdict(self.weather),
            "projection": projection_to_dict(SphericalProjection(self.sensor)),
        }
        shape = (self.sensor.beams, self.sensor.columns)
        request = json.loads(json.dumps(request))
        return tensor_cache(Path(self.root), "range_image", request, shape, "float16")

    def _simulate(
        self, items: Sequence[SimulatedImage], projection: Projection, stores: Sequence[Store]
    ) -> None:
        extractor: Any = self.extractor if len(stores) > 1 else None
        rank_zero_info(f"simulating {len(items)} range images into {self.root}")
        simulators = {
            drive: Simulator(
                self.simulation_seed,
                int(drive),
                self.weather,
                self.simulation_sensor,
                self.effects,
            )
            for drive in (*TRAIN_DRIVES, *VAL_DRIVES)
        }
        prepare = None if extractor is None else extractor.prepare
        loader = DataLoader(
            _Simulated(items, simulators, projection, prepare),
            batch_size=8,
            collate_fn=list,
            num_workers=self.num_workers,
            generator=torch.Generator(),  # the default draws from the global random state
        )
        with ExitStack() as stack:
            images, *grids = [stack.enter_context(store.writer()) for store in stores]
            for samples in tqdm(loader, desc="simulate", unit_scale=8, unit="scan", disable=None):
                keys = [sample.key for sample, _ in samples]
                images.add(keys, torch.stack([range_m for _, range_m in samples]))
                for writer in grids:
                    found = [sample for sample, _ in samples]
                    made = pooled_grids(extractor, found, projection, [self.grid_size])
                    writer.add(keys, made[self.grid_size])


class _Simulated(Dataset[Any]):
    """Points, prepared for an extractor if there is one, and range image of each scan."""

    def __init__(
        self,
        items: Sequence[SimulatedImage],
        simulators: dict[str, Simulator],
        projection: Projection,
        prepare: Any,
    ) -> None:
        self.items, self.simulators = items, simulators
        self.projection, self.prepare = projection, prepare

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, index: int) -> tuple[PointSample, torch.Tensor]:
        item = self.items[index]
        points = torch.from_numpy(self.simulators[item.drive].scan(item.number).points)
        range_m, _ = range_image(points[:, :3], self.projection)
        prepared = None if self.prepare is None else self.prepare(points)
        return PointSample(cast(Any, item), item.cache_key, points, prepared), range_m

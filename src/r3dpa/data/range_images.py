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

import numpy as np
import torch
from lightning.pytorch.utilities.rank_zero import rank_zero_info
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from lidarsim import SIMULATOR_VERSION, TRAIN_DRIVES, VAL_DRIVES, Simulator, split_scans
from r3dpa.data.datamodules import SimulatedDataModule
from r3dpa.data.datasets import PointSample
from r3dpa.data.feature_grids import GridSettings, pooled_grids
from r3dpa.data.loaders import at_least
from r3dpa.data.pixel_codes import decode_pixels, encode_pixels
from r3dpa.data.store import CachedTensors, ItemKey, Store, tensor_cache
from r3dpa.geometry import (
    SEMANTIC_CLASSES,
    Pixels,
    Projection,
    SphericalProjection,
    points_of,
    project_pixels,
    projection_to_dict,
)
from r3dpa.io import only_writer


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


@dataclass(frozen=True)
class CachedPixels:
    """Images of a cache: of ranges alone in float16, else in the codes of ``pixel_codes``."""

    rows: CachedTensors[Any]
    range_max_m: float

    def read(self, image: SimulatedImage, /) -> Pixels:
        """Pixels ``(H, W)`` of an image."""
        row = self.rows.read(image)
        coded = self.rows.store.dtype == "uint8"
        return decode_pixels(row, self.range_max_m) if coded else Pixels(row)


class SimulatedImageDataModule(SimulatedDataModule):
    """Simulated streets whose range images are cached in float16, 131 kB each; points are dropped.

    Images are made before the first use, and so are feature grids if there is an extractor: those
    that are missing only. Ranges are rounded to 11 bits, 1 cm at 20 m. Where the codec has channels
    of intensity or class, both are cached beside the range: 197 kB each.

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
    def images(self) -> CachedPixels:
        """Cached images of all scans."""
        train, val, _ = self._scans_and_projection()
        rows = CachedTensors(self._store, sorted(train + val))
        return CachedPixels(rows, self.sensor.range_max_m)

    def points(self, scan: Any) -> torch.Tensor:
        """Points ``(P, 3)`` at the centres of the pixels."""
        return points_of(self.images.read(scan).range_m, SphericalProjection(self.sensor))

    @property
    def _with_values(self) -> bool:
        """Whether intensity and class are cached beside the range."""
        return self.codec.intensity_channel or self.codec.num_classes > 0

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
        root, request = Path(self.root), json.loads(json.dumps(request))
        if not self._with_values:
            return tensor_cache(root, "range_image", request, shape, "float16")
        request["classes"] = [list(semantic.labels) for semantic in SEMANTIC_CLASSES]
        return tensor_cache(root, "labelled_image", request, (3, *shape), "uint8")

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
            _Simulated(items, simulators, projection, prepare, self._with_values),
            batch_size=8,
            collate_fn=list,
            num_workers=self.num_workers,
            generator=torch.Generator(),  # the default draws from the global random state
        )
        with ExitStack() as stack:
            images, *grids = [stack.enter_context(store.writer()) for store in stores]
            for samples in tqdm(loader, desc="simulate", unit_scale=8, unit="scan", disable=None):
                keys = [sample.key for sample, _ in samples]
                images.add(keys, torch.stack([row for _, row in samples]))
                for writer in grids:
                    found = [sample for sample, _ in samples]
                    made = pooled_grids(extractor, found, projection, [self.grid_size])
                    writer.add(keys, made[self.grid_size])


class _Simulated(Dataset[Any]):
    """Points, prepared for an extractor if there is one, and row of the cache of each scan."""

    def __init__(
        self,
        items: Sequence[SimulatedImage],
        simulators: dict[str, Simulator],
        projection: Projection,
        prepare: Any,
        with_values: bool,
    ) -> None:
        self.items, self.simulators = items, simulators
        self.projection, self.prepare = projection, prepare
        self.with_values = with_values

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, index: int) -> tuple[PointSample, torch.Tensor]:
        item = self.items[index]
        scan = self.simulators[item.drive].scan(item.number)
        points, labels = torch.from_numpy(scan.points), torch.from_numpy(np.int64(scan.labels))
        pixels = project_pixels(points, self.projection, labels)
        row = pixels.range_m
        if self.with_values:
            row = encode_pixels(pixels, self.projection.sensor.range_max_m)
        prepared = None if self.prepare is None else self.prepare(points)
        return PointSample(cast(Any, item), item.cache_key, points, prepared), row

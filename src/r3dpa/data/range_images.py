"""Simulated scans as cached range images, for training sets too large to keep their points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import torch
from lightning.pytorch.utilities.rank_zero import rank_zero_info
from torch import Tensor
from torch.utils.data import Dataset
from tqdm import tqdm

from lidarsim import (
    SIMULATOR_VERSION,
    TRAIN_DRIVES,
    VAL_DRIVES,
    Simulator,
    load_sensor,
    split_scans,
)
from lidarsim.sensors import PRESETS
from r3dpa.data.datamodules import SimulatedDataModule
from r3dpa.data.loaders import at_least, plain_loader
from r3dpa.data.store import CachedTensors, ItemKey, Store, tensor_cache
from r3dpa.geometry import (
    EMPTY_RANGE_M,
    NUM_CLASSES,
    SEMANTIC_CLASSES,
    UNKNOWN_CLASS,
    Pixels,
    Projection,
    points_of,
    project_pixels,
    projection_to_dict,
)
from r3dpa.io import json_values, only_writer

_SCANS_PER_BATCH = 8  # that are simulated between two writes
# Three bytes per pixel: 13 bits for the range, 4 for the class, 7 for the intensity.
_RANGES, _CLASSES, _INTENSITIES = 1 << 13, 1 << 4, 1 << 7
_HUNDREDTHS = 100  # the steps of the intensities of KITTI and of the simulator
assert NUM_CLASSES < _CLASSES


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
    """Images of a cache: of ranges alone in float16, else in the codes of :func:`encode_pixels`."""

    rows: CachedTensors[SimulatedImage]
    projection: Projection

    def read(self, image: SimulatedImage, /) -> Pixels:
        """Pixels ``(H, W)`` of an image."""
        row = self.rows.read(image)
        coded = self.rows.store.dtype == "uint8"
        return decode_pixels(row, self.projection.sensor.range_max_m) if coded else Pixels(row)


class SimulatedImageDataModule(SimulatedDataModule):
    """Simulated streets whose range images are cached in float16, 131 kB each; points are dropped.

    Images are made before the first use: only what is missing, eight scans between two writes. A
    larger ``num_scans`` adds to the images of an earlier run. Ranges are rounded to 11 bits, 1 cm
    at 20 m. Where the codec has channels of intensity, reflectance or class, intensity and class
    are cached beside the range, 197 kB each. Feature grids are made of the points of these pixels,
    so that an extractor that comes later needs no simulation.

    Args:
        root: Folder of the caches.
        every: Stride in scans of a drive; neighbours are 0.1 s apart.
        columns: Not read, but named by the configurations of earlier runs.
        kwargs: Arguments of :class:`SimulatedDataModule`, without ``projection: rings``.
    """

    def __init__(self, root: str, every: int = 1, columns: None = None, **kwargs: Any) -> None:
        super().__init__(root, **kwargs)
        at_least(1, every=every)
        if self.projection_kind == "rings":
            raise ValueError("projection must not be rings: the points are not kept to fit them")
        if self.extractor is not None and not self.has_values:
            raise ValueError(
                "an extractor reads intensities, but ranges alone are cached: give the codec a "
                "channel of intensity or class (--data.init_args.codec.intensity_channel true), or "
                "keep the scans (r3dpa.data.SimulatedDataModule)"
            )
        self.every = every

    def split(self) -> tuple[list[Any], list[Any]]:
        """Images of the official training and validation drives."""
        counts = split_scans(self.num_scans, (*TRAIN_DRIVES, *VAL_DRIVES))
        store = self._store
        request = crc32(store.settings.encode())

        def images_of(drives: Sequence[str]) -> list[Any]:
            return [
                SimulatedImage(drive, number * self.every, request, store.folder)
                for drive in drives
                for number in range(counts.get(drive, 0))
            ]

        return images_of(TRAIN_DRIVES), images_of(VAL_DRIVES)

    def simulate(self) -> None:
        """Simulate the images that are missing."""
        train, val = self.limited_split()
        images: list[Any] = sorted(train + val)
        with only_writer(Path(self.root) / ".lock", f"simulates into {self.root}", wait=True):
            if missing := self._store.missing(images):
                self._simulate(missing)

    @cached_property
    def images(self) -> CachedPixels:
        """Cached images of all scans."""
        train, val = self.limited_split()
        images: list[Any] = sorted(train + val)
        return CachedPixels(CachedTensors(self._store, images), self.known_projection)

    def points(self, scan: Any) -> Tensor:
        """Points ``(P, 3)`` at the centres of the pixels."""
        return points_of(self.images.read(scan).range_m, self.known_projection)

    @property
    def image_bytes(self) -> int:
        """Size of a cached image."""
        return self._store.row_bytes

    @property
    def has_values(self) -> bool:
        """Whether intensity and class are cached beside the range."""
        codec = self.codec
        return codec.reflectance or codec.intensity_channel or codec.num_classes > 0

    @property
    def _sensor_values(self) -> Any:
        """Name of a preset, or what the file of a sensor says now."""
        if self.simulation_sensor in PRESETS:
            return self.simulation_sensor
        return json_values(asdict(load_sensor(self.simulation_sensor)))

    @property
    def _store(self) -> Store:
        request: dict[str, Any] = {
            "simulator_version": SIMULATOR_VERSION,
            "seed": self.simulation_seed,
            "sensor": self._sensor_values,
            "effects": self.effects,
            "weather": None if self.weather is None else asdict(self.weather),
            "projection": projection_to_dict(self.known_projection),
        }
        shape = (self.sensor.beams, self.sensor.columns)
        if not self.has_values:
            return tensor_cache(Path(self.root), "range_image", request, shape, "float16")
        request["classes"] = [list(semantic.labels) for semantic in SEMANTIC_CLASSES]
        return tensor_cache(Path(self.root), "labelled_image", request, (3, *shape), "uint8")

    def _simulate(self, items: Sequence[SimulatedImage]) -> None:
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
        dataset = _Simulated(items, simulators, self.known_projection, self.has_values)
        loader = plain_loader(dataset, _SCANS_PER_BATCH, self.num_workers, collate_fn=list)
        with self._store.writer() as writer:
            for batch in tqdm(
                loader, desc="simulate", unit_scale=_SCANS_PER_BATCH, unit="scan", disable=None
            ):
                keys, rows = zip(*batch, strict=True)
                writer.add(keys, torch.stack(rows))


@dataclass(eq=False, repr=False)
class _Simulated(Dataset[tuple[ItemKey, Tensor]]):
    """Key and row of the cache of each scan."""

    items: Sequence[SimulatedImage]
    simulators: dict[str, Simulator]
    projection: Projection
    with_values: bool

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, index: int) -> tuple[ItemKey, Tensor]:
        item = self.items[index]
        scan = self.simulators[item.drive].scan(item.number)
        points, labels = torch.from_numpy(scan.points), torch.from_numpy(np.int64(scan.labels))
        pixels = project_pixels(points, self.projection, labels)
        row = pixels.range_m
        if self.with_values:
            row = encode_pixels(pixels, self.projection.sensor.range_max_m)
        return item.cache_key, row


def encode_pixels(pixels: Pixels, range_max_m: float) -> Tensor:
    """Codes ``(3, H, W)`` uint8 of the pixels ``(H, W)`` of one scan, intensity and class given.

    Ranges are rounded in equal steps of ``log2(1 + range)``, 1 cm at 20 m for ``range_max_m`` 56;
    intensities to hundredths.
    """
    range_m, intensity, classes = pixels
    assert intensity is not None
    assert classes is not None
    largest = math.log2(1 + range_max_m)
    steps = (1 + range_m.double().clamp(min=0)).log2() / largest * (_RANGES - 2)
    ranges = torch.where(range_m > 0, 1 + steps.round(), 0).long()  # 0: no return
    hundredths = (intensity.clamp(0, 1) * _HUNDREDTHS).round().long()
    codes = (ranges * _CLASSES + classes.long() + 1) * _INTENSITIES + hundredths
    return torch.stack([codes >> 16, codes >> 8 & 0xFF, codes & 0xFF]).to(torch.uint8)


def decode_pixels(codes: Tensor, range_max_m: float) -> Pixels:
    """Inverse of :func:`encode_pixels`, to rounding."""
    high, middle, low = codes.int()
    codes = (high << 16) + (middle << 8) + low
    ranges = codes // (_CLASSES * _INTENSITIES)
    classes = codes // _INTENSITIES % _CLASSES + UNKNOWN_CLASS
    intensity = (codes % _INTENSITIES).float() / _HUNDREDTHS
    return Pixels(_range_table(range_max_m)[ranges], intensity, classes.long())


def _range_table(range_max_m: float) -> Tensor:
    """Metres, float32, by the code of a range."""
    steps = torch.arange(_RANGES - 1, dtype=torch.float64) / (_RANGES - 2)
    range_m = torch.exp2(steps * math.log2(1 + range_max_m)) - 1
    return torch.cat([torch.tensor([EMPTY_RANGE_M]), range_m.float()])

"""What is computed once from each scan and kept on disk: range images, posteriors of a frozen VAE.

Each kind has a folder of its own for each set of settings, whose hash is part of the name: other
settings find another folder, never a wrong row. Folders of settings that nobody uses any more may
be deleted. Letters: H x W image size.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from r3dpa.atomic import atomic_path
from r3dpa.data.datasets import LidarDataset
from r3dpa.data.row_store import RowReader, Rows, RowWriter
from r3dpa.data.scans import Scan
from r3dpa.geometry import Projection, RangeCodec, projection_to_dict

_FLOAT_BYTES = 4
_VERSION = 1  # to be raised when other numbers come out of the same settings


class ScanCacheError(ValueError):
    """A cache that lacks a scan, is damaged or cannot be written; the message says the remedy."""


_ROWS = Rows(
    "cached tensors",
    "folder for the cache",
    "rows again by starting the run again",
    ScanCacheError,
)


class CachedTensors:
    """One float32 tensor per scan, read from disk; safe to hand to loader processes.

    Args:
        cache: Where they are.
        scans: Scans that will be asked for.

    Raises:
        ScanCacheError: If one is missing.
    """

    def __init__(self, cache: ScanCache, scans: Sequence[Scan]) -> None:
        self.shape, self._folder = cache.shape, cache.folder
        names = {scan.name for scan in scans}
        self._reader = RowReader(cache.folder, cache.row_bytes, _ROWS, names)
        if missing := names - {key[0] for key in self._reader.places}:
            raise ScanCacheError(
                f"{cache.folder} lacks {len(missing)} of {len(names)} scans, such as "
                f"{min(missing)}: start the run again, which adds them."
            )

    def read(self, scan: Scan) -> Tensor:
        """Tensor of one scan, a copy.

        Raises:
            ScanCacheError: If the scan was not given to the constructor, or its file was changed
                since the tensor was made.
        """
        found = self._reader.find(_key(scan))
        if found is None:
            raise ScanCacheError(
                f"{scan.path} was replaced after {self._folder} was made, or is no scan of this "
                "data set: start the run again, which adds it."
            )
        mapping, start = found
        values = torch.frombuffer(
            mapping, dtype=torch.float32, count=math.prod(self.shape), offset=start
        )
        return values.reshape(self.shape).clone()


@dataclass(frozen=True)
class ScanCache:
    """Place of one float32 tensor per scan.

    Args:
        root: Folder of caches.
        name: Kind, the first part of the folder's name.
        settings: All that the tensors depend on beside the scan, as JSON values.
        shape: Shape of each tensor.
    """

    root: Path
    name: str
    settings: Mapping[str, Any]
    shape: tuple[int, ...]

    @property
    def folder(self) -> Path:
        """``root/<name>_<hash of settings, shape and version>``."""
        return self.root / f"{self.name}_{hashlib.sha256(self._about.encode()).hexdigest()[:16]}"

    @property
    def row_bytes(self) -> int:
        """Disk space of one tensor."""
        return _FLOAT_BYTES * math.prod(self.shape)

    @property
    def _about(self) -> str:
        values = {"version": _VERSION, "shape": self.shape, "settings": self.settings}
        return json.dumps(values, indent=1, sort_keys=True)

    def missing(self, scans: Sequence[Scan]) -> list[Scan]:
        """Those of the scans that have no tensor.

        Raises:
            ScanCacheError: If the cache is damaged.
        """
        known = _ROWS.places(self.folder, self.row_bytes).keys()
        return [scan for scan in scans if _key(scan) not in known]

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lets one process at a time fill the cache; another one waits.

        Raises:
            ScanCacheError: If the folder cannot be written.
        """
        with _ROWS.lock(self.folder, f"waiting for another process that fills {self.folder}"):
            yield

    @contextmanager
    def writer(self, shard: int = 0) -> Iterator[Callable[[Sequence[Scan], Tensor], None]]:
        """Function ``(scans, tensors (B, *shape))`` that appends to a shard of this process.

        Any number of processes may write at once. Scans that are there are left out; what was
        appended before an error or a kill stays.

        Raises:
            ScanCacheError: If the folder cannot be written or is damaged, or a tensor is not
                finite, which would break a training step in every epoch; names the scan.
        """
        about = self.folder / "settings.json"
        with _ROWS.writing(self.folder), atomic_path(about) as temporary:
            temporary.write_text(self._about)
        writer = RowWriter(self.folder, self.row_bytes, _ROWS, shard)

        def add(scans: Sequence[Scan], tensors: Tensor) -> None:
            if tuple(tensors.shape) != (len(scans), *self.shape):
                raise ValueError(
                    f"tensors must be {(len(scans), *self.shape)}, got {tuple(tensors.shape)}"
                )
            keys = [_key(scan) for scan in scans]
            if new := writer.new(keys):
                finite = tensors[new].isfinite().flatten(1).all(dim=1).tolist()
                for place, sound in zip(new, finite, strict=True):
                    if not sound:
                        raise ScanCacheError(
                            f"{scans[place].path}: what is kept of it as {self.name} is not "
                            "finite; look at it with `r3dpa check`, and leave it out or, if it is "
                            "sound, train in fp32 or without the cache"
                        )
                rows = tensors[new].float().cpu().contiguous().numpy().astype("<f4", copy=False)
                writer.add([keys[place] for place in new], rows.tobytes())

        try:
            yield add
        finally:
            writer.close()


def range_image_cache(root: str | Path, projection: Projection, codec: RangeCodec) -> ScanCache:
    """Place of the encoded range images ``(1, H, W)`` of a projection and codec."""
    settings = {"projection": projection_to_dict(projection), "codec": asdict(codec)}
    sensor = projection.sensor
    return ScanCache(Path(root), "range_images", settings, (1, sensor.beams, sensor.columns))


def write_range_images(
    scans: Sequence[Scan],
    projection: Projection,
    codec: RangeCodec,
    root: str | Path,
    *,
    workers: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Project the scans whose range images are missing; another process that does is waited for.

    Args:
        scans: Scans, of any number of drives.
        projection: Points to pixels.
        codec: Metres to [-1, 1].
        root: Folder of caches.
        workers: Processes that project; 0 for none.
        progress: Called after each scan with the number of scans done and the number to do.

    Returns:
        Number of range images made.

    Raises:
        ScanCacheError: If the cache cannot be written or is damaged.
        ScanError: If a scan cannot be used; the message names the file.
    """
    cache = range_image_cache(root, projection, codec)
    if not cache.missing(scans):
        return 0  # a complete cache may lie on a read-only disk
    with cache.lock():
        todo = cache.missing(scans)  # another process may have made some
        loader = DataLoader(
            LidarDataset(todo, projection, codec),
            batch_size=8,
            num_workers=workers,
            generator=torch.Generator(),  # the default draws from the global random state
        )
        done = 0
        with cache.writer() as add:
            for batch in loader:
                add([todo[index] for index in batch["index"].tolist()], batch["range_image"])
                for _ in batch["name"]:
                    done += 1
                    if progress is not None:
                        progress(done, len(todo))
    return done


def _key(scan: Scan) -> tuple[str, int, int]:
    """What a row is found by: a file that was written anew has another time, if not another size.

    A copied file has another time as well: its row is made again, which is cheap here.
    """
    return scan.name, scan.num_bytes, scan.path.stat().st_mtime_ns

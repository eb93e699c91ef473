"""One float32 tensor for each scan or image, computed once and kept on disk.

Each kind has a folder of its own for each set of settings, whose hash is part of the name: other
settings find another folder, never a wrong row. Folders of settings that nobody uses any more may
be deleted.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from r3dpa.data.row_store import RowKey, RowReader, Rows, RowWriter
from r3dpa.io import atomic_path

__all__ = ["Cacheable", "CachedTensors", "TensorCache", "TensorCacheError"]

_FLOAT_BYTES = 4
_VERSION = 1  # to be raised when other numbers come out of the same settings


class TensorCacheError(ValueError):
    """A cache that lacks a tensor, is damaged or cannot be written; the message says the remedy."""


_ROWS = Rows(
    "cached tensors",
    "folder for the cache",
    "rows again by starting the run again",
    TensorCacheError,
)


class Cacheable(Protocol):
    """What a tensor may be kept of."""

    @property
    def name(self) -> str:
        """Unique within the data set."""

    @property
    def path(self) -> Path:
        """File that holds it, for messages."""

    @property
    def cache_key(self) -> RowKey:
        """Name, and what tells that the file was replaced."""


Item = TypeVar("Item", bound=Cacheable)


class CachedTensors(Generic[Item]):
    """One float32 tensor per item, read from disk; safe to hand to loader processes.

    Args:
        cache: Where they are.
        items: Items that will be asked for.

    Attributes:
        cache: As given.
        items: As given.

    Raises:
        TensorCacheError: If one is missing.
    """

    def __init__(self, cache: TensorCache[Item], items: Sequence[Item]) -> None:
        self.cache, self.items = cache, list(items)
        names = {item.name for item in items}
        self._reader = RowReader(cache.folder, cache.row_bytes, _ROWS, names)
        if missing := names - {key[0] for key in self._reader.places}:
            raise TensorCacheError(
                f"{cache.folder} lacks {len(missing)} of {len(names)}, such as {min(missing)}: "
                "start the run again, which adds them."
            )

    def read(self, item: Item) -> Tensor:
        """Tensor of one item, a copy.

        Raises:
            TensorCacheError: If the item was not given to the constructor, or its file was
                replaced since the tensor was made.
        """
        found = self._reader.find(item.cache_key)
        if found is None:
            raise TensorCacheError(
                f"{item.path} was replaced after {self.cache.folder} was made, or {item.name} is "
                "not of this data set: start the run again, which adds it."
            )
        mapping, start = found
        shape = self.cache.shape
        values = np.frombuffer(mapping, "<f4", count=math.prod(shape), offset=start)
        return torch.from_numpy(values.reshape(shape).copy())


@dataclass(frozen=True)
class TensorCache(Generic[Item]):
    """Place of one float32 tensor per item.

    Args:
        root: Folder of caches.
        name: Kind, the first part of the folder's name.
        settings: All that the tensors depend on beside the item, as JSON values.
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

    def missing(self, items: Sequence[Item]) -> list[Item]:
        """Those of the items that have no tensor.

        Raises:
            TensorCacheError: If the cache is damaged.
        """
        known = _ROWS.places(self.folder, self.row_bytes).keys()
        return [item for item in items if item.cache_key not in known]

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lets one process at a time fill the cache; another one waits.

        Raises:
            TensorCacheError: If the folder cannot be written.
        """
        with _ROWS.lock(self.folder, f"waiting for another process that fills {self.folder}"):
            yield

    @contextmanager
    def writer(self, shard: int = 0) -> Iterator[Callable[[Sequence[Item], Tensor], None]]:
        """Function ``(items, tensors (B, *shape))`` that appends to a shard of this process.

        Any number of processes may write at once. Items that are there are left out; what was
        appended before an error or a kill stays.

        Raises:
            TensorCacheError: If the folder cannot be written or is damaged, or a tensor is not
                finite, which would break a training step in every epoch; names the item.
        """
        self.write("settings.json", self._about)
        writer = RowWriter(self.folder, self.row_bytes, _ROWS, shard)

        def add(items: Sequence[Item], tensors: Tensor) -> None:
            if tuple(tensors.shape) != (len(items), *self.shape):
                raise ValueError(
                    f"tensors must be {(len(items), *self.shape)}, got {tuple(tensors.shape)}"
                )
            keys = [item.cache_key for item in items]
            if new := writer.new(keys):
                finite = tensors[new].isfinite().flatten(1).all(dim=1).tolist()
                for place, sound in zip(new, finite, strict=True):
                    if not sound:
                        raise TensorCacheError(
                            f"{items[place].path}: what is kept of {items[place].name} as "
                            f"{self.name} is not finite; look at the file (`r3dpa check` for "
                            "scans), and leave it out"
                        )
                rows = tensors[new].float().cpu().contiguous().numpy().astype("<f4", copy=False)
                writer.add([keys[place] for place in new], rows.tobytes())

        try:
            yield add
        finally:
            writer.close()

    def write(self, name: str, text: str) -> None:
        """Writes a text file beside the rows.

        Raises:
            TensorCacheError: If the folder cannot be written.
        """
        with _ROWS.writing(self.folder), atomic_path(self.folder / name) as temporary:
            temporary.write_text(text)

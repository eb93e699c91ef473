"""Tensors on disk, one row per scan or image, appended by any process.

A store is a folder::

    settings.json        all that the rows depend on
    shard_00000.rows     rows of fixed size
    shard_00000.jsonl    journal: {"scan": name, "bytes": size, "mtime_ns": time, "row": i} per row

A line of the journal is written after its row is on disk; rows without a line and an incomplete
last line are ignored. Every writer makes a shard of its own. A row belongs to the name, size and
time of change of its file.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from lidarsim.cloud_formats import DataError
from r3dpa.io import Journal, append, refuse_name, write_text

ItemKey = tuple[str, int, int]
"""Name, size in bytes and time of change (ns) of the file that a row is made from."""
_VERSION = 1  # to be raised when the same settings give other numbers
_DTYPES: dict[str, np.dtype[Any]] = {
    "float16": np.dtype("<f2"),
    "float32": np.dtype("<f4"),
    "uint8": np.dtype("u1"),
}
_TORCH_DTYPES = {"float16": torch.float16, "float32": torch.float32, "uint8": torch.uint8}


class StoreError(DataError):
    """A row that is missing, or a store that is damaged or cannot be written."""


class Cacheable(Protocol):
    """Scan or image that a row is made of."""

    @property
    def name(self) -> str:
        """Unique name."""

    @property
    def path(self) -> Path:
        """File that error messages name."""

    @property
    def cache_key(self) -> ItemKey:
        """Name, size in bytes and time of change of the file."""


Item = TypeVar("Item", bound=Cacheable)


@dataclass(frozen=True)
class Store:
    """Store of one tensor of ``shape`` per item."""

    folder: Path
    settings: str  #: all that the tensors depend on beside the item, as JSON text
    shape: tuple[int, ...]
    dtype: Literal["float32", "float16", "uint8"] = "float32"  #: float16 clamps larger values
    what: str = "cached tensors"  #: name of the rows, and how they are made again, for messages
    remedy: str = "by starting the run again"

    @property
    def row_bytes(self) -> int:
        """Size of a row in bytes."""
        return math.prod(self.shape) * _DTYPES[self.dtype].itemsize

    def rows(self, shard: int) -> Path:
        """File of the rows of a shard."""
        return self.folder / f"shard_{shard:05d}.rows"

    def places(self) -> dict[ItemKey, tuple[int, int]]:
        """Shard and row of each key.

        Raises:
            StoreError: If a journal is damaged.
        """
        places: dict[ItemKey, tuple[int, int]] = {}
        for path in sorted(self.folder.glob("shard_*.jsonl")):
            shard = int(path.stem.removeprefix("shard_"))
            places.update((key, (shard, row)) for row, key in enumerate(self._keys(path)))
        return places

    def missing(self, items: Sequence[Item]) -> list[Item]:
        """Items without a row.

        Raises:
            StoreError: If a journal is damaged.
        """
        places = self.places()
        return [item for item in items if item.cache_key not in places]

    def writer(self, shard: int = 0) -> StoreWriter:
        """Writer of a new shard, the first free one from this number on."""
        return StoreWriter(self, shard)

    def damaged(self, journal: Path, what: str) -> StoreError:
        """Error that names a shard, what is wrong, and the remedy."""
        rows = journal.with_suffix(".rows")
        return StoreError(
            f"{what}: delete {journal} and {rows.name} beside it, and make their {self.what} "
            f"again {self.remedy}"
        )

    def _keys(self, path: Path) -> list[ItemKey]:
        """Keys of the rows of a shard in order, from its journal."""
        rows = path.with_suffix(".rows")
        keys: list[ItemKey] = []
        try:
            for entry in Journal(path).read():
                where = f"line {len(keys) + 1}"
                if entry["row"] != len(keys):
                    raise ValueError(f"{where} is of row {entry['row']}")
                if reason := refuse_name(entry["scan"]):
                    raise ValueError(f"name of scan in {where} {reason}")
                num_bytes, time = entry["bytes"], entry["mtime_ns"]
                if not isinstance(num_bytes, int) or not isinstance(time, int):
                    raise TypeError(f"size or time in {where} is no whole number")
                keys.append((entry["scan"], num_bytes, time))
            if keys and rows.stat().st_size < len(keys) * self.row_bytes:
                raise ValueError(f"{rows.name} has fewer than its {len(keys)} rows")
        except (LookupError, TypeError, ValueError, RecursionError, OSError) as error:
            raise self.damaged(path, f"{path} is damaged ({error!r:.200})") from error
        return keys


@contextmanager
def writing(what: str, folder: Path) -> Iterator[None]:
    """Turn an ``OSError`` of the block into a ``StoreError`` that names the folder."""
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"{what} cannot be written to {folder} ({error.strerror}): give a folder "
            "on a disk that can be written and has space"
        ) from error


def tensor_cache(
    root: Path,
    name: str,
    settings: Mapping[str, Any],
    shape: tuple[int, ...],
    dtype: Literal["float32", "float16", "uint8"] = "float32",
) -> Store:
    """Store of tensors whose folder ``root/<name>_<hash>`` follows from its settings.

    ``settings`` are all that the tensors depend on beside the item, as JSON values.
    """
    about = {"version": _VERSION, "shape": shape, "settings": settings}
    text = json.dumps(about, indent=1, sort_keys=True)
    folder = root / f"{name}_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    return Store(folder, text, shape, dtype)


class StoreWriter:
    """Appends rows to a shard of its own, the first free one from ``shard`` on; a context manager.

    Raises:
        StoreError: If the store is damaged or cannot be written.
    """

    def __init__(self, store: Store, shard: int = 0) -> None:
        self._store, self._shard = store, shard
        self._files: tuple[FileIO, Journal] | None = None
        self._num_rows = 0
        self._known = set(store.places())
        settings = store.folder / "settings.json"
        if not settings.exists():
            with writing(store.what, store.folder):
                write_text(settings, store.settings)

    def add(self, keys: Sequence[ItemKey], tensors: Tensor) -> None:
        """Append rows ``(B, *shape)`` of those keys that the store lacks, and flush them to disk.

        The B keys must be taken before the files are read.

        Raises:
            StoreError: If the disk cannot be written, or a tensor is not finite.
            ValueError: For tensors of another shape.
        """
        expected = (len(keys), *self._store.shape)
        if tuple(tensors.shape) != expected:
            raise ValueError(f"{self._store.what} must be {expected}, got {tuple(tensors.shape)}")
        new = {key: row for row, key in enumerate(keys) if key not in self._known}
        if not new:
            return
        rows_to_add = tensors[list(new.values())].cpu()
        finite = rows_to_add.isfinite().flatten(1).all(dim=1).tolist()
        if not all(finite):
            name = list(new)[finite.index(False)][0]
            raise StoreError(f"{self._store.what} of {name} are not finite; leave this file out")
        lines = [
            {"scan": name, "bytes": size, "mtime_ns": time, "row": row}
            for row, (name, size, time) in enumerate(new, start=self._num_rows)
        ]
        if self._store.dtype == "float16":
            largest = torch.finfo(torch.float16).max
            rows_to_add = rows_to_add.clamp(-largest, largest)
        # Torch converts half precision eight times as fast as NumPy.
        values = rows_to_add.to(_TORCH_DTYPES[self._store.dtype]).numpy()
        values = values.astype(_DTYPES[self._store.dtype], copy=False)  # little-endian
        with writing(self._store.what, self._store.folder):
            try:
                rows, journal = self._open()
                append(rows, values.tobytes())
                os.fdatasync(rows)
                journal.add(*lines)
            except BaseException:
                self.close()  # what is unfinished is at the end, and does not count
                raise
        self._num_rows += len(new)
        self._known |= new.keys()

    def close(self) -> None:
        """Close the files; rows added later go to another shard."""
        for file in self._files or ():
            file.close()
        self._files, self._num_rows = None, 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _open(self) -> tuple[FileIO, Journal]:
        """Rows and journal; without buffers, which would be written after an error."""
        shard = self._shard
        while self._files is None:
            rows = self._store.rows(shard)
            shard += 1
            with suppress(FileExistsError):
                file = rows.open("xb", buffering=0)
                self._files = file, Journal(rows.with_suffix(".jsonl"))
        return self._files


class CachedTensors(Generic[Item]):
    """Rows of a store by item, each of which must be there; safe to hand to loader processes.

    Raises:
        StoreError: If a row is missing, or the store is damaged.
    """

    def __init__(self, store: Store, items: Sequence[Item]) -> None:
        self.store, self.items = store, list(items)
        keys, places = [item.cache_key for item in items], store.places()
        self._files: dict[int, int] = {}  # descriptor by shard
        missing = [item for item, key in zip(items, keys, strict=True) if key not in places]
        if missing:
            raise self._missing(missing)
        self._places = {key: places[key] for key in keys}

    def read(self, item: Item) -> Tensor:
        """Copy ``shape`` of the row of one item, float32, or uint8 where these are stored.

        Raises:
            StoreError: If its file was replaced since the row was made, or the store was damaged.
        """
        place = self._places.get(item.cache_key)
        if place is None:
            raise self._missing([item])
        store, (shard, row) = self.store, place
        values = np.empty(store.shape, _DTYPES[store.dtype])
        try:
            if shard not in self._files:
                self._files[shard] = os.open(store.rows(shard), os.O_RDONLY)
                weakref.finalize(self, os.close, self._files[shard])
            # One read of the whole row: a map would be read page by page, and a page that was cut
            # off since would kill the process.
            num_read = os.preadv(self._files[shard], [values.data], row * values.nbytes)
        except FileNotFoundError:
            num_read = 0
        if num_read < values.nbytes:
            path = store.rows(shard)
            what = f"{path} is gone or was cut short since its journal was read"
            raise store.damaged(path.with_suffix(".jsonl"), what)
        tensor = torch.from_numpy(values)
        return tensor.float() if tensor.is_floating_point() else tensor

    def _missing(self, items: Sequence[Cacheable]) -> StoreError:
        more = f" and {len(items) - 1} more" if len(items) > 1 else ""
        return StoreError(
            f"no {self.store.what} of {items[0].path}{more} in {self.store.folder}, or the file "
            "was replaced or copied without its modification time; make the missing ones "
            f"{self.store.remedy}"
        )

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_files": {}}

"""Feature grids on disk: fixed-size rows that are memory-mapped, and a journal of what they are.

``features_dir`` belongs to one extractor. Each grid size has a store in ``features_dir/<h>x<w>``::

    settings.json        how the grids were made, see :class:`GridSettings`
    shard_00000.rows     one row of fixed size a grid, see :attr:`GridSettings.row`
    shard_00000.jsonl    journal: one line a row, {"scan": name, "bytes": of its file, "row": i}

A line is written when its row is on disk, so that a process killed at any moment leaves no wrong
grid: rows that the journal does not name and a torn last line do not count. Every writing process
has a shard of its own. The key of a grid is the name of the scan and the size of its file.
Letters: B batch, N = h * w cells, D feature width.
"""

from __future__ import annotations

import fcntl
import json
import logging
import math
import mmap
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import FileIO
from itertools import count
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

from r3dpa.data.grid_settings import (
    REMEDY,
    FeatureGridError,
    GridSettings,
    check_settings,
    compare_settings,
    made_otherwise,
    store_folder,
    stored_settings,
    wanted_settings,
    write_settings,
)
from r3dpa.data.scans import Scan
from r3dpa.geometry import Projection

if TYPE_CHECKING:
    from r3dpa.data.feature_grids import Extractor

_log = logging.getLogger(__name__)
_LARGEST_CODE = 127
_TORCH = {"<f2": torch.float16, "<f4": torch.float32, "|i1": torch.int8}


class FeatureGridWriter:
    """Appends grids to a shard of its own; a context manager, or to be closed.

    What a killed process left unfinished at the end of the shard is cut off. An error closes the
    writer; what was added before stays.

    Args:
        features_dir: Folder of one extractor; the store lies in a sub-folder by grid size.
        settings: How the grids are made; must be those of the store, if there is one.
        shard: Number of the shard; the next one that no other process writes, if that is taken.

    Attributes:
        shard: Number of the shard that is written.

    Raises:
        FeatureGridError: If the store was made with other settings, is damaged, or cannot be
            written.
    """

    def __init__(self, features_dir: str | Path, settings: GridSettings, shard: int = 0) -> None:
        self._shape, self._row = settings.shape, settings.row
        self._folder = store_folder(features_dir, settings.grid_size)
        with _writing(self._folder):
            with folder_lock(self._folder):
                check_settings(features_dir, settings)
                write_settings(features_dir, settings)
            self.shard, self._rows, self._journal = _take_shard(self._folder, shard)
        try:
            path = _journal_path(self._folder, self.shard)
            keys, length = _read_journal(path, self._row.itemsize)
            self._num_rows = len(keys)
            with _writing(self._folder):
                self._rows.truncate(self._num_rows * self._row.itemsize)
                self._journal.truncate(length)
            self._known = set(_read_places(self._folder, self._row.itemsize))
        except BaseException:
            self.close()
            raise

    def add(self, samples: Sequence[tuple[Scan, int]], grids: Tensor) -> None:
        """Append grids; those that the store had when it was opened, or has since, are left out.

        When this returns, the rows are on disk and other processes can read them.

        Args:
            samples: B scans, each with the size of its file in bytes.
            grids: ``(B, N, D)``, finite, on any device.

        Raises:
            FeatureGridError: If the disk is full or cannot be written; names the folder.
            ValueError: If the shapes do not fit each other or the settings.
        """
        if tuple(grids.shape) != (len(samples), *self._shape):
            raise ValueError(
                f"grids must be {(len(samples), *self._shape)}, got {tuple(grids.shape)}."
            )
        keys = [(scan.name, num_bytes) for scan, num_bytes in samples]
        new = {key: place for place, key in enumerate(keys) if key not in self._known}
        if not new:
            return
        rows = _packed(grids[list(new.values())].float().cpu().numpy(), self._row)
        lines = [
            json.dumps({"scan": name, "bytes": num_bytes, "row": row}) + "\n"
            for row, (name, num_bytes) in enumerate(new, start=self._num_rows)
        ]
        try:
            # Not through a memory map: a full disk is an error here and a killed process there.
            with _writing(self._folder):
                _append(self._rows, rows.tobytes())
                os.fdatasync(self._rows)
                _append(self._journal, "".join(lines).encode())
        except BaseException:
            self.close()  # whoever opens the shard next cuts off what is unfinished
            raise
        self._num_rows += len(new)
        self._known |= new.keys()

    def close(self) -> None:
        """Give the shard free; a second call does nothing."""
        if not self._rows.closed:
            fcntl.flock(self._rows, fcntl.LOCK_UN)  # loader processes still hold copies of it
            self._rows.close()
            self._journal.close()

    def __enter__(self) -> Self:
        """The writer itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close it."""
        self.close()


class FeatureGrids:
    """Grids of one size, read scan by scan; safe to hand to loader processes.

    Args:
        features_dir: Folder of one extractor.
        scans: Scans that will be asked for; each must have a grid.
        projection: That of the range images.
        grid_size: Rows and columns (h, w) of the grids.
        extractor: The extractor that must have made them; any if None.

    Attributes:
        dim: Width D of the features.

    Raises:
        FeatureGridError: If a grid is missing or was made with another sensor, projection, grid
            size or extractor, or if the store is damaged.
    """

    def __init__(
        self,
        features_dir: str | Path,
        scans: Sequence[Scan],
        projection: Projection,
        grid_size: tuple[int, int],
        extractor: Extractor | None = None,
    ) -> None:
        stored, size = stored_settings(features_dir), (grid_size[0], grid_size[1])
        if not stored:
            raise _missing(scans, Path(features_dir))
        if size not in stored:
            sizes = ", ".join(str(list(other)) for other in stored)
            raise made_otherwise("grid_size", sizes, list(size), Path(features_dir))
        self._folder, settings = store_folder(features_dir, size), stored[size]
        compare_settings(wanted_settings(projection, extractor), settings, self._folder)
        self.dim, self._row = settings.dim, settings.row
        places, wanted = _read_places(self._folder, self._row.itemsize), {s.name for s in scans}
        self._places = {key: place for key, place in places.items() if key[0] in wanted}
        missing = wanted - {name for name, _ in self._places}
        if missing:
            raise _missing([scan for scan in scans if scan.name in missing], self._folder)
        self._maps: dict[int, mmap.mmap] = {}

    def read(self, scan: Scan, num_bytes: int) -> Tensor:
        """Grid ``(N, D)`` float32 of one scan, cells row by row; empty cells are zero.

        Args:
            scan: One of the scans given to the constructor.
            num_bytes: Size of its file, by which a replaced scan is noticed.

        Raises:
            FeatureGridError: If the scan was not given to the constructor, or the grid was made
                from a file of another size.
        """
        place = self._places.get((scan.name, num_bytes))
        if place is None:
            raise self._replaced_or_missing(scan, num_bytes)
        shard, position = place
        start = position * self._row.itemsize
        mapping = self._mapped(shard)
        # Asked for as a whole: page by page, as they are touched, a disk is slower than one read.
        page_start = start // mmap.PAGESIZE * mmap.PAGESIZE
        mapping.madvise(mmap.MADV_WILLNEED, page_start, start - page_start + self._row.itemsize)

        def field(name: str) -> Tensor:
            assert self._row.fields is not None
            dtype, offset = self._row.fields[name][:2]
            kind, shape = dtype.subdtype or (dtype, ())
            values = torch.frombuffer(
                mapping, dtype=_TORCH[kind.str], count=math.prod(shape), offset=start + offset
            )
            return values.reshape(shape).float()

        if "values" in (self._row.names or ()):
            return field("values")
        return field("codes").mul_(field("scale")[:, None])

    def _mapped(self, shard: int) -> mmap.mmap:
        if shard not in self._maps:
            with _rows_path(self._folder, shard).open("rb") as file:
                # A private copy that nobody writes: torch takes no memory that is read-only.
                self._maps[shard] = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
        return self._maps[shard]

    def __getstate__(self) -> dict[str, Any]:
        """State without the open files: each process maps them itself."""
        return self.__dict__ | {"_maps": {}}

    def _replaced_or_missing(self, scan: Scan, num_bytes: int) -> FeatureGridError:
        others = [str(other) for name, other in self._places if name == scan.name]
        if not others:
            return _missing([scan], self._folder)
        return FeatureGridError(
            f"{scan.path} has {num_bytes} bytes, but its feature grid in {self._folder} was made "
            f"from {' or '.join(others)}: the scan was replaced. Make the grid again with "
            f"{REMEDY}."
        )


def known_grids(features_dir: str | Path, settings: GridSettings) -> set[tuple[str, int]]:
    """Scan name and bytes of each grid of a store; empty if there is no store.

    Raises:
        FeatureGridError: If they would not be those of ``settings``, ``dtype`` and ``precision``
            apart, or the store is damaged.
    """
    folder = store_folder(features_dir, settings.grid_size)
    stored = stored_settings(features_dir).get(settings.grid_size)
    if stored is None:
        return set()
    reading = ("projection", "extractor", "dim")
    compare_settings({key: getattr(settings, key) for key in reading}, stored, folder)
    return set(_read_places(folder, stored.row.itemsize))


def stored_feature_dim(features_dir: str | Path) -> int:
    """Width D of the grids of a folder, the same for all sizes.

    Raises:
        FeatureGridError: If there are none.
    """
    return _any_settings(features_dir).dim


def stored_source(features_dir: str | Path) -> str:
    """Name of the extractor that made the grids of a folder.

    Raises:
        FeatureGridError: If there are none.
    """
    return str(_any_settings(features_dir).extractor["name"])


@contextmanager
def folder_lock(folder: Path, waiting: str | None = None) -> Iterator[None]:
    """Holds ``folder/.lock``, which the system releases when the process dies.

    Args:
        folder: Made if it is missing.
        waiting: Logged as a warning where another process holds it.

    Raises:
        FeatureGridError: If the folder cannot be written.
    """
    with _writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / ".lock").open("w")
    with file:
        with _writing(folder):
            if not _try_lock(file):
                if waiting is not None:
                    _log.warning(waiting)
                fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            fcntl.flock(file, fcntl.LOCK_UN)  # loader processes still hold copies of the file


def _any_settings(features_dir: str | Path) -> GridSettings:
    stored = stored_settings(features_dir)
    if not stored:
        raise FeatureGridError(
            f"No feature grids in {features_dir}: make them with {REMEDY}, or give an extractor."
        )
    return next(iter(stored.values()))


def _take_shard(folder: Path, first: int) -> tuple[int, FileIO, FileIO]:
    """Number, locked rows and journal of the first shard from ``first`` that nobody writes."""
    for shard in count(first):
        # Without a buffer, which would be written when the file is closed after an error.
        rows = _rows_path(folder, shard).open("ab", buffering=0)
        if _try_lock(rows):
            return shard, rows, _journal_path(folder, shard).open("ab", buffering=0)
        rows.close()
    raise AssertionError("numbers do not end")


def _read_places(folder: Path, row_bytes: int) -> dict[tuple[str, int], tuple[int, int]]:
    """Shard and row of each grid, by the name and the bytes of its scan, from all journals."""
    places: dict[tuple[str, int], tuple[int, int]] = {}
    for path in sorted(folder.glob("shard_*.jsonl")):
        shard = int(path.stem.removeprefix("shard_"))
        keys, _ = _read_journal(path, row_bytes)
        places.update((key, (shard, row)) for row, key in enumerate(keys))
    return places


def _read_journal(path: Path, row_bytes: int) -> tuple[list[tuple[str, int]], int]:
    """Name and bytes of the scan of each row, and the length in bytes of all whole lines."""
    data = path.read_bytes()
    end, rows = data.rfind(b"\n") + 1, path.with_suffix(".rows")
    keys: list[tuple[str, int]] = []
    try:
        # As one list: twice as fast as line by line, which matters for 80 000 lines.
        for entry in json.loads(b"[" + b",".join(data[:end].splitlines()) + b"]"):
            if entry["row"] != len(keys):
                raise ValueError(f"line {len(keys) + 1} is of row {entry['row']}")
            keys.append((entry["scan"], entry["bytes"]))
        if keys and rows.stat().st_size < len(keys) * row_bytes:
            raise ValueError(f"{rows.name} has fewer than its {len(keys)} rows")
    except (KeyError, TypeError, ValueError, FileNotFoundError) as error:
        raise FeatureGridError(
            f"{path} is damaged ({error!r}): delete it and {rows.name} beside it, and make their "
            f"grids again with {REMEDY}."
        ) from error
    return keys, end


def _packed(grids: np.ndarray, row: np.dtype[Any]) -> np.ndarray:
    """Rows ``(B,)`` of float32 grids ``(B, N, D)``, see :class:`GridSettings`."""
    rows = np.empty(len(grids), row)
    if "values" in (row.names or ()):
        largest = np.finfo(np.float16).max
        rows["values"] = grids.clip(-largest, largest)
        return rows
    scale = np.abs(grids).max(axis=2) / np.float32(_LARGEST_CODE)
    scale[scale < np.finfo(np.float32).tiny] = 0  # too small to be exact, as are their values
    rows["scale"] = scale
    rows["codes"] = np.rint(grids / np.where(scale > 0, scale, np.float32(np.inf))[..., None])
    return rows


def _missing(scans: Sequence[Scan], folder: Path) -> FeatureGridError:
    more = f" and {len(scans) - 1} more" if len(scans) > 1 else ""
    what = f"grid for scan {scans[0].path}{more}" if scans else "grids"
    return FeatureGridError(
        f"No feature {what} in {folder}: make what is missing with {REMEDY}, or give the data "
        "module an extractor, which does."
    )


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """Turns errors of the system into one that names the folder and the remedy."""
    try:
        yield
    except OSError as error:
        raise FeatureGridError(
            f"Feature grids cannot be written to {folder} ({error.strerror}): give a features_dir "
            "on a disk that can be written and has space."
        ) from error


def _try_lock(file: IO[Any]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _append(file: FileIO, data: bytes) -> None:
    left = memoryview(data)
    while left:  # the system may write a part
        left = left[file.write(left) :]


def _rows_path(folder: Path, shard: int) -> Path:
    return folder / f"shard_{shard:05d}.rows"


def _journal_path(folder: Path, shard: int) -> Path:
    return folder / f"shard_{shard:05d}.jsonl"

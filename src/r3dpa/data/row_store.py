"""Rows of fixed size on disk, one a scan: appended by any number of processes, memory-mapped.

A store is a folder::

    shard_00000.rows     one row of fixed size a scan
    shard_00000.jsonl    journal: one line a row, {"scan": name, "bytes": of its file, "row": i}

A line is written when its row is on disk, so that a process killed at any moment leaves no wrong
row: rows that the journal does not name and a torn last line do not count. Every writing process
has a shard of its own. The key of a row is the name of the scan and the size of its file; where its
owner gives one, also the time when the file was changed last, "mtime_ns".
"""

from __future__ import annotations

import fcntl
import json
import logging
import mmap
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import FileIO
from itertools import count
from pathlib import Path
from typing import IO, Any

from r3dpa.io import refuse_name

_log = logging.getLogger(__name__)

RowKey = tuple[str, int] | tuple[str, int, int]
"""Name of a scan, size of its file in bytes, and where it counts when that was changed (ns)."""

_KEY_NAMES = ("scan", "bytes", "mtime_ns")  # in a line of the journal


@dataclass(frozen=True)
class Rows:
    """What the rows of a store are, for its messages.

    Args:
        name: Such as ``feature grids``.
        option: Argument that names the folder.
        remedy: How what is missing or damaged is made again.
        error: Class of the errors.
    """

    name: str
    option: str
    remedy: str
    error: type[ValueError]

    @contextmanager
    def writing(self, folder: Path) -> Iterator[None]:
        """Turns errors of the system into one that names the folder and the remedy."""
        try:
            yield
        except OSError as error:
            raise self.error(
                f"{self.name.capitalize()} cannot be written to {folder} ({error.strerror}): give "
                f"a {self.option} on a disk that can be written and has space."
            ) from error

    @contextmanager
    def lock(self, folder: Path, waiting: str | None = None) -> Iterator[None]:
        """Holds ``folder/.lock``, which the system releases when the process dies.

        Args:
            folder: Made if it is missing.
            waiting: Logged as a warning where another process holds it.

        Raises:
            ValueError: Of class ``error``, if the folder cannot be written.
        """
        with self.writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            file = (folder / ".lock").open("w")
        with file:
            with self.writing(folder):
                if not _try_lock(file):
                    if waiting is not None:
                        _log.warning(waiting)
                    fcntl.flock(file, fcntl.LOCK_EX)
            try:
                yield
            finally:
                fcntl.flock(file, fcntl.LOCK_UN)  # loader processes still hold copies of the file

    def places(self, folder: Path, row_bytes: int) -> dict[RowKey, tuple[int, int]]:
        """Shard and row of each key, from all journals of a store.

        Raises:
            ValueError: Of class ``error``, if a journal is damaged.
        """
        places: dict[RowKey, tuple[int, int]] = {}
        for path in sorted(folder.glob("shard_*.jsonl")):
            shard = int(path.stem.removeprefix("shard_"))
            keys, _ = self.read_journal(path, row_bytes)
            places.update((key, (shard, row)) for row, key in enumerate(keys))
        return places

    def read_journal(self, path: Path, row_bytes: int) -> tuple[list[RowKey], int]:
        """Key of each row of a shard, and the length in bytes of all whole lines."""
        data = path.read_bytes()
        end, rows = data.rfind(b"\n") + 1, path.with_suffix(".rows")
        keys: list[RowKey] = []
        try:
            # As one list: twice as fast as line by line, which matters for 80 000 lines.
            for entry in json.loads(b"[" + b",".join(data[:end].splitlines()) + b"]"):
                if entry["row"] != len(keys):
                    raise ValueError(f"line {len(keys) + 1} is of row {entry['row']}")
                if reason := refuse_name(entry["scan"]):
                    raise ValueError(f"name of scan in line {len(keys) + 1} {reason}")
                stamp = [entry[name] for name in ("bytes", "mtime_ns") if name in entry]
                if "bytes" not in entry or not all(isinstance(value, int) for value in stamp):
                    raise TypeError(f"bytes in line {len(keys) + 1} are {stamp!r:.40}")
                keys.append((entry["scan"], *stamp))
            if keys and rows.stat().st_size < len(keys) * row_bytes:
                raise ValueError(f"{rows.name} has fewer than its {len(keys)} rows")
        except (LookupError, TypeError, ValueError, RecursionError, OSError) as error:
            raise self.error(
                f"{path} is damaged ({error!r}): delete it and {rows.name} beside it, and make "
                f"their {self.remedy}."
            ) from error
        return keys, end


class RowWriter:
    """Appends rows to a shard of its own.

    What a killed process left unfinished at the end of the shard is cut off. An error closes the
    writer; what was added before stays.

    Args:
        folder: The store, which exists.
        row_bytes: Size of a row.
        rows: What they are.
        shard: Number of the shard; the next one that no other process writes, if that is taken.

    Attributes:
        shard: Number of the shard that is written.

    Raises:
        ValueError: Of class ``rows.error``, if the store is damaged or cannot be written.
    """

    def __init__(self, folder: Path, row_bytes: int, rows: Rows, shard: int = 0) -> None:
        self._folder, self._kind = folder, rows
        with rows.writing(folder):
            self.shard, self._rows, self._journal = _take_shard(folder, shard)
        try:
            keys, length = rows.read_journal(_journal_path(folder, self.shard), row_bytes)
            self._num_rows = len(keys)
            with rows.writing(folder):
                self._rows.truncate(self._num_rows * row_bytes)
                self._journal.truncate(length)
            self._known = set(rows.places(folder, row_bytes))
        except BaseException:
            self.close()
            raise

    def new(self, keys: Sequence[RowKey]) -> list[int]:
        """Places of the keys that the store lacked when it was opened, and was not given since."""
        first = {key: place for place, key in enumerate(keys) if key not in self._known}
        return list(first.values())

    def add(self, keys: Sequence[RowKey], data: bytes) -> None:
        """Append the rows of some new keys, one after the other.

        When this returns, the rows are on disk and other processes can read them.

        Raises:
            ValueError: Of class ``rows.error``, if the disk is full or cannot be written.
        """
        lines = [
            json.dumps({**dict(zip(_KEY_NAMES, key, strict=False)), "row": row}) + "\n"
            for row, key in enumerate(keys, start=self._num_rows)
        ]
        try:
            # Not through a memory map: a full disk is an error here and a killed process there.
            with self._kind.writing(self._folder):
                append(self._rows, data)
                os.fdatasync(self._rows)
                append(self._journal, "".join(lines).encode())
        except BaseException:
            self.close()  # whoever opens the shard next cuts off what is unfinished
            raise
        self._num_rows += len(keys)
        self._known |= set(keys)

    def close(self) -> None:
        """Give the shard free; a second call does nothing."""
        if not self._rows.closed:
            fcntl.flock(self._rows, fcntl.LOCK_UN)  # loader processes still hold copies of it
            self._rows.close()
            self._journal.close()


class RowReader:
    """Rows of a store by key; safe to hand to loader processes.

    Args:
        folder: The store.
        row_bytes: Size of a row.
        rows: What they are.
        names: Names of the scans that will be asked for.

    Attributes:
        places: Shard and row of each key of these scans.

    Raises:
        ValueError: Of class ``rows.error``, if the store is damaged.
    """

    def __init__(self, folder: Path, row_bytes: int, rows: Rows, names: set[str]) -> None:
        self._folder, self._row_bytes, self._kind = folder, row_bytes, rows
        places = rows.places(folder, row_bytes)
        self.places = {key: place for key, place in places.items() if key[0] in names}
        self._maps: dict[int, mmap.mmap] = {}

    def find(self, key: RowKey) -> tuple[mmap.mmap, int] | None:
        """Memory of a shard, read-only, and where in it the row starts; None if there is none."""
        place = self.places.get(key)
        if place is None:
            return None
        shard, position = place
        start = position * self._row_bytes
        mapping = self._mapped(shard)
        # Of the file as it is now: to touch what was cut off since would kill the process.
        if mapping.size() < start + self._row_bytes:
            raise self._lost(shard, "was cut short")
        # Asked for as a whole: page by page, as they are touched, a disk is slower than one read.
        page_start = start // mmap.PAGESIZE * mmap.PAGESIZE
        mapping.madvise(mmap.MADV_WILLNEED, page_start, start - page_start + self._row_bytes)
        return mapping, start

    def _mapped(self, shard: int) -> mmap.mmap:
        if shard not in self._maps:
            try:
                with _rows_path(self._folder, shard).open("rb") as file:
                    # Read-only: a private copy would count as memory, 42 GB for a large shard.
                    self._maps[shard] = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            except (FileNotFoundError, ValueError) as error:  # gone, or empty
                raise self._lost(shard, "is gone or empty") from error
        return self._maps[shard]

    def _lost(self, shard: int, what: str) -> ValueError:
        rows, journal = _rows_path(self._folder, shard), _journal_path(self._folder, shard)
        return self._kind.error(
            f"{rows} {what} since its journal was read: delete it and {journal.name} beside it, "
            f"and make their {self._kind.remedy}."
        )

    def __getstate__(self) -> dict[str, Any]:
        """State without the open files: each process maps them itself."""
        return self.__dict__ | {"_maps": {}}


def _take_shard(folder: Path, first: int) -> tuple[int, FileIO, FileIO]:
    """Number, locked rows and journal of the first shard from ``first`` that nobody writes."""
    for shard in count(first):
        # Without a buffer, which would be written when the file is closed after an error.
        rows = _rows_path(folder, shard).open("ab", buffering=0)
        if _try_lock(rows):
            return shard, rows, _journal_path(folder, shard).open("ab", buffering=0)
        rows.close()
    raise AssertionError("numbers do not end")


def _try_lock(file: IO[Any]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def append(file: FileIO, data: bytes) -> None:
    """Write all of the data to a file without a buffer, which may take it in parts."""
    left = memoryview(data)
    while left:  # the system may write a part
        left = left[file.write(left) :]


def _rows_path(folder: Path, shard: int) -> Path:
    return folder / f"shard_{shard:05d}.rows"


def _journal_path(folder: Path, shard: int) -> Path:
    return folder / f"shard_{shard:05d}.jsonl"

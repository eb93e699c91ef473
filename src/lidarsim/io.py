"""Atomic writes, journals, locks, worker processes, and checks of names and files."""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import multiprocessing
import os
import pickle
import platform
import re
import signal
import struct
import threading
import tokenize
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from io import FileIO
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

T = TypeVar("T")
R = TypeVar("R")
_log = logging.getLogger(__name__)
_DAMAGED = (pickle.UnpicklingError, struct.error, tokenize.TokenError, zipfile.BadZipFile, EOFError)
_BAD_VALUES = (ArithmeticError, AttributeError, LookupError, SyntaxError, TypeError, ValueError)
_SYSTEM = (AssertionError, ImportError, MemoryError, OSError, RuntimeError)
#: Raised by ``torch.load``, ``numpy.load`` and restricted unpicklers on damaged files.
UNPICKLING_ERRORS = (*_DAMAGED, *_BAD_VALUES, *_SYSTEM)


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name that becomes ``path`` when the block ends without an error.

    A reader sees the old file or the complete new one; the bytes are flushed before the renaming.
    Makes missing parent folders. ``OSError`` names ``path`` if it cannot be written.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{uuid4().hex[:8]}.partial{path.suffix}")
    try:
        temporary.touch()
        usual = temporary.stat().st_mode
        try:
            yield temporary
            temporary.chmod(usual)  # safetensors makes files that nobody else can read
            _fsync(temporary)
            temporary.replace(path)
            _fsync(path.parent)
        finally:
            temporary.unlink(missing_ok=True)
    except Exception as error:
        number = _error_number(error, str(temporary))
        if number is None:
            raise
        raise OSError(number, os.strerror(number), str(path)) from error


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file atomically."""
    write_bytes(path, text.encode())


def sha256_of(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _fsync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def no_follow(path: str, flags: int) -> int:
    """``opener`` for :func:`open` that raises ``OSError`` for a symbolic link."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


class Journal:
    """Lines of JSON that a job appends as it goes, by which the same call completes it later.

    A last line that a killed process has left incomplete is ignored.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: FileIO | None = None

    def read(self) -> list[Any]:
        """Values of all lines; none without a file.

        Raises:
            ValueError: If a complete line is no JSON.
        """
        if not self.path.exists():
            return []
        complete, _, last = self.path.read_bytes().rpartition(b"\n")
        # As one list: twice as fast as line by line, which matters for 80 000 lines.
        values = json.loads(b"[" + b",".join(complete.splitlines()) + b"]")
        with suppress(ValueError, RecursionError):
            values.append(json.loads(last))
        return list(values)

    def start(self, *values: Any) -> None:
        """Replace all lines."""
        self.close()
        write_text(self.path, _json_lines(values))

    def add(self, *values: Any) -> None:
        """Append lines."""
        if self._file is None:
            self._file = FileIO(self.path, "ab", opener=no_follow)
        append(self._file, _json_lines(values).encode())

    def close(self) -> None:
        """Close the file, which the next line opens again."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def delete(self) -> None:
        """Delete the file, if there is one."""
        self.close()
        self.path.unlink(missing_ok=True)


def _json_lines(values: Iterable[Any]) -> str:
    return "".join(f"{json.dumps(value)}\n" for value in values)


def append(file: FileIO, data: bytes) -> None:
    """Write all data to an unbuffered file, which may take it in parts; errors name the file."""
    left = memoryview(data)
    try:
        while left:
            left = left[file.write(left) :]
    except OSError as error:
        error.filename = str(file.name)
        raise


def json_values(values: Any, default: Callable[[Any], Any] | None = None) -> Any:
    """Return values as a JSON file holds them: lists for tuples, text for numbers as keys."""
    text = json.dumps(values, default=default)
    return json.loads(text)


def differences(stored: Any, wanted: Any, name: str = "") -> Iterator[str]:
    """Yield each value of a stored request that differs from the wanted one, as text."""
    if isinstance(stored, dict) and isinstance(wanted, dict):
        for key in stored | wanted:
            place = f"{name}.{key}" if name else key
            yield from differences(stored.get(key), wanted.get(key), place)
    elif stored != wanted:
        yield f"{name} {_shown(stored)} there, {_shown(wanted)} now"


def _shown(value: Any) -> str:
    return f"{len(value)} values" if isinstance(value, list) and len(value) > 9 else repr(value)


def delete_unfinished(folder: Path) -> None:
    """Remove temporary files of killed writers below a folder."""
    for path in list(folder.rglob(".*.partial.*")):
        path.unlink(missing_ok=True)


@contextmanager
def only_writer(lock: Path, what: str, wait: bool = False) -> Iterator[None]:
    """Hold a lock file, which the system releases when the process ends.

    While another process holds it: waits, or raises a ``ValueError`` with ``what`` that one does.
    """
    from filelock import FileLock, Timeout  # drives need it, single scans do not

    lock.parent.mkdir(parents=True, exist_ok=True)
    held: AbstractContextManager[Any]
    try:
        held = FileLock(lock).acquire(blocking=False)
        with open(lock, "w", opener=no_follow) as file:
            file.write(f"{os.getpid()} on {platform.node()}")
    except Timeout as error:
        if not wait:
            raise ValueError(
                f"another process ({lock.read_text()}) {what}: wait for it, or give another folder"
            ) from error
        _log.warning("waiting for another process that %s", what)
        held = FileLock(lock).acquire()
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):
            raise
        _log.warning("the disk of %s has no locks: make sure that no other process %s", lock, what)
        held = nullcontext()
    with held:
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def in_processes(function: Callable[[T], R], tasks: Sequence[T], workers: int) -> Iterator[R]:
    """Yield results of a function in the order of the tasks; one worker is this process.

    Workers ignore interrupts and end when this process is killed. ``ChildProcessError`` if one of
    them was killed.
    """
    if workers == 1 or len(tasks) < 2:
        yield from map(function, tasks)
        return
    # spawn: forking a process that runs threads (torch, CUDA) can deadlock.
    pool = ProcessPoolExecutor(
        min(workers, len(tasks)),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_worker,
    )
    try:
        for future in [pool.submit(function, task) for task in tasks]:
            yield future.result()
    except BrokenProcessPool as error:
        raise ChildProcessError(
            "a worker process ended before its work: it was killed, as happens when memory runs "
            "out, or could not start. The same request goes on where this one stopped; use fewer "
            "workers, or one to see the error itself"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker() -> None:
    """Ignore interrupts, which the parent handles, and end when the parent is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _error_number(error: BaseException | None, temporary: str) -> int | None:
    """``errno`` of a failed write to a file; None for other errors."""
    while error is not None:
        if isinstance(error, OSError) and error.filename in (None, temporary):
            return error.errno
        # safetensors, written in Rust, has the number in its text; torch.save in the error before
        if number := re.search(r"\(os error (\d+)\)", str(error)):
            return int(number[1])
        error = error.__context__
    return None


def first_line(error: BaseException) -> str:
    """First line of an error's message, or its class name where it has none."""
    return str(error).partition("\n")[0] or type(error).__name__


def number_of(count: int, noun: str) -> str:
    """``1 scan``, ``2 scans``: a count with its noun."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def refuse_name(name: object) -> str | None:
    """Reason why a name from a file must not become part of a path; None for ``a/b/c``."""
    if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= 1024:
        return f"must be printable text of 1 to 1024 characters, got {name!r:.80}"
    outside = name.startswith("/") or "\\" in name or re.match("[A-Za-z]:", name)
    if outside or {"", ".", ".."} & set(name.split("/")):
        return f"leads out of its folder: {name!r:.80}"
    return None


def text_table(
    rows: Iterable[Sequence[str]], heads: Sequence[str], align: str = "", style: str = "simple"
) -> str:
    """A table of texts; ``align`` is ``l`` (default) or ``r`` per column, ``style`` of tabulate."""
    from tabulate import tabulate

    sides = ["left" if side == "l" else "right" for side in align]
    text = tabulate(
        list(rows),
        heads,
        style,
        disable_numparse=True,
        colalign=sides or None,
        preserve_whitespace=True,
    )
    return "\n".join(line.rstrip() for line in text.splitlines())

"""How files are written: under a temporary name, then renamed, by one process at a time."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

__all__ = ["atomic_path", "delete_unfinished", "only_writer"]

#: What network disks without lock servers answer.
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Temporary name beside ``path`` that becomes ``path`` when the block ends without an error.

    A reader sees the old file or the complete new one, with the usual permissions. Missing parent
    folders are made; after an error the temporary file is removed.

    Args:
        path: File to write. The temporary name is hidden, starts with a dot, and has the same
            suffix; no other writer has it, on this machine or on another one of a shared disk.

    Raises:
        OSError: If the file cannot be written; names ``path`` and the reason, also where the
            library that writes it does not.
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
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except Exception as error:
        number = _error_number(error, str(temporary))
        if number is None:
            raise
        raise OSError(number, os.strerror(number), str(path)) from error


def delete_unfinished(folder: Path) -> None:
    """Remove the temporary files that killed writers left below a folder nobody writes to now."""
    for path in list(folder.rglob(".*.partial.*")):
        path.unlink(missing_ok=True)


@contextmanager
def only_writer(lock: Path, what: str) -> Iterator[None]:
    """Refuse to start while another process, on any machine of a shared disk, is in such a block.

    The system gives the lock free when its process ends, however it does; children do not keep it.

    Args:
        lock: Hidden file that exists while the block runs; its folder is made if missing.
        what: For the message: what the other process does, and where to.

    Raises:
        ValueError: If another process is in the block; tells which.
        OSError: If the file cannot be written.
    """
    lock.parent.mkdir(parents=True, exist_ok=True)
    while True:
        with lock.open("a+", encoding="utf-8") as file:
            try:
                # Not flock: loader processes would keep it for seconds after a kill of their parent
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except (BlockingIOError, PermissionError) as error:
                file.seek(0)
                raise ValueError(
                    f"another process ({file.read() or 'just started'}) {what}: wait for it to "
                    f"end, or give another folder. If it is gone for sure, remove {lock}"
                ) from error
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
                warnings.warn(
                    f"the disk of {lock} has no locks ({error.strerror}): see to it that nobody "
                    f"else {what}",
                    stacklevel=3,
                )
            if not _is_file_at(file.fileno(), lock):
                continue  # whoever had the lock has ended and removed the file in between
            file.truncate(0)
            file.write(f"{os.getpid()} on {socket.gethostname()}")
            file.flush()
            try:
                yield
            finally:
                lock.unlink(missing_ok=True)
            return


def _is_file_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _error_number(error: BaseException | None, temporary: str) -> int | None:
    """Number of the system error that kept a file from being written; None if it was another."""
    while error is not None:
        if isinstance(error, OSError) and error.filename in (None, temporary):
            return error.errno
        # How safetensors, written in Rust, tells it. An error of torch.save follows that of the
        # file it is given.
        told = re.search(r"\(os error (\d+)\)", str(error))
        if told is not None:
            return int(told[1])
        error = error.__context__
    return None

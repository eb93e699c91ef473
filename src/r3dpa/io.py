"""Atomic writes, locks, provenance of results, and checks of names and files from elsewhere."""

from __future__ import annotations

import errno
import fcntl
import functools
import os
import pickle
import platform
import re
import shlex
import socket
import struct
import subprocess
import sys
import tokenize
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any
from uuid import uuid4

from r3dpa import __version__

__all__ = [
    "UNPICKLING_ERRORS",
    "atomic_path",
    "command",
    "delete_unfinished",
    "first_line",
    "machine",
    "one_line",
    "only_writer",
    "provenance",
    "refuse_name",
    "source_commit",
    "usable_device",
    "versions",
]

_DRIVE_LETTER = re.compile(r"[A-Za-z]:")
_MOST_CHARACTERS = 1024
#: Of ``torch.load``, restricted unpicklers and NumPy's heads, on bytes cut off, exchanged, or not
#: accepted. Where more is caught than files are known to raise, the cause stays in the message.
UNPICKLING_ERRORS = (
    pickle.UnpicklingError,
    struct.error,
    AssertionError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    MemoryError,
    OSError,
    OverflowError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    ZeroDivisionError,
    tokenize.TokenError,
    zipfile.BadZipFile,
)
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


def first_line(error: BaseException) -> str:
    """Start of an error's message, or its kind where it has none."""
    return str(error).partition("\n")[0] or type(error).__name__


def refuse_name(name: object) -> str | None:
    """Why a name must not become part of a path; None if it may.

    Allowed are relative names in the notation ``folder/name`` of any depth.

    Args:
        name: What a file gives as the name of a scan, sample or member.
    """
    if not isinstance(name, str) or not name:
        return f"must be text that is not empty, got {name!r:.80}"
    if len(name) > _MOST_CHARACTERS:
        return f"has {len(name)} characters, at most {_MOST_CHARACTERS} are read"
    if not name.isprintable():  # NUL and line breaks among them
        return f"holds characters that cannot be printed: {name!r:.80}"
    if name.startswith("/") or "\\" in name or _DRIVE_LETTER.match(name):
        return f"is no relative path with / between folders: {name!r:.80}"
    if {"", ".", ".."} & set(name.split("/")):
        return f"leads out of its folder or in circles: {name!r:.80}"
    return None


def usable_device(name: str) -> str:
    """A device by name, the GPU or else the CPU for ``auto``.

    Raises:
        ValueError: If there is none of this name.
    """
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(0, device=name)
    except (AssertionError, NotImplementedError, RuntimeError) as error:  # whatever torch lacks
        raise ValueError(
            f"device {name!r} cannot be used here ({first_line(error)}): give cpu or auto"
        ) from error
    return name


@functools.cache
def source_commit() -> str | None:
    """Commit of the r3dpa checkout that runs; None if it was installed without one."""
    package = Path(__file__).resolve().parent
    try:
        command = ["git", "-C", str(package), "rev-parse", "--show-toplevel", "HEAD"]
        answer = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    top, commit = answer.splitlines()
    return commit if Path(top, "src", "r3dpa").resolve() == package else None


def machine() -> dict[str, Any]:
    """Processor, processors that this process may use, and how many are busy, as it says itself."""
    cpu_info = Path("/proc/cpuinfo")
    lines = cpu_info.read_text().splitlines() if cpu_info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[0], 2),
    }


def versions(*packages: ModuleType) -> dict[str, str | None]:
    """Version and commit of this code, of Python, and of some packages."""
    return {
        "r3dpa": __version__,
        "commit": source_commit(),
        "python": platform.python_version(),
        **{package.__name__: package.__version__ for package in packages},
    }


def command() -> str:
    """The command line of this process; of a path only its name."""
    typed = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return re.sub(r"(?<![^\s='\"])[^\s='\"]*/(?=[^\s/'\"])", "", typed)


def provenance(scan: Path | None, num_points: int, *packages: ModuleType) -> dict[str, Any]:
    """Command, scan, machine and versions of a benchmark on one scan.

    Args:
        scan: Its file, of which only the name is kept; simulated where None.
        num_points: Of the scan.
        packages: As for :func:`versions`, beside torch.
    """
    import torch

    return {
        "command": command(),
        "scan": {"file": "simulated" if scan is None else scan.name, "points": num_points},
        "machine": machine() | {"threads": torch.get_num_threads()},
        "versions": versions(torch, *packages),
    }


def one_line(values: str | dict[str, Any]) -> str:
    """A text, or names and values, for a line of text."""
    if isinstance(values, str):
        return values
    return ", ".join(f"{name} {value}" for name, value in values.items())

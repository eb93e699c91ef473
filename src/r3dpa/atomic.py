"""The one way files are written: under a temporary name, then renamed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

__all__ = ["atomic_path"]


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Temporary name beside ``path`` that becomes ``path`` when the block ends without an error.

    A reader sees the old file or the complete new one, with the usual permissions. Missing parent
    folders are made; after an error the temporary file is removed.

    Args:
        path: File to write. The temporary name is hidden, starts with a dot, and has the same
            suffix; no other writer has it, on this machine or on another one of a shared disk.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{uuid4().hex[:8]}.partial{path.suffix}")
    temporary.touch()
    usual = temporary.stat().st_mode
    try:
        yield temporary
        temporary.chmod(usual)  # safetensors makes files that nobody else can read
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)

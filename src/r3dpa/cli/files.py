"""What all commands share: text on the terminal, and places that can be written to."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

__all__ = ["check_file", "check_folder", "print_text"]


def print_text(text: Any) -> None:
    """Write a line or table to the terminal."""
    sys.stdout.write(f"{text}\n")


def check_folder(out: Path) -> None:
    """Refuse what could not be a folder, before minutes of work are lost with it."""
    for folder in (out, *out.parents):
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"{folder} is a file; give another --out")


def check_file(out: Path | None) -> None:
    """The same for a file that is written at the end, if any."""
    if out is not None:
        if out.is_dir():
            raise ValueError(f"{out} is a folder; give --out the name of a file")
        check_folder(out.parent)

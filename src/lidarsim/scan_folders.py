"""Folders of scans: which of their files are scans.

Formats are listed in :data:`lidarsim.clouds.READERS`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from lidarsim.cloud_formats import READABLE, ScanError
from lidarsim.clouds import READERS, suffix_of

_RANGE_IMAGES = ("range_m.npy", "before.npy")  # beside the clouds of a folder of scenes


def find_files(source: Path) -> tuple[Path, list[Path]]:
    """Folder that names are relative to, and the scans of a file or folder, sorted."""
    if source.is_file():
        return source.parent, [source]
    everything = sorted(files_below(source))
    files = [file for file in without_range_images(everything) if suffix_of(file) in READERS]
    if not files:
        raise ScanError(f"{source}: {_why_no_scan(source, everything)}; can be read: {READABLE}")
    return source, files


def without_range_images(files: Sequence[Path]) -> list[Path]:
    """Files that are no range images of a folder of scenes, as r3dpa writes it."""
    images = {
        file.with_name(name)
        for file in files
        if file.name == "metadata.json"
        for name in _RANGE_IMAGES
    }
    return [file for file in files if file not in images]


def _why_no_scan(source: Path, files: Sequence[Path]) -> str:
    if files:
        return (
            f"is no folder with scans, it holds {len(files)} other files, such as {files[0].name}"
        )
    return "is an empty folder" if source.is_dir() else "is no folder and no file"


def files_below(root: Path) -> Iterator[Path]:
    """Files of a folder and its sub-folders, links followed, without hidden ones."""
    seen = set()
    for folder, below, names in os.walk(root, followlinks=True):
        real = os.path.realpath(folder)
        # Of a folder and a link to it, the same one on every machine; of a link upwards, none.
        below[:] = [] if real in seen else sorted(name for name in below if name[0] != ".")
        if real not in seen:
            yield from (Path(folder, name) for name in names if name[0] != ".")
        seen.add(real)

"""Devices, provenance, and the file helpers of :mod:`lidarsim.io`."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from lidarsim.io import (
    UNPICKLING_ERRORS,
    Journal,
    append,
    atomic_path,
    delete_unfinished,
    differences,
    first_line,
    in_processes,
    json_values,
    no_follow,
    number_of,
    only_writer,
    refuse_name,
    sha256_of,
    text_table,
    write_text,
)
from r3dpa import __version__

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "UNPICKLING_ERRORS",
    "Journal",
    "append",
    "atomic_path",
    "check_file",
    "check_folder",
    "command",
    "delete_unfinished",
    "differences",
    "first_line",
    "in_processes",
    "json_values",
    "machine",
    "no_follow",
    "number_of",
    "one_line",
    "only_writer",
    "refuse_name",
    "save_tensors",
    "sha256_of",
    "source_commit",
    "text_table",
    "usable_device",
    "versions",
    "weights_sha256",
    "write_text",
]


def usable_device(name: str) -> str:
    """Name of a device that works, GPU before CPU for ``auto``; ``ValueError`` otherwise."""
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


def weights_sha256(state: Mapping[str, Tensor], *, ordered: bool = True) -> str:
    """SHA-256 of the names and bytes of weights, whatever device, memory format or file.

    Args:
        state: Weights by name.
        ordered: Take the names in alphabetical order, else in the order of ``state``, as hashes of
            feature extractors do that files of feature grids and references hold.
    """
    import torch

    digest = hashlib.sha256()
    for name in sorted(state) if ordered else state:
        digest.update(name.encode())
        # As bytes, since NumPy has no bfloat16.
        values = state[name].detach().cpu().contiguous().flatten().view(torch.uint8)
        digest.update(values.numpy().data)
    return digest.hexdigest()


def save_tensors(content: Any, path: str | Path) -> None:
    """Write what ``torch.load`` reads, atomically; an OSError names the file and the reason."""
    import torch

    # An open file, since torch.save raises a RuntimeError of its own where it has to open one.
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)


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
    """Processor, number of cores, and load."""
    cpu_info = Path("/proc/cpuinfo")
    text = cpu_info.read_text() if cpu_info.exists() else ""
    model = re.search(r"model name\s*: (.*)", text)
    cpu = model[1].strip() if model else platform.processor()
    return {"cpu": cpu, "cores": os.cpu_count(), "load": round(os.getloadavg()[0], 2)}


def versions(*packages: ModuleType) -> dict[str, str | None]:
    """Versions of r3dpa, with its commit, of Python, and of some packages."""
    ours = {"r3dpa": __version__, "commit": source_commit(), "python": platform.python_version()}
    return ours | {package.__name__: package.__version__ for package in packages}


def command() -> str:
    """Command line of this process, paths reduced to their names."""
    program = Path(sys.argv[0]).name
    typed = shlex.join(["r3dpa" if program == "__main__.py" else program, *sys.argv[1:]])
    return re.sub(r"(?<![^\s='\"])[^\s='\"]*/(?=[^\s/'\"])", "", typed)


def one_line(values: str | dict[str, Any]) -> str:
    """A text as it is, or names and values in one line."""
    pairs = values.items() if isinstance(values, dict) else ()
    return ", ".join(f"{name} {value}" for name, value in pairs) or str(values)


def check_folder(out: Path | None) -> None:
    """Refuse an output folder whose path is a file, before the work starts.

    Raises:
        ValueError: With the name of the file.
    """
    for folder in () if out is None else (out, *out.parents):
        if folder.is_file():
            raise ValueError(f"{folder} is a file; give another --out")


def check_file(out: Path | None) -> None:
    """Refuse an output file whose path is a folder, before the work starts.

    Raises:
        ValueError: With the name of the folder, or of a file above it.
    """
    if out is not None and out.is_dir():
        raise ValueError(f"{out} is a folder; give --out the name of a file")
    check_folder(None if out is None else out.parent)

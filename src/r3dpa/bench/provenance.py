"""Where and with what a figure was measured: what a reader needs to judge or repeat it."""

from __future__ import annotations

import os
import platform
import re
import shlex
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from r3dpa import __version__
from r3dpa.checkpoints import source_commit


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

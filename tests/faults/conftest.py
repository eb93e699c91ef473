"""What the tests of faults share: small disks and commands."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from fault_commands import Command, fit_words


@pytest.fixture
def start(tmp_path):
    """``start(words, *faults)``: a command on its way."""
    started = []

    def run(words, *faults) -> Command:
        started.append(Command(tmp_path / f".log_{len(started)}", words, *faults))
        return started[-1]

    return run


@pytest.fixture
def ended(start):
    """``ended(words, *faults)``: exit status of a command and what the user saw."""
    return lambda words, *faults: start(words, *faults).end()


@pytest.fixture
def small_disk(tmp_path):
    """``small_disk(num_bytes)``: folder of a disk of its own, in memory, of that size."""
    folder = tmp_path / "disk"

    def make(num_bytes: int) -> Path:
        folder.mkdir()
        _mount("-t", "tmpfs", "-o", f"size={num_bytes}", "tmpfs", folder)
        return folder

    yield make
    if folder.is_mount():
        subprocess.run(["umount", "--lazy", folder], check=True)


@pytest.fixture
def make_read_only():
    """``make_read_only(disk)``: nothing can be written to a disk of ``small_disk`` any more."""
    return lambda disk: _mount("-o", "remount,ro", disk)


def _mount(*words):
    try:
        subprocess.run(["mount", *map(str, words)], check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"this user may not mount a disk in memory: {getattr(error, 'stderr', error)}")


def write_scans(folder):
    folder.mkdir()
    generator = np.random.default_rng(0)
    points = generator.uniform((2, 2, 2, 0), (20, 20, 20, 1), (8, 200, 4)).astype(np.float32)
    for index, scan in enumerate(points):
        (folder / f"{index:06d}.bin").write_bytes(scan.tobytes())
    return folder


@pytest.fixture(scope="session")
def scans_folder(tmp_path_factory):
    """Eight small scans in a folder."""
    return write_scans(tmp_path_factory.mktemp("faults") / "scans")


@pytest.fixture
def own_scans(tmp_path):
    """The same scans, to be damaged."""
    return write_scans(tmp_path / "scans")


@pytest.fixture(scope="session")
def undisturbed(scans_folder, tmp_path_factory):
    """Folder of a run without faults."""
    run_dir = tmp_path_factory.mktemp("undisturbed")
    words = fit_words(scans_folder, run_dir / "run")
    assert Command(run_dir / ".log", words).end()[0] == 0
    return run_dir / "run"

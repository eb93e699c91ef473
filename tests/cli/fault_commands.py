"""Real commands in processes of their own, the faults put into them, and what must hold after.

A command runs in a fork of a server that has imported r3dpa and has parsed nothing: as from the
shell, without the seconds of the imports. Signals, limits and full disks are real.
"""

from __future__ import annotations

import atexit
import functools
import json
import multiprocessing
import os
import pkgutil
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
import torch
import yaml
from safetensors.torch import load_file

from lidarsim.scan_files import read_npz, read_points, read_scan
from r3dpa.data.feature_grids import GridSettings

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    [f"r3dpa.cli.{name}" for name in ("fit", "stages", "features", "sample", "evaluate")]
    + ["r3dpa.baselines", "wandb"]  # imported by each parser of a stage
)
PATIENCE_S = 100
STEPS = 4
CONF = Path(__file__).resolve().parents[2] / "conf"


class Command:
    """``r3dpa WORDS`` in a process of its own, in which ``faults`` are called before."""

    def __init__(self, log: Path, words: list, *faults: Callable[[], None]) -> None:
        self.log = log
        log.touch()
        arguments = (log, [str(word) for word in words], faults)
        self._process = CONTEXT.Process(target=_run, args=arguments)
        self._process.start()
        self.pid = self._process.pid

    def wait_for(self, condition: Callable[[], object]) -> None:
        """Waits until something has happened while the command runs."""
        end = time.monotonic() + PATIENCE_S
        while not condition():
            assert self._process.is_alive(), f"ended too soon: {self.log.read_text()}"
            assert time.monotonic() < end, f"nothing happened: {self.log.read_text()}"
            time.sleep(0.01)

    def end(self) -> tuple[int, str]:
        """Exit status, negative for a signal, and what the user saw."""
        self._process.join(PATIENCE_S)
        if self._process.exitcode is None:
            self._process.kill()
            raise AssertionError(f"hangs: {self.log.read_text()}")
        return self._process.exitcode, self.log.read_text()


def _run(log: Path, words: list[str], faults: tuple[Callable[[], None], ...]) -> None:
    with log.open("a") as file:
        for descriptor in (1, 2):
            os.dup2(file.fileno(), descriptor)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    torch.set_num_threads(1)
    sys.argv = ["r3dpa", *words]
    for fault in faults:
        fault()
    from r3dpa.cli import main

    try:
        main()
    finally:
        atexit._run_exitfuncs()  # as at the end of any process but those of multiprocessing


@dataclass(frozen=True)
class At:
    """Does something when ``target`` is called with a path that ends with ``match``."""

    target: str
    do: Callable[[], None]
    call: int = 1
    match: str = ""

    def __call__(self) -> None:
        owner, _, name = self.target.rpartition(".")
        holder = pkgutil.resolve_name(owner)
        original, calls = getattr(holder, name), count(1)

        @functools.wraps(original)
        def patched(*args, **kwargs):
            paths = [str(arg) for arg in args if isinstance(arg, str | Path)]
            fits = not self.match or any(path.endswith(self.match) for path in paths)
            if fits and next(calls) == self.call:
                self.do()
            return original(*args, **kwargs)

        setattr(holder, name, patched)


def write_stdout(path: Path) -> None:
    """Standard output goes into a file of its own."""
    with path.open("w") as file:
        os.dup2(file.fileno(), 1)


def leave_wandb_of_parent() -> None:
    """Start a service of wandb for this process alone, which has written all when it ends."""
    os.environ.pop("WANDB_SERVICE", None)


def kill_worker() -> None:
    """One of the processes that work for this one is killed."""
    os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)


def limit_files(num_bytes: int) -> None:
    """The system kills this process in the midst of writing any longer file."""
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, resource.RLIM_INFINITY))


def fill(disk: Path, left: int) -> None:
    """A disk has only so many bytes left."""
    size = shutil.disk_usage(disk).free - left
    with suppress(OSError):  # a thread of the command may take some of it first
        (disk / "filler").write_bytes(bytes(max(size, 0)))


def cut(path: Path, kept: int | None = None) -> None:
    """A file loses its end; or vanishes, where nothing of it is kept."""
    if kept is None:
        path.unlink()
    else:
        os.truncate(path, kept)


def pause(folder: Path) -> None:
    """The command waits, having said so with one file, until there is another."""
    (folder / "reached").touch()
    while not (folder / "go").exists():
        time.sleep(0.01)


def assert_whole(folder: Path) -> int:
    """Opens each file that looks whole, that is, has no hidden name; returns how many there are."""
    num_files = 0
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.name.startswith(".") and path.name != "filler":
            _CHECKS[path.suffix](path)
            num_files += 1
    return num_files


def rows_of(journal: Path) -> dict[str, bytes]:
    """Row of each scan that a journal names; a resumed run makes another shard."""
    settings = json.loads((journal.parent / "settings.json").read_text())
    size = GridSettings(**settings).store("").row_bytes
    data = journal.with_suffix(".rows").read_bytes()
    whole = journal.read_bytes().rpartition(b"\n")[0].splitlines() if journal.exists() else []
    lines = [json.loads(line) for line in whole]
    assert [line["row"] for line in lines] == list(range(len(lines)))
    assert len(data) >= len(lines) * size
    return {line["scan"]: data[line["row"] * size : (line["row"] + 1) * size] for line in lines}


def _check_beside(path: Path) -> None:
    """A label may be there before the points of its scan; then it is no scan yet."""
    scan = path.parents[1] / "data" / f"{path.stem}.bin"
    if scan.exists():
        size = {".label": 4, ".origin": 1}[path.suffix]
        assert path.stat().st_size == len(read_scan(scan)) * size


_CHECKS: dict[str, Callable[[Path], object]] = {
    ".bin": read_scan,
    ".ckpt": lambda path: torch.load(path, weights_only=True, map_location="cpu"),
    ".json": lambda path: json.loads(path.read_text()),
    ".jsonl": rows_of,
    ".label": _check_beside,
    ".npy": np.load,
    ".npz": read_npz,
    ".origin": _check_beside,
    ".ply": read_points,
    ".rows": lambda path: rows_of(path.with_suffix(".jsonl")),
    ".safetensors": load_file,
    ".txt": lambda path: path.read_text(),
    ".yaml": lambda path: yaml.safe_load(path.read_text()),
}


def fit_words(scans, run_dir, *more):
    """Four steps of two batches each, saved after every second step."""
    files = [CONF / name for name in ("trainer.yaml", "experiment/vae_alignment.yaml")]
    options = {
        "data.class_path": "r3dpa.data.LidarDataModule",
        "data.init_args.scans": scans,
        "data.init_args.val_every": "null",
        "data.init_args.extractor": "null",
        "model.init_args.weights": "{vae_alignment: 0, sit_alignment: 0}",
        "trainer.max_steps": STEPS,
        "trainer.accumulate_grad_batches": 2,
        "trainer.limit_val_batches": 0,
        "trainer.logger": "false",
        "checkpoint.every_n_train_steps": 2,
        "run_dir": run_dir,
    }
    configs = [word for file in (*files, CONF / "smoke.yaml") for word in ("--config", file)]
    return ["fit", *configs, *(f"--{key}={value}" for key, value in options.items()), *more]


def last(run_dir):
    return run_dir / "checkpoints" / "last.ckpt"

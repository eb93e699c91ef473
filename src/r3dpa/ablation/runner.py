"""Runs the stages of a plan, each in a process of its own, so that one that fails ends no other."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from subprocess import Popen, TimeoutExpired
from typing import Any, NamedTuple

import yaml

from r3dpa.ablation.configs import merged, with_value
from r3dpa.ablation.plan import Plan, Stage
from r3dpa.atomic import atomic_path
from r3dpa.metrics.scene_features import FREE_SPACES

__all__ = ["Outcome", "RunSettings", "evaluation_of", "run_plan", "stage_folder"]

_TAIL = 12  # lines of a failed process that are shown
_STOP_SECONDS = 60.0  # that a stopped training gets to save its checkpoint


@dataclass(frozen=True)
class RunSettings:
    """Where and how stages run; none of it changes what comes out.

    Args:
        out: Folder of the ablation.
        jobs: Processes at a time; the cores are shared out among them.
        devices: Devices of each training, which share its batches.
        online: Send the curves of stages to wandb while they train.

    Raises:
        ValueError: If a count is below 1.
    """

    out: Path
    jobs: int = 1
    devices: int = 1
    online: bool = False

    def __post_init__(self) -> None:
        """Checks the counts."""
        if self.jobs < 1 or self.devices < 1:
            raise ValueError(
                f"--jobs and --devices must be at least 1, got {self.jobs} and {self.devices}"
            )


class Outcome(NamedTuple):
    """What became of the processes: why each failed one failed, and seconds of the others."""

    failed: dict[str, str]
    seconds: dict[str, float]


@dataclass(frozen=True)
class _Job:
    """A command, and what must have ended well before it.

    Args:
        name: For the user.
        words: Of the command line.
        place: Its output goes to ``<place>.log``; ``<place>.done`` says that it has ended well.
        needs: Names of other jobs.
        content: All that the result depends on: another one of before does not count as done.
    """

    name: str
    words: list[str]
    place: Path
    needs: tuple[str, ...]
    content: str

    @property
    def log(self) -> Path:
        return self.place.with_suffix(".log")

    @property
    def done(self) -> Path:
        return self.place.with_suffix(".done")

    def seconds(self) -> float | None:
        """What it took, None where it is still to be run."""
        if not self.done.is_file():
            return None
        try:
            found = json.loads(self.done.read_text(encoding="utf-8"))
            return float(found["seconds"]) if found["content"] == self.content else None
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{self.done}: is damaged ({error}); remove it to run {self.name} again"
            ) from error


def stage_folder(out: Path, stage: Stage) -> Path:
    """Folder that a stage is run in."""
    return out / "stages" / stage.name


def evaluation_of(out: Path, stage: Stage) -> Path:
    """File with the numbers of a tested stage."""
    return stage_folder(out, stage) / "evaluation" / "evaluation.json"


def run_plan(plan: Plan, settings: RunSettings, say: Callable[[str], None]) -> Outcome:
    """Trains and tests what is not done yet; the same call goes on after an interrupt.

    A failed stage takes with it only what starts from it.

    Args:
        plan: What to run.
        settings: Where and how.
        say: Gets a line for each process that starts or ends.

    Returns:
        Failures by name of the process.

    Raises:
        ValueError: If a stage's batch cannot be shared by the devices.
    """
    jobs = _jobs(plan, settings)
    for job in jobs:
        job.place.parent.mkdir(parents=True, exist_ok=True)
    seconds = {job.name: took for job in jobs if (took := job.seconds()) is not None}
    left = {job.name: job for job in jobs if job.name not in seconds}
    if len(left) < len(jobs):
        say(f"{len(jobs) - len(left)} of {len(jobs)} are done already")
    failed: dict[str, str] = {}
    running: dict[Future[float], _Job] = {}
    with ThreadPoolExecutor(settings.jobs) as pool, _processes() as start:
        while left or running:
            for job in _lost(left, failed):
                cause = next(name for name in job.needs if name in failed)
                failed[job.name] = f"not run, since {cause} failed"
                say(f"  - {job.name}: {failed[job.name]}")
                del left[job.name]
            for job in list(left.values()):
                if len(running) < settings.jobs and seconds.keys() >= set(job.needs):
                    running[pool.submit(start, job, settings)] = left.pop(job.name)
                    say(f"  > {job.name}")
            if not running:
                continue
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job = running.pop(future)
                error = future.exception()
                if error is None:
                    seconds[job.name] = future.result()
                    num_done = f"{len(seconds)} of {len(jobs)}"
                    say(f"  = {job.name}: {seconds[job.name]:.0f} s ({num_done})")
                elif isinstance(error, RuntimeError):
                    failed[job.name] = str(error)
                    say(f"  ! {job.name} {error}")
                else:
                    raise error
    return Outcome(failed, seconds)


def _lost(left: Mapping[str, _Job], failed: Mapping[str, str]) -> list[_Job]:
    return [job for job in left.values() if any(name in failed for name in job.needs)]


def _jobs(plan: Plan, settings: RunSettings) -> list[_Job]:
    """Scans and their reference, trainings, tests; each after what it needs."""
    out = settings.out
    data, reference = out / "data.yaml", out / "reference.safetensors"
    block = merged(plan.scale.data, {"data": plan.scale.overrides.get("data", {})})
    _write(data, _placed({"data": block["data"]}, out))
    scans, spaces = json.dumps(block, sort_keys=True), _spaces(plan.scale.scorer)
    words = ["reference", "--data", str(data), "--out", str(reference), *spaces]
    on_scans = [stage.config["data"]["init_args"] for stage in plan.stages if plan.on_scans(stage)]
    grids = sorted({tuple(init_args["grid_size"]) for init_args in on_scans})
    made = ["--grid_sizes", json.dumps(grids)]
    jobs = [
        _Job(
            "features",
            ["features", "--data", str(data), *made],
            out / "features",
            (),
            f"{scans} {grids}",
        ),
        _Job("reference", words, out / "reference", ("features",), f"{scans} {spaces}"),
    ]
    for stage in plan.stages:
        folder = stage_folder(out, stage)
        config = folder / "stage.yaml"
        _write(config, _settled(stage, settings))
        words = ["fit", "--config", str(config), "--run_dir", str(folder), "--ckpt_path", "last"]
        needs = tuple(before.name for before in stage.before)
        if plan.on_scans(stage):
            needs = (*needs, "features")
        jobs.append(_Job(stage.name, words, folder / "fit", needs, stage.name))
    for stage in plan.tested:
        folder = stage_folder(out, stage)
        words = ["test", "--config", str(folder / "stage.yaml"), "--run_dir", str(folder)]
        words += ["--ckpt_path", str(_checkpoint(folder)), "--scorer.reference", str(reference)]
        words += ["--trainer.logger", "false", "--trainer.devices", "1"]
        content = json.dumps([scans, stage.config.get("scorer")], sort_keys=True)
        needs = (stage.name, "reference")
        jobs.append(_Job(f"test of {stage.name}", words, folder / "test", needs, content))
    return jobs


def _spaces(scorer: Mapping[str, Any]) -> list[str]:
    """Options of ``r3dpa reference`` for the feature spaces that are scored."""
    files = scorer.get("ckpt") or {}
    names = scorer.get("spaces") or list(dict.fromkeys((*FREE_SPACES, *files)))
    given = [word for name, file in files.items() for word in (f"--ckpt.{name}", str(file))]
    protocol = ["--protocol", scorer["protocol"]] if scorer.get("protocol") else []
    return ["--spaces", ",".join(names), *given, *protocol]


def _settled(stage: Stage, settings: RunSettings) -> dict[str, Any]:
    """Configuration of a stage with folders, devices and loggers."""
    config = _placed(stage.config, settings.out)
    for key, start in stage.starts.items():
        path = start
        if isinstance(start, Stage):
            path = _checkpoint(stage_folder(settings.out, start))
        config = with_value(config, key, str(path))
    batch = config["data"]["init_args"]["batch_size"]
    if batch % settings.devices:
        raise ValueError(
            f"--devices {settings.devices}: a batch of {batch} scans ({stage.experiment}) cannot "
            "be shared by them; give a divisor of it"
        )
    config = with_value(config, "data.init_args.batch_size", batch // settings.devices)
    config = with_value(config, "trainer.devices", settings.devices)
    config = with_value(config, "trainer.enable_progress_bar", False)  # it would go to a file
    loggers = [{"class_path": "CSVLogger", "init_args": {"save_dir": "runs", "name": ""}}]
    if settings.online:
        init_args = {"project": "r3dpa", "save_dir": "runs", "name": stage.name}
        init_args |= {"job_type": "stage", "group": f"stages of {settings.out.name}"}
        loggers.append({"class_path": "WandbLogger", "init_args": init_args})
    for logger in loggers:
        logger["class_path"] = f"lightning.pytorch.loggers.{logger['class_path']}"
    return with_value(config, "trainer.logger", loggers)


def _checkpoint(folder: Path) -> Path:
    return folder / "checkpoints" / "last.ckpt"


def _placed(value: Any, out: Path) -> Any:
    """``{out}`` in all texts replaced by the folder of the ablation."""
    if isinstance(value, Mapping):
        return {key: _placed(item, out) for key, item in value.items()}
    if isinstance(value, list):
        return [_placed(item, out) for item in value]
    return value.replace("{out}", str(out)) if isinstance(value, str) else value


def _write(path: Path, config: Mapping[str, Any]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(yaml.safe_dump(dict(config), sort_keys=False), encoding="utf-8")


@contextmanager
def _processes() -> Iterator[Callable[[_Job, RunSettings], float]]:
    """A function that runs jobs; when the block is left early, those that still run are stopped."""
    alive: set[Popen[bytes]] = set()
    stopped = False

    def start(job: _Job, settings: RunSettings) -> float:
        if stopped:
            raise RuntimeError("was not started any more")
        began = time.monotonic()
        cores = max(1, (os.cpu_count() or 1) // settings.jobs)
        environment = {"OMP_NUM_THREADS": str(cores)} | os.environ
        words = [sys.executable, "-m", "r3dpa", *job.words]
        with job.log.open("ab") as log:
            process = Popen(words, stdout=log, stderr=log, env=environment)
            alive.add(process)
            status = process.wait()
            alive.discard(process)
        if status:
            lines = job.log.read_text(encoding="utf-8", errors="replace").splitlines()
            tail = "\n".join(f"      {line}" for line in lines[-_TAIL:])
            raise RuntimeError(f"ended with status {status}; {job.log} ends with\n{tail}")
        seconds = time.monotonic() - began
        with atomic_path(job.done) as temporary:
            text = json.dumps({"seconds": seconds, "content": job.content})
            temporary.write_text(text, encoding="utf-8")
        return seconds

    try:
        yield start
    except BaseException:
        stopped = True
        for process in list(alive):
            process.terminate()
        deadline = time.monotonic() + _STOP_SECONDS
        for process in list(alive):
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except TimeoutExpired:
                process.kill()
        raise

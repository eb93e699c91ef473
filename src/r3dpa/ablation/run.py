"""Runs a plan: each job is an ``r3dpa`` command in its own process, repeated only if needed."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from subprocess import Popen, TimeoutExpired
from typing import Any

import yaml

from r3dpa.ablation.plan import Plan, Stage, merged, with_value
from r3dpa.io import atomic_path, source_commit
from r3dpa.metrics.scene_features import FREE_SPACES

__all__ = ["Job", "RunSettings", "commit_of", "evaluation_of", "run_plan", "stage_folder"]

_TAIL = 12  # lines of a failed process that are shown
_STOP_SECONDS = 60.0  # for a stopped training to save its checkpoint


@dataclass(frozen=True)
class RunSettings:
    """Where and how stages run; the results do not depend on it.

    Args:
        out: Folder of the ablation.
        jobs: Processes at a time, which share the cores.
        devices: Devices of each training, which share its batches.
        online: Log the stages to wandb while they train.

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


@dataclass(frozen=True)
class _State:
    """Stored state of a started job: settings, inputs, and a new ``ending`` at each success."""

    content: str
    used: dict[str, str]
    commit: str | None
    ending: str | None = None


@dataclass(frozen=True)
class Job:
    """A command line, and the jobs that must have ended well before it.

    Args:
        name: For the user.
        words: Command line after ``r3dpa``.
        place: Its output goes to ``<place>.log``, its state to ``<place>.state``.
        content: Settings that its result depends on.
        needs: Names of jobs before it.
        uses: Those of ``needs`` whose results change its own.
        makes: File that it must write; an old one is removed.
        resumes: Whether it resumes the training in the folder of ``place``.
    """

    name: str
    words: list[str]
    place: Path
    content: str
    needs: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()
    makes: Path | None = None
    resumes: bool = False

    def state(self) -> _State | None:
        """State of its last start."""
        return _read_state(self.place.with_suffix(".state"))

    def save(self, state: _State) -> None:
        """Writes the state atomically."""
        with atomic_path(self.place.with_suffix(".state")) as temporary:
            temporary.write_text(json.dumps(asdict(state)), encoding="utf-8")


def _read_state(path: Path) -> _State | None:
    if not path.is_file():
        return None
    try:
        return _State(**json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: is damaged ({error}); remove it to run its job again") from error


def stage_folder(out: Path, stage: Stage) -> Path:
    """Run folder of a stage."""
    return out / "stages" / stage.name


def evaluation_of(out: Path, stage: Stage) -> Path:
    """File with the numbers of a tested stage."""
    return stage_folder(out, stage) / "evaluation" / "evaluation.json"


def commit_of(out: Path, stage: Stage) -> str | None:
    """Commit of the code that trained a stage, if known."""
    state = _read_state(stage_folder(out, stage) / "fit.state")
    return None if state is None else state.commit


def run_plan(plan: Plan, settings: RunSettings, say: Callable[[str], None]) -> dict[str, str]:
    """Trains and tests what is not done yet; the same call continues after an interrupt.

    A job is done if it ended well with the same settings and the same results of the jobs before
    it; another commit of the code does not count. A failed job fails only the jobs that need it.

    Args:
        plan: Plan to run.
        settings: Where and how.
        say: Receives a line for each process that starts or ends.

    Returns:
        Reasons of failures by name of the job.

    Raises:
        ValueError: If a stage's batch cannot be shared by the devices.
    """
    jobs = _jobs(plan, settings)
    for job in jobs:
        job.place.parent.mkdir(parents=True, exist_ok=True)
    endings = _endings(jobs, {})
    left = {job.name: job for job in jobs if job.name not in endings}
    if endings:
        say(f"{len(endings)} of {len(jobs)} are done already")
    failed: dict[str, str] = {}
    running: dict[Future[None], tuple[Job, float]] = {}
    with ThreadPoolExecutor(settings.jobs) as pool, _processes() as start:
        while left or running:
            for job in list(left.values()):
                if cause := next((name for name in job.needs if name in failed), None):
                    failed[job.name] = f"not run, since {cause} failed"
                    say(f"  - {job.name}: {failed[job.name]}")
                    del left[job.name]
                elif len(running) < settings.jobs and endings.keys() >= set(job.needs):
                    used = {name: endings[name] for name in job.uses}
                    running[pool.submit(start, job, used, settings)] = job, time.monotonic()
                    del left[job.name]
                    say(f"  > {job.name}")
            if not running:
                continue
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job, began = running.pop(future)
                error = future.exception()
                if error is None:
                    endings |= _endings([job], endings)
                    took, num_done = time.monotonic() - began, f"{len(endings)} of {len(jobs)}"
                    say(f"  = {job.name}: {took:.0f} s ({num_done})")
                elif isinstance(error, RuntimeError):
                    failed[job.name] = str(error)
                    say(f"  ! {job.name} {error}")
                else:
                    raise error
    return failed


def _endings(jobs: Iterable[Job], known: Mapping[str, str]) -> dict[str, str]:
    """Endings of the jobs that are done, in addition to those of jobs before them."""
    found = dict(known)
    for job in jobs:
        state = job.state()
        if state is None or state.ending is None:
            continue
        used = {name: found.get(name) for name in job.uses}
        made = job.makes is None or job.makes.is_file()
        if (state.content, state.used) == (job.content, used) and made:
            found[job.name] = state.ending
    return found


def _jobs(plan: Plan, settings: RunSettings) -> list[Job]:
    """Scans and their reference, trainings, tests; each after the jobs that it needs."""
    out = settings.out
    data, reference = out / "data.yaml", out / "reference.safetensors"
    block = merged(plan.scale.data, {"data": plan.scale.overrides.get("data", {})})
    _write(data, _placed({"data": block["data"]}, out))
    scans, spaces = json.dumps(block, sort_keys=True), _spaces(plan.scale.scorer)
    on_scans = [stage.config["data"]["init_args"] for stage in plan.stages if plan.on_scans(stage)]
    grids = sorted({tuple(init_args["grid_size"]) for init_args in on_scans})
    words = ["features", "--data", str(data), "--grid_sizes", json.dumps(grids)]
    jobs = [Job("features", words, out / "features", f"{scans} {grids}")]
    words = ["reference", "--data", str(data), "--out", str(reference), *spaces]
    place, content = out / "reference", f"{scans} {spaces}"
    jobs.append(Job("reference", words, place, content, ("features",), makes=reference))
    for stage in plan.stages:
        folder = stage_folder(out, stage)
        config = folder / "stage.yaml"
        _write(config, settled(stage, settings))
        words = ["fit", "--config", str(config), "--run_dir", str(folder), "--ckpt_path", "last"]
        uses = tuple(before.name for before in stage.before)
        needs = (*uses, "features") if plan.on_scans(stage) else uses
        name = stage.name
        jobs.append(Job(name, words, folder / "fit", name, needs, uses, resumes=True))
    for stage in plan.tested:
        folder = stage_folder(out, stage)
        words = ["test", "--config", str(folder / "stage.yaml"), "--run_dir", str(folder)]
        words += ["--ckpt_path", str(_checkpoint(folder)), "--scorer.reference", str(reference)]
        words += ["--trainer.logger", "false", "--trainer.devices", "1"]
        content = json.dumps([scans, stage.config.get("scorer")], sort_keys=True)
        needs, makes = (stage.name, "reference"), evaluation_of(out, stage)
        name = f"test of {stage.name}"
        jobs.append(Job(name, words, folder / "test", content, needs, needs, makes))
    return jobs


def _spaces(scorer: Mapping[str, Any]) -> list[str]:
    """Options of ``r3dpa reference`` for the feature spaces that are scored."""
    files = scorer.get("ckpt") or {}
    names = scorer.get("spaces") or list(dict.fromkeys((*FREE_SPACES, *files)))
    given = [word for name, file in files.items() for word in (f"--ckpt.{name}", str(file))]
    protocol = ["--protocol", scorer["protocol"]] if scorer.get("protocol") else []
    return ["--spaces", ",".join(names), *given, *protocol]


def settled(stage: Stage, settings: RunSettings) -> dict[str, Any]:
    """Configuration of a stage with folders, devices and loggers."""
    config = _placed(stage.config, settings.out)
    for key, start in stage.starts.items():
        if isinstance(start, Stage):
            start = _checkpoint(stage_folder(settings.out, start))
        config = with_value(config, key, str(start))
    batch = config["data"]["init_args"]["batch_size"]
    if batch % settings.devices:
        raise ValueError(
            f"--devices {settings.devices}: a batch of {batch} scans ({stage.experiment}) cannot "
            "be shared by them; give a divisor of it"
        )
    config = with_value(config, "data.init_args.batch_size", batch // settings.devices)
    config = with_value(config, "trainer.devices", settings.devices)
    config = with_value(config, "trainer.enable_progress_bar", False)  # the output is a file
    loggers = [{"class_path": "CSVLogger", "init_args": {"save_dir": "runs", "name": ""}}]
    if settings.online:
        init_args = {"project": "r3dpa", "save_dir": "runs", "name": stage.name}
        init_args |= {"job_type": "stage", "group": f"stages of {settings.out.name}"}
        init_args |= {"id": f"{settings.out.name}-{stage.name}"}
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
def _processes() -> Iterator[Callable[[Job, dict[str, str], RunSettings], None]]:
    """A function that runs jobs; an early end of the block stops those that still run."""
    alive: set[Popen[bytes]] = set()
    stopped = False

    def start(job: Job, used: dict[str, str], settings: RunSettings) -> None:
        if stopped:
            raise RuntimeError("was not started any more")
        before, state = job.state(), _State(job.content, used, source_commit())
        if job.resumes and before is not None and before.used != used:  # of other inputs
            for path in job.place.parent.iterdir():
                if path.is_dir():
                    shutil.rmtree(path)
        if job.makes is not None:
            job.makes.unlink(missing_ok=True)
        job.save(state)
        cores = max(1, (os.cpu_count() or 1) // settings.jobs)
        environment = {"OMP_NUM_THREADS": str(cores)} | os.environ
        words, log_path = [sys.executable, "-m", "r3dpa", *job.words], job.place.with_suffix(".log")
        with log_path.open("ab") as log:
            process = Popen(words, stdout=log, stderr=log, env=environment)
            alive.add(process)
            status = process.wait()
            alive.discard(process)
        lines = log_path.read_text(encoding="utf-8", errors="replace").splitlines()
        tail = "\n".join(f"      {line}" for line in lines[-_TAIL:])
        if status:
            raise RuntimeError(f"ended with status {status}; {log_path} ends with\n{tail}")
        if job.makes is not None and not job.makes.is_file():
            raise RuntimeError(f"left no {job.makes.name}; {log_path} ends with\n{tail}")
        job.save(replace(state, ending=uuid.uuid4().hex))

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

"""Runs a plan: each job is an ``r3dpa`` command in its own process, repeated only if needed."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from subprocess import Popen
from typing import Any, NamedTuple

import yaml

from r3dpa.ablation.plan import Plan, PlannedStage
from r3dpa.io import no_follow, only_writer, write_text

_CSV_LOGGER = {
    "class_path": "lightning.pytorch.loggers.CSVLogger",
    "init_args": {"save_dir": "", "name": ""},
}
_TAIL = 12  # lines of a failed process that are shown
_PAUSE_S = 0.2  # between looks at the processes


class Job(NamedTuple):
    """A command, whose output goes to ``<place>.log``.

    ``content`` holds the settings that its result depends on, ``needs`` names the jobs before it,
    and ``makes`` is a file that it must write.
    """

    name: str
    words: list[str]
    place: Path
    content: str
    needs: tuple[str, ...] = ()
    makes: Path | None = None

    @property
    def done(self) -> bool:
        """Whether the job has succeeded with these settings."""
        mark = self.place.with_suffix(".done")
        has_result = self.makes is None or self.makes.is_file()
        return has_result and mark.is_file() and mark.read_text(encoding="utf-8") == self.content

    @property
    def log(self) -> Path:
        """File of its output."""
        return self.place.with_suffix(".log")


def budget_of(plan: Plan) -> str:
    """Number and length of all trainings, in a line."""
    trainings = Counter(
        (stage.words[0], stage.config["trainer"]["max_steps"])
        for stage in plan.stages
        if stage.config
    )
    listed = [f"{num} {name} of {steps} steps" for (name, steps), num in trainings.items()]
    return f"budget: {trainings.total()} trainings: {', '.join(listed)}"


def run_plan(plan: Plan, say: Callable[[str], None], jobs: int = 1) -> dict[str, str]:
    """Train and test what is not done yet; the same call continues after an interrupt.

    A job is done if it ended well with the same settings; the commit of the code does not count. A
    failed job fails only the jobs that need it. As many processes at a time as ``jobs`` share the
    cores, and ``say`` receives a line when one starts or ends. Returns the reasons of failures by
    name of the job.
    """
    every = plan_jobs(plan)
    waiting = [job for job in every if not job.done]
    num_jobs = len(waiting)
    if num_jobs < len(every):
        say(f"{len(every) - num_jobs} of {len(every)} are done already")
    cores = max(1, (os.cpu_count() or 1) // jobs)
    job_of = {job.name: job for job in every}
    running: dict[str, Popen[bytes]] = {}
    began: dict[str, float] = {}
    failed: dict[str, str] = {}
    try:
        while waiting or running:
            unfinished = {job.name for job in waiting}.union(running)
            for job in waiting.copy():
                broken = [name for name in job.needs if name in failed]
                if broken:
                    waiting.remove(job)
                    failed[job.name] = f"not run, since {broken[0]} failed"
                    say(f"  ! {job.name} {failed[job.name]}")
                elif len(running) < jobs and unfinished.isdisjoint(job.needs):
                    waiting.remove(job)
                    say(f"  > {job.name}")
                    began[job.name] = time.monotonic()
                    running[job.name] = start(job, cores)
            ended = [name for name, process in running.items() if process.poll() is not None]
            for name in ended:
                reason = finish(job_of[name], running.pop(name).returncode)
                if reason is not None:
                    failed[name] = reason
                    say(f"  ! {name} {reason}")
                else:
                    count = num_jobs - len(waiting) - len(running)
                    seconds = time.monotonic() - began[name]
                    say(f"  = {name}: {seconds:.0f} s ({count} of {num_jobs})")
            if not ended:
                time.sleep(_PAUSE_S)
    finally:
        for process in running.values():
            process.terminate()  # a training saves its checkpoint
        for process in running.values():
            process.wait()
    return failed


def start(job: Job, cores: int) -> Popen[bytes]:
    """Start the process of a job; its output goes to the log."""
    if job.words[0] == "fit":  # one that a killed call has left may still train
        with only_writer(job.place.parent / ".fit.lock", f"trains {job.name}", wait=True):
            pass
    if job.makes is not None:
        job.makes.unlink(missing_ok=True)
    job.place.parent.mkdir(parents=True, exist_ok=True)
    # Without a safe path `python -m` and its own processes import files of the current folder.
    environment = {"OMP_NUM_THREADS": str(cores)} | os.environ | {"PYTHONSAFEPATH": "1"}
    with open(job.log, "ab", opener=no_follow) as log:
        return Popen(
            [sys.executable, "-m", "r3dpa", *job.words],
            stdout=log,
            stderr=log,
            env=environment,
            process_group=0,  # Ctrl-C reaches it once, by way of this process
            preexec_fn=_end_with_parent,
        )


def finish(job: Job, status: int) -> str | None:
    """Mark an ended job as done, or return the reason of its failure with the end of its log."""
    if status:
        reason = f"ended with status {status}"
    elif job.makes is not None and not job.makes.is_file():
        reason = f"left no {job.makes.name}"
    else:
        write_text(job.place.with_suffix(".done"), job.content)
        return None
    lines = job.log.read_text(encoding="utf-8", errors="replace").splitlines()[-_TAIL:]
    return "\n      ".join([f"{reason}; {job.log} ends with", *lines])


def _end_with_parent() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def plan_jobs(plan: Plan) -> list[Job]:
    """Jobs for scans and their reference, trainings and tests, each after those that it needs."""
    out, data, reference = plan.out, plan.out / "data.yaml", plan.out / "reference.safetensors"
    # Baselines see the same scans without features, through sensors of their own.
    trained = [stage.config for stage in plan.stages if stage.on_features]
    if not trained:
        raise ValueError("no row is left to train: compare released files by `r3dpa evaluate`")
    scans, scorer = trained[0]["data"], trained[0]["scorer"]
    sizes = sorted({tuple(config["data"]["init_args"]["grid_size"]) for config in trained})
    write_text(data, yaml.safe_dump({"data": scans}))
    of_scans = json.dumps([scans, sizes], sort_keys=True)
    of_reference = f"{of_scans} {plan.reference}"
    extract = ["features", "--data", str(data), "--grid_sizes", json.dumps(sizes)]
    refer = ["reference", "--data", str(data), "--out", str(reference), *plan.reference]
    jobs = [
        Job("features", extract, out / "features", of_scans),
        Job("reference", refer, out / "reference", of_reference, ("features",), reference),
    ]
    tested = {chain[-1].name for chain in plan.chains}
    for stage in plan.stages:
        if not stage.config:
            jobs += _released_jobs(stage, reference, of_reference, scorer)
            continue
        jobs.append(_training_job(stage))
        if stage.name in tested:
            jobs.append(_test_job(stage, reference, of_reference))
    return jobs


def _training_job(stage: PlannedStage) -> Job:
    needs = (*stage.before, "features") if stage.on_scans else stage.before
    words = ["fit", *_stage_words(stage), "--ckpt_path", "last"]
    words += ["--trainer.logger", json.dumps([_CSV_LOGGER])]
    return Job(stage.name, words, stage.folder / "fit", stage.name, needs)


def _test_job(stage: PlannedStage, reference: Path, of_reference: str) -> Job:
    words = ["test", *_stage_words(stage), "--ckpt_path", str(stage.checkpoint)]
    words += ["--scorer.reference", str(reference), "--trainer.logger", "false"]
    words += ["--trainer.devices", "1"]
    content = json.dumps([of_reference, stage.config.get("scorer")], sort_keys=True)
    needs = (stage.name, "reference")
    return Job(
        f"test of {stage.name}", words, stage.folder / "test", content, needs, stage.evaluation
    )


def _stage_words(stage: PlannedStage) -> list[str]:
    options = ["--run_dir", str(stage.folder), "--trainer.enable_progress_bar", "false"]
    return [*stage.words, *options]


def _released_jobs(
    stage: PlannedStage, reference: Path, of_reference: str, scorer: dict[str, Any]
) -> list[Job]:
    """Samples of released weights, as many as of trained ones, and their comparison."""
    given, *sampling = stage.words
    samples, num = stage.folder / "samples", str(scorer["num_scenes"])
    jobs = []
    if Path(given).is_file():
        words = ["sample", "--ckpt", given, "--out", str(samples), "--num", num, "--pictures", "0"]
        words += sampling
        jobs.append(Job(stage.name, words, stage.folder / "sample", f"{stage.name} {num}"))
        given = str(samples)
    words = ["evaluate", "--samples", given, "--reference", str(reference), "--skip_bad", "true"]
    words += ["--allow_few", str(scorer["allow_few"]).lower()]
    words += ["--out", str(stage.evaluation.parent)]
    spaces, weights = scorer["spaces"], scorer["ckpt"] or {}
    if spaces is not None:
        words += ["--spaces", ",".join(spaces)]
    words += [word for space, path in weights.items() for word in (f"--ckpt.{space}", str(path))]
    needs = (*(job.name for job in jobs), "reference")
    content = f"{of_reference} {given} {num} {scorer['allow_few']} {spaces} {weights}"
    test = f"test of {stage.name}"
    return [*jobs, Job(test, words, stage.folder / "test", content, needs, stage.evaluation)]

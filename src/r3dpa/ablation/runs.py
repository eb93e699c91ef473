"""Runs a plan: each job is an ``r3dpa`` command in its own process, repeated only if needed."""

from __future__ import annotations

import asyncio
import ctypes
import json
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from r3dpa.ablation.plan import Plan, Stage
from r3dpa.io import no_follow, only_writer, write_text

_CSV_LOGGER = {
    "class_path": "lightning.pytorch.loggers.CSVLogger",
    "init_args": {"save_dir": "", "name": ""},
}
_TAIL = 12  # lines of a failed process that are shown


class Job(NamedTuple):
    """A command, whose output goes to ``<place>.log``.

    ``content`` holds the settings that its result depends on, ``needs`` the jobs before it, and
    ``makes`` is a file that it must write.
    """

    name: str
    words: list[str]
    place: Path
    content: str
    needs: tuple[str, ...] = ()
    makes: Path | None = None

    @property
    def done(self) -> bool:
        """Whether it ended well with these settings."""
        mark = self.place.with_suffix(".done")
        made = self.makes is None or self.makes.is_file()
        return made and mark.is_file() and mark.read_text(encoding="utf-8") == self.content


def budget_of(plan: Plan) -> str:
    """Number and length of all trainings, in a line."""
    trainings = Counter(
        (s.words[0], s.config["trainer"]["max_steps"]) for s in plan.stages if s.config
    )
    listed = [f"{num} {name} of {steps} steps" for (name, steps), num in trainings.items()]
    return f"budget: {trainings.total()} trainings: {', '.join(listed)}"


def run_plan(plan: Plan, say: Callable[[str], None], jobs: int = 1) -> dict[str, str]:
    """Trains and tests what is not done yet; the same call continues after an interrupt.

    A job is done if it ended well with the same settings; another commit of the code does not
    count. A failed job fails only the jobs that need it. As many processes at a time as ``jobs``
    share the cores, and ``say`` receives a line when one starts or ends. Returns the reasons of
    failures by name of the job.
    """
    every = _jobs(plan)
    todo = [job for job in every if not job.done]
    if len(todo) < len(every):
        say(f"{len(every) - len(todo)} of {len(every)} are done already")
    failed: dict[str, str] = {}
    tasks: dict[str, asyncio.Task[None]] = {}
    slots, cores = asyncio.Semaphore(jobs), max(1, (os.cpu_count() or 1) // jobs)

    async def finish(job: Job) -> None:
        await asyncio.gather(*(tasks[name] for name in job.needs if name in tasks))
        async with slots:
            began = time.monotonic()
            failure = next((f"not run, since {n} failed" for n in job.needs if n in failed), None)
            if failure is None:
                say(f"  > {job.name}")
                failure = await _run(job, cores)
            if failure is not None:
                failed[job.name] = failure
                say(f"  ! {job.name} {failure}")
                return
            num = sum(task.done() for task in tasks.values()) + 1
            say(f"  = {job.name}: {time.monotonic() - began:.0f} s ({num} of {len(todo)})")

    async def finish_all() -> None:
        tasks.update((job.name, asyncio.create_task(finish(job))) for job in todo)
        await asyncio.gather(*tasks.values())

    asyncio.run(finish_all())
    return failed


async def _run(job: Job, cores: int) -> str | None:
    """Runs the process of a job; why it failed, if it did."""
    if job.words[0] == "fit":  # one that a killed call has left may still train
        with only_writer(job.place.parent / ".fit.lock", f"trains {job.name}", wait=True):
            pass
    if job.makes is not None:
        job.makes.unlink(missing_ok=True)
    job.place.parent.mkdir(parents=True, exist_ok=True)
    log_path = job.place.with_suffix(".log")
    with open(log_path, "ab", opener=no_follow) as log:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "r3dpa", *job.words),
            stdout=log,
            stderr=log,
            # Else `python -m` and its own processes would import files of the current folder.
            env={"OMP_NUM_THREADS": str(cores), "PYTHONSAFEPATH": "1"} | os.environ,
            process_group=0,  # Ctrl-C reaches it once, by way of this process
            preexec_fn=_end_with_parent,
        )
        try:
            status = await process.wait()
        except asyncio.CancelledError:
            process.terminate()  # a training saves its checkpoint
            await process.wait()
            raise
    if status or (job.makes is not None and not job.makes.is_file()):
        why = f"ended with status {status}" if status else f"left no {job.makes and job.makes.name}"
        lines = log_path.read_text(encoding="utf-8", errors="replace").splitlines()[-_TAIL:]
        return "\n      ".join([f"{why}; {log_path} ends with", *lines])
    write_text(job.place.with_suffix(".done"), job.content)
    return None


def _end_with_parent() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def _jobs(plan: Plan) -> list[Job]:
    """Scans and their reference, trainings, tests; each after the jobs that it needs."""
    out, data, reference = plan.out, plan.out / "data.yaml", plan.out / "reference.safetensors"
    # Baselines see the same scans without features, through sensors of their own.
    trained = [stage.config for stage in plan.stages if stage.on_features]
    if not trained:
        raise ValueError("no row is left to train: compare released files by `r3dpa evaluate`")
    featured, scorer = [config["data"] for config in trained], trained[0]["scorer"]
    sizes = sorted({tuple(block["init_args"]["grid_size"]) for block in featured})
    write_text(data, yaml.safe_dump({"data": featured[0]}))
    scans = json.dumps([featured[0], sizes], sort_keys=True)
    of_reference = f"{scans} {plan.reference}"
    extract = ["features", "--data", str(data), "--grid_sizes", json.dumps(sizes)]
    refer = ["reference", "--data", str(data), "--out", str(reference), *plan.reference]
    jobs = [
        Job("features", extract, out / "features", scans),
        Job("reference", refer, out / "reference", of_reference, ("features",), reference),
    ]
    tested = {chain[-1].name for chain in plan.chains}
    for stage in plan.stages:
        name, folder = stage.name, stage.folder
        if not stage.config:
            jobs += _of_released(stage, reference, of_reference, scorer)
            continue
        needs = (*stage.before, "features") if stage.on_scans else stage.before
        words = [*stage.words, "--run_dir", str(folder), "--trainer.enable_progress_bar", "false"]
        fit = ["fit", *words, "--ckpt_path", "last", "--trainer.logger", json.dumps([_CSV_LOGGER])]
        jobs.append(Job(name, fit, folder / "fit", name, needs))
        if name in tested:
            test = ["test", *words, "--ckpt_path", str(folder / "checkpoints/last.ckpt")]
            test += ["--scorer.reference", str(reference), "--trainer.logger", "false"]
            test += ["--trainer.devices", "1"]
            content = json.dumps([of_reference, stage.config.get("scorer")], sort_keys=True)
            needs = (name, "reference")
            jobs.append(
                Job(f"test of {name}", test, folder / "test", content, needs, stage.evaluation)
            )
    return jobs


def _of_released(
    stage: Stage, reference: Path, of_reference: str, scorer: dict[str, Any]
) -> list[Job]:
    """Samples of released weights, as many as of trained ones, and their comparison."""
    (given,) = stage.words
    samples, num = stage.folder / "samples", str(scorer["num_scenes"])
    jobs = []
    if Path(given).is_file():
        words = ["sample", "--ckpt", given, "--out", str(samples), "--num", num, "--pictures", "0"]
        jobs = [Job(stage.name, words, stage.folder / "sample", f"{stage.name} {num}")]
        given = str(samples)
    words = ["evaluate", "--samples", given, "--reference", str(reference), "--skip_bad", "true"]
    words += [
        "--allow_few",
        str(scorer["allow_few"]).lower(),
        "--out",
        str(stage.evaluation.parent),
    ]
    needs = (*(job.name for job in jobs), "reference")
    content = f"{of_reference} {given}"
    test = f"test of {stage.name}"
    return [*jobs, Job(test, words, stage.folder / "test", content, needs, stage.evaluation)]

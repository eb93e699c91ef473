"""Runs a plan: each job is an ``r3dpa`` command in its own process, repeated only if needed."""

from __future__ import annotations

import asyncio
import ctypes
import json
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
import torch
import yaml
from lightning.pytorch.cli import LightningArgumentParser
from torch.utils.flop_counter import FlopCounterMode

from r3dpa.ablation.plan import Plan
from r3dpa.io import only_writer, source_commit
from r3dpa.metrics.results import save_text
from r3dpa.modules import GenerativeModule
from r3dpa.modules.steps import PathDraws

_CSV_LOGGER = {
    "class_path": "lightning.pytorch.loggers.CSVLogger",
    "init_args": {"save_dir": "", "name": ""},
}
_TAIL = 12  # lines of a failed process that are shown
_STOP_SECONDS = 60.0  # for a stopped training to save its checkpoint
#: Operations per second: A100 by the paper's 1 M joint steps of 32 scans in 70 h, 15 % of the peak
#: of eight; the same share of an H200's peak is assumed.
_RATES = {"1 x H200": 150e12, "8 x A100": 8 * 48e12}


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
        same = mark_of(self.place).get("content") == self.content
        return same and (self.makes is None or self.makes.is_file())


def mark_of(place: Path) -> dict[str, Any]:
    """Settings and commit of a job that has ended well; empty before."""
    path = place.with_suffix(".done")
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}


def run_plan(plan: Plan, out: Path, say: Callable[[str], None], jobs: int = 1) -> dict[str, str]:
    """Trains and tests what is not done yet; the same call continues after an interrupt.

    A job is done if it ended well with the same settings; another commit of the code does not
    count. A failed job fails only the jobs that need it.

    Args:
        plan: Plan to run.
        out: Folder of the ablation.
        say: Receives a line for each process that starts or ends.
        jobs: Processes at a time, which share the cores.

    Returns:
        Reasons of failures by name of the job.

    Raises:
        ValueError: If ``jobs`` is below 1.
    """
    if jobs < 1:
        raise ValueError(f"--jobs must be at least 1, got {jobs}")
    every = _jobs(plan, out)
    todo = [job for job in every if not job.done]
    num_done = len(every) - len(todo)
    if num_done:
        say(f"{num_done} of {len(every)} are done already")
    failed: dict[str, str] = {}
    cores = max(1, (os.cpu_count() or 1) // jobs)

    async def finish(job: Job, slots: asyncio.Semaphore) -> None:
        nonlocal num_done
        await asyncio.gather(*(tasks[name] for name in job.needs if name in tasks))
        if cause := next((name for name in job.needs if name in failed), None):
            failed[job.name] = f"not run, since {cause} failed"
            say(f"  - {job.name}: {failed[job.name]}")
            return
        async with slots:
            say(f"  > {job.name}")
            began = time.monotonic()
            if failure := await _run(job, cores):
                failed[job.name] = failure
                say(f"  ! {job.name} {failure}")
                return
            num_done += 1
            took = time.monotonic() - began
            say(f"  = {job.name}: {took:.0f} s ({num_done} of {len(every)})")

    tasks: dict[str, asyncio.Task[None]] = {}

    async def finish_all() -> None:
        slots = asyncio.Semaphore(jobs)
        for job in todo:
            tasks[job.name] = asyncio.create_task(finish(job, slots))
        await asyncio.gather(*tasks.values())

    asyncio.run(finish_all())
    return failed


async def _run(job: Job, cores: int) -> str | None:
    """Runs the process of a job; why it failed, if it did."""
    if job.words[0] == "fit":  # one that a killed call has left may still save its checkpoint
        with only_writer(job.place.parent / ".fit.lock", f"trains {job.name}", wait=True):
            pass
    if job.makes is not None:
        job.makes.unlink(missing_ok=True)
    job.place.parent.mkdir(parents=True, exist_ok=True)
    log_path = job.place.with_suffix(".log")
    with log_path.open("ab") as log:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "r3dpa", *job.words),
            stdout=log,
            stderr=log,
            env={"OMP_NUM_THREADS": str(cores)} | os.environ,
            process_group=0,  # Ctrl-C reaches it once, by way of this process
            preexec_fn=_end_with_parent,
        )
        try:
            status = await process.wait()
        except asyncio.CancelledError:
            process.terminate()  # a training saves its checkpoint
            try:
                await asyncio.wait_for(process.wait(), _STOP_SECONDS)
            except TimeoutError:
                process.kill()
            raise
    if status or (job.makes is not None and not job.makes.is_file()):
        why = f"ended with status {status}" if status else f"left no {job.makes and job.makes.name}"
        lines = log_path.read_text(encoding="utf-8", errors="replace").splitlines()[-_TAIL:]
        return "\n      ".join([f"{why}; {log_path} ends with", *lines])
    mark = {"content": job.content, "commit": source_commit()}
    save_text(job.place.with_suffix(".done"), json.dumps(mark))
    return None


def _end_with_parent() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def _jobs(plan: Plan, out: Path) -> list[Job]:
    """Scans and their reference, trainings, tests; each after the jobs that it needs."""
    data, reference = out / "data.yaml", out / "reference.safetensors"
    on_scans = [_placed(stage.config["data"], out) for stage in plan.stages if stage.on_scans]
    sizes = sorted({tuple(block["init_args"]["grid_size"]) for block in on_scans})
    save_text(data, yaml.safe_dump({"data": on_scans[0]}))
    scans = json.dumps([on_scans[0], sizes], sort_keys=True)
    words = ["features", "--data", str(data), "--grid_sizes", json.dumps(sizes)]
    jobs = [Job("features", words, out / "features", scans)]
    words = ["reference", "--data", str(data), "--out", str(reference), *plan.reference]
    of_reference = f"{scans} {plan.reference}"
    needs: tuple[str, ...] = ("features",)
    jobs.append(Job("reference", words, out / "reference", of_reference, needs, reference))
    for stage in plan.stages:
        folder = stage.folder(out)
        words = [*_placed(stage.words, out), "--run_dir", str(folder)]
        words += ["--trainer.enable_progress_bar", "false"]
        needs = (*stage.before, "features") if stage.on_scans else stage.before
        fit = ["fit", *words, "--ckpt_path", "last", "--trainer.logger", json.dumps([_CSV_LOGGER])]
        jobs.append(Job(stage.name, fit, folder / "fit", stage.name, needs))
        if stage in plan.tested:
            test = ["test", *words, "--ckpt_path", str(folder / "checkpoints/last.ckpt")]
            test += ["--scorer.reference", str(reference), "--trainer.logger", "false"]
            test += ["--trainer.devices", "1"]
            content = json.dumps([of_reference, stage.config.get("scorer")], sort_keys=True)
            needs, makes = (stage.name, "reference"), stage.evaluation(out)
            jobs.append(Job(f"test of {stage.name}", test, folder / "test", content, needs, makes))
    return jobs


def _placed(content: Any, out: Path) -> Any:
    """Words or a configuration with the folder of the ablation for ``{out}``."""
    return json.loads(json.dumps(content).replace("{out}", json.dumps(str(out))[1:-1]))


def budget_of(plan: Plan) -> str:
    """Estimated cost of all trainings, without sampling and metrics, in a line."""
    flop = 0.0
    for stage in plan.stages:
        trainer, batch = stage.config["trainer"], stage.config["data"]["init_args"]["batch_size"]
        devices = str(trainer["devices"])
        batch *= trainer["accumulate_grad_batches"] * (int(devices) if devices.isdigit() else 1)
        flop += trainer["max_steps"] * batch * flop_per_sample(stage.config)
    hours = [f"{flop / rate / 3600:.3g} h on {machine}" for machine, rate in _RATES.items()]
    return (
        f"budget: {len(plan.stages)} trainings, {flop:.3g} FLOP; {', '.join(hours)} (for large "
        "networks; small ones do not use a GPU fully)"
    )


def flop_per_sample(config: Mapping[str, Any]) -> float:
    """Operations of a training step on one scan or image, counted on the meta device."""
    model = deepcopy(config["model"])
    if teacher := model["init_args"].get("teacher"):
        teacher["init_args"]["weights"] = None
    parser = LightningArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(L.LightningModule, "model")
    parsed = parser.parse_object({"model": model})
    with torch.device("meta"):
        module = parser.instantiate(parsed).model.train()
        channels, side = module.vae.latent_channels, config["data"]["init_args"].get("image_size")
        batch = {}
        if isinstance(module, GenerativeModule):
            rows, columns = module.sit.input_size
            grid = math.prod(module.sit.grid_size), module.sit.feature_dim
            batch["feature_grid"] = torch.empty(1, *grid)
            size = rows * module.vae.stride[0], columns * module.vae.stride[1]
            batch["range_image"] = torch.empty(1, 1, *size)
        elif side is not None:
            rows, columns = module.vae.latent_size((side, side))
            batch["image"] = torch.empty(1, 3, side, side)
        if getattr(module, "cache_latents", not isinstance(module, GenerativeModule)):
            batch["posterior_moments"] = torch.empty(1, 2 * channels, rows, columns)
        latents = torch.empty(1, channels, rows, columns)
        draws = PathDraws(latents, torch.empty(1), latents)
    module.draw_path, module.log_dict = lambda *_: draws, lambda *_: None
    with FlopCounterMode(display=False) as counter:
        module.training_step(batch, 0).backward()
    return counter.get_total_flops()

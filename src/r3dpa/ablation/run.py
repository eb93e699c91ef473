"""Runs a plan: each job is an ``r3dpa`` command in its own process, repeated only if needed."""

from __future__ import annotations

import asyncio
import ctypes
import json
import math
import os
import shutil
import signal
import sys
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
import torch
import yaml
from lightning.pytorch.cli import LightningArgumentParser
from torch.utils.flop_counter import FlopCounterMode

from r3dpa.ablation.plan import Plan, Stage, with_value
from r3dpa.io import atomic_path, only_writer, source_commit
from r3dpa.metrics.scene_features import FREE_SPACES
from r3dpa.modules import GenerativeModule
from r3dpa.modules.steps import PathDraws

_TAIL = 12  # lines of a failed process that are shown
_STOP_SECONDS = 60.0  # for a stopped training to save its checkpoint
#: Operations per second: A100 by the paper's 1 M joint steps of 32 scans in 70 h, 15 % of the peak
#: of eight; the same share of an H200's peak is assumed.
_RATES = {"1 x H200": 150e12, "8 x A100": 8 * 48e12}


class Job(NamedTuple):
    """A command, with its output in ``<place>.log`` and its state in ``<place>.state``.

    ``content`` holds the settings that its result depends on, ``needs`` the jobs before it,
    ``uses`` those of them whose results change its own, ``makes`` a file that it must write.
    """

    name: str
    words: list[str]
    place: Path
    content: str
    needs: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()
    makes: Path | None = None

    def ending(self, endings: Mapping[str, str]) -> str | None:
        """Mark of its last success; None if settings or results before it have changed since."""
        state = state_of(self.place)
        used = {name: endings.get(name) for name in self.uses}
        same = (state.get("content"), state.get("used")) == (self.content, used)
        return state.get("ending") if same and (not self.makes or self.makes.is_file()) else None


def state_of(place: Path) -> dict[str, Any]:
    """Settings, inputs and commit of a job's last start, and ``ending`` if it succeeded."""
    path = place.with_suffix(".state")
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: is damaged ({error}); remove it to run its job again") from error


def stage_folder(out: Path, stage: Stage) -> Path:
    """Run folder of a stage."""
    return out / "stages" / stage.name


def evaluation_of(out: Path, stage: Stage) -> Path:
    """File with the numbers of a tested stage."""
    return stage_folder(out, stage) / "evaluation" / "evaluation.json"


def run_plan(
    plan: Plan,
    out: Path,
    say: Callable[[str], None],
    jobs: int = 1,
    devices: int = 1,
    online: bool = False,
) -> dict[str, str]:
    """Trains and tests what is not done yet; the same call continues after an interrupt.

    A job is done if it ended well with the same settings and the same results of the jobs before
    it; another commit of the code does not count. A failed job fails only the jobs that need it.

    Args:
        plan: Plan to run.
        out: Folder of the ablation.
        say: Receives a line for each process that starts or ends.
        jobs: Processes at a time, which share the cores.
        devices: Devices of each training, which share its batches.
        online: Log the stages to wandb while they train.

    Returns:
        Reasons of failures by name of the job.

    Raises:
        ValueError: If a count is below 1, or a stage's batch cannot be shared by the devices.
    """
    if jobs < 1 or devices < 1:
        raise ValueError(f"--jobs and --devices must be at least 1, got {jobs} and {devices}")
    every = _jobs(plan, out, devices, online)
    endings: dict[str, str] = {}
    failed: dict[str, str] = {}
    for job in every:
        if job.words[0] == "fit":  # that a killed call has left may still save its checkpoint
            with only_writer(job.place.parent / ".fit.lock", f"trains {job.name}", wait=True):
                pass
        if ending := job.ending(endings):
            endings[job.name] = ending
    if endings:
        say(f"{len(endings)} of {len(every)} are done already")
    cores = max(1, (os.cpu_count() or 1) // jobs)
    slots = asyncio.Semaphore(jobs)
    tasks: dict[str, asyncio.Task[None]] = {}

    async def finish(job: Job) -> None:
        for name in job.needs:
            if name in tasks:
                await tasks[name]
        if cause := next((name for name in job.needs if name in failed), None):
            failed[job.name] = f"not run, since {cause} failed"
            say(f"  - {job.name}: {failed[job.name]}")
            return
        async with slots:
            say(f"  > {job.name}")
            began = time.monotonic()
            used = {name: endings[name] for name in job.uses}
            if failure := await _run(job, used, cores):
                failed[job.name] = failure
                say(f"  ! {job.name} {failure}")
                return
            endings[job.name] = state_of(job.place)["ending"]
            took = time.monotonic() - began
            say(f"  = {job.name}: {took:.0f} s ({len(endings)} of {len(every)})")

    async def finish_all() -> None:
        for job in every:
            if job.name not in endings:
                tasks[job.name] = asyncio.create_task(finish(job))
        await asyncio.gather(*tasks.values())

    asyncio.run(finish_all())
    return failed


async def _run(job: Job, used: Mapping[str, str], cores: int) -> str | None:
    """Runs the process of a job; why it failed, if it did."""
    if job.words[0] == "fit" and state_of(job.place).get("used", used) != used:  # of other inputs
        for path in job.place.parent.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
    if job.makes is not None:
        job.makes.unlink(missing_ok=True)
    state = {"content": job.content, "used": used, "commit": source_commit()}
    _write(job.place.with_suffix(".state"), state)
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
    _write(job.place.with_suffix(".state"), state | {"ending": uuid.uuid4().hex})
    return None


def _end_with_parent() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def _jobs(plan: Plan, out: Path, devices: int, online: bool) -> list[Job]:
    """Scans and their reference, trainings, tests; each after the jobs that it needs."""
    data, reference = out / "data.yaml", out / "reference.safetensors"
    _write(data, _placed({"data": plan.scale.data["data"]}, out))
    scorer = plan.scale.scorer
    files = scorer.get("ckpt") or {}
    names = scorer.get("spaces") or list(dict.fromkeys((*FREE_SPACES, *files)))
    spaces = ["--spaces", ",".join(names)]
    for name, file in files.items():
        spaces += [f"--ckpt.{name}", str(file)]
    spaces += ["--protocol", scorer["protocol"]] if scorer.get("protocol") else []
    scans = json.dumps(plan.scale.data, sort_keys=True)
    on_scans = [stage.config["data"]["init_args"] for stage in plan.stages if stage.on_scans]
    grids = sorted({tuple(init_args["grid_size"]) for init_args in on_scans})
    words = ["features", "--data", str(data), "--grid_sizes", json.dumps(grids)]
    jobs = [Job("features", words, out / "features", f"{scans} {grids}")]
    words = ["reference", "--data", str(data), "--out", str(reference), *spaces]
    place, content = out / "reference", f"{scans} {spaces}"
    jobs.append(Job("reference", words, place, content, ("features",), makes=reference))
    for stage in plan.stages:
        folder = stage_folder(out, stage)
        _write(folder / "stage.yaml", settled(stage, out, devices, online))
        words = ["fit", "--config", str(folder / "stage.yaml"), "--run_dir", str(folder)]
        words += ["--ckpt_path", "last"]
        needs = (*stage.before, "features") if stage.on_scans else stage.before
        jobs.append(Job(stage.name, words, folder / "fit", stage.name, needs, stage.before))
    for stage in plan.tested:
        folder = stage_folder(out, stage)
        words = ["test", "--config", str(folder / "stage.yaml"), "--run_dir", str(folder)]
        words += [
            "--ckpt_path",
            str(folder / "checkpoints/last.ckpt"),
            "--scorer.reference",
            str(reference),
        ]
        words += ["--trainer.logger", "false", "--trainer.devices", "1"]
        content = json.dumps([scans, stage.config.get("scorer")], sort_keys=True)
        needs, makes = (stage.name, "reference"), evaluation_of(out, stage)
        jobs.append(
            Job(f"test of {stage.name}", words, folder / "test", content, needs, needs, makes)
        )
    return jobs


def settled(stage: Stage, out: Path, devices: int = 1, online: bool = False) -> dict[str, Any]:
    """Configuration of a stage with folders, devices and loggers."""
    config = _placed(stage.config, out)
    batch = config["data"]["init_args"]["batch_size"]
    if batch % devices:
        raise ValueError(
            f"--devices {devices}: a batch of {batch} scans ({stage.experiment}) cannot be shared "
            "by them; give a divisor of it"
        )
    loggers = {"CSVLogger": {"name": ""}}
    if online:
        group = f"stages of {out.name}"
        names = {"name": stage.name, "job_type": "stage", "group": group}
        loggers["WandbLogger"] = {"project": "r3dpa", **names}
    listed = [
        {"class_path": f"lightning.pytorch.loggers.{name}", "init_args": {"save_dir": "runs"} | own}
        for name, own in loggers.items()
    ]
    trainer = {"devices": devices, "enable_progress_bar": False, "logger": listed}
    config = with_value(config, "data.init_args.batch_size", batch // devices)
    return with_value(config, "trainer", trainer)


def _placed(config: Mapping[str, Any], out: Path) -> dict[str, Any]:
    """A configuration with the folder of the ablation for ``{out}``."""
    placed: dict[str, Any] = json.loads(
        json.dumps(config).replace("{out}", json.dumps(str(out))[1:-1])
    )
    return placed


def _write(path: Path, content: Mapping[str, Any]) -> None:
    dump = yaml.safe_dump if path.suffix == ".yaml" else json.dumps
    with atomic_path(path) as temporary:
        temporary.write_text(dump(dict(content)), encoding="utf-8")


def budget_of(plan: Plan) -> str:
    """Estimated cost of all trainings, without sampling and metrics, in a line."""
    flop = 0.0
    for stage in plan.stages:
        trainer, batch = stage.config["trainer"], stage.config["data"]["init_args"]["batch_size"]
        batch *= trainer.get("accumulate_grad_batches", 1)
        flop += trainer["max_steps"] * batch * flop_per_sample(stage.config)
    hours = [f"{flop / rate / 3600:.3g} h on {machine}" for machine, rate in _RATES.items()]
    return (
        f"budget: {len(plan.stages)} trainings, {flop:.3g} FLOP; {', '.join(hours)} (for large "
        "networks; small ones do not use a GPU fully)"
    )


def flop_per_sample(config: Mapping[str, Any]) -> float:
    """Operations of a training step on one scan or image, counted on the meta device."""
    if config["model"]["init_args"].get("teacher"):
        config = with_value(config, "model.init_args.teacher.init_args.weights", None)
    parser = LightningArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(L.LightningModule, "model")
    parsed = parser.parse_object({"model": config["model"]})
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

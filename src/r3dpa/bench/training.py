"""What training costs: real steps of each stage, with time, FLOP, memory and their parts."""

from __future__ import annotations

import json
import logging
import resource
import sys
import tempfile
import time
import warnings
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any, Literal

import lightning as L
import torch
import yaml
from lightning.pytorch.cli import LightningArgumentParser
from torch import Tensor
from tqdm import tqdm

from r3dpa.bench.timing import Comparison
from r3dpa.bench.training_profile import PartCost, StepProfile
from r3dpa.checkpoints import Checkpoint, NetworkState, save_checkpoint
from r3dpa.checkpoints.networks import format_table
from r3dpa.data.datamodules import LidarDataModule
from r3dpa.geometry import LidarSensor
from r3dpa.io import atomic_path, command, machine, one_line, usable_device, versions
from r3dpa.modules import GenerativeModule
from r3dpa.nn import LatentNorm
from r3dpa.nn.backbones import GeometricFeatures
from r3dpa.simulation import simulate

__all__ = ["STAGES", "StageCost", "StepSettings", "training"]

STAGES = ("vae_alignment", "joint", "flow_matching")
"""Experiments that are measured where none are named."""

_GIB = 2**30
_QUICK_ROUNDS = 10


@dataclass(frozen=True)
class StepSettings:
    """How the measured steps are run.

    Args:
        batch_size: Scans per step.
        steps: Optimiser steps. The first one pays for warm-up and runs before the optimiser has
            moments: the peak of a long run takes two.
        precision: Precision as the Trainer names it.
        device: ``cpu``, ``cuda``, or ``auto`` for the GPU where there is one.

    Raises:
        ValueError: If a count is below 1.
    """

    batch_size: int = 1
    steps: int = 2
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    device: Literal["auto", "cpu", "cuda"] = "auto"

    def __post_init__(self) -> None:
        """Check the counts."""
        if self.batch_size < 1 or self.steps < 1:
            raise ValueError(
                f"batch_size and steps must be at least 1, got {self.batch_size} and {self.steps}"
            )

    @property
    def accelerator(self) -> str:
        """``cpu`` or ``cuda``."""
        return usable_device(self.device)


@dataclass(frozen=True)
class StageCost:
    """What training one stage costs.

    Args:
        stage: Name of the experiment.
        num_parameters: Parameters of ``vae``, ``sit`` and ``sit_without_projector`` (both with the
            position embedding, as published counts have it), ``discriminator`` (0 where the stage
            has none), and ``trained``, those that the optimiser moves.
        step_seconds: Wall time of each step: losses, backward, clipping, optimiser and averages,
            without loading the batch.
        loss: Weighted loss of the last step.
        peak_host_bytes: Largest resident memory of the process, everything included.
        peak_gpu_bytes: Largest memory of tensors on the GPU; None on a CPU.
        batch_size: Scans per step.
        parts: Cost of each part of a step, run by itself.
        loader_images_per_second: What one process reads.
        variants: Steps with other settings; None where they were not compared.
        guards: Steps without guards, and with them; None where they were not compared.
    """

    stage: str
    num_parameters: dict[str, int]
    step_seconds: list[float]
    loss: float
    peak_host_bytes: int
    peak_gpu_bytes: int | None
    batch_size: int
    parts: dict[str, PartCost]
    loader_images_per_second: float
    variants: Comparison | None
    guards: Comparison | None

    @property
    def usual_seconds(self) -> float:
        """Median time of a step, without the first one where there are others."""
        return median(self.step_seconds[1:] or self.step_seconds)

    @property
    def images_per_second(self) -> float:
        """Scans that the model takes."""
        return self.batch_size / self.usual_seconds

    @property
    def flop(self) -> int:
        """Floating-point operations of a step."""
        return sum(part.flop for part in self.parts.values())

    def speed_row(self) -> list[str]:
        """Cells of the table of speeds; shares of the time of a step, in percent."""
        shares = ", ".join(
            f"{name} {100 * part.seconds / self.usual_seconds:.0f}"
            for name, part in self.parts.items()
        )
        return [
            self.stage,
            f"{self.images_per_second:.3g}",
            f"{self.loader_images_per_second:.3g}",
            f"{self.flop / self.batch_size / 1e9:.4g}",
            f"{self.flop / self.usual_seconds / 1e9:.4g}",
            shares,
        ]

    def values(self) -> dict[str, Any]:
        """Everything as plain values, with what follows from it."""
        derived = ("usual_seconds", "images_per_second", "flop")
        return asdict(self) | {name: getattr(self, name) for name in derived}

    def row(self) -> list[str]:
        """Cells of the printed table: millions, seconds (first, median of the others), GiB."""
        first, *others = self.step_seconds
        return [
            self.stage,
            *(f"{count / 1e6:.2f}" for count in self.num_parameters.values()),
            f"{first:.3g}",
            f"{median(others):.3g}" if others else "-",
            f"{self.peak_host_bytes / _GIB:.2f}",
            "-" if self.peak_gpu_bytes is None else f"{self.peak_gpu_bytes / _GIB:.2f}",
            f"{self.loss:.4g}",
        ]


def training(
    conf: Path,
    stages: tuple[str, ...] = STAGES,
    settings: StepSettings = StepSettings(),
    out: Path | None = None,
    quick: bool = False,
) -> str:
    """Trains each stage for a few steps, as configured, and says what that costs.

    Each stage runs in a fresh process, so that no peak contains what another stage left behind.
    The scans are simulated, as many as a batch has, with the image and grid size that the networks
    expect; weights start from random values.

    After its steps the parts of a step run by themselves; with ``quick`` whole steps, too, with
    other settings in turn, see :func:`r3dpa.bench.timing.compare`.

    Args:
        conf: Folder of the configurations; stage ``joint`` is ``<conf>/experiment/joint.yaml``.
        stages: Experiments to measure.
        settings: Size, number, precision and place of the steps.
        out: JSON file for the same figures, without rounding.
        quick: The small networks of ``<conf>/experiment/<stage>_demo.yaml``, and comparisons of
            memory format, precision and fused optimiser, and of steps without and with guards.

    Returns:
        A table of costs and one of speeds with a row per stage, and a line each about settings,
        machine and versions.

    Raises:
        ValueError: If there is no such experiment.
        RuntimeError: If the process of a stage was killed, as happens when memory runs out.
    """
    for stage in stages:
        _experiments(conf, stage, quick)
    costs = []
    with tempfile.TemporaryDirectory(prefix="r3dpa_bench_") as folder:
        simulate(Path(folder) / "scans", scans=settings.batch_size)
        for stage in tqdm(stages, unit="stage", desc="bench"):
            costs.append(_in_new_process(stage, conf, Path(folder), settings, quick))
    on_gpu = settings.accelerator == "cuda"
    about: dict[str, Any] = {
        "command": command(),
        "settings": asdict(settings) | {"quick": quick},
        "machine": machine()
        | {
            "threads": torch.get_num_threads(),
            "gpu": torch.cuda.get_device_name() if on_gpu else None,
        },
        "versions": versions(torch, L),
    }
    if out is not None:
        content = {**about, "stages": [cost.values() for cost in costs]}
        with atomic_path(out) as temporary:
            temporary.write_text(json.dumps(content, indent=2) + "\n")
    header = ["stage", "VAE M", "SiT M", "no proj. M", "discr. M", "trained M"]
    header += ["first s", "next s", "host GiB", "GPU GiB", "loss"]
    lines = [format_table(header, (cost.row() for cost in costs))]
    header = ["stage", "images/s", "loader images/s", "GFLOP/image", "GFLOP/s"]
    lines.append(format_table([*header, "% of the step"], (cost.speed_row() for cost in costs)))
    for cost in costs:
        compared = (cost.variants, cost.guards)
        lines += [_variants(cost.stage, cases) for cases in compared if cases is not None]
    for name, values in about.items():
        lines.append(f"{name}: {one_line(values)}")
    return "\n".join(lines)


def _variants(stage: str, comparison: Comparison) -> str:
    """Table of the steps with other settings; ``time`` is over that of the first."""
    rows = []
    for name, times in comparison.ms.items():
        ratio = comparison.over_first.get(name)
        over = "1" if ratio is None else f"{ratio.value:.3f} [{ratio.low:.3f}, {ratio.high:.3f}]"
        rows.append([name, f"{times.median:.4g}", over])
    again = comparison.repeat
    check = f"first case again: {again.value:.3f} [{again.low:.3f}, {again.high:.3f}]"
    sound = "sound" if comparison.sound else "NOT SOUND: the ratios are no evidence"
    return f"{format_table([stage, 'ms', 'time'], rows)}\n{check}, {sound}"


def _in_new_process(
    stage: str, conf: Path, folder: Path, settings: StepSettings, quick: bool
) -> StageCost:
    # spawn: a forked process would share memory with this one.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(_measure, stage, conf, folder, settings, quick).result()
        except BrokenProcessPool as error:
            raise RuntimeError(
                f"the process that trained stage {stage} was killed, most likely for lack of "
                f"memory at batch_size {settings.batch_size}, precision {settings.precision}; "
                "give a smaller batch_size or precision bf16-mixed, or free memory"
            ) from error


def _measure(
    stage: str, conf: Path, folder: Path, settings: StepSettings, quick: bool
) -> StageCost:
    """Trains one stage in this process."""
    # Advice on loaders and loggers, and the list of devices: beside the point here.
    warnings.filterwarnings("ignore", module="lightning")
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    L.seed_everything(0, verbose=False)
    module = _build(_experiments(conf, stage, quick), folder / f"{stage}.safetensors")
    timer, profile = _StepTimer(), StepProfile(_QUICK_ROUNDS if quick else 0)
    trainer = L.Trainer(
        accelerator=settings.accelerator,
        devices=1,
        precision=settings.precision,
        max_steps=settings.steps,
        max_epochs=-1,
        gradient_clip_val=1.0,
        limit_val_batches=0,
        logger=False,
        callbacks=[timer, profile],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder,
    )
    trainer.fit(module, datamodule=_data(module, folder, stage, settings.batch_size))
    return StageCost(
        stage,
        _num_parameters(module),
        timer.seconds,
        timer.loss,
        timer.peak_host_bytes,
        timer.peak_gpu_bytes,
        settings.batch_size,
        profile.parts,
        profile.loader_images_per_second,
        profile.variants,
        profile.guards,
    )


def _experiments(conf: Path, stage: str, quick: bool) -> list[Path]:
    """The experiment, and the one of the small networks that is given after it."""
    paths = [conf / "experiment" / f"{name}.yaml" for name in [stage, f"{stage}_demo"][: 1 + quick]]
    for path in paths:
        if not path.is_file():
            raise ValueError(
                f"there is no experiment {path}; run in the repository of r3dpa, or give conf its "
                "folder conf, which an installed package does not contain"
            )
    return paths


def _build(experiments: list[Path], fresh_vae: Path) -> GenerativeModule:
    """The module of an experiment in one or more files, to start from a VAE with random weights.

    Stage flow_matching refuses to start without the VAE of another stage. Random weights cost the
    same, so all stages are given such a file.
    """
    parser = LightningArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(GenerativeModule, "model")
    parser.add_argument("--trainer", type=dict)  # the length of a whole run: not used
    parser.add_argument("--config", action="config")
    config = parser.parse_args([f"--config={path}" for path in experiments])
    del config["config"]
    module = parser.instantiate_classes(config).model
    # Dumped and read again, the arguments are plain values.
    vae = yaml.safe_load(parser.dump(config))["model"]["init_args"]["vae"]
    norm = LatentNorm(module.vae.latent_channels)
    norm.num_batches_tracked.fill_(1)  # known statistics: 0 and 1
    states = {
        "vae": NetworkState(vae["class_path"], vae["init_args"], module.vae.state_dict()),
        "latent_norm": NetworkState.of(norm, {"channels": norm.channels}),
    }
    save_checkpoint(Checkpoint(fresh_vae, "untrained", states), fresh_vae)
    module.init_from, module.init_networks = str(fresh_vae), tuple(states)
    return module


def _data(module: GenerativeModule, folder: Path, stage: str, batch_size: int) -> LidarDataModule:
    """The simulated scans at the size that the networks of a module expect."""
    beams, columns = (
        size * stride for size, stride in zip(module.sit.input_size, module.vae.stride, strict=True)
    )
    return LidarDataModule(
        str(folder / "scans"),
        sensor=LidarSensor(beams=beams, columns=columns),
        grid_size=module.sit.grid_size,
        extractor=GeometricFeatures(module.sit.feature_dim),
        features_dir=str(folder / f"{stage}_features"),
        batch_size=batch_size,
        val_every=None,
    )


class _StepTimer(L.Callback):
    """Wall time of each step, with the batch on its device at the start, and memory and loss."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.start = 0.0
        self.loss = 0.0
        self.peak_host_bytes = 0
        self.peak_gpu_bytes: int | None = None

    def on_train_batch_start(self, trainer: L.Trainer, *args: Any) -> None:
        """Starts the clock."""
        self.start = self._now(trainer)

    def on_train_batch_end(self, trainer: L.Trainer, *args: Any) -> None:
        """Stops the clock, after optimiser and averages."""
        self.seconds.append(self._now(trainer) - self.start)
        self.loss = float(trainer.callback_metrics["train/loss"])
        self.peak_host_bytes = _peak_host_bytes()
        if trainer.strategy.root_device.type == "cuda":
            self.peak_gpu_bytes = torch.cuda.max_memory_allocated()

    def _now(self, trainer: L.Trainer) -> float:
        if trainer.strategy.root_device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()


def _num_parameters(module: GenerativeModule) -> dict[str, int]:
    sit, discriminator = module.sit, module.discriminator
    whole = _count((*sit.parameters(), *sit.buffers()))  # a fixed position embedding counts
    return {
        "vae": _count(module.vae.parameters()),
        "sit": whole,
        "sit_without_projector": whole - _count(sit.projector.parameters()),
        "discriminator": 0 if discriminator is None else _count(discriminator.parameters()),
        "trained": _count(
            p for net in module.trainable().values() for p in net.parameters() if p.requires_grad
        ),
    }


def _count(tensors: Iterable[Tensor]) -> int:
    return sum(tensor.numel() for tensor in tensors)


def _peak_host_bytes() -> int:
    """Largest resident memory since this program started.

    Linux hands ``ru_maxrss`` on to child processes: there it is at least the memory of the process
    that started this one. ``VmHWM`` begins anew with each program.
    """
    status = Path("/proc/self/status")
    if status.exists():
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024

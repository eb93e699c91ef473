"""``r3dpa bench training``: real steps of each stage, with their time, memory and work."""

from __future__ import annotations

import json
import logging
import tempfile
import time
import warnings
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any, Literal, cast

import lightning as L
import torch
import yaml
from lightning.pytorch.cli import LightningArgumentParser
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode
from tqdm import tqdm

from r3dpa.bench.measure import peak_bytes, synchronise
from r3dpa.checkpoints import Checkpoint, NetworkState, save_checkpoint
from r3dpa.checkpoints.networks import format_table
from r3dpa.data.datamodules import LidarDataModule
from r3dpa.geometry import LidarSensor
from r3dpa.io import atomic_path, command, machine, one_line, usable_device, versions
from r3dpa.modules import GenerativeModule
from r3dpa.nn import LatentNorm
from r3dpa.nn.backbones import GeometricFeatures
from r3dpa.simulation import simulate

STAGES = ("vae_alignment", "joint", "flow_matching")
_GIB = 2**30
_LOADER_EPOCHS = 4  # of one batch; the first one does not count


@dataclass(frozen=True)
class StepSettings:
    """How the measured steps are run.

    Args:
        batch_size: Scans per step.
        steps: Optimiser steps. The first one pays for warm-up and runs before the optimiser has
            moments: the peak of a long run takes two.
        precision: Precision as the Trainer names it.
        device: ``cpu``, ``cuda``, or ``auto`` for the GPU where there is one.
        quick: The small networks of ``<conf>/experiment/<stage>_demo.yaml``.
    """

    batch_size: int = 1
    steps: int = 2
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    device: Literal["auto", "cpu", "cuda"] = "auto"
    quick: bool = False

    def __post_init__(self) -> None:
        """Checks the counts."""
        if self.batch_size < 1 or self.steps < 1:
            raise ValueError(
                f"batch_size and steps must be at least 1, got {self.batch_size} and {self.steps}"
            )


@dataclass(frozen=True)
class StageCost:
    """Cost of training one stage.

    Args:
        stage: Name of the experiment.
        num_parameters: Of ``vae``, ``sit`` and ``sit_without_projector`` (both with the position
            embedding, as published counts have it), ``discriminator`` (0 where there is none), and
            ``trained``, those that the optimiser moves.
        step_seconds: Wall time of each step: losses, backward, clipping, optimiser and averages,
            without loading the batch.
        loss: Weighted loss of the last step.
        peak_host_bytes: Largest resident memory of the process, everything included.
        peak_gpu_bytes: Largest memory of tensors on the GPU; None on a CPU.
        flop: Floating-point operations of a step, counted in one more.
        images_per_second: Scans that the model takes.
        loader_images_per_second: Scans that one process reads.
    """

    stage: str
    num_parameters: dict[str, int]
    step_seconds: list[float]
    loss: float
    peak_host_bytes: int
    peak_gpu_bytes: int | None
    flop: int
    images_per_second: float
    loader_images_per_second: float

    def row(self, batch_size: int) -> list[str]:
        """Cells of the table: millions, seconds (first, median of the others), GiB, FLOP."""
        first, *others = self.step_seconds
        usual = median(others or [first])
        return [
            self.stage,
            *(f"{count / 1e6:.2f}" for count in self.num_parameters.values()),
            f"{first:.3g}",
            f"{median(others):.3g}" if others else "-",
            f"{self.peak_host_bytes / _GIB:.2f}",
            "-" if self.peak_gpu_bytes is None else f"{self.peak_gpu_bytes / _GIB:.2f}",
            f"{self.loss:.4g}",
            f"{self.images_per_second:.3g}",
            f"{self.loader_images_per_second:.3g}",
            f"{self.flop / batch_size / 1e9:.4g}",
            f"{self.flop / usual / 1e9:.4g}",
        ]


def training(
    conf: Path,
    stages: tuple[str, ...] = STAGES,
    settings: StepSettings = StepSettings(),
    out: Path | None = None,
) -> str:
    """Trains each stage for a few steps, as configured, and returns a table of its cost.

    Each stage runs in a fresh process, so that no peak contains what another stage left behind.
    The scans are simulated, as many as a batch has, with the image and grid size that the networks
    expect; weights start from random values.

    Args:
        conf: Folder of the configurations; stage ``joint`` is ``<conf>/experiment/joint.yaml``.
        stages: Experiments to measure.
        settings: Size, number, precision and device of the steps.
        out: JSON file for the same figures, without rounding.

    Raises:
        ValueError: If there is no such experiment.
        RuntimeError: If the process of a stage was killed, as happens when memory runs out.
    """
    settings = replace(settings, device=cast(Any, usable_device(settings.device)))
    files = {stage: _experiments(conf, stage, settings.quick) for stage in stages}
    costs = []
    with tempfile.TemporaryDirectory(prefix="r3dpa_bench_") as folder:
        simulate(Path(folder) / "scans", scans=settings.batch_size)
        for stage in tqdm(stages, unit="stage", desc="bench", disable=None):
            costs.append(_in_new_process(stage, files[stage], Path(folder), settings))
    gpu = torch.cuda.get_device_name() if settings.device == "cuda" else None
    about: dict[str, Any] = {
        "command": command(),
        "settings": asdict(settings),
        "machine": machine() | {"threads": torch.get_num_threads(), "gpu": gpu},
        "versions": versions(torch, L),
    }
    if out is not None:
        content = about | {"stages": [asdict(cost) for cost in costs]}
        with atomic_path(out) as temporary:
            temporary.write_text(json.dumps(content, indent=2) + "\n")
    header = ["stage", "VAE M", "SiT M", "no proj. M", "discr. M", "trained M", "first s", "next s"]
    header += ["host GiB", "GPU GiB", "loss", "images/s", "loader images/s", "GFLOP/image"]
    table = format_table([*header, "GFLOP/s"], (cost.row(settings.batch_size) for cost in costs))
    return "\n".join([table, *(f"{name}: {one_line(values)}" for name, values in about.items())])


def _experiments(conf: Path, stage: str, quick: bool) -> list[Path]:
    """The experiment, and the one of the small networks that is given after it."""
    paths = [conf / "experiment" / f"{name}.yaml" for name in [stage, f"{stage}_demo"][: 1 + quick]]
    for path in paths:
        if not path.is_file():
            raise ValueError(
                f"there is no experiment {path}; name one of {', '.join(STAGES)}, and give conf "
                "the folder of the configurations"
            )
    return paths


def _in_new_process(
    stage: str, files: list[Path], folder: Path, settings: StepSettings
) -> StageCost:
    # spawn: a forked process would share memory with this one.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(_measure, stage, files, folder, settings).result()
        except BrokenProcessPool as error:
            raise RuntimeError(
                f"the process that trained stage {stage} was killed, most likely for lack of "
                f"memory at batch_size {settings.batch_size}, precision {settings.precision}; "
                "give a smaller batch_size or precision bf16-mixed, or free memory"
            ) from error


def _measure(stage: str, files: list[Path], folder: Path, settings: StepSettings) -> StageCost:
    """Trains one stage in this process."""
    # Hints about loaders and loggers do not apply to a benchmark.
    warnings.filterwarnings("ignore", module="lightning")
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    L.seed_everything(0, verbose=False)
    module = _build(files, folder / f"{stage}.safetensors")
    meter = _StepMeter(settings.steps)
    trainer = L.Trainer(
        accelerator=settings.device,
        devices=1,
        precision=settings.precision,
        max_steps=settings.steps + 1,  # the work of the last one is counted
        max_epochs=-1,
        gradient_clip_val=1.0,
        limit_val_batches=0,
        logger=False,
        callbacks=[meter],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder,
    )
    trainer.fit(module, datamodule=_data(module, folder, stage, settings.batch_size))
    usual = median(meter.seconds[1:] or meter.seconds)
    return StageCost(
        stage,
        _num_parameters(module),
        meter.seconds,
        meter.loss,
        meter.peak_host_bytes,
        meter.peak_gpu_bytes,
        meter.flop,
        settings.batch_size / usual,
        _loader_rate(trainer),
    )


def _build(files: list[Path], fresh_vae: Path) -> GenerativeModule:
    """The module of an experiment, to start from a VAE with random weights.

    Stage flow_matching refuses to start without the VAE of another stage. Random weights cost the
    same, so all stages are given such a file.
    """
    parser = LightningArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(GenerativeModule, "model")
    parser.add_argument("--trainer", type=dict)  # the length of a whole run: not used
    parser.add_argument("--config", action="config")
    config = parser.parse_args([f"--config={path}" for path in files])
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


class _StepMeter(L.Callback):
    """Time of each step with its batch on the device, loss and memory; FLOP of one step more."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self.seconds: list[float] = []
        self.flop = 0
        self._start = self.loss = 0.0
        self.peak_host_bytes = 0
        self.peak_gpu_bytes: int | None = None
        self._counting = ExitStack()
        self._counter = FlopCounterMode(display=False)

    def on_train_batch_start(self, trainer: L.Trainer, *args: Any) -> None:
        """Starts clock or counter."""
        if trainer.global_step == self.steps:
            self._counting.enter_context(self._counter)
        self._start = self._now(trainer)

    def on_train_batch_end(self, trainer: L.Trainer, *args: Any) -> None:
        """Stops it, after optimiser and averages."""
        device = trainer.strategy.root_device
        if trainer.global_step > self.steps:
            self._counting.close()
            self.flop = self._counter.get_total_flops()
            return
        self.seconds.append(self._now(trainer) - self._start)
        self.loss = float(trainer.callback_metrics["train/loss"])
        self.peak_host_bytes = peak_bytes(torch.device("cpu"))
        self.peak_gpu_bytes = peak_bytes(device) if device.type == "cuda" else None

    @staticmethod
    def _now(trainer: L.Trainer) -> float:
        synchronise(trainer.strategy.root_device)
        return time.perf_counter()


def _loader_rate(trainer: L.Trainer) -> float:
    """Scans per second of one loader process."""
    rates = []
    for _ in range(_LOADER_EPOCHS):
        start = time.perf_counter()
        num_scans = sum(len(batch["name"]) for batch in cast(Any, trainer.train_dataloader))
        rates.append(num_scans / (time.perf_counter() - start))
    return median(rates[1:])


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

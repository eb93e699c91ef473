"""``r3dpa bench training``: real steps of each stage, with their time, memory and work."""

from __future__ import annotations

import json
import logging
import math
import tempfile
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any, Literal, cast

import lightning as L
import torch
import yaml
from lightning.pytorch.cli import LightningArgumentParser
from torch.utils.flop_counter import FlopCounterMode
from tqdm import tqdm

from lidarsim import simulate
from r3dpa.bench.measure import peak_bytes, synchronise
from r3dpa.checkpoints import Checkpoint, NetworkState, save_checkpoint
from r3dpa.data.datamodules import LidarDataModule
from r3dpa.features import GeometricFeatures
from r3dpa.geometry import LidarSensor
from r3dpa.io import (
    command,
    machine,
    one_line,
    text_table,
    usable_device,
    versions,
    write_text,
)
from r3dpa.modules import GenerativeModule
from r3dpa.nn import LatentNorm

STAGES = ("vae_alignment", "joint", "flow_matching")


@dataclass(frozen=True)
class StepSettings:
    """Settings of the measured steps; ``quick`` measures the networks of the demo.

    The first of ``steps`` pays for warm-up and runs before the optimiser has moments: the peak of a
    long run takes two.
    """

    batch_size: int = 1
    steps: int = 2
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    device: Literal["auto", "cpu", "cuda"] = "auto"
    quick: bool = False


@dataclass
class StageCost:
    """Cost of training one stage.

    ``step_seconds`` are times of losses, backward, clipping, optimiser and EMA, without loading;
    ``flop`` is of one step, ``peak_host_bytes`` of the process, ``peak_gpu_bytes`` of tensors.
    """

    stage: str
    step_seconds: list[float] = field(default_factory=list)
    loss: float = 0.0
    peak_host_bytes: int = 0
    peak_gpu_bytes: int | None = None
    flop: int = 0
    images_per_second: float = 0.0

    def row(self) -> dict[str, str]:
        """Cells of the table."""
        first, *others = self.step_seconds
        gpu = self.peak_gpu_bytes
        return {
            "stage": self.stage,
            "first s": f"{first:.3g}",
            "next s": f"{median(others):.3g}" if others else "-",
            "host GiB": f"{self.peak_host_bytes / 2**30:.2f}",
            "GPU GiB": "-" if gpu is None else f"{gpu / 2**30:.2f}",
            "loss": f"{self.loss:.4g}",
            "images/s": f"{self.images_per_second:.3g}",
            "GFLOP/step": f"{self.flop / 1e9:.4g}",
            "GFLOP/s": f"{self.flop / median(others or [first]) / 1e9:.4g}",
        }


def training(
    conf: Path,
    stages: tuple[str, ...] = STAGES,
    settings: StepSettings = StepSettings(),
    out: Path | None = None,
) -> str:
    """Train each stage for a few steps on simulated scans; return a table of its cost.

    Each stage runs in a fresh process, so that no peak contains what another stage left behind.

    Args:
        conf: Folder of the configurations: stage ``joint`` is ``<conf>/experiment/joint.yaml``.
        stages: Stages to measure.
        settings: Size of the measurement.
        out: JSON file for the figures without rounding.

    Raises:
        RuntimeError: If a process was killed, as happens when memory runs out.
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
        write_text(out, json.dumps(content, indent=2) + "\n")
    rows = [cost.row() for cost in costs]
    table = text_table(([*row.values()] for row in rows), list(rows[0]))
    return "\n".join([table, *(f"{name}: {one_line(values)}" for name, values in about.items())])


def _experiments(conf: Path, stage: str, quick: bool) -> list[Path]:
    paths = [conf / "experiment" / f"{stage}.yaml"]
    if quick:
        paths.append(conf / "demo" / f"{stage}.yaml")
    for path in paths:
        if not path.is_file():
            raise ValueError(f"{path} does not exist; choose stages from {', '.join(STAGES)}")
    return paths


def _in_new_process(
    stage: str, files: list[Path], folder: Path, settings: StepSettings
) -> StageCost:
    # spawn: a forked process would share memory with this one.
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        try:
            return pool.submit(_measure, stage, files, folder, settings).result()
        except BrokenProcessPool as error:
            raise RuntimeError(
                f"the process that trained stage {stage} was killed, most likely for lack of "
                f"memory at batch_size {settings.batch_size}, precision {settings.precision}; "
                "give a smaller batch_size or precision bf16-mixed, or free memory"
            ) from error


@contextmanager
def quiet_lightning() -> Iterator[None]:
    """Hide hints about loaders and loggers, which do not apply to a benchmark."""
    logger = logging.getLogger("lightning.pytorch")
    level = logger.level
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="lightning")
        logger.setLevel(logging.WARNING)
        try:
            yield
        finally:
            logger.setLevel(level)


def _measure(stage: str, files: list[Path], folder: Path, settings: StepSettings) -> StageCost:
    L.seed_everything(0, verbose=False)
    module = _build(files, folder / f"{stage}.safetensors")
    data = _data(module, folder, stage, settings.batch_size)
    with quiet_lightning():
        return measure_steps(module, data, settings)


def measure_steps(
    module: GenerativeModule,
    data: LidarDataModule,
    settings: StepSettings,
    *,
    counts_work: bool = True,
    enough_s: float = math.inf,
) -> StageCost:
    """Train a module for some steps, and for one more to count its FLOP.

    Files that the stage makes, such as caches, lie beside the feature grids of the data.

    Args:
        module: Stage to train.
        data: Scans, with a folder of feature grids.
        settings: Steps, batch size, precision and device.
        counts_work: Whether to count FLOP.
        enough_s: End after the step that reaches this time in all.
    """
    cost = StageCost(module.stage)
    trainer = L.Trainer(
        accelerator=settings.device,
        devices=1,
        precision=settings.precision,
        max_steps=settings.steps + counts_work,
        max_epochs=-1,
        gradient_clip_val=1.0,
        limit_val_batches=0,
        logger=False,
        callbacks=[_StepMeter(settings.steps, cost, enough_s)],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=cast(Path, data.features_dir).parent,
    )
    trainer.fit(module, datamodule=data)
    seconds = median(cost.step_seconds[1:] or cost.step_seconds)
    cost.images_per_second = settings.batch_size / seconds
    return cost


def _build(files: list[Path], fresh_vae: Path) -> GenerativeModule:
    """Build the module of an experiment, with a VAE of random weights as the stage before.

    Stage flow_matching refuses to start without one, and random weights cost the same.
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

    def __init__(self, steps: int, cost: StageCost, enough_s: float) -> None:
        self.steps, self.cost, self.enough_s, self._start = steps, cost, enough_s, 0.0
        self._counting = ExitStack()
        self._counter = FlopCounterMode(display=False)

    def on_train_batch_start(self, trainer: L.Trainer, *args: Any) -> None:
        """Start the clock, or the counter in the last step."""
        if trainer.global_step == self.steps:
            self._counting.enter_context(self._counter)
        self._start = self._now(trainer)

    def on_train_batch_end(self, trainer: L.Trainer, *args: Any) -> None:
        """Stop it, after optimiser and EMA."""
        device = trainer.strategy.root_device
        if trainer.global_step > self.steps:
            self._counting.close()
            self.cost.flop = self._counter.get_total_flops()
            return
        self.cost.step_seconds.append(self._now(trainer) - self._start)
        trainer.should_stop = sum(self.cost.step_seconds) >= self.enough_s
        self.cost.loss = float(trainer.callback_metrics["train/loss"])
        self.cost.peak_host_bytes = peak_bytes(torch.device("cpu"))
        self.cost.peak_gpu_bytes = peak_bytes(device) if device.type == "cuda" else None

    @staticmethod
    def _now(trainer: L.Trainer) -> float:
        synchronise(trainer.strategy.root_device)
        return time.perf_counter()

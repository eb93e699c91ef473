"""``r3dpa fit --dry_run``: what a training takes, from a measured step."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, cast

import torch
from lightning import LightningDataModule, LightningModule, Trainer

from lidarsim import simulate
from r3dpa.bench.training import (
    STAGES,
    StageCost,
    StepSettings,
    measure_steps,
    quiet_lightning,
)
from r3dpa.callbacks import EMASnapshots
from r3dpa.data.datamodules import LidarDataModule, SimulatedDataModule
from r3dpa.data.range_images import SimulatedImageDataModule
from r3dpa.features import GeometricFeatures
from r3dpa.modules import GenerativeModule

_PAPER_BATCH = 32
_LONG_S = 30 * 86400.0
_MOST_STEPS, _ENOUGH_S = 5, 10.0  # of the measurement
_SIMULATED_SCAN_BYTES = 2.6e6


@dataclass(frozen=True)
class DryRun:
    """A training that is described, but not started.

    Args:
        module: Stage, as ``r3dpa fit`` makes it.
        data: Its data module.
        trainer: Trainer with the devices, steps and checkpoints of the run.
    """

    module: LightningModule
    data: LightningDataModule
    trainer: Trainer

    def describe(self) -> str:
        """Measure a step, and return global batch, steps, time, memory and disk, line by line.

        The scans of the step are simulated, whatever the data. On a CPU a step has one scan, and
        the first one is the last if it takes long, so that the answer takes a minute.
        """
        lines = [*batch_lines(self.module, self.data, self.trainer), *self._time_and_memory()]
        lines += [f"disk: {part}" for part in (*self._checkpoints(), *self._scans_and_caches())]
        return "\n".join(lines)

    def _time_and_memory(self) -> list[str]:
        steps = self.trainer.max_steps
        if steps <= 0:
            return ["steps: no limit; give --trainer.max_steps"]
        lines = [f"steps: {steps:,}"]
        if getattr(self.module, "stage", None) not in STAGES:
            return [*lines, f"time: not measured; only stages {', '.join(STAGES)} are"]
        settings = self._settings()
        cost = self._measure(settings)
        count = len(cost.step_seconds)
        seconds = median(cost.step_seconds[1:] or cost.step_seconds)  # the first warms up
        scans = cast(Any, self.data).batch_size * self.trainer.accumulate_grad_batches
        step_s = seconds * scans / settings.batch_size
        lines += [
            f"time: {_duration(step_s * steps)} without loading and validation, {step_s:.3g} s per "
            f"step of {scans} scans in each process",
            f"measured: {seconds:.3g} s per step of {settings.batch_size}, in {count} "
            f"step{'s' * (count > 1)} on {settings.device} with {torch.get_num_threads()} "
            f"thread{'s' * (torch.get_num_threads() > 1)}, {settings.precision}",
        ]
        if step_s * steps > _LONG_S:
            lines += [
                f"warning: {_duration(step_s * steps)} on this machine: take GPUs, or fewer steps "
                "(--trainer.max_steps), or try the stage with --preset demo"
            ]
        if cost.peak_gpu_bytes is not None:
            return [*lines, f"memory: {_size(cost.peak_gpu_bytes)} of each GPU"]
        memory = f"memory: {_size(cost.peak_host_bytes)} of the process with 1 scan per step"
        return [*lines, f"{memory}, more with {scans}" if scans > 1 else memory]

    def _settings(self) -> StepSettings:
        on_gpu = self.trainer.strategy.root_device.type == "cuda"
        return StepSettings(
            batch_size=cast(Any, self.data).batch_size if on_gpu else 1,
            steps=_MOST_STEPS,
            precision=cast(Any, self.trainer.precision),
            device="cuda" if on_gpu else "cpu",
        )

    def _measure(self, settings: StepSettings) -> StageCost:
        module, data = cast(GenerativeModule, self.module), cast(LidarDataModule, self.data)
        with (
            tempfile.TemporaryDirectory(prefix="r3dpa_dry_run_") as folder,
            quiet_lightning(),
        ):
            simulate(Path(folder) / "scans", scans=settings.batch_size)
            scans = LidarDataModule(
                str(Path(folder) / "scans"),
                sensor=data.sensor,
                codec=data.codec,
                grid_size=data.grid_size,
                extractor=GeometricFeatures(module.sit.feature_dim),
                features_dir=str(Path(folder) / "features"),
                batch_size=settings.batch_size,
                val_every=None,
            )
            # With the beams of the run: a checkpoint to start from is compared with them.
            scans.beams, scans.projection_kind = data.beams, data.projection_kind
            if hasattr(module, "latents_dir"):
                # The cache of the run itself is for its own scans.
                cast(Any, module).latents_dir = None
            return measure_steps(module, scans, settings, counts_work=False, enough_s=_ENOUGH_S)

    def _checkpoints(self) -> list[str]:
        """Size and number of checkpoints and snapshots that stay."""
        trainer: Any = self.trainer
        state = sum(tensor.nbytes for tensor in self.module.state_dict().values())
        trained = sum(p.numel() for p in self.module.parameters() if p.requires_grad)
        size = state + 2 * 4 * trained  # both moments of AdamW
        saver = trainer.checkpoint_callback
        count = 1 + max(0, saver.save_top_k)
        if saver.save_top_k < 0 < trainer.max_steps:
            every = saver._every_n_train_steps or trainer.max_steps  # 0 with every_n_epochs
            count = math.ceil(trainer.max_steps / every)
        parts = [f"{count} checkpoints of {_size(size)}, {_size(count * size)}"]
        for callback in trainer.callbacks:
            if not isinstance(callback, EMASnapshots):
                continue
            if (ema := callback.average_of(self.module)) is not None:
                count = len(callback.fractions if callback.steps is None else callback.steps)
                size = sum(tensor.nbytes for tensor in ema.sit.state_dict().values())
                parts += [f"{count} snapshots of {_size(size)}, {_size(count * size)}"]
        return parts

    def _scans_and_caches(self) -> list[str]:
        """Sizes of scans, feature grids and cached latents, if the scans are known."""
        data, module = self.data, self.module
        if not isinstance(data, LidarDataModule):
            return []
        try:
            train, val = data.limited_split()
            num_scans = len(train) + len(val)
            if isinstance(data, SimulatedImageDataModule):
                scan_bytes = num_scans * data.image_bytes
            else:
                scan_bytes = sum(scan.path.stat().st_size for scan in train + val)
            parts = [f"{num_scans:,} scans, {_size(scan_bytes)}"]
        except ValueError as error:  # before they are downloaded or simulated
            if not isinstance(data, SimulatedDataModule):
                return [f"scans and caches are not known: {error}"]
            num_scans = data.num_scans
            parts = [f"{num_scans:,} scans to simulate, {_size(num_scans * _SIMULATED_SCAN_BYTES)}"]
        if data.features_dir is not None:
            size = 2 * math.prod(data.grid_size) * data.feature_dim
            parts += [
                f"feature grids of {_size(size)} per scan, {_size(num_scans * size)}, in "
                f"{data.features_dir}"
            ]
        if getattr(module, "cache_latents", False):
            size = 2 * 4 * math.prod(cast(GenerativeModule, module).latent_shape)
            parts += [f"cached latents of {_size(size)} per scan, {_size(num_scans * size)}"]
        return parts


def batch_lines(module: LightningModule, data: LightningDataModule, trainer: Trainer) -> list[str]:
    """Return the scans per step, which grow with the processes, and a warning on KITTI-360.

    The paper's settings are for a global batch of 32.
    """
    batch_size = getattr(data, "batch_size", None)
    if batch_size is None:
        return []
    processes, accumulated = trainer.world_size, trainer.accumulate_grad_batches
    total = batch_size * processes * accumulated
    lines = [
        f"global batch: {total} = {batch_size} per process x {processes} processes x "
        f"{accumulated} accumulated"
    ]
    of_paper = getattr(module, "stage", None) in STAGES and getattr(data, "dataset", None)
    if of_paper and total != _PAPER_BATCH:
        line = f"warning: the paper trains with a global batch of {_PAPER_BATCH}"
        needed, rest = divmod(_PAPER_BATCH, processes * accumulated)
        lines += [f"{line}: give --data.init_args.batch_size {needed}" if not rest else line]
    return lines


def _size(num_bytes: float) -> str:
    """Bytes in a decimal unit."""
    units = ("bytes", "kB", "MB", "GB", "TB")
    place = min(len(units) - 1, int(math.log10(max(num_bytes, 1)) // 3))
    return f"{num_bytes / 1000**place:.3g} {units[place]}"


def _duration(seconds: float) -> str:
    for name, unit_s in (("years", 365 * 86400), ("days", 86400), ("hours", 3600)):
        if seconds >= 2 * unit_s:
            return f"{seconds / unit_s:.3g} {name}"
    return f"{seconds / 60:.3g} minutes"

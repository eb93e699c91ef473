"""Callbacks of the trainer configuration."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import threading
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, cast

import lightning as L
import torch
from lightning.fabric.plugins.io import TorchCheckpointIO
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import WandbLogger
from lightning.pytorch.utilities import rank_zero_info
from matplotlib.figure import Figure
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor
from tqdm import tqdm

from r3dpa import viz
from r3dpa.data import Scan, write_bin
from r3dpa.data.datamodules import LidarDataModule
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import points_of
from r3dpa.io import atomic_path, source_commit
from r3dpa.metrics.evaluation import TooFewScenesError, check_counts
from r3dpa.metrics.protocol import PROTOCOLS
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.results import Evaluation
from r3dpa.metrics.scene import EvaluationScene
from r3dpa.metrics.scene_features import FREE_SPACES, SceneFeatures
from r3dpa.modules import GenerativeModule
from r3dpa.modules.guards import StepGuard
from r3dpa.nn import EMA
from r3dpa.scoring import (
    AnyReference,
    cached_reference,
    compare,
    feature_spaces,
    load_reference,
    reference_spaces,
    report,
    save_reports,
)

__all__ = [
    "AtomicCheckpointIO",
    "PictureLogger",
    "ReconstructionWriter",
    "RunCheckpoint",
    "SceneScorer",
]

_SAMPLER = SamplerConfig()
_OPTION = "--scorer.{} true"  # how the SceneScorer of `r3dpa test` is told to allow something


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints beside their place, then renames them: no moment has half a file there.

    Lightning's own writes to the system's folder for temporary files. Where that is on another disk
    than the run, its last move is a copy over the checkpoint before, which a kill or a full disk
    leaves cut short.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None
    ) -> None:
        """Writes a checkpoint.

        Args:
            checkpoint: What to write.
            path: Its file.
            storage_options: Refused, as by Lightning's own.

        Raises:
            OSError: If it cannot be written; names the file and the reason. A checkpoint that was
                there before stays.
        """
        if storage_options is not None:
            raise TypeError(f"{type(self).__name__} knows no storage_options")
        # A file object: what torch opens itself fails without telling why.
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            torch.save(checkpoint, file)
            file.flush()
            os.fsync(file.fileno())  # else a loss of power could leave an empty file of this name


class RunCheckpoint(ModelCheckpoint):
    """ModelCheckpoint whose ``last.ckpt`` holds the last step, whatever the saving interval.

    Lightning's own saves at the end of training only if it has never saved before.

    A SIGTERM, as job systems send it before they end a job, and Ctrl-C (SIGINT) are obeyed after
    the next optimiser step, or by a single process after the next batch of a validation:
    ``last.ckpt`` is saved and the process ends with status 143 or 130. It is enough that one of
    several gets the signal. A second Ctrl-C ends a single process at once, without saving.

    Several processes that go on from different checkpoints, as copies on the disks of their own
    may be, are refused.
    """

    _signal = 0  # that asked to stop
    _step = 0  # optimiser steps when a batch ended last

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Has checkpoints written whole, unless a strategy or plugin writes them its own way."""
        super().setup(trainer, pl_module, stage)
        if type(trainer.strategy.checkpoint_io) is TorchCheckpointIO:
            trainer.strategy.checkpoint_io = AtomicCheckpointIO()

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Takes the signals over from Lightning, which ends training without saving.

        Raises:
            ValueError: If the processes are at different steps.
        """
        super().on_train_start(trainer, pl_module)
        first = trainer.strategy.broadcast(trainer.global_step)
        if trainer.global_step != first:
            raise ValueError(
                f"process {trainer.global_rank} goes on from step {trainer.global_step} of "
                f"{trainer.ckpt_path}, the first one from step {first}: give all processes the "
                "same checkpoint, on a disk that all see, by its full name"
            )
        self._step = trainer.global_step
        self._signal = signal.SIGTERM if trainer.received_sigterm else 0
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):  # Lightning restores those before

                def stop(asked: int, _: object) -> None:
                    if self._signal == asked == signal.SIGINT and trainer.world_size == 1:
                        raise KeyboardInterrupt  # of several, torchrun sends each another one
                    self._signal = asked

                signal.signal(number, stop)

    def on_before_optimizer_step(
        self, trainer: L.Trainer, pl_module: L.LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        """Has the guard of the step tell the other processes who asked to stop: no talk more."""
        guard = getattr(pl_module, "guard", None)
        if isinstance(guard, StepGuard):
            guard.stop = self._signal

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Saves where it is time to; then stops where that was asked for."""
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)
        if trainer.global_step != self._step:  # else gradients are still to be accumulated
            self._step = trainer.global_step
            self._stop_if_asked(trainer)

    def on_validation_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Stops where that was asked for: a validation may take longer than a job system waits.

        Several processes wait for the next step: they may have unequal numbers of batches here.
        """
        if trainer.state.fn == "fit" and not trainer.sanity_checking and trainer.world_size == 1:
            self._stop_if_asked(trainer)

    def _asked(self, trainer: L.Trainer) -> int:
        """Signal that asked any process to stop, 0 for none; the same answer in all of them."""
        guard = getattr(trainer.lightning_module, "guard", None)
        if trainer.world_size == 1:
            return self._signal
        if isinstance(guard, StepGuard):
            return guard.stop
        asked = torch.tensor(self._signal, device=trainer.strategy.root_device)
        return int(trainer.strategy.reduce(asked, reduce_op="max"))

    def _stop_if_asked(self, trainer: L.Trainer) -> None:
        number = self._asked(trainer)
        if not number:
            return
        if not self._should_skip_saving_checkpoint(trainer):
            self.save_last = True  # else the steps since the last saving would be lost
            self._save_last_checkpoint(trainer, self._monitor_candidates(trainer))
        rank_zero_info(
            f"stopped by {signal.Signals(number).name} after step {trainer.global_step}: the same "
            f"command goes on with --ckpt_path {self.last_model_path}"
        )
        raise SystemExit(128 + number)  # as a shell reports it

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Saves unless the last step is saved already, or this is a ``fast_dev_run``."""
        if cast(Any, trainer).fast_dev_run:
            return  # Lightning would save here, though nowhere else
        if self._last_global_step_saved != trainer.global_step:
            self._last_checkpoint_saved = ""
        super().on_train_end(trainer, pl_module)

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Saves where all steps were trained before, but ``last.ckpt`` is older: of a killed run.

        Lightning ends such a training without calling ``on_train_end``.
        """
        super().on_fit_end(trainer, pl_module)
        resumed = Path(trainer.ckpt_path or "")
        if resumed.name != f"{self.CHECKPOINT_NAME_LAST}.ckpt" and not (
            self._should_skip_saving_checkpoint(trainer)
        ):
            self._save_last_checkpoint(trainer, self._monitor_candidates(trainer))


class ReconstructionWriter(L.Callback):
    """Writes what ``r3dpa predict`` reconstructs, as ``<run_dir>/reconstructions/<scan>.bin``."""

    def on_predict_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Writes the points of each reconstructed range image, intensity 0."""
        if not isinstance(pl_module, GenerativeModule):
            raise TypeError(f"needs a GenerativeModule, got {type(pl_module).__name__}")
        folder = Path(trainer.default_root_dir) / "reconstructions"
        for name, range_m in zip(batch["name"], outputs.float().cpu(), strict=True):
            points = points_of(range_m, pl_module.scan_geometry.projection)
            write_bin(folder / f"{name}.bin", points)


class PictureLogger(L.Callback):
    """Draws a held-out reconstruction and a few samples after each validation or test run.

    Pictures go to ``<run_dir>/pictures`` and, where a WandbLogger is attached, to wandb.

    Args:
        num_scenes: Scenes to sample; 0 samples none.
        steps: Euler steps of those samples.
        seed: Seed of those samples.
    """

    def __init__(self, num_scenes: int = 4, steps: int = 32, seed: int = 0) -> None:
        self.num_scenes = num_scenes
        self.sampler = SamplerConfig(solver="euler", steps=steps)
        self.seed = seed

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draws after a validation run, but not after the sanity check."""
        if not trainer.sanity_checking:
            self._draw(trainer, pl_module, "val")

    def on_test_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draws after a test run."""
        self._draw(trainer, pl_module, "test")

    def _draw(self, trainer: L.Trainer, module: L.LightningModule, split: str) -> None:
        if not trainer.is_global_zero:
            return
        if not isinstance(module, GenerativeModule):
            raise TypeError(f"PictureLogger draws GenerativeModules, got {type(module).__name__}")
        datamodule = getattr(trainer, "datamodule", None)
        if not isinstance(datamodule, LidarDataModule):
            raise TypeError(
                f"PictureLogger needs a LidarDataModule, got {type(datamodule).__name__}"
            )
        pictures = {}
        if datamodule.val_set:
            image = datamodule.val_set[len(datamodule.val_set) // 2]["range_image"]
            pictures["reconstruction"] = self._reconstruction(module, image)
        if self.num_scenes and module.ema is not None:
            pictures["samples"] = self._samples(module, module.ema)
        folder = Path(trainer.default_root_dir) / "pictures"
        step = trainer.global_step or module.loaded_step
        for name, figure in pictures.items():
            path = viz.save(figure, folder / f"{split}_{name}_{step:07d}.png")
            for logger in trainer.loggers:
                if isinstance(logger, WandbLogger):
                    logger.log_image(f"{split}/{name}", [str(path)])

    @torch.inference_mode()
    def _reconstruction(self, module: GenerativeModule, image: Tensor) -> Figure:
        image = image[None].to(module.device)
        geometry = module.scan_geometry
        sensor = geometry.projection.sensor
        range_m = geometry.codec.decode(image[0, 0], sensor)
        found_m = geometry.codec.decode(module.reconstruct(image)[0, 0].float(), sensor)
        both = (range_m > 0) & (found_m > 0)
        error_m = (range_m - found_m).abs()[both].mean().item()
        agreement = ((range_m > 0) == (found_m > 0)).float().mean().item()
        return viz.reconstruction_figure(range_m, found_m, sensor, error_m, agreement)

    def _samples(self, module: GenerativeModule, average: EMA) -> Figure:
        generator = _generator(module, average, self.sampler)
        scenes = generator.generate(range(self.num_scenes), self.seed)
        return viz.scenes_sheet(list(scenes.range_m.cpu()), generator.geometry.projection)


class SceneScorer(L.Callback):
    """Samples scenes after a test run and tells how near they are to real scans.

    The processes share the sampling; the first one compares. Scenes are sampled in the same
    batches whatever the number of processes, so that the numbers do not depend on it. It prints
    the table of ``r3dpa evaluate``, logs its numbers as ``test/<metric>`` and writes them with
    tables and figures to ``<run_dir>/evaluation``, which all processes must see.

    A stage that trains no velocity has nothing to sample, and says so.

    Args:
        num_scenes: Scenes to sample, more than there are features; 0 samples none.
        batch_size: Scenes sampled together.
        sampler: Solver and steps.
        precision: Of the networks that sample.
        seed: Of the scenes, see :class:`SceneGenerator`.
        reference: File of ``r3dpa reference``, or R3DPA's own ``data_statistics.npy``. Without it,
            all scans of the data module are the reference, training and held-out; their statistics
            are computed once and kept in ``<run_dir>/evaluation/reference.safetensors``.
        split: Of ``data_statistics.npy`` alone; ``val`` where it holds both and none is given.
        spaces: Feature spaces; where None, those that need no file or have one in ``ckpt``.
        ckpt: Official weights by space.
        protocol: ``default`` or ``published``; where None, that of the reference file, or
            ``default`` without one.
        allow_few: Accept fewer scenes than features: only to try it.
        skip_bad: Leave out scenes that cannot be used, such as those without any return; the tables
            tell how many and the numbers' file which. Else the first one ends the test.

    Raises:
        ValueError: If a number is out of its range.
    """

    def __init__(
        self,
        num_scenes: int = 256,
        batch_size: int = 8,
        sampler: SamplerConfig = _SAMPLER,
        precision: Literal["fp32", "bf16"] = "fp32",
        seed: int = 0,
        reference: str | None = None,
        split: Literal["val", "all"] | None = None,
        spaces: list[str] | None = None,
        ckpt: dict[str, str] | None = None,
        protocol: Literal["default", "published"] | None = None,
        allow_few: bool = False,
        skip_bad: bool = True,
    ) -> None:
        for name, value, least in (
            ("num_scenes", num_scenes, 0),
            ("batch_size", batch_size, 1),
            ("seed", seed, 0),
        ):
            if value < least:
                raise ValueError(f"scorer.{name} must be at least {least}, got {value}")
        self.num_scenes = num_scenes
        self.batch_size = batch_size
        self.sampler = sampler
        self.precision = precision
        self.seed = seed
        self.reference = reference
        self.split = split
        self.spaces = spaces
        self.ckpt = ckpt or {}
        self.protocol = protocol
        self.allow_few = allow_few
        self.skip_bad = skip_bad
        self._job: tuple[AnyReference, list[SceneFeatures], list[Scan]] | None = None

    def on_test_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Checks all that can be checked before scenes are sampled."""
        self._job = None
        if not isinstance(pl_module, GenerativeModule) or not self.num_scenes:
            return
        if pl_module.ema is None:
            rank_zero_info(f"stage {pl_module.stage} has nothing to sample: no scenes are scored")
            return
        datamodule = getattr(trainer, "datamodule", None)
        if not isinstance(datamodule, LidarDataModule) or datamodule.all_set is None:
            raise TypeError(f"SceneScorer needs a LidarDataModule, got {type(datamodule).__name__}")
        device = str(pl_module.device)
        counts, statistics = {"generated scenes": self.num_scenes}, self._loaded()
        scans: list[Scan] = []
        if statistics is not None:
            spaces = reference_spaces(statistics, self.spaces, self.ckpt, self.protocol, device)
        else:
            scans = datamodule.all_set.scans
            setting = PROTOCOLS[self.protocol or "default"].with_sensor(datamodule.sensor)
            names = (*FREE_SPACES, *(name for name in self.ckpt if name not in FREE_SPACES))
            spaces = feature_spaces(self.spaces or names, self.ckpt, setting, device)
            about = {
                "data": str(datamodule.scans),
                "split": "all",
                "scans_sha256": _stamp(scans),  # names may stay
                "commit": source_commit(),
            }
            scan_names = [scan.name for scan in scans]
            statistics = ReferenceStatistics.prepare(spaces, setting, scan_names, about)
        if isinstance(statistics, ReferenceStatistics):
            counts["real scans"] = len(statistics.names)
        check_counts(counts, spaces, self.allow_few, _OPTION)
        self._job = (statistics, spaces, scans)

    def on_test_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Samples and compares."""
        if self._job is None or not isinstance(pl_module, GenerativeModule):
            return
        statistics, spaces, scans = self._job
        self._job = None
        folder = Path(trainer.default_root_dir) / "evaluation"
        self._sample(trainer, pl_module, folder)
        trainer.strategy.barrier("SceneScorer")
        if not trainer.is_global_zero:
            return
        made_with = self._made_with(trainer, pl_module, folder)
        if isinstance(statistics, ReferenceStatistics) and not statistics.complete:
            path = folder / "reference.safetensors"
            statistics = cached_reference(statistics, scans, spaces, path)
        try:
            evaluation, comparison = compare(
                self._sampled(pl_module, folder, statistics),
                statistics,
                spaces,
                label=folder.absolute().parent.name,
                source=str(trainer.ckpt_path),
                made_with=made_with,
                commit=source_commit(),
                allow_few=True,  # checked before; what falls out later is told
                skip_bad=self.skip_bad,
                option=_OPTION,
            )
        except TooFewScenesError as error:  # the losses of the test are still to be printed
            trainer.print(f"nothing is compared with real scans: {error}; see {_parts(folder)}")
            return
        shutil.rmtree(_parts(folder))
        save_reports(evaluation, comparison, statistics, folder)
        trainer.print(report(evaluation, statistics))
        _log(trainer, evaluation, trainer.global_step or pl_module.loaded_step)

    def _loaded(self) -> AnyReference | None:
        """The reference file, None without one."""
        if self.reference is None:
            return None
        try:
            return load_reference(Path(self.reference), self.split)
        except ValueError as error:
            raise ValueError(f"scorer.reference: {error}") from error

    def _sample(self, trainer: L.Trainer, module: GenerativeModule, folder: Path) -> None:
        """Writes the batches of this process."""
        assert module.ema is not None
        generator = _generator(module, module.ema, self.sampler, self.precision)
        starts = range(0, self.num_scenes, self.batch_size)
        quiet = None if trainer.is_global_zero else True
        for first in tqdm(
            starts[trainer.global_rank :: trainer.world_size],
            "sampling",
            unit="batch",
            disable=quiet,
        ):
            indices = range(first, min(first + self.batch_size, self.num_scenes))
            scenes = generator.generate(indices, self.seed)
            part = {"range_m": scenes.range_m.cpu().contiguous(), "nfe": torch.tensor(scenes.nfe)}
            with atomic_path(_part(folder, first)) as temporary:
                save_file(part, temporary)

    def _made_with(
        self, trainer: L.Trainer, module: GenerativeModule, folder: Path
    ) -> dict[str, Any]:
        """What made the scenes; ``nfe`` is the mean over all of them, whoever drew them."""
        total = 0
        for first in range(0, self.num_scenes, self.batch_size):
            with safe_open(_part(folder, first), framework="pt") as file:
                num = file.get_slice("range_m").get_shape()[0]
                total += num * int(file.get_tensor("nfe"))
        nfe = total / self.num_scenes  # whole but for a solver that chooses its steps
        nfe = int(nfe) if nfe.is_integer() else nfe
        return {
            "solver": self.sampler.solver,
            "steps": self.sampler.steps,
            "seed": self.seed,
            "precision": self.precision,
            "feature_source": module.feature_source,
            "checkpoint": str(trainer.ckpt_path),
            "stage": module.stage,
            "step": trainer.global_step or module.loaded_step,
            "weights": "ema",
            "nfe": nfe,
            "sampler": asdict(self.sampler),
        }

    def _sampled(
        self, module: GenerativeModule, folder: Path, statistics: AnyReference
    ) -> Iterator[EvaluationScene]:
        """Scenes of all processes, in order; as points where the reference has other pixels."""
        projection = module.scan_geometry.projection
        for first in range(0, self.num_scenes, self.batch_size):
            images = load_file(_part(folder, first))["range_m"]
            for index, range_m in enumerate(images, first):
                name = f"{index:06d}"
                if projection == statistics.protocol.projection:
                    yield EvaluationScene(name, None, range_m)
                else:
                    yield EvaluationScene(name, points_of(range_m, projection))


def _generator(
    module: GenerativeModule,
    average: EMA,
    sampler: SamplerConfig,
    precision: Literal["fp32", "bf16"] = "fp32",
) -> SceneGenerator:
    """Samples from the averaged weights of a module."""
    return SceneGenerator(
        module.vae,
        average.sit,
        average.latent_norm,
        module.scan_geometry,
        sampler,
        module.interpolant.path,
        precision,
    )


def _stamp(scans: Sequence[Scan]) -> str:
    """Hash of names, sizes and times of change: scans replaced by others of their names differ."""
    stats = [(scan.name, scan.path.stat()) for scan in scans]
    told = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
    return hashlib.sha256(repr(told).encode()).hexdigest()


def _parts(folder: Path) -> Path:
    return folder / "sampled"


def _part(folder: Path, first: int) -> Path:
    """File of the batch that starts with this scene."""
    return _parts(folder) / f"{first:06d}.safetensors"


def _log(trainer: L.Trainer, evaluation: Evaluation, step: int) -> None:
    values = {
        f"test/{row.name.replace(' ', '_')}": row.value
        for row in evaluation.rows
        if row.value is not None
    }
    for logger in trainer.loggers:
        logger.log_metrics(values, step)
        logger.save()

"""Reconstructions as files, and pictures of a validation or test run."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import lightning as L
import torch
from lightning.pytorch.loggers import WandbLogger
from lightning.pytorch.utilities import rank_zero_info, rank_zero_warn
from matplotlib.figure import Figure
from torch import Tensor

from r3dpa import viz
from r3dpa.data import write_bin
from r3dpa.generation import SamplerConfig
from r3dpa.geometry import points_of
from r3dpa.io import first_line
from r3dpa.modules import GenerativeModule

if TYPE_CHECKING:
    from r3dpa.baselines import Baseline


class ReconstructionWriter(L.Callback):
    """Writes what ``r3dpa predict`` reconstructs, as ``<run_dir>/reconstructions/<scan>.bin``."""

    def on_predict_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Refuse scans of equal names, as two data sets may have them: their files would be one."""
        dataset = getattr(cast(Any, trainer).datamodule, "all_set", None)
        scans = [] if dataset is None else dataset.scans
        for name, count in Counter(_file_name(scan.name) for scan in scans).items():
            if count > 1:
                raise ValueError(
                    f"{count} scans would be written as {name}: predict each data set by itself"
                )

    def on_predict_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: Any,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Write the points of each reconstructed range image, intensity 0."""
        folder = _reconstructions(trainer)
        for name, range_m in zip(batch["name"], outputs.float().cpu(), strict=True):
            points = points_of(range_m, pl_module.scan_geometry.projection)
            write_bin(folder / _file_name(name), points)

    def on_predict_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Name the folder."""
        rank_zero_info(f"reconstructions: {_reconstructions(trainer)}")


def _file_name(scan_name: str) -> str:
    """File of a reconstruction; ``.pcd.bin``, as nuScenes has it, is of five columns."""
    return f"{scan_name.removesuffix('.pcd')}.bin"


def _reconstructions(trainer: L.Trainer) -> Path:
    return Path(trainer.default_root_dir) / "reconstructions"


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

    def on_validation_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Draw after a validation run, but not after the sanity check; a failure is a warning."""
        if trainer.sanity_checking:
            return
        try:
            self._draw(trainer, pl_module, "val")
        except (OSError, RuntimeError, ValueError) as error:  # training is worth more than pictures
            rank_zero_warn(f"no pictures at step {trainer.global_step}: {first_line(error)}")

    def on_test_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Draw after a test run."""
        self._draw(trainer, pl_module, "test")

    def _draw(self, trainer: L.Trainer, module: GenerativeModule | Baseline, split: str) -> None:
        if not trainer.is_global_zero:
            return
        pictures = {}
        val_set = getattr(cast(Any, trainer).datamodule, "val_set", None)
        if val_set and isinstance(module, GenerativeModule):
            image = val_set[len(val_set) // 2]["range_image"]
            pictures["reconstruction"] = self._reconstruction(module, image)
        if self.num_scenes and module.ema is not None:
            generator = module.scene_generator(self.sampler)
            scenes = generator.generate(range(self.num_scenes), self.seed)
            projection = generator.geometry.projection
            pictures["samples"] = viz.scenes_sheet(list(scenes.range_m.cpu()), projection)
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
        range_m = geometry.codec.ranges_of(image[0], sensor)
        found_m = geometry.codec.ranges_of(module.reconstruct(image)[0].float(), sensor)
        error_m = (range_m - found_m).abs()[(range_m > 0) & (found_m > 0)].mean().item()
        agreement = ((range_m > 0) == (found_m > 0)).float().mean().item()
        return viz.reconstruction_figure(range_m, found_m, sensor, error_m, agreement)

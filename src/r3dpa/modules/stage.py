"""Bases of the stages: optimiser, held-out losses and checkpoints, on scans or RGB images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import asdict
from typing import Any

import lightning as L
import torch
from torch import Tensor, nn

from r3dpa import __version__
from r3dpa.data.augmentation import Augmentation
from r3dpa.data.image_datamodule import ImageDataModule
from r3dpa.flow.interpolant import LINEAR, Interpolant
from r3dpa.geometry import ScanGeometry
from r3dpa.io import source_commit
from r3dpa.modules import steps
from r3dpa.modules.checks import check_geometry, check_trainer, geometry_of
from r3dpa.modules.settings import OptimizerConfig, TimeSampling
from r3dpa.nn import ImageVAE


class Stage(L.LightningModule, ABC):
    """Optimiser, losses of held-out samples, and checkpoints that name their stage.

    Random numbers of a step are a function of ``(seed, batch, sample)`` alone: they do not depend
    on the number of processes or on where a run was interrupted.

    Args:
        optimizer: Optimiser settings.
        seed: Key of the training draws.
        time_sampling: Density of the training times.
    """

    stage: str
    interpolant: Interpolant = LINEAR

    def __init__(
        self, optimizer: OptimizerConfig, seed: int, time_sampling: TimeSampling = "uniform"
    ) -> None:
        super().__init__()
        self.optimizer_config, self.seed, self.time_sampling = optimizer, seed, time_sampling
        self.held_out = steps.HeldOutMeans()
        self.logged_losses: dict[str, Tensor] = {}  # of the last training batch
        self.step_skipped = False  # set by StepGuard

    @abstractmethod
    def trainable(self) -> dict[str, nn.Module]:
        """Networks that this stage trains, by name; frozen parameters inside stay frozen."""

    draw_path = steps.draw_path
    weigh_and_log = steps.weigh_and_log

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """One AdamW with a parameter group per trained network, fused where the device has it."""
        groups = [
            {"params": [p for p in network.parameters() if p.requires_grad], "name": name}
            for name, network in self.trainable().items()
        ]
        settings = self.optimizer_config.adamw()
        return torch.optim.AdamW(groups, **settings, fused=steps.uses_fused(self))

    configure_gradient_clipping = steps.clip_per_network
    on_before_optimizer_step = steps.set_learning_rate
    on_train_start = steps.fit_optimizer
    on_validation_epoch_end = on_test_epoch_end = steps.log_held_out

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds stage, interpolant and version."""
        checkpoint["r3dpa"] = {
            "stage": self.stage,
            "interpolant": self.interpolant.path,
            "version": __version__,
            "commit": source_commit(),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuses the checkpoint of another stage; optimiser settings stay those of this run."""
        found = checkpoint.get("r3dpa", {}).get("stage")
        if found != self.stage:
            raise ValueError(
                f"the checkpoint is of stage {found!r}, this is {self.stage!r}; to start a stage "
                "from another one, give --model.init_args.init_from instead of --ckpt_path"
            )
        for state in checkpoint.get("optimizer_states", []):
            for group in state["param_groups"]:
                group.update(self.optimizer_config.adamw())


class ScanStage(Stage):
    """Base of the stages on range images, whose checkpoints hold the geometry of the scans."""

    geometry: ScanGeometry | None = None
    augmentation: Augmentation | None = None
    feature_source: str | None = None
    loaded_step = 0

    def attach(self) -> tuple[Any, ScanGeometry]:
        """Checks the trainer and keeps the scan geometry; returns data module and geometry."""
        check_trainer(self.trainer)
        datamodule = getattr(self.trainer, "datamodule", None)
        self.geometry = geometry_of(datamodule, self)
        self.augmentation = getattr(datamodule, "augmentation", None)
        return datamodule, self.geometry

    @property
    def scan_geometry(self) -> ScanGeometry:
        """Geometry of the scans it trains on, known from setup or from a checkpoint."""
        if self.geometry is None:
            raise RuntimeError("the module has no scan geometry yet: set it up with a data module")
        return self.geometry

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds stage and scan geometry, enough to sample from, and what it was trained with."""
        super().on_save_checkpoint(checkpoint)
        checkpoint["r3dpa"] |= {
            "geometry": self.scan_geometry.to_dict(),
            "augmentation": None if self.augmentation is None else asdict(self.augmentation),
            "feature_source": self.feature_source,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuses the checkpoint of another stage or of other range images, and keeps its step."""
        self.loaded_step = checkpoint.get("global_step", 0)
        super().on_load_checkpoint(checkpoint)
        there = ScanGeometry.from_dict(checkpoint["r3dpa"]["geometry"])
        if self.geometry is None:
            self.geometry = there
        else:
            check_geometry(there, self.geometry, "the checkpoint")


class ImageStage(Stage):
    """Base of the stages on RGB images, whose checkpoints say which."""

    vae: ImageVAE

    @property
    def images(self) -> ImageDataModule:
        """Data module, whose images are of a size that the VAE can encode."""
        found = getattr(self.trainer, "datamodule", None)
        if not isinstance(found, ImageDataModule):
            raise ValueError(
                f"{type(self).__name__} needs an ImageDataModule, got {type(found).__name__}"
            )
        self.vae.latent_size((found.image_size, found.image_size))
        return found

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds the stage and the images that it was trained with."""
        super().on_save_checkpoint(checkpoint)
        checkpoint["r3dpa"]["images"] = self.images.settings

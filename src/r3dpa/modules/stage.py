"""Base of all stages on range images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import asdict
from typing import Any

import lightning as L
import torch
from torch import Tensor, nn

from r3dpa.data.augmentation import Augmentation
from r3dpa.flow import Interpolant
from r3dpa.geometry import ScanGeometry
from r3dpa.modules import steps
from r3dpa.modules.checks import check_trainer, geometry_of
from r3dpa.modules.settings import OptimizerConfig, TimeSampling


class ScanStage(L.LightningModule, ABC):
    """Optimiser, losses of held-out scans, and checkpoints with the geometry of the scans.

    Random numbers of a step are a function of ``(seed, batch, sample)`` alone: they do not depend
    on the number of processes or on where a run was interrupted.

    Args:
        optimizer: Optimiser settings.
        seed: Key of the training draws.
        time_sampling: Density of the training times.
    """

    stage: str
    interpolant: Interpolant

    def __init__(
        self, optimizer: OptimizerConfig, seed: int, time_sampling: TimeSampling = "uniform"
    ) -> None:
        super().__init__()
        self.optimizer_config, self.seed, self.time_sampling = optimizer, seed, time_sampling
        self.geometry: ScanGeometry | None = None
        self.augmentation: Augmentation | None = None
        self.feature_source: str | None = None
        self.held_out = steps.HeldOutMeans()
        self.loaded_step = 0
        self.logged_losses: dict[str, Tensor] = {}  # of the last training batch
        self.step_skipped = False  # set by StepGuard

    @abstractmethod
    def trainable(self) -> dict[str, nn.Module]:
        """Networks that this stage trains, by name; frozen parameters inside stay frozen."""

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

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """One AdamW with a parameter group per trained network."""
        return steps.adamw(self, self.trainable(), self.optimizer_config)

    configure_gradient_clipping = steps.clip_per_network
    on_before_optimizer_step = steps.set_learning_rate
    on_train_start = steps.fit_optimizer
    on_validation_epoch_end = on_test_epoch_end = steps.log_held_out

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds stage and scan geometry, enough to sample from, and what it was trained with."""
        steps.describe_stage(checkpoint, self.stage, self.interpolant.path)
        checkpoint["r3dpa"] |= {
            "geometry": self.scan_geometry.to_dict(),
            "augmentation": None if self.augmentation is None else asdict(self.augmentation),
            "feature_source": self.feature_source,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuses the checkpoint of another stage or of other range images."""
        steps.check_resumed(self, checkpoint)

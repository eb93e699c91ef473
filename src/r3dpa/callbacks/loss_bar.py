"""Progress bar of a training, with its losses."""

from __future__ import annotations

from typing import Any

import lightning as L
from lightning.pytorch.callbacks import TQDMProgressBar

_PREFIX = "train/"


class LossBar(TQDMProgressBar):
    """Progress bar that shows the last training losses instead of the version of the logger."""

    def get_metrics(self, trainer: L.Trainer, pl_module: L.LightningModule) -> dict[str, Any]:
        """Return the losses by name without ``train/``, the total one first."""
        shown = super().get_metrics(trainer, pl_module)
        shown.pop("v_num", None)
        losses = {
            name.removeprefix(_PREFIX): f"{value.item():.3g}"
            for name, value in trainer.callback_metrics.items()
            if name.startswith(_PREFIX) and name != f"{_PREFIX}skipped_steps"
        }
        shown.pop(f"{_PREFIX}loss", None)
        total = {"loss": losses["loss"]} if "loss" in losses else {}
        return total | losses | shown

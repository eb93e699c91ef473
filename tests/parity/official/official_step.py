"""Our joint training step on one batch with given draws, to be compared with the official one."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from typing import Any

import lightning as L
from official_runs import Trained
from torch import Tensor
from torch.utils.data import DataLoader

from r3dpa.checkpoints import Checkpoint, to_official
from r3dpa.checkpoints.networks import NetworkState
from r3dpa.modules import JointAlignment
from r3dpa.modules.base import PathDraws

__all__ = ["train_ours"]


class _GivenDraws(JointAlignment):
    """Joint training without a data module, with the same draws in every step."""

    draws: PathDraws

    def setup(self, stage: str) -> None:
        """Needs no scans: the batch is given."""

    def draw_path(
        self, num_scans: int, batch_number: int | None = None, stream: int = 0
    ) -> PathDraws:
        """The given draws."""
        return self.draws


class _Timer(L.Callback):
    """Time of each step: losses, backward, clipping, optimiser and averages."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.clock = clock
        self.seconds: list[float] = []
        self.start = 0.0

    def on_train_batch_start(self, *args: Any) -> None:
        """Starts the clock."""
        self.start = self.clock()

    def on_train_batch_end(self, *args: Any) -> None:
        """Stops it."""
        self.seconds.append(self.clock() - self.start)


def train_ours(
    checkpoint: Checkpoint,
    image: Tensor,
    features: Tensor,
    draws: tuple[Tensor, Tensor, Tensor],
    steps: int,
    clock: Callable[[], float],
) -> Trained:
    """Trains as `train_official` does, by a Trainer with one optimiser and one backward pass.

    Args:
        checkpoint: Weights to start from; the latent statistics start at (0, 1).
        image: ``(B, 1, H, W)`` range images.
        features: ``(B, N, F)`` feature grids.
        draws: Posterior noise ``(B, C, h, w)``, times ``(B,)`` and noise of every step.
        steps: Optimiser steps.
        clock: Seconds since some time.
    """
    networks: dict[str, Any] = {
        name: checkpoint.network(name).build()
        for name in ("vae", "sit", "discriminator", "latent_norm")
    }
    module = _GivenDraws(**networks, ema_buffers="decay")
    module.draws = PathDraws(*draws)
    timer = _Timer(clock)
    batch = {"range_image": image, "feature_grid": features}
    level = logging.getLogger("lightning.pytorch").level
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # advice on loaders and loggers
        trainer = L.Trainer(
            accelerator="cpu",
            max_steps=steps,
            gradient_clip_val=1.0,
            callbacks=[timer],
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        trainer.fit(module, DataLoader([batch] * steps, batch_size=None))  # type: ignore[arg-type]
    logging.getLogger("lightning.pytorch").setLevel(level)
    states = {
        name: NetworkState(
            checkpoint.network(name).class_path,
            checkpoint.network(name).init_args,
            network.state_dict(),
        )
        for name, network in networks.items()
    }
    content = to_official(Checkpoint(checkpoint.path, checkpoint.stage, states))
    weights = {
        ours: {key: value.detach() for key, value in content[theirs].items()}
        for ours, theirs in (("vae", "vae"), ("sit", "model"), ("discriminator", "discriminator"))
    }
    return Trained(timer.seconds, weights)

"""Checkpoints of a run: written whole, on time, at the end and when a signal asks to stop."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import Any, cast

import lightning as L
import torch
from lightning.fabric.plugins.io import TorchCheckpointIO
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.utilities import rank_zero_info

from r3dpa.callbacks.step_guard import StepGuard
from r3dpa.io import save_tensors


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints beside their place, then renames them: a partial file is never visible.

    Lightning writes to the system's temporary folder; where that is on another disk than the run,
    its last move is a copy over the previous checkpoint, which a kill or a full disk cuts short.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None
    ) -> None:
        """Write a checkpoint; an OSError names the file and the reason."""
        save_tensors(checkpoint, path)


class RunCheckpoint(ModelCheckpoint):
    """ModelCheckpoint whose ``last.ckpt`` holds the last step, whatever the saving interval.

    Lightning's own saves at the end of training only if it has never saved before.

    After SIGTERM, as job systems send it before they end a job, or Ctrl-C (SIGINT) the next
    optimiser step, or the next validation batch of a single process, is the last: ``last.ckpt`` is
    saved and all processes end with status 143 or 130. It is enough that one process receives the
    signal. A second Ctrl-C ends a single process at once, without saving. A validation that was
    interrupted is not repeated by the resumed run.

    Processes that resume from different checkpoints are refused, and a run resumed at the end of an
    epoch starts the next one. After a resume within an epoch, Lightning's ``epoch`` counts one
    more; steps, weights and the end of the training do not depend on it.
    """

    _signal = 0  # received by this process; 0 without one
    _step = 0  # optimiser steps when a batch ended last

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Make writes atomic, unless a strategy or plugin has a checkpoint format of its own."""
        super().setup(trainer, pl_module, stage)
        if type(trainer.strategy.checkpoint_io) is TorchCheckpointIO:
            trainer.strategy.checkpoint_io = AtomicCheckpointIO()

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Replace Lightning's signal handlers, which end training without saving."""
        super().on_train_start(trainer, pl_module)
        first = trainer.strategy.broadcast(trainer.global_step)
        if trainer.global_step != first:
            raise ValueError(
                f"process {trainer.global_rank} goes on from step {trainer.global_step} of "
                f"{trainer.ckpt_path}, the first one from step {first}: give all processes the "
                "same checkpoint, on a disk that all see, by its full name"
            )
        _start_next_epoch(trainer)
        self._step = trainer.global_step
        self._signal = signal.SIGTERM if trainer.received_sigterm else 0
        if threading.current_thread() is threading.main_thread():

            def stop(received: int, _: object) -> None:
                is_second = self._signal == received == signal.SIGINT
                if is_second and trainer.world_size == 1:
                    raise KeyboardInterrupt  # torchrun sends several processes two signals each
                self._signal = received

            for number in (signal.SIGTERM, signal.SIGINT):
                signal.signal(number, stop)  # Lightning restores the handlers before

    def on_after_backward(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Send the stop signal with the guard's all-reduce."""
        guard = _guard(trainer)
        if guard is not None:
            guard.stop = self._signal

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any, **kwargs: Any
    ) -> None:
        """Save on time; then stop on a signal."""
        super().on_train_batch_end(trainer, pl_module, *args, **kwargs)
        if trainer.global_step != self._step:  # else gradients are still to be accumulated
            self._step = trainer.global_step
            self._stop_on_signal(trainer)

    def on_validation_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any, **kwargs: Any
    ) -> None:
        """Stop on a signal: a validation may take longer than a job system waits.

        Not with several processes, which may have unequal numbers of batches here.
        """
        if trainer.state.fn == "fit" and not trainer.sanity_checking and trainer.world_size == 1:
            self._stop_on_signal(trainer)

    def _stop_signal(self, trainer: L.Trainer) -> int:
        """Stop signal received by any process, 0 for none; the same answer in all of them."""
        guard = _guard(trainer)
        if trainer.world_size == 1:
            return self._signal
        if guard is not None:
            return guard.stop
        received = torch.tensor(self._signal, device=trainer.strategy.root_device)
        return int(trainer.strategy.reduce(received, reduce_op="max"))

    def _stop_on_signal(self, trainer: L.Trainer) -> None:
        number = self._stop_signal(trainer)
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

    def _save_last_checkpoint(self, trainer: L.Trainer, monitor_candidates: Any) -> None:
        """Replace ``last.ckpt`` in a run folder that was moved or copied, too.

        Lightning takes the file there for another run's and writes ``last-v1.ckpt``.
        """
        last = self.format_checkpoint_name(monitor_candidates, self.CHECKPOINT_NAME_LAST)
        self.last_model_path = last
        super()._save_last_checkpoint(trainer, monitor_candidates)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save the last step, unless it is saved already or this is a ``fast_dev_run``."""
        if cast(Any, trainer).fast_dev_run:
            return  # Lightning would save here, though nowhere else
        if self._last_global_step_saved != trainer.global_step:
            self._last_checkpoint_saved = ""
        super().on_train_end(trainer, pl_module)

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save where a killed run had trained all steps, but its ``last.ckpt`` is older.

        Lightning ends such a training without calling ``on_train_end``.
        """
        super().on_fit_end(trainer, pl_module)
        resumed = Path(trainer.ckpt_path or "")
        is_last = resumed.name == f"{self.CHECKPOINT_NAME_LAST}.ckpt"
        if not is_last and not self._should_skip_saving_checkpoint(trainer):
            self._save_last_checkpoint(trainer, self._monitor_candidates(trainer))


def _guard(trainer: L.Trainer) -> StepGuard | None:
    callbacks = cast(Any, trainer).callbacks
    return next((guard for guard in callbacks if isinstance(guard, StepGuard)), None)


def _start_next_epoch(trainer: L.Trainer) -> None:
    """Start an epoch anew where the checkpoint was written after the last batch of one.

    Lightning would go on within that epoch, train a batch of the next one there and drop the rest.
    """
    loop = trainer.fit_loop.epoch_loop
    if loop.restarting and loop.batch_progress.current.completed >= trainer.num_training_batches:
        loop.restarting = False

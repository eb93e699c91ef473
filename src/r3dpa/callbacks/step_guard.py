"""Skips training steps that are not finite."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning as L
import torch
import torch.distributed as dist
from jsonargparse.typing import NonNegativeInt, PositiveInt
from lightning.pytorch.utilities import rank_zero_warn
from torch import Tensor

from r3dpa.callbacks.bad_batches import format_values, list_bad_batches, report_bad_batches
from r3dpa.modules.stage import gradient_norms


class StepGuard(L.Callback):
    """Skips a step with a loss, gradient norm or buffer that is not finite, on any process.

    A skipped step changes no weight, moment or average, and restores batch norm and latent
    statistics; ``train/skipped_steps`` counts it, and its batches are named and saved for ``r3dpa
    replay``. Overflows caused by the loss scale of float16 are only counted.

    Args:
        max_skipped_steps: Skipped steps in a row after which training stops.
        saved_batches: Maximum number of batches that a process saves in ``<run_dir>/bad_batches``.
    """

    def __init__(
        self, max_skipped_steps: PositiveInt = 10, saved_batches: NonNegativeInt = 3
    ) -> None:
        self.max_skipped_steps = max_skipped_steps
        self.saved_batches = saved_batches
        self.skipped = self.in_a_row = 0
        self.stop = 0  # stop signal of this process; after a step the highest of all processes
        self._batches: list[tuple[int, Any, dict[str, Tensor]]] = []  # number, content, losses
        self._buffers: list[tuple[Tensor, Tensor]] = []  # and their values before the step

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Copy the buffers before the first batch of a step: the forward pass moves them."""
        if not self._batches:
            average = getattr(pl_module, "ema", None)
            averaged = set() if average is None else set(average.buffers())
            buffers = [buffer for buffer in pl_module.buffers() if buffer not in averaged]
            self._buffers = [(buffer, buffer.detach().clone()) for buffer in buffers]
        self._batches.append((trainer.fit_loop.epoch_loop.total_batch_idx, batch, {}))

    def on_after_backward(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Record the losses of the batch."""
        self._batches[-1][2].update(getattr(pl_module, "logged_losses", {}))

    def on_before_optimizer_step(
        self, trainer: L.Trainer, pl_module: Any, optimizer: torch.optim.Optimizer
    ) -> None:
        """Skip the step if it is not finite; stop after ``max_skipped_steps`` in a row."""
        pl_module.grad_norms = gradient_norms(optimizer, pl_module.device)
        norms = torch.stack(list(pl_module.grad_norms.values()))
        bad_here, bad_losses, bad_gradients, bad_buffers, self.stop, idle = self._find_faults(norms)
        if idle:
            rank_zero_warn("all gradients of a step are 0: check the weights of the losses")
        pl_module.step_skipped = bool(bad_losses or bad_gradients or bad_buffers)
        self.skipped += pl_module.step_skipped
        # Filled on the device: a copy from the host would make it wait.
        pl_module.log("train/skipped_steps", norms.new_full((), self.skipped))
        batches, buffers = self._batches, self._buffers
        self._batches, self._buffers = [], []
        if not pl_module.step_skipped:
            self.in_a_row = 0
            return
        optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            for buffer, before in buffers:
                buffer.copy_(before)
        scaler = getattr(trainer.precision_plugin, "scaler", None)
        # With a scale of 1 or less it is not the scale that made the gradients overflow.
        if scaler and scaler.get_scale() > 1 and not (bad_losses or bad_buffers):
            return
        self.in_a_row += 1
        values = format_values({name: float(norm) for name, norm in pl_module.grad_norms.items()})
        if bad_here or not bad_losses:
            report_bad_batches(pl_module, batches, values, self.saved_batches)
        if self.in_a_row >= self.max_skipped_steps:
            raise RuntimeError(
                f"{self.in_a_row} steps in a row had a non-finite loss or gradient, the last at "
                f"step {trainer.global_step} (gradient norms: {values}). "
                f"{_replay_advice(trainer)}If the samples are sound, lower the learning rate, or "
                "leave fp16 for bf16 or fp32"
            )

    def _find_faults(self, norms: Tensor) -> list[int]:
        """Return flags of non-finite values, the stop signal, and whether all gradients are 0.

        In order: losses of this process; losses, gradients and buffers of any process.
        """
        losses = [values["loss"].to(norms) for _, _, values in self._batches if values]
        bad_losses = ~torch.stack([norms.new_zeros(()), *losses]).isfinite().all()
        moved = [b for b, _ in self._buffers if b.numel() and b.is_floating_point()]
        sizes = torch._foreach_norm(moved, torch.inf) if moved else ()
        bad_buffers = ~torch.stack([norms.new_zeros(()), *sizes]).isfinite().all()
        bad_gradients = ~norms.isfinite().all()
        flags = torch.stack([bad_losses, bad_gradients, bad_buffers]).int()
        shared = torch.cat([flags, flags.new_full((1,), self.stop)])
        if dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1:
            dist.all_reduce(shared, dist.ReduceOp.MAX)  # one process skips: all skip
        # Read at once, as each read makes the host wait for the device.
        return torch.stack([bad_losses.int(), *shared, (~norms.any()).int()]).tolist()

    def state_dict(self) -> dict[str, int]:
        """Return both counters."""
        return {"skipped": self.skipped, "in_a_row": self.in_a_row}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Restore both counters."""
        self.skipped, self.in_a_row = state_dict["skipped"], state_dict["in_a_row"]


def _replay_advice(trainer: L.Trainer) -> str:
    """Sentence with the command that repeats the newest saved step; empty where none was saved."""
    run_dir = Path(trainer.default_root_dir)
    saved = list_bad_batches(run_dir / "bad_batches")
    if not saved:
        return ""
    return (
        f"Run `r3dpa replay {saved[-1]} CKPT` with the last checkpoint before it in "
        f"{run_dir / 'checkpoints'} as CKPT. "
    )

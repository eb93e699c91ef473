"""Skips training steps that are not finite."""

from __future__ import annotations

from typing import Any

import lightning as L
import torch
import torch.distributed as dist
from jsonargparse.typing import NonNegativeInt, PositiveInt
from lightning.pytorch.utilities import rank_zero_warn
from torch import Tensor

from r3dpa.callbacks.bad_batches import listed, report_skipped
from r3dpa.modules.steps import batch_number, gradient_norms


class StepGuard(L.Callback):
    """Skips a step with a loss, gradient norm or buffer that is not finite, on any process.

    A skipped step moves no weight, moment or average, and batch norm and latent statistics are put
    back; ``global_step`` and ``train/skipped_steps`` count it, and its batches are named and kept
    for ``r3dpa replay``. Gradients that overflow through the loss scale of float16 are counted
    only. A step, of one or more batches, costs one read of the device and one all-reduce.

    Args:
        max_skipped_steps: Skipped steps in a row after which training stops.
        saved_batches: Batches that each process keeps in ``<run_dir>/bad_batches`` at most.

    Attributes:
        stop: Signal that asks this process to stop, 0 for none; after a step the highest of all
            processes, see :class:`r3dpa.callbacks.RunCheckpoint`.
    """

    def __init__(
        self, max_skipped_steps: PositiveInt = 10, saved_batches: NonNegativeInt = 3
    ) -> None:
        self.max_skipped_steps, self.saved_batches = max_skipped_steps, saved_batches
        self.skipped = self.in_a_row = self.stop = 0
        self._batches: list[tuple[int, Any, dict[str, Tensor]]] = []  # number, content, losses
        self._kept: list[tuple[Tensor, Tensor]] = []  # buffers and their values before the step

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Copies the buffers before the first batch of a step: the forward pass moves them."""
        if not self._batches:
            average = getattr(pl_module, "ema", None)
            still = set() if average is None else set(average.buffers())
            buffers = [buffer for buffer in pl_module.buffers() if buffer not in still]
            self._kept = [(buffer, buffer.detach().clone()) for buffer in buffers]
        self._batches.append((batch_number(pl_module), batch, {}))

    def on_after_backward(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Notes the losses of the batch."""
        self._batches[-1][2].update(getattr(pl_module, "logged_losses", {}))

    def on_before_optimizer_step(
        self, trainer: L.Trainer, pl_module: Any, optimizer: torch.optim.Optimizer
    ) -> None:
        """Skips the step if it is not finite; stops after ``max_skipped_steps`` in a row."""
        pl_module.grad_norms = gradient_norms(pl_module, optimizer)
        norms = torch.stack(list(pl_module.grad_norms.values()))
        own_bad, losses_bad, gradients_bad, buffers_bad, idle = self._faults(norms)
        if idle:
            rank_zero_warn("all gradients of a step are 0: check the weights of the losses")
        skip = pl_module.step_skipped = losses_bad or gradients_bad or buffers_bad
        self.skipped += skip
        # Filled on the device: a copy from the host would make it wait.
        pl_module.log("train/skipped_steps", norms.new_full((), self.skipped))
        batches, kept = self._batches, self._kept
        self._batches, self._kept = [], []
        if not skip:
            self.in_a_row = 0
            return
        optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            for buffer, before in kept:
                buffer.copy_(before)
        scaler = getattr(trainer.precision_plugin, "scaler", None)
        # With a scale of 1 or less it is not the scale that made the gradients overflow.
        if scaler and scaler.get_scale() > 1 and not (losses_bad or buffers_bad):
            return
        self.in_a_row += 1
        found = {name: float(norm) for name, norm in pl_module.grad_norms.items()}
        if own_bad or not losses_bad:
            report_skipped(pl_module, batches, found, self.saved_batches)
        if self.in_a_row >= self.max_skipped_steps:
            raise RuntimeError(
                f"{self.in_a_row} steps in a row had a non-finite loss or gradient, the last one "
                f"at step {trainer.global_step} (gradient norms: {listed(found)}). Look at the "
                f"named samples, with `r3dpa replay` in {trainer.default_root_dir}/bad_batches; if "
                "they are sound, lower the learning rate, or leave fp16 for bf16 or fp32"
            )

    def _faults(self, norms: Tensor) -> list[bool]:
        """Not finite: own losses, any process's losses, norms, buffers; whether norms are all 0."""
        losses = [values["loss"].to(norms) for _, _, values in self._batches if values]
        own = ~torch.stack([norms.new_zeros(()), *losses]).isfinite().all()
        moved = [b for b, _ in self._kept if b.numel() and b.is_floating_point()]
        sizes = torch._foreach_norm(moved, torch.inf) if moved else ()
        finite = torch.stack([norms.new_zeros(()), *sizes]).isfinite().all()
        flags = torch.stack([own, ~norms.isfinite().all(), ~finite, torch.zeros_like(own)]).int()
        flags[3] = self.stop
        if dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1:
            dist.all_reduce(flags, dist.ReduceOp.MAX)  # one process skips: all skip
        # One number, for each read makes the host wait for the device.
        bits = (own, *flags[:3], ~norms.any())
        code = int(sum(bit.int() << place for place, bit in enumerate(bits)) + (flags[3] << 5))
        self.stop = code >> 5
        return [bool(code & 1 << bit) for bit in range(5)]

    def state_dict(self) -> dict[str, int]:
        """The two counts."""
        return {"skipped": self.skipped, "in_a_row": self.in_a_row}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Goes on counting from there."""
        self.skipped, self.in_a_row = state_dict["skipped"], state_dict["in_a_row"]

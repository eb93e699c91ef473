"""Guards of a training step: judged by one read of the host, undone if it was bad.

A step may span several batches (accumulated gradients); it is good or bad as a whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor

from r3dpa.modules.settings import GuardConfig

__all__ = ["SeenBatch", "StepGuard", "Verdict"]


@dataclass
class SeenBatch:
    """A batch of the step at hand.

    Args:
        content: What the training step received.
        number: Number of the batch since the start of training.
        losses: Its losses by name, without their weights, and ``loss``, their weighted sum.
    """

    content: Mapping[str, Any]
    number: int
    losses: dict[str, Tensor] = field(default_factory=dict)


class Verdict(NamedTuple):
    """What is known of a step.

    Attributes:
        good: Losses, gradient norms and buffers of all processes are finite.
        suspect: The fault may lie in a batch of this process: one of its losses is not finite, or
            all losses of all processes are, so that the fault came with the gradients.
        overflow: Only the gradients of losses that were scaled up are not finite: the scaler of
            float16 looks for its scale, which it halves after such a step.
    """

    good: bool
    suspect: bool
    overflow: bool


class StepGuard:
    """Judges each step, and takes back what a bad one did to the buffers.

    Batch norm and latent statistics move in the forward pass, before anything is known of the
    gradients. So they are copied when a step begins, and copied back if it turns out bad.

    Args:
        config: Limits.

    Attributes:
        batches: What the step has seen so far.
        dropped: Whether the last step was bad.
        stop: Signal that asks this process to stop, 0 for none; after :meth:`judge` the highest of
            all processes.
        skipped: Bad steps since the start of training.
        in_a_row: Bad steps since the last good one, but for those of an overflow.
        still: Steps since the last one with a gradient norm of at least ``config.collapse_norm``.
    """

    def __init__(self, config: GuardConfig) -> None:
        self.config = config
        self.batches: list[SeenBatch] = []
        self.dropped, self.stop = False, 0
        self.skipped = self.in_a_row = self.still = 0
        self._kept: list[tuple[Tensor, Tensor]] = []
        self._judged = True

    def begin(self, content: Mapping[str, Any], number: int, buffers: Iterable[Tensor]) -> None:
        """Notes a batch; copies the buffers if it is the first of a step."""
        if self._judged:
            self._kept = [(buffer, buffer.detach().clone()) for buffer in buffers]
            self.batches, self._judged = [], False
        self.batches.append(SeenBatch(content, number))

    def saw(self, losses: Mapping[str, Tensor]) -> None:
        """Notes the losses of the last batch, detached."""
        if self.batches:
            self.batches[-1].losses = dict(losses)

    def judge(self, norms: Tensor, loss_scale: Callable[[], float] = lambda: 1.0) -> Verdict:
        """Ends the step; counts, and restores the buffers if it was bad.

        Args:
            norms: Gradient norm of each network, ``(n,)``, equal in all processes.
            loss_scale: Factor of the losses, asked for after a bad step; equal in all processes.
        """
        losses = [batch.losses["loss"].to(norms) for batch in self.batches if batch.losses]
        own = ~torch.stack([norms.new_zeros(()), *losses]).isfinite().all()
        kept = [buffer for buffer, _ in self._kept if buffer.numel()]
        moved = [buffer for buffer in kept if buffer.is_floating_point()]
        sizes = [norms.new_zeros(()), *(torch._foreach_norm(moved, torch.inf) if moved else ())]
        faults = [own, ~norms.isfinite().all(), ~torch.stack(sizes).isfinite().all()]
        flags = torch.stack(faults).int()
        flags = torch.cat([flags, flags.new_full((1,), self.stop)])
        if dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1:
            dist.all_reduce(flags, dist.ReduceOp.MAX)  # one process skips: all skip
        still = norms.max() < self.config.collapse_norm
        # One number, for each read makes the host wait for the device.
        code = flags[0] + 2 * flags[1] + 4 * flags[2] + 8 * own + 16 * still + 32 * flags[3]
        told = int(code)
        losses_bad, gradients_bad, buffers_bad, own_bad, is_still = (
            bool(told & 1 << bit) for bit in range(5)
        )
        self.stop = told >> 5
        self.dropped = losses_bad or gradients_bad or buffers_bad
        # With a scale of 1 or less it is not the scale that made them overflow.
        overflow = gradients_bad and not (losses_bad or buffers_bad) and loss_scale() > 1
        if self.dropped:
            self.skipped += 1
            self.in_a_row += not overflow
            with torch.no_grad():
                for buffer, before in self._kept:
                    buffer.copy_(before)
        else:
            self.in_a_row = 0
            self.still = self.still + 1 if is_still else 0
        self._judged = True
        suspect = self.dropped and (own_bad or not losses_bad)
        return Verdict(not self.dropped, suspect, overflow)

    def forget(self) -> None:
        """Lets go of the batches of a step that was judged."""
        self.batches, self._kept = [], []

    def state_dict(self) -> dict[str, int]:
        """The three counts."""
        return {"skipped": self.skipped, "in_a_row": self.in_a_row, "still": self.still}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Goes on counting from there."""
        self.skipped, self.in_a_row = int(state["skipped"]), int(state["in_a_row"])
        self.still = int(state["still"])

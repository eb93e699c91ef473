"""How a step moves the weights: optimiser, clipping per network, guards, averages."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from r3dpa import __version__
from r3dpa.io import source_commit
from r3dpa.modules.bad_batches import BadBatch, tensors_of
from r3dpa.modules.guards import StepGuard, Verdict
from r3dpa.modules.settings import OptimizerConfig
from r3dpa.modules.step_losses import StepLosses
from r3dpa.nn import EMA

__all__ = ["GuardedOptimisation"]


class GuardedOptimisation(StepLosses):
    """One optimiser for all networks; a step that is not finite leaves no trace but a count.

    Judged are the losses of all batches of a step, the gradient norm of each network, and what the
    forward passes made of batch norm and latent statistics. A bad step moves no weight, moment or
    average, and those statistics are put back: the run goes on as if the batches had not been
    there, but for ``global_step``, which counts them.
    """

    stage: str
    replayed = False  # whether `r3dpa replay` knows the stage
    ema: EMA | None
    optimizer_config: OptimizerConfig

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds the stage, the path of its velocities, the version, and what the guard counted."""
        checkpoint["r3dpa"] = {
            "stage": self.stage,
            "interpolant": self.interpolant.path,
            "version": __version__,
            "commit": source_commit(),
        }
        if self.guard is not None:
            checkpoint["guards"] = self.guard.state_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuses the checkpoint of another stage; optimiser settings stay those of this run.

        Raises:
            ValueError: Naming both stages.
        """
        found = checkpoint.get("r3dpa", {}).get("stage")
        if found != self.stage:
            raise ValueError(
                f"the checkpoint is of stage {found!r}, this is {self.stage!r}; to start a stage "
                "from another one, give model.init_from instead of ckpt_path"
            )
        for state in checkpoint.get("optimizer_states", []):
            for group in state["param_groups"]:
                group.update(asdict(self.optimizer_config))
        if self.guard is not None and "guards" in checkpoint:
            self.guard.load_state_dict(checkpoint["guards"])

    def trainable(self) -> dict[str, nn.Module]:
        """Networks that this stage trains, by name; frozen parameters inside stay frozen."""
        raise NotImplementedError

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """One AdamW with a parameter group per trained network, fused where the device has it."""
        groups = [
            {"params": [p for p in network.parameters() if p.requires_grad], "name": name}
            for name, network in self.trainable().items()
        ]
        return torch.optim.AdamW(groups, **asdict(self.optimizer_config), fused=self._fused)

    @property
    def _fused(self) -> bool:
        """Whether one kernel moves all weights.

        In float16 it would also undo the scale of the gradients, after they were clipped.
        """
        supported = self.device.type in ("cpu", "cuda", "mps", "xpu")
        return supported and self.trainer.precision != "16-mixed"

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: int | float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clips each network's gradient norm by itself and logs it as ``grad_norm/<network>``.

        A step that :class:`StepGuard` finds bad is dropped. One whose gradients only overflowed
        because float16 scales the losses up is counted, but neither reported nor a reason to stop.

        Raises:
            RuntimeError: After too many such steps in a row, or without any gradient.
        """
        if gradient_clip_algorithm not in (None, "norm"):
            raise ValueError(
                "gradients are clipped by norm per network; leave gradient_clip_algorithm out, got "
                f"{getattr(gradient_clip_algorithm, 'value', gradient_clip_algorithm)!r}"
            )
        limit = float("inf") if gradient_clip_val is None else float(gradient_clip_val)
        norms = {
            group["name"]: nn.utils.get_total_norm(
                [p.grad for p in group["params"] if p.grad is not None]
            ).to(self.device)  # without any gradient it is made on the host
            for group in optimizer.param_groups
        }
        values = {f"grad_norm/{name}": norm for name, norm in norms.items()}
        if self.guard is not None:
            # Only the precision of float16 has one; it is the same in all processes.
            scaler = getattr(self.trainer.precision_plugin, "scaler", None)
            asked = {} if scaler is None else {"loss_scale": scaler.get_scale}
            verdict = self.guard.judge(torch.stack(list(norms.values())), **asked)
            # Filled on the device: a copy from the host would make it wait.
            count = next(iter(norms.values())).new_full((), self.guard.skipped)
            values["train/skipped_steps"] = count
            if not verdict.good:
                optimizer.zero_grad(set_to_none=True)
            if not (verdict.good or verdict.overflow):
                self._report(self.guard, verdict, norms)
            self._refuse_collapse(self.guard)
            self.guard.forget()
        self.log_dict(values)
        if self._dropped:
            return
        for group in optimizer.param_groups:
            nn.utils.clip_grads_with_norm_(group["params"], limit, norms[group["name"]])

    @property
    def _dropped(self) -> bool:
        """Whether the last step was dropped."""
        return self.guard is not None and self.guard.dropped

    def _report(self, guard: StepGuard, verdict: Verdict, norms: dict[str, Tensor]) -> None:
        """Tells of a dropped step and keeps its batches; stops after too many in a row."""
        run_dir = Path(self.trainer.default_root_dir)
        folder = run_dir / "bad_batches"
        found = {name: float(norm) for name, norm in norms.items()}
        losses = [{k: float(v) for k, v in seen.losses.items()} for seen in guard.batches]
        chosen = [
            index
            for index, values in enumerate(losses)
            if verdict.suspect and not all(map(math.isfinite, values.values()))
        ] or list(range(len(losses) if verdict.suspect else 0))
        for index in chosen:
            batch, number = guard.batches[index].content, guard.batches[index].number
            names = list(batch.get("name", []))
            try:
                file = self._bad_batch(batch, number, losses[index], found).save(
                    folder, guard.config.saved_batches
                )
                kept = f"kept in {file}" if file else f"not kept: {folder} holds enough"
            except OSError as error:  # a full disk is no reason to end a run that could go on
                kept = f"not kept: {error}"
            warnings.warn(
                f"step {self.global_step} was skipped: losses {_listed(losses[index])}; gradient "
                f"norms {_listed(found)}; samples {', '.join(names) or 'without names'} (batch "
                f"{number}, process {self.global_rank}), {kept}",
                stacklevel=2,
            )
        if guard.in_a_row >= guard.config.max_skipped_steps:
            look = f"Look at the samples that are named in {folder}"
            if self.replayed:
                look = (
                    f"For a file of {folder}, `r3dpa replay FILE {run_dir}/checkpoints/last.ckpt` "
                    "tells in which layer it starts; look at the scans with `r3dpa check`"
                )
            raise RuntimeError(
                f"{guard.in_a_row} steps in a row had a non-finite loss or gradient, the last one "
                f"at step {self.global_step} (gradient norms: {_listed(found)}). {look}; if they "
                "are sound, lower the learning rate, or train in bf16 or fp32 instead of fp16"
            )

    def _refuse_collapse(self, guard: StepGuard) -> None:
        config = guard.config
        if guard.still >= config.collapse_steps:
            raise RuntimeError(
                f"all gradient norms have been below {config.collapse_norm:g} for {guard.still} "
                f"steps, until step {self.global_step}: nothing learns any more. Go on from an "
                "earlier checkpoint with a lower learning rate, in bf16 or fp32 instead of fp16; "
                "at the very start, look at the loss weights and at what is frozen"
            )

    def _bad_batch(
        self,
        batch: Mapping[str, Any],
        number: int,
        losses: dict[str, float],
        grad_norms: dict[str, float],
    ) -> BadBatch:
        tensors = tensors_of(batch)
        num_scans = len(next(iter(tensors.values())))
        return BadBatch(
            tensors=tensors,
            names=list(batch.get("name", [])),
            draws=self.draw_path(num_scans, number),
            stage=self.stage,
            step=self.global_step,
            number=number,
            seed=self.seed,
            rank=self.global_rank,
            world_size=self.trainer.world_size,
            precision=str(self.trainer.precision),
            path=self.interpolant.path,
            weights=self.weights,
            losses=losses,
            grad_norms=grad_norms,
        )

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Keeps the statistics as they are before the step."""
        if self.guard is not None:
            average = set() if self.ema is None else set(self.ema.buffers())
            moved = (buffer for buffer in self.buffers() if buffer not in average)
            self.guard.begin(batch, self.batch_number, moved)

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Steps the optimiser, then the averages, unless the step was dropped."""
        super().optimizer_step(*args, **kwargs)
        if self.ema is not None and not self._dropped:
            self.ema.update(self.sit, self.latent_norm)

    def on_train_start(self) -> None:
        """Fits the state of a resumed optimiser to this run."""
        optimizer = cast(torch.optim.Optimizer, self.optimizers(use_pl_optimizer=False))
        self.arrange_optimizer(optimizer, self._fused)

    @staticmethod
    def arrange_optimizer(optimizer: torch.optim.Optimizer, fused: bool) -> None:
        """Puts the state of an AdamW where it has to be, in the memory format of the weights.

        A fused optimiser walks through the memory of weights and moments alike, unchecked.

        Args:
            optimizer: It may hold the state of a run with other settings.
            fused: Whether one kernel moves all weights.
        """
        for group in optimizer.param_groups:
            group["fused"] = fused
        for parameter, state in optimizer.state.items():
            state["step"] = state["step"].to(parameter.device if fused else "cpu")
            for name in ("exp_avg", "exp_avg_sq"):
                if state[name].stride() != parameter.stride():
                    state[name] = torch.empty_like(parameter).copy_(state[name])


def _listed(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in values.items()) or "unknown"

"""Where a training step spends its time: parts, settings side by side, and the loader beside it.

Run as a callback after the last step, when weights, moments and data are on their device.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from statistics import median
from typing import Any, cast

import lightning as L
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from r3dpa.bench.timing import Comparison, compare
from r3dpa.modules import GenerativeModule, JointAlignment
from r3dpa.modules.guards import StepGuard
from r3dpa.modules.step_losses import frozen

__all__ = ["PartCost", "StepProfile"]

_GUARD_ROUNDS = 5  # as many as of the settings: the difference is small
_LOADER_EPOCHS = 4  # of one batch; the first one does not count


@dataclass(frozen=True)
class PartCost:
    """What one part of a step costs, forward and backward.

    Args:
        flop: Floating-point operations of convolutions, linear layers and attention.
        seconds: Wall time, run by itself.
    """

    flop: int
    seconds: float


class StepProfile(L.Callback):
    """Measures the parts of a step, the loader, and, if asked for, settings side by side.

    Args:
        rounds: Rounds of :func:`r3dpa.bench.timing.compare` over the settings; 0 for none.

    Attributes:
        parts: Cost of each part, by name. What a step takes beyond them is clipping, logging and
            the loop around it.
        loader_images_per_second: Of one loader process.
        variants: Steps with other settings than the first; None where ``rounds`` is 0.
        guards: Steps without guards, and with them; None where ``rounds`` is 0.
    """

    def __init__(self, rounds: int = 0) -> None:
        self.rounds = rounds
        self.parts: dict[str, PartCost] = {}
        self.loader_images_per_second = 0.0
        self.variants: Comparison | None = None
        self.guards: Comparison | None = None

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Measures after the last step."""
        if trainer.global_step < trainer.max_steps:
            return
        module = cast(GenerativeModule, pl_module)
        for name, part in step_parts(module, batch).items():
            with FlopCounterMode(display=False) as counter:
                part()
            self.parts[name] = PartCost(counter.get_total_flops(), _timed(module, part))
        self.loader_images_per_second = _loader_rate(trainer)
        if self.rounds:
            self.variants = compare(_variants(module, batch), self.rounds)
            self.guards = compare(_guards(module, batch), _GUARD_ROUNDS * self.rounds)


def step_parts(module: GenerativeModule, batch: dict[str, Any]) -> dict[str, Callable[[], None]]:
    """Parts of a training step, each of which starts from inputs of its own.

    Their operations are those of the step, no more and no less.
    """
    precision = module.trainer.precision_plugin
    optimizer = cast(torch.optim.Optimizer, module.optimizers(use_pl_optimizer=False))
    image, features = batch.get("range_image"), batch.get("feature_grid")
    draws = module.draw_path(len(batch["name"]), 0)
    latents = torch.randn_like(draws.noise)
    trains_vae = "vae" in module.trainable()

    def backward(losses: Callable[[], Tensor | dict[str, Tensor]]) -> Callable[[], None]:
        def run() -> None:
            with precision.forward_context():
                found = losses()
                total = sum(found.values()) if isinstance(found, dict) else found
            cast(Tensor, total).backward()

        return run

    def encode() -> None:
        with torch.no_grad(), precision.forward_context():
            module.vae.encode(cast(Tensor, image))

    def align() -> dict[str, Tensor]:
        with frozen(module.sit) if isinstance(module, JointAlignment) else nullcontext():
            return module.vae_alignment_losses(latents.clone().requires_grad_(), features, draws)

    def optimise() -> None:
        optimizer.step()
        if module.ema is not None:
            module.ema.update(module.sit, module.latent_norm)

    parts: dict[str, Callable[[], None]] = {}
    if trains_vae:
        seen = cast(Tensor, image)
        with torch.no_grad():
            posterior = module.vae.encode(seen)
        parts["VAE encode"] = backward(lambda: module.vae.encode(seen).sample(latents).mean())
        parts["VAE decode"] = backward(
            lambda: module.vae.decode(latents.clone().requires_grad_()).mean()
        )
        # Reconstruction and KL are elementwise; what is left of these losses is the discriminator.
        parts["adversarial"] = backward(
            lambda: module.vae_losses(seen, posterior, seen.clone().requires_grad_())
        )
        parts["discriminator"] = backward(lambda: module.discriminator_losses(seen, seen))
    elif image is not None:
        parts["VAE encode"] = encode
    if trains_vae and module.weights.vae_alignment != 0:
        parts["alignment"] = backward(align)
    if module.trains_velocity:
        normalised = module.latent_norm.normalise(latents)
        parts["SiT"] = backward(lambda: module.flow_losses(normalised, features, draws))
    parts["optimiser"] = optimise
    return parts


def _variants(module: GenerativeModule, batch: dict[str, Any]) -> dict[str, Callable[[], float]]:
    """The same step in turn with one setting changed; what the change costs is not timed."""
    optimizer = cast(torch.optim.Optimizer, module.optimizers(use_pl_optimizer=False))

    def case(channels_last: bool, bf16: bool, fused: bool) -> Callable[[], float]:
        step = _step(module, batch, optimizer, bf16)

        def run() -> float:
            module.channels_last = channels_last
            module.arrange_networks()
            module.arrange_optimizer(optimizer, fused)
            return _timed(module, step)

        return run

    optimizer.zero_grad()
    return {
        "fp32, contiguous, fused": case(False, False, True),
        "fp32, channels last, fused": case(True, False, True),
        "bf16, contiguous, fused": case(False, True, True),
        "bf16, channels last, fused": case(True, True, True),
        "fp32, contiguous, not fused": case(False, False, False),
    }


def _guards(module: GenerativeModule, batch: dict[str, Any]) -> dict[str, Callable[[], float]]:
    """The same step without guards and with them."""
    optimizer = cast(torch.optim.Optimizer, module.optimizers(use_pl_optimizer=False))
    guard, step = module.guard, _step(module, batch, optimizer, bf16=False)

    def case(chosen: StepGuard | None) -> Callable[[], float]:
        def run() -> float:
            module.guard = chosen
            return _timed(module, step)

        return run

    return {"without guards": case(None), "with guards": case(guard)}


def _step(
    module: GenerativeModule,
    batch: dict[str, Any],
    optimizer: torch.optim.Optimizer,
    bf16: bool,
) -> Callable[[], None]:
    """A whole step as Lightning takes it, but for its loop and the averages."""

    def step() -> None:
        module.on_train_batch_start(batch, 0)
        with torch.autocast(module.device.type, torch.bfloat16, enabled=bf16):
            loss = cast(Tensor, module.training_step(batch, 0))
        loss.backward()
        module.configure_gradient_clipping(optimizer, gradient_clip_val=1.0)
        optimizer.step()
        optimizer.zero_grad()

    return step


def _loader_rate(trainer: L.Trainer) -> float:
    loader = cast(Any, trainer.train_dataloader)
    rates = []
    for _ in range(_LOADER_EPOCHS):
        start = time.perf_counter()
        num_scans = sum(len(batch["name"]) for batch in loader)
        rates.append(num_scans / (time.perf_counter() - start))
    return median(rates[1:])


def _timed(module: L.LightningModule, function: Callable[[], None]) -> float:
    on_gpu = module.device.type == "cuda"
    if on_gpu:
        torch.cuda.synchronize()
    start = time.perf_counter()
    function()
    if on_gpu:
        torch.cuda.synchronize()
    return time.perf_counter() - start

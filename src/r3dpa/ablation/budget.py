"""What a plan costs before it is started: operations counted, hours from stated rates, disk."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import lightning as L
import torch
import yaml
from lightning.pytorch.cli import LightningArgumentParser
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from r3dpa.ablation.configs import with_value
from r3dpa.ablation.plan import Plan, Stage
from r3dpa.modules import FlowMatching, GenerativeModule, RGBPretraining
from r3dpa.modules.steps import PathDraws

__all__ = ["Budget", "StageBudget", "budget_of"]

#: Operations per second of a whole machine. Of the A100, the paper's own: 1 M joint steps of 32
#: scans in 70 h on eight are 15 % of their peak. Of the H200 the same share of its 989: assumed.
_RATES = {"1 x H200": 150e12, "8 x A100": 8 * 48e12}
_COPIES = 2  # checkpoints that a stage keeps: the last one, and that of its last interval
_SCAN_BYTES = 2.6e6
_FLOAT_BYTES, _HALF_BYTES = 4, 2


@dataclass(frozen=True)
class StageBudget:
    """Cost of one training.

    Args:
        flop: Of all steps, forward and backward.
        num_bytes: On disk.
    """

    flop: float
    num_bytes: float


@dataclass(frozen=True)
class Budget:
    """Cost of a plan, by name of the stage; ``str`` gives the line for the user.

    Sampling and metrics are left out: a scene of 256 evaluations costs as much as 9 joint steps of
    one scan.
    """

    stages: dict[str, StageBudget]
    scan_bytes: float

    @property
    def flop(self) -> float:
        """Of all trainings."""
        return sum(stage.flop for stage in self.stages.values())

    @property
    def num_bytes(self) -> float:
        """Of checkpoints, cached latents, scans and feature grids."""
        return self.scan_bytes + sum(stage.num_bytes for stage in self.stages.values())

    def hours(self) -> dict[str, float]:
        """Training time by machine, at the rates that are assumed."""
        return {machine: self.flop / rate / 3600 for machine, rate in _RATES.items()}

    def __str__(self) -> str:
        """The line for the user."""
        hours = self.hours()
        told = "; ".join(
            f"{_duration(hours[machine])} on {machine} at {rate / 1e12:.0f} TFLOP/s"
            for machine, rate in _RATES.items()
        )
        return (
            f"budget: {len(self.stages)} trainings, {self.flop:.3g} FLOP; {told} (large networks "
            f"reach such rates, small ones do not); {self.num_bytes / 1e9:.3g} GB on disk"
        )


def _duration(hours: float) -> str:
    return f"{hours:.3g} h" if hours >= 0.1 else f"{3600 * hours:.2g} s"


def budget_of(plan: Plan) -> Budget:
    """Counts the operations of one scan in each training, on networks without memory.

    Args:
        plan: All of its stages count, also those that are done already.

    Raises:
        ValueError: If a configuration names no module that is known here.
    """
    stages = {stage.name: _stage_budget(stage, plan) for stage in plan.stages}
    grids = {
        (*stage.config["data"]["init_args"]["grid_size"], _feature_dim(stage))
        for stage in plan.stages
        if plan.on_scans(stage)
    }
    per_scan = _SCAN_BYTES + _HALF_BYTES * sum(math.prod(grid) for grid in grids)
    return Budget(stages, plan.scale.num_scans * per_scan)


def _stage_budget(stage: Stage, plan: Plan) -> StageBudget:
    module = _on_meta(stage.config)
    trainer = stage.config["trainer"]
    batch = stage.config["data"]["init_args"]["batch_size"]
    batch *= trainer.get("accumulate_grad_batches", 1)
    flop = _flop_per_sample(module, stage.config["data"]["init_args"].get("image_size"))
    state = sum(value.numel() for value in module.state_dict().values())
    trained = sum(p.numel() for p in module.parameters() if p.requires_grad)
    num_bytes = _COPIES * _FLOAT_BYTES * (state + 2 * trained)
    count = plan.scale.num_scans if plan.on_scans(stage) else plan.scale.num_images
    if isinstance(module, RGBPretraining) or (
        isinstance(module, FlowMatching) and module.cache_latents
    ):
        moments = 2 * module.latent_norm.channels * math.prod(module.sit.input_size)
        num_bytes += count * moments * _FLOAT_BYTES
    return StageBudget(trainer["max_steps"] * batch * flop, num_bytes)


def _on_meta(config: Mapping[str, Any]) -> L.LightningModule:
    """The module of a configuration, its weights without memory, and no file read."""
    if config["model"]["init_args"].get("teacher"):
        config = with_value(config, "model.init_args.teacher.init_args.weights", None)
    parser = LightningArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(L.LightningModule, "model")
    parsed = parser.parse_string(yaml.safe_dump({"model": config["model"]}))
    with torch.device("meta"):
        module: L.LightningModule = parser.instantiate_classes(parsed).model
    return module


def _flop_per_sample(module: Any, image_size: int | None) -> float:
    """Of the losses of one scan or image, and their gradients."""
    with _quiet():
        module.trainer = L.Trainer(
            accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False
        )
    module.train()
    batch, draws = _batch(module, image_size)
    module.draw_path, module.log_dict = lambda *_: draws, lambda *_: None
    with FlopCounterMode(display=False) as counter:
        module.training_step(batch, 0).backward()
    return counter.get_total_flops()


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the lines of a trainer on devices, which is none that trains."""
    log = logging.getLogger("lightning.pytorch")
    before = log.level
    log.setLevel(logging.WARNING)
    try:
        yield
    finally:
        log.setLevel(before)


def _batch(module: Any, image_size: int | None) -> tuple[dict[str, Tensor], PathDraws]:
    """A scan or image of the size that the networks expect, and the random numbers of a step."""

    def empty(*shape: int) -> Tensor:
        return torch.empty(1, *shape, device="meta")

    channels = module.vae.latent_channels
    batch = {}
    if isinstance(module, GenerativeModule):
        rows, columns = module.sit.input_size
        tokens = module.sit.grid_size[0] * module.sit.grid_size[1]
        batch["feature_grid"] = empty(tokens, module.sit.feature_dim)
        image = (rows * module.vae.stride[0], columns * module.vae.stride[1])
        batch["range_image"] = empty(1, *image)
    elif image_size is not None:
        rows, columns = module.vae.latent_size((image_size, image_size))
        batch["image"] = empty(3, image_size, image_size)
    if getattr(module, "cache_latents", not isinstance(module, GenerativeModule)):
        batch["posterior_moments"] = empty(2 * channels, rows, columns)
    latents = (channels, rows, columns)
    return batch, PathDraws(empty(*latents), empty(), empty(*latents))


def _feature_dim(stage: Stage) -> int:
    network: Any = stage.config["model"]["init_args"].get("sit", {})
    return network.get("init_args", {}).get("feature_dim", 0)

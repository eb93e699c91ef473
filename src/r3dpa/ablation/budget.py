"""Cost of a plan: operations counted on the meta device, hours at assumed rates."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any

import lightning as L
import torch
import yaml
from lightning.pytorch.cli import LightningArgumentParser
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from r3dpa.ablation.plan import Plan, with_value
from r3dpa.modules import GenerativeModule
from r3dpa.modules.steps import PathDraws

__all__ = ["budget_of", "flop_per_sample"]

#: Operations per second of a machine. A100: the paper's 1 M joint steps of 32 scans in 70 h on
#: eight, 15 % of their peak. H200: the same share of its peak, assumed.
_RATES = {"1 x H200": 150e12, "8 x A100": 8 * 48e12}


def budget_of(plan: Plan) -> str:
    """Estimated cost of all trainings, without sampling and metrics, in a line.

    A scene of 256 evaluations costs as much as 9 joint steps of one scan.

    Raises:
        ValueError: If a configuration names no known module.
    """
    flop = 0.0
    for stage in plan.stages:
        trainer = stage.config["trainer"]
        batch = stage.config["data"]["init_args"]["batch_size"]
        batch *= trainer.get("accumulate_grad_batches", 1)
        flop += trainer["max_steps"] * batch * flop_per_sample(stage.config)
    hours = {machine: flop / rate / 3600 for machine, rate in _RATES.items()}
    times = "; ".join(
        f"{f'{time:.3g} h' if time >= 0.1 else f'{3600 * time:.2g} s'} on {machine} at "
        f"{_RATES[machine] / 1e12:.0f} TFLOP/s"
        for machine, time in hours.items()
    )
    return (
        f"budget: {len(plan.stages)} trainings, {flop:.3g} FLOP; {times} (large networks reach "
        "such rates, small ones do not)"
    )


def flop_per_sample(config: Mapping[str, Any]) -> float:
    """Operations of a training step on one scan or image, counted on the meta device."""
    if config["model"]["init_args"].get("teacher"):
        config = with_value(config, "model.init_args.teacher.init_args.weights", None)
    parser = LightningArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(L.LightningModule, "model")
    parsed = parser.parse_string(yaml.safe_dump({"model": config["model"]}))
    with torch.device("meta"):
        module = parser.instantiate(parsed).model
    log = logging.getLogger("lightning.pytorch")
    level = log.level
    log.setLevel(logging.WARNING)  # this trainer need not list the devices of the machine
    module.trainer = L.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    log.setLevel(level)
    module.train()
    batch, draws = _meta_batch(module, config["data"]["init_args"].get("image_size"))
    module.draw_path, module.log_dict = lambda *_: draws, lambda *_: None
    with FlopCounterMode(display=False) as counter:
        module.training_step(batch, 0).backward()
    return counter.get_total_flops()


def _meta_batch(module: Any, image_size: int | None) -> tuple[dict[str, Tensor], PathDraws]:
    """A scan or image of the size of the networks, and the random numbers of a step."""

    def empty(*shape: int) -> Tensor:
        return torch.empty(1, *shape, device="meta")

    channels = module.vae.latent_channels
    batch = {}
    if isinstance(module, GenerativeModule):
        rows, columns = module.sit.input_size
        batch["feature_grid"] = empty(math.prod(module.sit.grid_size), module.sit.feature_dim)
        batch["range_image"] = empty(1, rows * module.vae.stride[0], columns * module.vae.stride[1])
    elif image_size is not None:
        rows, columns = module.vae.latent_size((image_size, image_size))
        batch["image"] = empty(3, image_size, image_size)
    if getattr(module, "cache_latents", not isinstance(module, GenerativeModule)):
        batch["posterior_moments"] = empty(2 * channels, rows, columns)
    latents = (channels, rows, columns)
    return batch, PathDraws(empty(*latents), empty(), empty(*latents))

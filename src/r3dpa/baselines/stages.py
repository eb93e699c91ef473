"""The baselines by the stage that their checkpoints name."""

from __future__ import annotations

from typing import Any, Literal

from r3dpa.baselines.base import Baseline
from r3dpa.baselines.generator import BaselineGenerator
from r3dpa.baselines.lidm import LiDM
from r3dpa.baselines.r2dm import R2DM
from r3dpa.baselines.r2flow import R2Flow
from r3dpa.checkpoints import Checkpoint
from r3dpa.flow.sampler import Quality, SamplerConfig
from r3dpa.geometry import ScanGeometry
from r3dpa.io import usable_device

BASELINES: dict[str, type[Baseline]] = {kind.stage: kind for kind in (R2DM, R2Flow, LiDM)}


def baseline_generator(
    checkpoint: Checkpoint,
    sampler: SamplerConfig | Quality | None = None,
    *,
    weights: Literal["ema", "last"] = "ema",
    device: str = "auto",
    **options: Any,
) -> BaselineGenerator:
    """Generator of a checkpoint of a baseline.

    Args:
        checkpoint: Content of the checkpoint.
        sampler: Solver and steps. Default: the published sampler of the baseline.
        weights: Averaged or last weights.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
        **options: See :class:`BaselineGenerator`.

    Raises:
        ValueError: If an option is for R3DPA alone, or the checkpoint names no sensor.
    """
    if isinstance(sampler, str):
        raise ValueError(
            f"quality {sampler} is not measured for stage {checkpoint.stage}: give --solver and "
            "--steps, or neither for its published sampler"
        )
    if sampler is not None and sampler.solver == "average_velocity":
        raise ValueError(
            f"solver average_velocity needs a checkpoint of stage few_step, and {checkpoint.path} "
            f"is of stage {checkpoint.stage}: choose another solver"
        )
    for name in ("autoguidance", "decoder", "guidance_scale"):
        if options.pop(name, None) not in (None, "full", 1.0):
            raise ValueError(f"{name} is not for stage {checkpoint.stage}; leave it out")
    if checkpoint.geometry is None:
        raise ValueError(f"{checkpoint.path} does not record which sensor it was trained for")
    baseline = baseline_of(checkpoint, weights)
    baseline.ema = None  # a copy for training
    baseline.to(usable_device(device))
    geometry = ScanGeometry.from_dict(dict(checkpoint.geometry))
    chosen = sampler or baseline.published
    return BaselineGenerator(baseline, baseline.network, geometry, chosen, **options)


def baseline_of(checkpoint: Checkpoint, weights: Literal["ema", "last"] = "ema") -> Baseline:
    """Module of a checkpoint of a baseline, with the averaged or the last weights as its network.

    Every other network of the checkpoint goes to the argument of its name.
    """
    kind = BASELINES[checkpoint.stage]
    chosen = "ema_network" if weights == "ema" else "network"
    networks = {"network": checkpoint.network(chosen).build()}
    for name in set(checkpoint.networks) - {"network", "ema_network"}:
        networks[name] = checkpoint.network(name).build()
    return kind(**networks, **dict(checkpoint.settings)).eval()  # type: ignore[arg-type]

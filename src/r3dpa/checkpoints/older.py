"""Translates what earlier versions recorded of networks; the one place that knows of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_SIT = ("r3dpa.nn.SiT", "r3dpa.nn.sit.SiT")
_AVERAGE_VELOCITY = "r3dpa.nn.average_velocity.AverageVelocitySiT"
_AVERAGES_FIRST = ("ema", "sit")


def current_network(config: Mapping[str, Any]) -> dict[str, Any]:
    """Class path and arguments of a network for the classes of this version.

    Version 0.1.0 kept the guidance of generated scenes and the blocks of average velocities among
    the arguments of SiT.
    """
    if config.get("class_path") not in _SIT:
        return dict(config)
    init_args = dict(config.get("init_args") or {})
    init_args.pop("guidance_block", None)
    init_args.pop("guidance_scale", None)
    average_blocks = init_args.pop("average_blocks", 0)
    if not average_blocks:
        return {**config, "init_args": init_args}
    init_args["average_blocks"] = average_blocks
    return {**config, "class_path": _AVERAGE_VELOCITY, "init_args": init_args}


def recorded_sampling(facts: Mapping[str, Any], configs: Mapping[str, Any]) -> dict[str, Any]:
    """Sampling settings of a checkpoint, from its facts or from the arguments of its SiT."""
    if facts.get("sampling") is not None:
        return dict(facts["sampling"])
    for name in _AVERAGES_FIRST:
        config = configs.get(name)
        init_args = config.get("init_args") if isinstance(config, Mapping) else None
        if init_args and init_args.get("guidance_block"):
            scale = init_args.get("guidance_scale", 1.0)
            return {"perturbed_attention": {"block": init_args["guidance_block"], "scale": scale}}
    return {}

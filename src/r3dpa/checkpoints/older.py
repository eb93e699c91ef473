"""Sampling settings that earlier versions recorded among the arguments of a network."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def recorded_sampling(facts: Mapping[str, Any], configs: Mapping[str, Any]) -> dict[str, Any]:
    """Sampling settings of a checkpoint, from its facts or from the arguments of its SiT."""
    if facts.get("sampling") is not None:
        return dict(facts["sampling"])
    for name in ("ema", "sit"):
        config = configs.get(name)
        init_args = config.get("init_args") if isinstance(config, Mapping) else None
        if init_args and init_args.get("guidance_block"):
            scale = init_args.get("guidance_scale", 1.0)
            return {"perturbed_attention": {"block": init_args["guidance_block"], "scale": scale}}
    return {}

"""Released checkpoints of LiDM, and of its first stage alone."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from r3dpa.checkpoints.networks import Checkpoint, NetworkState
from r3dpa.checkpoints.official import PROJECTION, unet_sizes, vae_sizes, whole_stride

_MARK = "quantize.embedding.weight"
#: Official keys -> network; the names inside are ours, without dots in the average.
_TABLE: tuple[tuple[str, str | None], ...] = (
    (r"model\.diffusion_model\.(.+)", "network"),
    (r"model_ema\.diffusion_model(.+)", "ema_network"),
    (r"first_stage_model\.(.+)", "first_stage"),
    (r"((?:encoder|decoder|quantize|quant_conv|post_quant_conv)\..+)", "network"),  # first stage
    (r"loss\..+|model_ema\.(?:decay|num_updates)", None),
    (r"logvar|betas|(?:sqrt_|log_)?\w*alphas_cumprod(?:_prev)?|posterior_\w+|lvlb_weights", None),
)
_CODECS = {
    "log2": {"encoding": "log2", "scale": 5.84, "legacy_inverse": True},
    "linear": {"encoding": "linear", "scale": 56.0},
}


def is_lidm(content: Any) -> bool:
    """Whether the content of a ``.ckpt`` file is of LiDM or of its first stage."""
    weights = content.get("state_dict") if isinstance(content, Mapping) else None
    return isinstance(weights, Mapping) and bool(
        {_MARK, f"first_stage_model.{_MARK}"} & set(weights)
    )


def from_lidm(
    content: Mapping[str, Any], path: Path, encoding: Literal["linear", "log2"] | None = None
) -> Checkpoint:
    """Checkpoint of LiDM from its Lightning file, every key read or left out by the table.

    Args:
        content: Of the file.
        path: Of the file.
        encoding: ``linear`` for the networks ``*_wo_logscale``; ``log2`` where None.
    """
    weights: dict[str, dict[str, Tensor]] = {}
    for key, value in content["state_dict"].items():
        match, name = _looked_up(key)
        if name is not None:
            weights.setdefault(name, {})[match[1]] = value
    first = weights.get("first_stage") or weights["network"]
    sizes = vae_sizes(first) | {
        "num_codes": len(first[_MARK]),
        "latent_channels": first["post_quant_conv.weight"].shape[1],
        "z_channels": len(first["post_quant_conv.weight"]),
        "mask": len(first["decoder.conv_out.weight"]) == 2,
    }
    networks, settings = {}, {}
    if "first_stage" in weights:
        if "ema_network" not in weights:
            raise ValueError("the file holds no averaged weights (model_ema.*) of LiDM")
        unet, average = weights["network"], weights["ema_network"]
        ours = {key.replace(".", ""): key for key in unet}
        weights["ema_network"] = {ours.get(key, key): value for key, value in average.items()}
        sensor = PROJECTION["sensor"]
        stride = whole_stride(sizes["strides"])
        size = [sensor["beams"] // stride[0], sensor["columns"] // stride[1]]
        arguments = unet_sizes(unet) | {"input_size": size, "position_bias": "ape.bias" in unet}
        for name in ("network", "ema_network"):
            networks[name] = _state("LiDMUNet", arguments, weights[name], name)
        betas = content["state_dict"]["betas"]
        settings = {"first_beta": betas[0].item(), "last_beta": betas[-1].item()}
    name = "first_stage" if networks else "network"
    networks[name] = _state("VQAutoencoder", sizes, first, name)
    return Checkpoint(
        path=path,
        stage="lidm" if settings else "lidm_first_stage",
        networks=networks,
        step=content.get("global_step"),
        geometry={
            "projection": PROJECTION,
            "codec": _CODECS[encoding or "log2"],
            "grid_size": [8, 64],
        },
        settings=settings,
        left_out={
            name: "training starts a new one"
            for name in ("optimizer_states", "lr_schedulers")
            if content.get(name)
        },
    )


def _looked_up(key: str) -> tuple[re.Match[str], str | None]:
    for pattern, name in _TABLE:
        if match := re.fullmatch(pattern, key):
            return match, name
    raise ValueError(f"{key} is no weight of LiDM without conditions, which alone is read")


def _state(kind: str, arguments: Mapping[str, Any], weights: Any, name: str) -> NetworkState:
    path = f"r3dpa.baselines.lidm_networks.{kind}"
    return NetworkState(path, arguments, weights).checked(name)

"""Image VAEs in the layout of diffusers: ``diffusion_pytorch_model.safetensors``."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path

from safetensors import SafetensorError, safe_open

from r3dpa.checkpoints.networks import Checkpoint, NetworkState
from r3dpa.io import UNPICKLING_ERRORS, first_line
from r3dpa.nn.image_vae import ImageVAE

__all__ = ["from_diffusers", "is_diffusers"]

_STEM = "encoder.down_blocks.0.resnets.0.norm1.weight"
# Names of attention layers before diffusers 0.14, as in the files of Stable Diffusion itself.
_OLD_ATTENTION = {"query": "to_q", "key": "to_k", "value": "to_v", "proj_attn": "to_out.0"}
_USUAL_GROUPS = 32


def is_diffusers(path: Path) -> bool:
    """Whether a ``.safetensors`` file holds an image VAE of diffusers."""
    try:
        with safe_open(path, framework="pt") as file:
            return _STEM in file.keys()  # noqa: SIM118 - no dict
    except (*UNPICKLING_ERRORS, SafetensorError):
        return False


def from_diffusers(path: Path) -> Checkpoint:
    """Checkpoint with the image VAE of a file; every tensor is used.

    Widths and depths are read from the weights, ``norm_num_groups`` from ``config.json`` beside it
    where there is one.

    Args:
        path: ``.safetensors`` file with the state dict of an ``AutoencoderKL``.

    Raises:
        ValueError: If a key is unknown or missing, or a shape does not fit.
    """
    try:
        with safe_open(path, framework="pt") as file:
            weights = {_renamed(key): file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (*UNPICKLING_ERRORS, SafetensorError) as error:
        raise ValueError(f"the file is damaged ({first_line(error)})") from error
    levels = range(_count(weights, r"encoder\.down_blocks\.(\d+)\."))
    config = path.with_name("config.json")
    try:
        about = json.loads(config.read_text()) if config.is_file() else {}
        groups = int(about.get("norm_num_groups", _USUAL_GROUPS))
        init_args = {
            "latent_channels": weights["post_quant_conv.weight"].shape[0],
            "channels": [
                len(weights[f"encoder.down_blocks.{level}.resnets.0.conv1.weight"])
                for level in levels
            ],
            "num_res_blocks": _count(weights, r"encoder\.down_blocks\.0\.resnets\.(\d+)\."),
            "norm_groups": groups,
        }
    except UNPICKLING_ERRORS as error:
        raise ValueError(
            f"it is no AutoencoderKL with quant_conv, or {config.name} beside it is damaged "
            f"({first_line(error)})"
        ) from error
    kind = f"{ImageVAE.__module__}.{ImageVAE.__qualname__}"
    state = NetworkState(kind, init_args, weights)
    state.check()
    return Checkpoint(path=path, stage="diffusers", networks={"vae": state})


def _renamed(key: str) -> str:
    for old, new in _OLD_ATTENTION.items():
        key = re.sub(rf"(\.attentions\.\d+\.){old}\.", rf"\g<1>{new}.", key)
    return key


def _count(keys: Iterable[str], pattern: str) -> int:
    """Number of different indices that a pattern finds."""
    return len({found[1] for key in keys if (found := re.match(pattern, key))})

"""Released checkpoints of the baselines: their keys, options and times, translated to ours.

One table of names per network; a key that no table knows is kept and refused when the network
is built. Classes are named, not imported, as in every checkpoint.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from r3dpa.checkpoints.networks import Checkpoint, NetworkState

StateDict = Mapping[str, Tensor]

#: Names of the efficient U-Net of R2DM and R2Flow: official pattern, ours.
_EFFICIENT_UNET = (
    (r"^d_block(\d)\.", lambda found: f"down.{int(found[1]) - 1}."),
    (r"^u_block(\d)\.", lambda found: f"up.{4 - int(found[1])}."),
    (r"^time_embedding\.(\d)", lambda found: f"time_embedding.{int(found[1]) - 1}"),
    (r"\.residual_blocks\.", ".blocks."),
    (r"\.norm2\.proj\.1\.", ".modulation."),
    (r"\.self_attn_block\.norm\.", ".attention.norm."),
    (r"\.self_attn_block\.attn\.in_proj_", ".attention.mix.qkv."),
    (r"\.self_attn_block\.attn\.out_proj\.", ".attention.mix.proj."),
)
#: Constants that are buffers there and formulas here.
_CONSTANTS = re.compile(r"(^_dummy|\.scale|\.kernel|^coords_encoding\.(freqs|phase))$")


def efficient_unet_weights(official: StateDict) -> dict[str, Tensor]:
    """Weights of an official ``EfficientUNet`` by our names, without its constants.

    Raises:
        ValueError: If a scale of the residual branches is not 1 / sqrt(2).
    """
    weights = {}
    for key, value in official.items():
        if key.endswith(".scale") and (value - math.sqrt(0.5)).abs().max() > 1e-6:
            raise ValueError(f"{key} is {value.item():g}, but only 1 / sqrt(2) is known")
        if not _CONSTANTS.search(key):
            for pattern, ours in _EFFICIENT_UNET:
                key = re.sub(pattern, ours, key)
            weights[key] = value
    return weights


def is_r2dm(content: Any) -> bool:
    """Whether the content of a ``.pth`` file is a training checkpoint of R2DM."""
    return isinstance(content, Mapping) and {"cfg", "weights", "ema_weights"} <= set(content)


def from_r2dm(content: Mapping[str, Any], path: Path) -> Checkpoint:
    """Checkpoint of R2DM, such as ``r2dm-h-kitti360-300k.pth``: both U-Nets and the settings."""
    options = content["cfg"]
    model, diffusion, data = options["model"], options["diffusion"], options["data"]
    found = model["architecture"], diffusion["timestep_type"], diffusion["noise_schedule"]
    if found[:2] != ("efficient_unet", "continuous") or found[2] not in ("cosine", "linear"):
        raise ValueError(
            "only an efficient_unet with continuous time and a cosine or linear schedule is read, "
            f"found {', '.join(map(str, found))}"
        )
    given = (
        *("base_channels", "temb_channels", "channel_multiplier", "num_residual_blocks"),
        *("gn_num_groups", "gn_eps", "attn_num_heads", "coords_encoding"),
    )
    init_args = {name: _plain(model[name]) for name in given}
    init_args["in_channels"] = int(data["train_depth"]) + int(data["train_reflectance"])
    init_args["resolution"] = list(data["resolution"])
    networks = {}
    for name, key in (("network", "weights"), ("ema_network", "ema_weights")):
        inner = {k.removeprefix("model."): value for k, value in content[key].items()}
        class_path = "r3dpa.baselines.efficient_unet.EfficientUNet"
        state = NetworkState(class_path, init_args, efficient_unet_weights(inner))
        networks[name] = state.checked(name)
    return Checkpoint(
        path=path,
        stage="r2dm",
        networks=networks,
        step=content.get("global_step"),
        geometry=image_geometry(
            networks["network"].state_dict["coords"],
            str(data["depth_format"]),
            reflectance=bool(data["train_reflectance"]),
        ),
        interpolant="cosine",
        settings={
            "prediction": diffusion["prediction_type"],
            "schedule": diffusion["noise_schedule"],
        },
        left_out={
            name: "training starts a new one"
            for name in ("optimizer", "lr_scheduler")
            if name in content
        },
    )


def image_geometry(
    coords: Tensor,
    depth_format: str,
    reflectance: bool = True,
    min_depth: float = 1.45,
    max_depth: float = 80.0,
) -> dict[str, Any]:
    """Plain values of the ``ScanGeometry`` of images of R2DM and R2Flow.

    Args:
        coords: ``(1, 2, H, W)`` inclination and azimuth of the rays, radians; equal steps make a
            spherical projection, others one row per ring.
        depth_format: ``log_depth``, ``inverse_depth`` or ``depth``.
        reflectance: Whether it is the second channel.
        min_depth: Least range, metres.
        max_depth: Largest range, metres; R2DM has both as constants.
    """
    inclination = coords[0, 0, :, 0].double().rad2deg()
    rows, columns = coords.shape[2:]
    linear = 3 - 28 * torch.arange(rows, dtype=torch.float64) / rows
    projection: dict[str, Any] = {
        "kind": "spherical",
        "sensor": {
            "beams": rows,
            "columns": columns,
            "inclination_max_deg": 3.0,
            "inclination_min_deg": -25.0,
            "range_min_m": min_depth,
            "range_max_m": max_depth,
        },
    }
    if (inclination - linear).abs().max() > 1e-3:
        projection |= {"kind": "rings", "ring_inclinations_deg": inclination.tolist()}
    encodings: dict[str, dict[str, Any]] = {
        "log_depth": {"encoding": "log2", "scale": math.log2(max_depth + 1), "offset_m": 0.0},
        "inverse_depth": {"encoding": "inverse", "scale": min_depth},
        "depth": {"encoding": "linear", "scale": max_depth},
    }
    codec = encodings[depth_format] | {"reflectance": reflectance}
    return {"projection": projection, "codec": codec, "grid_size": [rows // 8, columns // 16]}


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, list | tuple) else value


#: Layouts of the baselines: how a file is recognised, and its reader.
READERS: tuple[
    tuple[Callable[[Any], bool], Callable[[Mapping[str, Any], Path], Checkpoint]], ...
] = ((is_r2dm, from_r2dm),)

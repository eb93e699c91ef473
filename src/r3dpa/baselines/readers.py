"""Released checkpoints of the baselines: their keys, options and times, translated to ours.

One table of names per network; a key that no table knows is kept and refused when the network
is built. Classes are named, not imported, as in every checkpoint.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from r3dpa.baselines.lidm_reader import from_lidm, is_lidm
from r3dpa.checkpoints.networks import Checkpoint, NetworkState

StateDict = Mapping[str, Tensor]

#: Names of the U-Nets of R2DM and R2Flow: official pattern, ours.
_UNETS = (
    (r"^d_block(\d)\.", lambda match: f"down.{int(match[1]) - 1}."),
    (r"^u_block(\d)\.", lambda match: f"up.{4 - int(match[1])}."),
    (r"^time_embedding\.(\d)", lambda match: f"time_embedding.{int(match[1]) - 1}"),
    (r"\.residual_blocks\.", ".blocks."),
    (r"\.skip_conv\.", ".skip."),
    (r"\.norm2\.proj\.1\.", ".modulation."),
    (r"\.self_attn_block\.norm\.", ".attention.norm."),
    (r"\.self_attn_block\.attn\.in_proj_", ".attention.mix.qkv."),
    (r"\.self_attn_block\.attn\.out_proj\.", ".attention.mix.proj."),
)
_UNET_ARGUMENTS = (
    "temb_channels",
    "channel_multiplier",
    "num_residual_blocks",
    "gn_num_groups",
    "gn_eps",
    "attn_num_heads",
    "coords_encoding",
)
#: Constants that are buffers there and formulas here.
_CONSTANTS = re.compile(r"(^_dummy|\.scale|\.kernel|^coords_encoding\.(freqs|phase))$")
_HDIT_CONSTANTS = "spatial_pe.0.embedding."


def read_baseline(
    content: Any, path: Path, encoding: Literal["linear", "log2"] | None = None
) -> Checkpoint | None:
    """Checkpoint from the content of a released file; None if it is of no baseline.

    Args:
        content: Content of the file.
        path: The file.
        encoding: Range encoding of LiDM, see :func:`from_lidm`.
    """
    if is_lidm(content):
        return from_lidm(content, path, encoding)
    if is_r2dm(content):
        return from_r2dm(content, path)
    if is_r2flow(content):
        return from_r2flow(content, path)
    return None


def unet_weights(official: StateDict) -> dict[str, Tensor]:
    """Weights of an official ``EfficientUNet`` or ``ADMUNet`` by our names, without constants."""
    weights = {}
    for key, value in official.items():
        if key.endswith(".scale") and (value - math.sqrt(0.5)).abs().max() > 1e-6:
            raise ValueError(f"{key} is {value.item():g}, but only 1 / sqrt(2) is known")
        if not _CONSTANTS.search(key):
            for pattern, ours in _UNETS:
                key = re.sub(pattern, ours, key)
            weights[key] = value
    return weights


def hdit_weights(official: StateDict) -> dict[str, Tensor]:
    """Weights of an official ``HDiT``, whose names are ours, without constants."""
    return {key: value for key, value in official.items() if not key.startswith(_HDIT_CONSTANTS)}


def is_r2dm(content: Any) -> bool:
    """Whether the content of a ``.pth`` file is a training checkpoint of R2DM."""
    return isinstance(content, Mapping) and {"cfg", "weights", "ema_weights"} <= set(content)


def from_r2dm(content: Mapping[str, Any], path: Path) -> Checkpoint:
    """Checkpoint of R2DM, such as ``r2dm-h-kitti360-300k.pth``: both U-Nets and the settings."""
    options = content["cfg"]
    model, diffusion, data = options["model"], options["diffusion"], options["data"]
    design = model["architecture"], diffusion["timestep_type"], diffusion["noise_schedule"]
    if design[:2] != ("efficient_unet", "continuous") or design[2] not in ("cosine", "linear"):
        raise ValueError(
            "only an efficient_unet with continuous time and a cosine or linear schedule is read, "
            f"found {', '.join(map(str, design))}"
        )
    init_args = {name: _plain(model[name]) for name in ("base_channels", *_UNET_ARGUMENTS)}
    init_args["in_channels"] = int(data["train_depth"]) + int(data["train_reflectance"])
    init_args["resolution"] = list(data["resolution"])
    networks = {}
    for name, key in (("network", "weights"), ("ema_network", "ema_weights")):
        inner = {k.removeprefix("model."): value for k, value in content[key].items()}
        class_path = "r3dpa.baselines.efficient_unet.EfficientUNet"
        state = NetworkState(class_path, init_args, unet_weights(inner))
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
        left_out=_left_out(content),
    )


#: Networks of R2Flow by the ``architecture`` of its options.
_R2FLOW_NETWORKS = {
    "nat_hdit": "r3dpa.baselines.hdit.HDiT",
    "adm_unet": "r3dpa.baselines.adm_unet.ADMUNet",
    "efficient_unet": "r3dpa.baselines.efficient_unet.EfficientUNet",
}
_R2FLOW_FORMATS = {"logscale": "log_depth", "inverse": "inverse_depth", "metric": "depth"}
#: Last layers of the networks of R2Flow, whose sign is the direction of the velocity.
_OUTPUTS = (
    "detokenizer.1.weight",
    "out_conv.weight",
    "out_conv.bias",
    "out_conv.2.weight",
    "out_conv.2.bias",
)
_MAX_PERIOD = 10_000.0  # of the sinusoids of the time


def is_r2flow(content: Any) -> bool:
    """Whether the content of a ``.pth`` file is a training checkpoint of R2Flow."""
    return isinstance(content, Mapping) and {"cfg", "weights", "num_images"} <= set(content)


def from_r2flow(content: Mapping[str, Any], path: Path) -> Checkpoint:
    """Checkpoint of R2Flow, such as ``r2flow-kitti360-2rf.pth``: averaged network and settings."""
    options = content["cfg"]
    model, data = options["model"], options["data"]
    architecture, depth_format = model["architecture"], data["data_format"]
    if architecture not in _R2FLOW_NETWORKS or depth_format not in _R2FLOW_FORMATS:
        raise ValueError(
            f"only the networks {', '.join(_R2FLOW_NETWORKS)} of images in "
            f"{', '.join(_R2FLOW_FORMATS)} are read, found {architecture}, {depth_format}"
        )
    weights = reverse_time(content["weights"])
    init_args: dict[str, Any] = {
        "in_channels": 1 + int(data["train_reflectance"]),
        "resolution": _plain(data["resolution"]),
        "base_channels": model["base_channels"],
    }
    if architecture == "nat_hdit":
        init_args["time_channels"] = model["temb_channels"]
        init_args["depths"] = _plain(model["num_residual_blocks"])
        init_args["num_heads"] = _plain(model["attn_num_heads"])
        init_args["positional_embedding"] = model["coords_encoding"]
        weights = hdit_weights(weights)
    else:
        init_args |= {name: _plain(model[name]) for name in _UNET_ARGUMENTS}
        weights = unet_weights(weights)
    state = NetworkState(_R2FLOW_NETWORKS[architecture], init_args, weights)
    return Checkpoint(
        path=path,
        stage="r2flow",
        networks={"ema_network": state.checked("ema_network")},
        step=content["num_images"] // options["training"]["batch_size"],
        geometry=image_geometry(
            weights["coords"],
            _R2FLOW_FORMATS[depth_format],
            bool(data["train_reflectance"]),
            data["min_depth"],
            data["max_depth"],
        ),
        settings={"num_steps": options["finetuning"]["k_distil"]},
        left_out=_left_out(content),
    )


def reverse_time(weights: StateDict) -> dict[str, Tensor]:
    """Weights of a network of R2Flow whose time runs the other way; its own inverse.

    The official time runs from 0 (noise) to 1 (data), ours from the data, and the velocity points
    to the noise: in terms of the official ``v`` it is ``-v(x, 1 - t)``. All networks take the time
    as cosines and sines. Both of ``w (1 - t)`` are linear in both of ``w t``, so a reflection of
    the columns of the first linear layer and the sign of the last layer translate the weights.
    Gradients by the weights are translated alike, as the map is orthogonal.

    Args:
        weights: Official state dict of a HDiT, ADM U-Net or efficient U-Net.
    """
    turned = {key: -weights[key] for key in _OUTPUTS if key in weights}
    if (key := "timestep_pe.0.linear.weight") in weights:
        angles = 2 * math.pi * weights["timestep_pe.0.freqs"].double()
        turned[key] = _reflect_time(weights[key], angles)
    if (key := "time_embedding.1.weight") in weights:
        half = weights[key].shape[1] // 2
        exponents = torch.arange(half, dtype=torch.float64) / (half - 1)
        angles = torch.exp(-math.log(_MAX_PERIOD) * exponents)
        sines_last = weights[key].roll(half, dims=1)
        turned[key] = _reflect_time(sines_last, angles).roll(half, dims=1)
    return dict(weights) | turned


def _reflect_time(weight: Tensor, angles: Tensor) -> Tensor:
    """Weight ``(E, 2K)`` for features of time t instead of 1 - t, cosines before sines.

    ``cos(w - w t) = cos(w) cos(w t) + sin(w) sin(w t)``, and with ``sin(w - w t)``
    ``= sin(w) cos(w t) - cos(w) sin(w t)``; ``angles`` are the ``(K,)`` frequencies w.
    """
    cosine, sine = angles.cos(), angles.sin()
    of_cosines, of_sines = weight.double().chunk(2, dim=1)
    mixed = of_cosines * cosine + of_sines * sine, of_cosines * sine - of_sines * cosine
    return torch.cat(mixed, dim=1).to(weight.dtype)


def _left_out(content: Mapping[str, Any]) -> dict[str, str]:
    names = ("optimizer", "lr_scheduler")
    return {name: "training starts a new one" for name in names if name in content}


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

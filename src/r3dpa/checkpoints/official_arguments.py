"""Constructor arguments of official networks, inferred from their weights and training options."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from r3dpa.checkpoints.networks import NetworkState
from r3dpa.nn.discriminator import PatchDiscriminator
from r3dpa.nn.vae import VAE

__all__ = [
    "OFFICIAL_PROJECTION",
    "UNET_NAMES",
    "discriminator_state",
    "is_vae",
    "path_of",
    "sit_arguments",
    "unet_arguments",
    "vae_state",
    "vae_strides",
]

StateDict = Mapping[str, Tensor]

_NUM_HEADS = {384: 6, 768: 12, 1024: 16, 1152: 16}  # SiT-S, -B, -L, -XL by token width
UNET_NAMES = {256: "UNet_lidm", 160: "UNet_small"}  # by channels
_UNET_HEAD_CHANNELS = 32  # of both
OFFICIAL_PROJECTION: dict[str, Any] = {
    "kind": "spherical",
    "sensor": {
        "beams": 64,
        "columns": 1024,
        "inclination_max_deg": 3.0,
        "inclination_min_deg": -25.0,
        "range_min_m": 1.0,
        "range_max_m": 56.0,
    },
}


def path_of(kind: type[nn.Module]) -> str:
    """Import path of a class."""
    return f"{kind.__module__}.{kind.__qualname__}"


def is_vae(content: Any) -> bool:
    """Whether these are weights of a VAE for one-channel range images."""
    conv_in = content.get("encoder.conv_in.weight") if isinstance(content, Mapping) else None
    return isinstance(conv_in, Tensor) and conv_in.dim() == 4 and conv_in.shape[1] == 1


def sit_arguments(
    sit: StateDict,
    args: Mapping[str, Any],
    given: Mapping[str, Any],
    strides: tuple[int, int] | None,
) -> dict[str, Any]:
    """Arguments of an official SiT; raises a ``ValueError`` if one cannot be inferred."""
    try:
        hidden_size, in_channels, patch_size, _ = sit["x_embedder.proj.weight"].shape
        num_rows = len(sit["y_embedder.embedding_table.weight"])
        inferred: dict[str, Any] = {
            "in_channels": in_channels,
            "patch_size": patch_size,
            "hidden_size": hidden_size,
            "depth": len({key.split(".")[1] for key in sit if key.startswith("blocks.")}),
            "mlp_ratio": len(sit["blocks.0.mlp.fc1.weight"]) / hidden_size,
            "feature_dim": len(sit["projector.4.weight"]),
            "projector_dim": len(sit["projector.0.weight"]),
            "qk_norm": "blocks.0.attn.q_norm.weight" in sit,
        }
        num_tokens = sit["pos_embed"].shape[1]
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise ValueError(
            f"the weights are not those of an official SiT or UNet ({error}); other backbones "
            "cannot be read"
        ) from error
    num_classes = {**args, **given}.get("num_classes", max(1, num_rows - 1))
    if num_rows not in (num_classes, num_classes + 1):
        raise ValueError(
            f"the label table has {num_rows} rows, which fits no model of {num_classes} classes"
        )
    inferred |= {"num_classes": num_classes, "class_dropout": num_rows > num_classes}
    if "encoder_depth" in args:
        inferred["alignment_depth"] = args["encoder_depth"]
    if hidden_size in _NUM_HEADS:
        inferred["num_heads"] = _NUM_HEADS[hidden_size]
    input_size = _input_size(num_tokens, patch_size, strides)
    if input_size is not None:
        inferred["input_size"] = list(input_size)
    init_args = inferred | dict(given)
    unknown = {"alignment_depth", "num_heads", "input_size"} - set(init_args)
    if unknown:
        raise ValueError(
            f"neither weights nor training options (args, args.json) tell {sorted(unknown)} of "
            f"this SiT with {num_tokens} tokens of width {hidden_size}; give them as sit_args"
        )
    return init_args


def unet_arguments(unet: StateDict, given: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of an official UNet; raises a ``ValueError`` if one cannot be inferred."""
    try:
        _, channels, *input_size = unet["ape.bias"].shape
        num_levels = 1 + sum(key.endswith(".op.weight") for key in unet)
        num_up = len({key.split(".")[1] for key in unet if key.startswith("output_blocks.")})
        num_res_blocks = num_up // num_levels - 1
        # A level is its residual blocks and, but for the last, a step down; first comes the input.
        last_blocks = [(level + 1) * (num_res_blocks + 1) - 1 for level in range(num_levels)]
        widths = [len(unet[f"input_blocks.{i}.0.out_layers.3.weight"]) for i in last_blocks]
        inferred: dict[str, Any] = {
            "input_size": list(input_size),
            "in_channels": unet["input_blocks.0.0.weight"].shape[1],
            "channels": channels,
            "channel_multipliers": [width // channels for width in widths],
            "num_res_blocks": num_res_blocks,
            "feature_dim": len(unet["projector.4.weight"]),
            "projector_dim": len(unet["projector.0.weight"]),
            "num_classes": len(unet["label_emb.weight"]),
        }
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise ValueError(f"the weights are not those of an official UNet ({error})") from error
    attends = [f"input_blocks.{i}.1.qkv.weight" in unet for i in last_blocks]
    if not all(attends):
        inferred["attention_resolutions"] = [2**i for i in range(num_levels) if attends[i]]
    if channels in UNET_NAMES:
        inferred["head_channels"] = _UNET_HEAD_CHANNELS
    init_args = inferred | dict(given)
    if "head_channels" not in init_args:
        raise ValueError(
            f"nothing tells the head_channels of this UNet with {channels} channels; give them as "
            "sit_args"
        )
    return init_args


def _input_size(
    num_tokens: int, patch_size: int, strides: tuple[int, int] | None
) -> tuple[int, int] | None:
    """Latent rows and columns: of the official range image, else of a square image."""
    if strides is not None:
        sensor = OFFICIAL_PROJECTION["sensor"]
        rows, columns = sensor["beams"] // strides[0], sensor["columns"] // strides[1]
        return (rows, columns) if rows * columns == num_tokens * patch_size**2 else None
    side = round(num_tokens**0.5)
    return (side * patch_size, side * patch_size) if side**2 == num_tokens else None


def vae_strides(vae: StateDict, args: Mapping[str, Any]) -> tuple[int, int] | None:
    """Rows and columns of the image per latent, of a range-image VAE or of its official name.

    ``h2p4d8``: patches of 4 x 4 pixels, twice as long horizontally, 8 channels.
    """
    if is_vae(vae):
        strides = vae_state(vae).init_args["strides"]
        return math.prod(rows for rows, _ in strides), math.prod(columns for _, columns in strides)
    name = re.fullmatch(r"h(\d+)(?:p(\d+))?d\d+", str(args.get("vae", "")))
    if name is None:
        return None
    patch = int(name[2] or 1)
    return patch, patch * int(name[1])


def vae_state(weights: StateDict) -> NetworkState:
    """Range-image VAE; its decoder kernels are 1x5 above a (1, 2) upsampling, 3x3 above (2, 2)."""
    try:
        channels = len(weights["encoder.conv_in.weight"])
        levels = range(len({k.split(".")[2] for k in weights if k.startswith("encoder.down.")}))
        widths = [len(weights[f"encoder.down.{i}.block.0.conv1.weight"]) for i in levels]
        ups = [weights[f"decoder.up.{i}.upsample.conv.weight"] for i in levels[1:]]
        kernels = [(int(up.shape[2]), int(up.shape[3])) for up in ups]
        latent_channels = len(weights["post_quant_conv.weight"])
    except (KeyError, IndexError, TypeError) as error:
        raise ValueError(f"the weights of the VAE are incomplete: {error}") from error
    strides = {(1, 5): [1, 2], (3, 3): [2, 2]}
    if not set(kernels) <= set(strides):
        raise ValueError(
            f"the VAE's upsampling kernels {kernels} are not those of an official VAE, "
            f"{list(strides)}"
        )
    blocks = {key.split(".")[4] for key in weights if key.startswith("encoder.down.0.block.")}
    init_args = {
        "in_channels": weights["encoder.conv_in.weight"].shape[1],
        "latent_channels": latent_channels,
        "channels": channels,
        "channel_multipliers": [width // channels for width in widths],
        "strides": [strides[kernel] for kernel in kernels],
        "num_res_blocks": len(blocks),
        "attention_levels": [i for i in levels if f"encoder.down.{i}.attn.0.q.weight" in weights],
        "legacy_upsample": True,
    }
    return NetworkState(path_of(VAE), init_args, dict(weights))


def discriminator_state(weights: StateDict) -> NetworkState:
    """Patch discriminator with arguments inferred from its weights."""
    first = weights.get("main.0.weight")
    num_convolutions = sum(value.dim() == 4 for value in weights.values())
    if first is None or first.dim() != 4 or num_convolutions < 3:
        raise ValueError(
            "the weights are not those of a patch discriminator, which has at least 3 convolutions "
            f"from main.0 on: {num_convolutions} found"
        )
    init_args = {
        "in_channels": first.shape[1],
        "channels": len(first),
        "num_layers": num_convolutions - 2,
    }
    return NetworkState(path_of(PatchDiscriminator), init_args, dict(weights))

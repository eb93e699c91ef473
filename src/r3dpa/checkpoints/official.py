"""Official R3DPA checkpoints: keys and options of valeoai/R3DPA, translated in both directions.

An official SiT or UNet holds the latent batch norm as ``bn.*`` and its projector as
``projectors.0.*``; everything else has the same name here. What we write also holds an entry
``r3dpa``, which the official code ignores: all facts without a place in the official layout.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from r3dpa.checkpoints.networks import Checkpoint, NetworkState, path_of, recorded_facts
from r3dpa.class_paths import current_network
from r3dpa.nn.discriminator import PatchDiscriminator
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.sit import SiT
from r3dpa.nn.unet import UNet
from r3dpa.nn.vae import VAE

StateDict = Mapping[str, Tensor]
Options = Mapping[str, Any]
Encoding = Literal["linear", "log2"]
Strides = tuple[int, int] | None

_SIT_NETWORKS = {"model": ("sit", "latent_norm"), "ema": ("ema", "ema_latent_norm")}
_OPTIMISERS = {"opt": "SiT", "opt_vae": "VAE", "opt_disc": "discriminator"}
_STATISTICS = {"latents_scale", "latents_bias"}
OURS = "r3dpa"
_DATASET_CONFIGS: dict[Encoding, str] = {"linear": "kitti.yaml", "log2": "kitti_logscale.yaml"}
_SIT_SIZES = {384: ("S", 12, 6), 768: ("B", 12, 12), 1024: ("L", 24, 16), 1152: ("XL", 28, 16)}
"""Name, depth and number of heads by token width."""
_UNET_NAMES = {256: "UNet_lidm", 160: "UNet_small"}  # by channels
_UNET_HEAD_CHANNELS = 32  # of both
_UPSAMPLING = {(1, 5): [1, 2], (3, 3): [2, 2]}  # stride of the VAE by kernel of its decoder
PROJECTION: dict[str, Any] = {
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


def is_official(content: Any) -> bool:
    """Whether the content of a ``.pt`` file is an official training checkpoint or VAE."""
    return _is_vae(content) or (
        isinstance(content, Mapping)
        and any(isinstance(content.get(key), Mapping) for key in _SIT_NETWORKS)
    )


def from_official(
    content: Mapping[str, Any],
    path: Path,
    *,
    args: Options | None = None,
    sit_args: Options | None = None,
    encoding: Encoding | None = None,
) -> Checkpoint:
    """Checkpoint from the content of an official file; every key is translated or left out by name.

    ``args`` are the options of the official training script, where ``content`` has none; without
    an encoding, there or given, the geometry is unknown.
    """
    given = sit_args or {}
    if isinstance(content.get(OURS), Mapping):
        return _from_ours(content, path, given)
    recorded = content.get("args", args)
    if isinstance(recorded, argparse.Namespace):
        recorded = vars(recorded)
    options = dict(recorded or {})
    networks: dict[str, NetworkState] = {}
    left_out: dict[str, str] = {}
    if set(content) >= _STATISTICS:
        networks["latent_norm"] = _norm_from_statistics(content)
    try:
        strides = _vae_strides(content.get("vae", {}), options)
        for key, value in content.items():
            if key in _SIT_NETWORKS:
                parts = _sit(_weights(key, value), options, given, strides)
                networks |= dict(zip(_SIT_NETWORKS[key], parts, strict=True))
            elif key == "vae" and _is_vae(value):
                networks[key] = _vae(_weights(key, value))
            elif key == "vae":
                left_out[key] = "the file's VAE is not for range images"
            elif key == "discriminator":
                networks[key] = _discriminator(_weights(key, value))
            elif key in _OPTIMISERS:
                left_out[key] = f"optimiser of the {_OPTIMISERS[key]}: training starts a new one"
            elif key not in {"args", "steps"} | _STATISTICS:
                left_out[key] = "no part of an official checkpoint"
    except (LookupError, TypeError) as error:
        reason = f"the weights do not belong to an official network ({type(error).__name__}: "
        raise ValueError(f"{reason}{error})") from error
    return Checkpoint(
        path=path,
        stage="official",
        networks={name: state.checked(name) for name, state in networks.items()},
        step=content.get("steps"),
        geometry=_geometry(networks, options, encoding) if strides is not None else None,
        official_args=options,
        left_out=left_out,
    )


def _from_ours(content: Mapping[str, Any], path: Path, sit_args: Options) -> Checkpoint:
    about = content[OURS]
    networks: dict[str, NetworkState] = {}
    for name, config in about["networks"].items():
        key = next((key for key, names in _SIT_NETWORKS.items() if name in names), name)
        sit, norm = _split(_weights(key, content.get(key)))
        weights = norm if name.endswith("latent_norm") else sit
        config = current_network(config)
        init_args = {**config["init_args"], **(sit_args if name in ("sit", "ema") else {})}
        networks[name] = NetworkState(config["class_path"], init_args, weights).checked(name)
    return Checkpoint(
        path=path,
        networks=networks,
        step=content.get("steps"),
        official_args=about["official_args"],
        **recorded_facts(about, about["networks"]),
    )


def to_official(checkpoint: Checkpoint) -> dict[str, Any]:
    """Content of an official training checkpoint, without optimisers.

    ``ema`` takes the statistics of ``latent_norm`` if the checkpoint has no others. Without
    the options of an official run, ``args`` is made from the arguments of the networks.
    """
    content: dict[str, Any] = {}
    if checkpoint.stage == "few_step":
        raise ValueError(
            f"{checkpoint.path} is of stage few_step, whose average velocities and thin decoder "
            "have no official counterpart; convert the flow that it started from"
        )
    for key, (sit_name, norm_name) in _SIT_NETWORKS.items():
        if sit_name in checkpoint.networks:
            sit = _official_part(checkpoint, sit_name, SiT, UNet)
            if sit.arguments.get("projector", "mlp") != "mlp":
                raise ValueError(
                    f"{sit_name} of {checkpoint.path} has a convolutional projector: only one "
                    "built with projector: mlp has an official counterpart"
                )
            norm = checkpoint.networks.get(norm_name) or checkpoint.network("latent_norm")
            weights = {
                re.sub(r"^projector\.", "projectors.0.", k): v for k, v in sit.state_dict.items()
            }
            content[key] = weights | {f"bn.{k}": v for k, v in norm.state_dict.items()}
    for key, kind in (("vae", VAE), ("discriminator", PatchDiscriminator)):
        if key in checkpoint.networks:
            content[key] = dict(_official_part(checkpoint, key, kind).state_dict)
    if "vae" in content:
        _check_official_vae(checkpoint)
    if checkpoint.step is not None:
        content["steps"] = checkpoint.step
    args = dict(checkpoint.official_args) or _args_of(checkpoint)
    return content | {"args": argparse.Namespace(**args)}


def _check_official_vae(checkpoint: Checkpoint) -> None:
    """Refuse a VAE that the official code could not run."""
    arguments = checkpoint.network("vae").arguments
    if not arguments["legacy_upsample"]:
        raise ValueError(
            f"the VAE of {checkpoint.path} wraps columns when it upsamples: only one built with "
            "legacy_upsample=True has an official counterpart"
        )
    given = {**arguments, "stem": tuple(arguments["stem"])}
    for name, official in (("in_channels", 1), ("modes", 1), ("stem", (1, 1))):
        if (value := given[name]) != official:
            raise ValueError(
                f"the VAE of {checkpoint.path} has {name} {value}: only one with {name} {official} "
                "has an official counterpart"
            )


def statistics_of(norm: StateDict) -> dict[str, Tensor]:
    """Official latent statistics: scale ``1 / sqrt(variance)`` and bias, each ``(1, C, 1, 1)``."""
    scale, bias = norm["running_var"].rsqrt(), norm["running_mean"]
    return {"latents_scale": scale[None, :, None, None], "latents_bias": bias[None, :, None, None]}


def _official_part(checkpoint: Checkpoint, name: str, *kinds: type[nn.Module]) -> NetworkState:
    state = checkpoint.network(name)
    if state.kind not in kinds:
        raise ValueError(
            f"{name} of {checkpoint.path} is a {state.class_path}, which has no official "
            "counterpart"
        )
    return state


def _is_vae(content: Any) -> bool:
    """Whether these are weights of a VAE for one-channel range images."""
    conv_in = content.get("encoder.conv_in.weight") if isinstance(content, Mapping) else None
    return isinstance(conv_in, Tensor) and conv_in.dim() == 4 and conv_in.shape[1] == 1


def _weights(key: str, value: Any) -> StateDict:
    if not isinstance(value, Mapping) or not all(isinstance(v, Tensor) for v in value.values()):
        raise ValueError(f"entry {key!r} holds no weights but {type(value).__name__}")
    return value


def _split(weights: StateDict) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Weights of an official network by our names, and its latent statistics."""
    norm = {k.removeprefix("bn."): v for k, v in weights.items() if k.startswith("bn.")}
    sit = {
        re.sub(r"^projectors\.0\.", "projector.", k): v
        for k, v in weights.items()
        if not k.startswith("bn.")
    }
    return sit, norm


def _sit(
    weights: StateDict, args: Options, given: Options, strides: Strides
) -> tuple[NetworkState, NetworkState]:
    """SiT or UNet and its latent statistics from an official one."""
    sit, norm = _split(weights)
    if any(key.startswith("input_blocks.") for key in sit):
        network = NetworkState(path_of(UNet), _unet_arguments(sit, given), sit)
    else:
        network = NetworkState(path_of(SiT), _sit_arguments(sit, args, given, strides), sit)
    norm_args = {
        "channels": network.init_args["in_channels"],
        "momentum": args.get("bn_momentum", 0.1),
        "legacy_inverse": True,
    }
    return network, NetworkState(path_of(LatentNorm), norm_args, norm)


def _sit_arguments(
    sit: StateDict, args: Options, given: Options, strides: Strides
) -> dict[str, Any]:
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
    num_classes = {**args, **given}.get("num_classes", max(1, num_rows - 1))
    if num_rows not in (num_classes, num_classes + 1):
        raise ValueError(
            f"the label table has {num_rows} rows, which fits no model of {num_classes} classes"
        )
    inferred |= {"num_classes": num_classes, "class_dropout": num_rows > num_classes}
    if "encoder_depth" in args:
        inferred["alignment_depth"] = args["encoder_depth"]
    if hidden_size in _SIT_SIZES:
        inferred["num_heads"] = _SIT_SIZES[hidden_size][2]
    if strides is None:
        rows = columns = patch_size * round(num_tokens**0.5)  # a square image
    else:
        rows = PROJECTION["sensor"]["beams"] // strides[0]
        columns = PROJECTION["sensor"]["columns"] // strides[1]
    if rows * columns == num_tokens * patch_size**2:
        inferred["input_size"] = [rows, columns]
    init_args = inferred | dict(given)
    unknown = {"alignment_depth", "num_heads", "input_size"} - set(init_args)
    if unknown:
        raise ValueError(
            f"neither weights nor training options (args, args.json) hold {sorted(unknown)} of "
            f"this SiT with {num_tokens} tokens of width {hidden_size}; give them as sit_args"
        )
    return init_args


def _unet_arguments(unet: StateDict, given: Options) -> dict[str, Any]:
    inferred = unet_sizes(unet) | {
        "input_size": list(unet["ape.bias"].shape[2:]),
        "feature_dim": len(unet["projector.4.weight"]),
        "projector_dim": len(unet["projector.0.weight"]),
        "num_classes": len(unet["label_emb.weight"]),
    }
    init_args = inferred | dict(given)
    if "head_channels" not in init_args:
        raise ValueError(
            f"unknown head_channels of a UNet with {init_args['channels']} channels; give them as "
            "sit_args"
        )
    return init_args


def unet_sizes(unet: StateDict) -> dict[str, Any]:
    """Arguments of the U-Net of R3DPA or LiDM that follow from its weights."""
    channels, in_channels, *_ = unet["input_blocks.0.0.weight"].shape
    num_levels = 1 + sum(key.endswith(".op.weight") for key in unet)
    num_up = len({key.split(".")[1] for key in unet if key.startswith("output_blocks.")})
    num_res_blocks = num_up // num_levels - 1
    # A level is its residual blocks and, but for the last, a step down; first comes the input.
    last_blocks = [(level + 1) * (num_res_blocks + 1) - 1 for level in range(num_levels)]
    widths = [len(unet[f"input_blocks.{i}.0.out_layers.3.weight"]) for i in last_blocks]
    inferred: dict[str, Any] = {
        "in_channels": in_channels,
        "channels": channels,
        "channel_multipliers": [width // channels for width in widths],
        "num_res_blocks": num_res_blocks,
    }
    attends = [f"input_blocks.{i}.1.qkv.weight" in unet for i in last_blocks]
    if not all(attends):
        inferred["attention_resolutions"] = [2**i for i in range(num_levels) if attends[i]]
    if channels in _UNET_NAMES:
        inferred["head_channels"] = _UNET_HEAD_CHANNELS
    return inferred


def _vae_strides(vae: StateDict, args: Options) -> Strides:
    """Rows and columns of the image per latent, of a range-image VAE or of its official name.

    ``h2p4d8``: patches of 4 x 4 pixels, twice as long horizontally, 8 channels.
    """
    if _is_vae(vae):
        return whole_stride(_vae(vae).init_args["strides"])
    name = re.fullmatch(r"h(\d+)(?:p(\d+))?d\d+", str(args.get("vae", "")))
    if name is None:
        return None
    patch = int(name[2] or 1)
    return patch, patch * int(name[1])


def whole_stride(strides: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Rows and columns of the image per latent."""
    return math.prod(rows for rows, _ in strides), math.prod(columns for _, columns in strides)


def _vae(weights: StateDict) -> NetworkState:
    return NetworkState(path_of(VAE), vae_sizes(weights), dict(weights))


def vae_sizes(weights: StateDict) -> dict[str, Any]:
    """Arguments of the VAE of R3DPA or LiDM that follow from its weights."""
    levels = range(len({k.split(".")[2] for k in weights if k.startswith("encoder.down.")}))
    channels = len(weights["encoder.conv_in.weight"])
    widths = [len(weights[f"encoder.down.{i}.block.0.conv1.weight"]) for i in levels]
    ups = [weights[f"decoder.up.{i}.upsample.conv.weight"] for i in levels[1:]]
    blocks = {key.split(".")[4] for key in weights if key.startswith("encoder.down.0.block.")}
    attends = [i for i in levels if f"encoder.down.{i}.attn.0.q.weight" in weights]
    return {
        "in_channels": weights["encoder.conv_in.weight"].shape[1],
        "latent_channels": len(weights["post_quant_conv.weight"]),
        "channels": channels,
        "channel_multipliers": [width // channels for width in widths],
        "strides": [_UPSAMPLING[(int(up.shape[2]), int(up.shape[3]))] for up in ups],
        "num_res_blocks": len(blocks),
        "attention_levels": attends,
        "legacy_upsample": True,
    }


def _discriminator(weights: StateDict) -> NetworkState:
    channels, in_channels, _, _ = weights["main.0.weight"].shape
    num_layers = sum(value.dim() == 4 for value in weights.values()) - 2  # less first and last
    init_args = {"in_channels": in_channels, "channels": channels, "num_layers": num_layers}
    return NetworkState(path_of(PatchDiscriminator), init_args, dict(weights))


def _norm_from_statistics(content: StateDict) -> NetworkState:
    """Latent statistics; the number of batches is not recorded, 1 marks them as fitted."""
    scale, bias = (content[key].flatten() for key in ("latents_scale", "latents_bias"))
    weights = {
        "running_mean": bias,
        "running_var": scale.double().pow(-2).to(scale.dtype),
        "num_batches_tracked": torch.tensor(1),
    }
    init_args = {"channels": len(bias), "legacy_inverse": True}
    return NetworkState(path_of(LatentNorm), init_args, weights)


def _geometry(
    networks: Mapping[str, NetworkState], args: Options, encoding: Encoding | None
) -> dict[str, Any] | None:
    """Plain values of the official ``ScanGeometry``; None without a network or encoding."""
    if encoding is None and "dataset_config" in args:
        by_config = {config: key for key, config in _DATASET_CONFIGS.items()}
        encoding = by_config.get(Path(str(args["dataset_config"])).name)
    sit = networks.get("sit") or networks.get("ema")
    if encoding is None or sit is None:
        return None
    if sit.kind is UNet:
        patch_size = 2 ** (len(sit.init_args["channel_multipliers"]) - 1)
    else:
        patch_size = sit.init_args["patch_size"]
    return {
        "projection": PROJECTION,
        "codec": {"encoding": encoding, "scale": None, "legacy_inverse": False},
        "grid_size": [side // patch_size for side in sit.init_args["input_size"]],
    }


def _args_of(checkpoint: Checkpoint) -> dict[str, Any]:
    """The options that the official scripts read, as far as the checkpoint determines them."""
    args: dict[str, Any] = {}
    if "vae" in checkpoint.networks:
        vae = checkpoint.network("vae").arguments
        rows, columns = whole_stride(vae["strides"])
        patch = f"p{rows}" if rows > 1 else ""
        args["vae"] = f"h{columns // rows}{patch}d{vae['latent_channels']}"
    state = checkpoint.networks.get("sit") or checkpoint.networks.get("ema")
    if state is not None:
        sit = state.arguments
        args["num_classes"] = sit["num_classes"]
        norm = checkpoint.networks.get("latent_norm") or checkpoint.network("ema_latent_norm")
        args["bn_momentum"] = norm.arguments["momentum"]
        if state.kind is UNet:
            model = _UNET_NAMES.get(sit["channels"])
        else:
            args["cfg_prob"] = 0.1 if sit["class_dropout"] else 0.0
            args["encoder_depth"] = sit["alignment_depth"]
            args["qk_norm"] = sit["qk_norm"]
            size, depth, _ = _SIT_SIZES.get(sit["hidden_size"], ("", 0, 0))
            model = f"SiT-{size}/{sit['patch_size']}" if depth == sit["depth"] else None
        if model is not None:
            args["model"] = model
    if checkpoint.geometry is not None:
        projection, codec = checkpoint.geometry["projection"], checkpoint.geometry["codec"]
        if all(projection[key] == value for key, value in PROJECTION.items()):
            args["dataset_config"] = f"configs/{_DATASET_CONFIGS[codec['encoding']]}"
    return args

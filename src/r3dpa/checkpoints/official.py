"""Official R3DPA checkpoints: keys and options of valeoai/R3DPA, translated in both directions.

An official SiT or UNet holds the latent batch norm as ``bn.*`` and its projector as
``projectors.0.*``; everything else has the same name here. Training checkpoints written by
:func:`r3dpa.checkpoints.convert` also hold an entry ``r3dpa``, which the official code ignores:
arguments of the networks, sensor, encoding and other facts without a place in the official layout.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from r3dpa.checkpoints.networks import Checkpoint, NetworkState
from r3dpa.checkpoints.official_arguments import (
    OFFICIAL_PROJECTION,
    UNET_NAMES,
    discriminator_state,
    is_vae,
    path_of,
    sit_arguments,
    unet_arguments,
    vae_state,
    vae_strides,
)
from r3dpa.nn.discriminator import PatchDiscriminator
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.sit import SiT
from r3dpa.nn.unet import UNet
from r3dpa.nn.vae import VAE

__all__ = ["facts_of", "from_official", "is_official", "statistics_of", "to_official"]

StateDict = Mapping[str, Tensor]
Encoding = Literal["linear", "log2"]

_OFFICIAL_PREFIX, _OUR_PREFIX, _NORM_PREFIX = "projectors.0.", "projector.", "bn."
_SIZE_NAMES = {(384, 12): "S", (768, 12): "B", (1024, 24): "L", (1152, 28): "XL"}
_SIT_NETWORKS = {"model": ("sit", "latent_norm"), "ema": ("ema", "ema_latent_norm")}
_OPTIMISERS = {"opt": "SiT", "opt_vae": "VAE", "opt_disc": "discriminator"}
_STATISTICS = {"latents_scale", "latents_bias"}
_OURS = "r3dpa"
_FACTS = ("stage", "geometry", "augmentation", "feature_source", "interpolant", "version", "commit")
_DATASET_CONFIGS: dict[Encoding, str] = {"linear": "kitti.yaml", "log2": "kitti_logscale.yaml"}


def is_official(content: Any) -> bool:
    """Whether what a ``.pt`` file holds is one of the four official layouts."""
    return isinstance(content, Mapping) and (
        any(isinstance(content.get(key), Mapping) for key in _SIT_NETWORKS)
        or set(content) == _STATISTICS
        or is_vae(content)
        or _is_discriminator(content)
    )


def from_official(
    content: Mapping[str, Any],
    path: Path,
    *,
    args: Mapping[str, Any] | None = None,
    sit_args: Mapping[str, Any] | None = None,
    encoding: Encoding | None = None,
) -> Checkpoint:
    """Checkpoint from the content of an official file; every key is translated or left out by name.

    The geometry is known if the file holds :func:`facts_of`, or if the options or
    ``encoding`` give the encoding of a SiT for range images.

    Args:
        content: A training checkpoint (``model``, ``ema``, ``vae``, ``discriminator``, ``steps``,
            ``args``, optimisers), or the weights of a VAE, of a discriminator, or latent
            statistics (``latents_scale``, ``latents_bias``) alone.
        path: File that held it.
        args: Options of the official training script, where ``content`` has no ``args``.
        sit_args: Arguments of SiT or UNet that override those of the file.
        encoding: Encoding of the range image. Default: that of the options.

    Raises:
        ValueError: If a key is unknown or missing, a shape is inconsistent, or an argument of SiT
            or UNet can neither be read nor inferred.
    """
    if isinstance(content.get(_OURS), Mapping):
        return _from_ours(content, path, sit_args or {})
    found = content.get("args", args)
    options = dict(vars(found) if isinstance(found, argparse.Namespace) else found or {})
    if is_vae(content):
        content = {"vae": content}
    elif _is_discriminator(content):
        content = {"discriminator": content}
    networks: dict[str, NetworkState] = {}
    left_out: dict[str, str] = {}
    if set(content) >= _STATISTICS:
        networks["latent_norm"] = _norm_from_statistics(content)
        content = {key: value for key, value in content.items() if key not in _STATISTICS}
    strides = vae_strides(content.get("vae", {}), options)
    for key, value in content.items():
        if key in _SIT_NETWORKS:
            parts = _sit(_weights(key, value), options, sit_args or {}, strides)
            networks |= dict(zip(_SIT_NETWORKS[key], parts, strict=True))
        elif key == "vae" and not is_vae(value):
            left_out[key] = "that of the file is not for range images"
        elif key == "vae":
            networks[key] = vae_state(_weights(key, value))
        elif key == "discriminator":
            networks[key] = discriminator_state(_weights(key, value))
        elif key in _OPTIMISERS:
            left_out[key] = f"optimiser of the {_OPTIMISERS[key]}: training starts with a new one"
        elif key not in ("args", "steps"):
            left_out[key] = "no part of an official checkpoint"
    for name, state in networks.items():
        try:
            state.check()
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    return Checkpoint(
        path=path,
        stage="official",
        networks=networks,
        step=content.get("steps"),
        geometry=_geometry(networks, options, encoding) if strides is not None else None,
        official_args=options,
        left_out=left_out,
    )


def _from_ours(content: Mapping[str, Any], path: Path, sit_args: Mapping[str, Any]) -> Checkpoint:
    """Checkpoint from an official file with :func:`facts_of`."""
    about = content[_OURS]
    networks: dict[str, NetworkState] = {}
    for name, config in about.get("networks", {}).items():
        key = next((key for key, names in _SIT_NETWORKS.items() if name in names), name)
        sit, norm = _split(_weights(key, content.get(key)))
        weights = norm if name.endswith("latent_norm") else sit
        changes = sit_args if name in ("sit", "ema") else {}
        networks[name] = NetworkState(
            config["class_path"], {**config["init_args"], **changes}, weights
        )
        networks[name].check()
    facts = {key: about[key] for key in _FACTS if key in about}
    options = about.get("official_args", {})
    return Checkpoint(
        path=path, networks=networks, step=content.get("steps"), official_args=options, **facts
    )


def to_official(checkpoint: Checkpoint) -> dict[str, Any]:
    """Content of an official training checkpoint, without optimisers.

    The statistics of ``ema`` are those of ``latent_norm`` if the checkpoint has no others. Without
    the options of an official run, ``args`` is made from the arguments of the networks.

    Returns:
        The networks it has under ``model``, ``ema``, ``vae``, ``discriminator``; ``steps``, and
        ``args`` as a ``Namespace``.

    Raises:
        ValueError: If a network has no official counterpart.
    """
    content: dict[str, Any] = {}
    for key, (sit_name, norm_name) in _SIT_NETWORKS.items():
        if sit_name in checkpoint.networks:
            sit = _official_part(checkpoint, sit_name, SiT, UNet)
            norm = checkpoint.networks.get(norm_name) or checkpoint.network("latent_norm")
            content[key] = {
                _renamed(k, _OUR_PREFIX, _OFFICIAL_PREFIX): v for k, v in sit.state_dict.items()
            } | {f"{_NORM_PREFIX}{k}": v for k, v in norm.state_dict.items()}
    if "vae" in checkpoint.networks:
        vae = _official_part(checkpoint, "vae", VAE)
        if not vae.arguments["legacy_upsample"]:
            raise ValueError(
                f"the VAE of {checkpoint.path} wraps columns when it upsamples, the official one "
                "does not, so its weights would decode to other images there: only a VAE built "
                "with legacy_upsample=True has an official counterpart"
            )
        content["vae"] = dict(vae.state_dict)
    if "discriminator" in checkpoint.networks:
        state = _official_part(checkpoint, "discriminator", PatchDiscriminator)
        content["discriminator"] = dict(state.state_dict)
    if checkpoint.step is not None:
        content["steps"] = checkpoint.step
    args = dict(checkpoint.official_args) or _args_of(checkpoint)
    return content | {"args": argparse.Namespace(**args)}


def facts_of(checkpoint: Checkpoint) -> dict[str, Any]:
    """Entry for an official training checkpoint: the facts that its layout has no place for."""
    about: dict[str, Any] = {key: getattr(checkpoint, key) for key in _FACTS}
    about["official_args"] = dict(checkpoint.official_args)
    about["networks"] = {
        name: {"class_path": state.class_path, "init_args": dict(state.init_args)}
        for name, state in checkpoint.networks.items()
    }
    return {_OURS: about}


def statistics_of(norm: StateDict) -> dict[str, Tensor]:
    """Official latent statistics: scale ``1 / sqrt(variance)`` and bias, each ``(1, C, 1, 1)``."""
    scale, bias = norm["running_var"].rsqrt(), norm["running_mean"]
    return {"latents_scale": scale[None, :, None, None], "latents_bias": bias[None, :, None, None]}


def _official_part(checkpoint: Checkpoint, name: str, *kinds: type[nn.Module]) -> NetworkState:
    state = checkpoint.network(name)
    if state.kind not in kinds:
        raise ValueError(
            f"{name} of {checkpoint.path} is a {state.class_path}, which has no official "
            f"counterpart; {' or '.join(map(path_of, kinds))} has"
        )
    return state


def _weights(key: str, value: Any) -> StateDict:
    if not isinstance(value, Mapping) or not all(isinstance(v, Tensor) for v in value.values()):
        raise ValueError(f"entry {key!r} holds no weights but {type(value).__name__}")
    return value


def _is_discriminator(content: Mapping[str, Any]) -> bool:
    return len(content) > 0 and all(str(key).startswith("main.") for key in content)


def _renamed(key: str, old: str, new: str) -> str:
    return new + key.removeprefix(old) if key.startswith(old) else key


def _split(weights: StateDict) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Weights of an official network by our names, and its latent statistics."""
    norm = {
        key.removeprefix(_NORM_PREFIX): value
        for key, value in weights.items()
        if key.startswith(_NORM_PREFIX)
    }
    sit = {
        _renamed(key, _OFFICIAL_PREFIX, _OUR_PREFIX): value
        for key, value in weights.items()
        if not key.startswith(_NORM_PREFIX)
    }
    return sit, norm


def _sit(
    weights: StateDict,
    args: Mapping[str, Any],
    sit_args: Mapping[str, Any],
    strides: tuple[int, int] | None,
) -> tuple[NetworkState, NetworkState]:
    """SiT or UNet and its latent statistics from an official one."""
    sit, norm = _split(weights)
    kind: type[nn.Module] = UNet if any(key.startswith("input_blocks.") for key in sit) else SiT
    if kind is UNet:
        init_args = unet_arguments(sit, sit_args)
    else:
        init_args = sit_arguments(sit, args, sit_args, strides)
    norm_args = {
        "channels": init_args["in_channels"],
        "momentum": args.get("bn_momentum", 0.1),
        "legacy_inverse": True,
    }
    return (
        NetworkState(path_of(kind), init_args, sit),
        NetworkState(path_of(LatentNorm), norm_args, norm),
    )


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
    networks: Mapping[str, NetworkState],
    args: Mapping[str, Any],
    encoding: Encoding | None,
) -> dict[str, Any] | None:
    """Plain values of the official ``ScanGeometry``; None without a network or encoding."""
    if encoding is None and "dataset_config" in args:
        by_config = {config: key for key, config in _DATASET_CONFIGS.items()}
        encoding = by_config.get(Path(str(args["dataset_config"])).name)
    sit = next((networks[name] for name in ("sit", "ema") if name in networks), None)
    if encoding is None or sit is None:
        return None
    if sit.kind is UNet:
        patch_size = 2 ** (len(sit.init_args["channel_multipliers"]) - 1)
    else:
        patch_size = sit.init_args["patch_size"]
    return {
        "projection": OFFICIAL_PROJECTION,
        "codec": {"encoding": encoding, "scale": None, "legacy_inverse": False},
        "grid_size": [side // patch_size for side in sit.init_args["input_size"]],
    }


def _args_of(checkpoint: Checkpoint) -> dict[str, Any]:
    """The options that the official scripts read, as far as the checkpoint tells them."""
    args: dict[str, Any] = {}
    if "vae" in checkpoint.networks:
        vae = checkpoint.network("vae").arguments
        rows, columns = (math.prod(stride[axis] for stride in vae["strides"]) for axis in (0, 1))
        patch = f"p{rows}" if rows > 1 else ""
        args["vae"] = f"h{columns // rows}{patch}d{vae['latent_channels']}"
    sit_name = next((name for name in ("sit", "ema") if name in checkpoint.networks), None)
    if sit_name is not None:
        sit = checkpoint.network(sit_name).arguments
        args |= {
            "num_classes": sit["num_classes"],
            "bn_momentum": checkpoint.network("latent_norm").arguments["momentum"],
        }
        if checkpoint.network(sit_name).kind is UNet:
            model = UNET_NAMES.get(sit["channels"])
        else:
            args |= {
                "cfg_prob": 0.1 if sit["class_dropout"] else 0.0,
                "encoder_depth": sit["alignment_depth"],
                "qk_norm": sit["qk_norm"],
            }
            size = _SIZE_NAMES.get((sit["hidden_size"], sit["depth"]))
            model = None if size is None else f"SiT-{size}/{sit['patch_size']}"
        if model is not None:
            args["model"] = model
    if checkpoint.geometry is not None:
        projection, codec = checkpoint.geometry["projection"], checkpoint.geometry["codec"]
        if all(projection[key] == value for key, value in OFFICIAL_PROJECTION.items()):
            args["dataset_config"] = f"configs/{_DATASET_CONFIGS[codec['encoding']]}"
    return args

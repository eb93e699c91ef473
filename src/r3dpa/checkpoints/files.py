"""Checkpoint files: reads every layout, writes ours and the official one."""

from __future__ import annotations

import argparse
import json
import pickle
import re
import reprlib
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import torch
import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from r3dpa import __version__
from r3dpa.checkpoints.networks import (
    Checkpoint,
    NetworkState,
    check_same_arguments,
    path_of,
    recorded_facts,
)
from r3dpa.checkpoints.official import OURS, from_official, is_official, statistics_of, to_official
from r3dpa.class_paths import current_network
from r3dpa.io import (
    UNPICKLING_ERRORS,
    atomic_path,
    first_line,
    save_tensors,
    sha256_of,
    source_commit,
    text_table,
    weights_sha256,
)
from r3dpa.nn.image_vae import ImageVAE
from r3dpa.pretrained import weights_file

_FORMAT = "r3dpa-checkpoint-1"
# Where a LightningModule keeps each network: beginning of its keys, name of its argument.
_LIGHTNING = {
    "vae": ("vae.", "vae"),
    "discriminator": ("discriminator.", "discriminator"),
    "sit": ("sit.", "sit"),
    "latent_norm": ("latent_norm.", "latent_norm"),
    "thin_decoder": ("thin_decoder.", "thin_decoder"),
    "ema": ("ema.sit.", "sit"),
    "ema_latent_norm": ("ema.latent_norm.", "latent_norm"),
    "network": ("network.", "network"),
    "ema_network": ("ema.network.", "network"),
    "first_stage": ("first_stage.", "first_stage"),
}
# A class that Lightning 1.4 writes as a key, in the checkpoints of LiDM; read as ``object``.
_OLD_CALLBACK = "pytorch_lightning.callbacks.model_checkpoint.ModelCheckpoint"
_ENCODER = ("encoder.", "quant_conv.")
_FLOW = frozenset({"sit", "latent_norm", "ema", "ema_latent_norm"})
_FEW_STEPS = "average."  # copied blocks of an AverageVelocitySiT
_LOST = ("sensor and encoding", "step", "arguments of the latent statistics")
_DIFFUSERS_KEY = "encoder.down_blocks.0.resnets.0.norm1.weight"
# Names of attention layers before diffusers 0.14, as in the files of Stable Diffusion itself.
_OLD_ATTENTION = {"query": "to_q", "key": "to_k", "value": "to_v", "proj_attn": "to_out.0"}
_OLD_KEY = re.compile(rf"(\.attentions\.\d+\.)({'|'.join(_OLD_ATTENTION)})\.")


def read_checkpoint(
    path: str | Path,
    *,
    sit_args: Mapping[str, Any] | None = None,
    encoding: Literal["linear", "log2"] | None = None,
) -> Checkpoint:
    """Read a checkpoint of any layout without running code from it.

    Layouts: ours (``.safetensors`` with its ``.yaml``), Lightning's (``.ckpt``), the official one
    (``.pt``), the released ones of the baselines, and image VAEs of diffusers
    (``.safetensors``). Also read are ``<name>-latents-stats.pt`` and
    ``<name>-discriminator-ckpt.pt`` beside an official VAE ``<name>.pt``, and for a file without
    ``args`` an ``args.json`` in its folder, or above a folder ``checkpoints``.

    Args:
        path: File to read, name of weights in this package, or ``hf://owner/name``.
        sit_args: Official files only: arguments of SiT that the file does not hold.
        encoding: Official files only: range encoding, if the options do not name it.

    Raises:
        ValueError: If the file is damaged, of no known layout, names a class not allowed, or is not
            official and ``sit_args`` or ``encoding`` are given.
        FileNotFoundError: If there is no such file.
    """
    path = weights_file(path)
    given = {"sit_args": sit_args, "encoding": encoding}
    for_official = [name for name, value in given.items() if value is not None]
    if path.suffix == ".safetensors":
        with _naming(path):
            _refuse_options(for_official)
            described = path.with_suffix(".yaml").is_file()
            return _from_ours(path) if described else _from_diffusers(path)
    content = _load_pickle(path)
    with _naming(path):
        if is_official(content):
            content, args = _with_neighbours(content, path)
            return from_official(content, path, args=args, sit_args=sit_args, encoding=encoding)
        from_lightning = isinstance(content, dict) and "pytorch-lightning_version" in content
        if not (from_lightning and "r3dpa" in content):
            # Imported here: no file of ours needs the baselines.
            readers = import_module("r3dpa.baselines.readers")
            baseline: Checkpoint | None = readers.read_baseline(content, path, encoding)
            if baseline is not None:
                return baseline
        if from_lightning:
            _refuse_options(for_official)
            return _from_lightning(content, path)
        entries = list(content)[:10] if isinstance(content, Mapping) else type(content).__name__
        raise ValueError(
            f"it holds {entries}; expected a Lightning checkpoint of r3dpa, an official R3DPA "
            "checkpoint, one of a baseline, or a .safetensors file with its .yaml"
        )


def save_checkpoint(checkpoint: Checkpoint, path: str | Path, *, overwrite: bool = False) -> Path:
    """Write ``<name>.safetensors`` (all weights) and ``<name>.yaml`` (everything else).

    Both appear complete or not at all; the second holds the hash of the first.

    Returns:
        ``path``.

    Raises:
        ValueError: If a file exists and ``overwrite`` is not set.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ValueError(f"our checkpoints are called <name>.safetensors, got {path}")
    description = path.with_suffix(".yaml")
    _refuse_existing([path, description], overwrite)
    weights = {  # copies: safetensors wants contiguous tensors that share no memory
        f"{name}.{key}": value.detach().cpu().clone(memory_format=torch.contiguous_format)
        for name, state in checkpoint.networks.items()
        for key, value in state.state_dict.items()
    }
    about = {"format": _FORMAT, "step": checkpoint.step, **checkpoint.facts}
    about |= {"version": __version__, "commit": source_commit()}
    about["left_out"] = dict(checkpoint.left_out)
    with atomic_path(path) as weights_path, atomic_path(description) as description_path:
        save_file(weights, weights_path)
        about["sha256"] = sha256_of(weights_path)
        description_path.write_text(yaml.safe_dump(about, sort_keys=False))
    return path


def convert(
    source: str | Path,
    out: str | Path,
    to: Literal["r3dpa", "official"] = "r3dpa",
    *,
    overwrite: bool = False,
    sit_args: Mapping[str, Any] | None = None,
    encoding: Literal["linear", "log2"] | None = None,
    networks: Sequence[str] | None = None,
    half: bool = False,
    decoder: str | Path | None = None,
    decoder_share: float = 1.0,
    flow: str | Path | None = None,
) -> str:
    """Convert a checkpoint of any layout to ours, or to the official one.

    Weights stay equal bit for bit, unless ``half`` rounds them; optimisers are left out. Official
    training checkpoints keep all facts for the way back. A checkpoint without SiT becomes the
    official VAE file with its neighbours for discriminator and latent statistics, which lose some.
    The arguments have the meaning that ``r3dpa convert --help`` shows.

    Returns:
        Files, networks and what was not converted, as text.

    Raises:
        ValueError: If a network has no counterpart in the other layout, a file exists, the VAE of
            ``decoder`` or ``flow`` has other latents, or decoder or flow another shape.
    """
    if decoder is None and decoder_share != 1:
        raise ValueError(f"decoder_share {decoder_share:g} needs a decoder to average with")
    source, out = Path(source), Path(out)
    checkpoint = read_checkpoint(source, sit_args=sit_args, encoding=encoding)
    if flow is not None:
        checkpoint = _with_flow_of(checkpoint, read_checkpoint(flow))
    if decoder is not None:
        checkpoint = _with_decoder_of(checkpoint, read_checkpoint(decoder), decoder_share)
    if networks is not None or half:
        checkpoint = replace(checkpoint, networks=_select_networks(checkpoint, networks, half))
    left_out = dict(checkpoint.left_out)
    if to == "r3dpa":
        outputs = [save_checkpoint(checkpoint, out, overwrite=overwrite), out.with_suffix(".yaml")]
    else:
        outputs = _save_official(checkpoint, out, overwrite)
        if not {"sit", "ema"} & set(checkpoint.networks):
            left_out |= dict.fromkeys(_LOST, "official files of a VAE have no place for it")
    rows = []
    for name, state in checkpoint.networks.items():
        size = sum(value.numel() for value in state.state_dict.values())
        kind = state.class_path.rpartition(".")[2]
        rows.append((name, kind, str(len(state.state_dict)), f"{size:,}"))
    table = text_table(rows, ("network", "class", "tensors", "elements"))
    lines = [f"{source} -> {', '.join(map(str, outputs))}", table]
    lines += [f"not converted: {name} ({reason})" for name, reason in left_out.items()]
    return "\n".join(lines)


def _refuse_options(names: Sequence[str]) -> None:
    """Refuse options of official files for another one, where they would change nothing."""
    if names:
        raise ValueError(f"only official files need {' and '.join(names)}, and this is none")


def _save_official(checkpoint: Checkpoint, out: Path, overwrite: bool) -> list[Path]:
    if out.suffix != ".pt":
        raise ValueError(f"official checkpoints are called <name>.pt, got {out}")
    content = to_official(checkpoint)
    if {"model", "ema"} & set(content):
        files: dict[Path, Any] = {out: content | {OURS: checkpoint.facts}}
    else:
        files = {out: content["vae"]} if "vae" in content else {}
        if "discriminator" in content:
            files[_neighbour(out, "discriminator-ckpt")] = content["discriminator"]
        if "latent_norm" in checkpoint.networks:
            norm = checkpoint.network("latent_norm").state_dict
            files[_neighbour(out, "latents-stats")] = statistics_of(norm)
    if not files:
        raise ValueError(
            f"{checkpoint.path} is of stage {checkpoint.stage}, which has no official R3DPA "
            "layout: leave --to out"
        )
    _refuse_existing(list(files), overwrite)
    for path, weights in files.items():
        save_tensors(weights, path)
    return list(files)


def _select_networks(
    checkpoint: Checkpoint, names: Sequence[str] | None, half: bool
) -> dict[str, NetworkState]:
    """Networks of these names, in float16 but for latent statistics, where ``half`` is set."""
    chosen = {name: checkpoint.network(name) for name in names or checkpoint.networks}
    if half:
        for name, state in chosen.items():
            if not name.endswith("latent_norm"):
                weights = {
                    key: value.half() if value.is_floating_point() else value
                    for key, value in state.state_dict.items()
                }
                chosen[name] = replace(state, state_dict=weights)
    return chosen


def _with_decoder_of(checkpoint: Checkpoint, other: Checkpoint, share: float) -> Checkpoint:
    """Checkpoint with the VAE of ``other``, whose encoder must be its own, and its codec.

    Where ``share`` is below 1, the weights of the decoder are means of both, see WiSE-FT (Wortsman
    et al., "Robust fine-tuning of zero-shot models", CVPR 2022).
    """
    _check_same_latents(checkpoint, other)
    geometry = checkpoint.geometry
    if geometry is not None and other.geometry is not None:
        geometry = {**geometry, "codec": other.geometry["codec"]}
    vae = other.network("vae")
    if share != 1:
        vae = _mean_of(checkpoint.network("vae"), vae, share, checkpoint.path, other.path)
    return replace(checkpoint, networks={**checkpoint.networks, "vae": vae}, geometry=geometry)


def _mean_of(
    first: NetworkState, second: NetworkState, share: float, path: Path, other: Path
) -> NetworkState:
    """Weights ``(1 - share) * first + share * second``, in float32."""
    if not 0 < share <= 1:
        raise ValueError(f"decoder_share must be above 0 and at most 1, got {share:g}")
    shapes = [{k: v.shape for k, v in net.state_dict.items()} for net in (first, second)]
    if shapes[0] != shapes[1]:
        raise ValueError(
            f"the decoders of {path} and {other} have other layers, so that their weights have no "
            "mean: leave decoder_share out"
        )
    weights = {
        key: torch.lerp(value.float(), second.state_dict[key].float(), share)
        for key, value in first.state_dict.items()
    }
    return replace(second, state_dict=weights)


def _with_flow_of(checkpoint: Checkpoint, other: Checkpoint) -> Checkpoint:
    """Checkpoint with the flow of ``other``, its latent statistics and its guidance.

    Its few steps stay.
    """
    _check_same_latents(checkpoint, other)
    if other.interpolant != checkpoint.interpolant:
        raise ValueError(
            f"{other.path} was trained on the {other.interpolant} path, {checkpoint.path} on the "
            f"{checkpoint.interpolant} path: give a flow of the same path"
        )
    networks = dict(checkpoint.networks)
    for name in _FLOW & networks.keys():
        check_same_arguments(name, checkpoint, other)
        weights, given = networks[name].state_dict, other.network(name).state_dict
        flow = {key: value for key, value in given.items() if not key.startswith(_FEW_STEPS)}
        needed = {key for key in weights if not key.startswith(_FEW_STEPS)}
        for key in sorted(needed | flow.keys()):
            here, there = (tuple(of[key].shape) if key in of else None for of in (weights, flow))
            if here != there:
                raise ValueError(
                    f"the flow of {other.path} does not fit {checkpoint.path}: {name}.{key} has "
                    f"shape {there} there and {here} here"
                )
        networks[name] = replace(networks[name], state_dict={**weights, **flow})
    return replace(checkpoint, networks=networks, sampling=other.sampling)


def _check_same_latents(checkpoint: Checkpoint, other: Checkpoint) -> None:
    """Refuse a checkpoint whose VAE has another encoder."""
    here, there = (
        weights_sha256(
            {
                key: value.float()
                for key, value in of.network("vae").state_dict.items()
                if key.startswith(_ENCODER)
            }
        )
        for of in (checkpoint, other)
    )
    if here != there:
        raise ValueError(
            f"{other.path} has another encoder than {checkpoint.path}, so other latents: give a "
            "checkpoint that started from it and kept its encoder (train_encoder: false)"
        )


def _refuse_existing(paths: list[Path], overwrite: bool) -> None:
    existing = [str(path) for path in paths if path.exists()]
    if existing and not overwrite:
        exist = "exists" if len(existing) == 1 else "exist"
        raise ValueError(
            f"{' and '.join(existing)} {exist} already; give another name, or --overwrite true "
            "(overwrite=True in Python)"
        )


def _neighbour(vae: Path, kind: str) -> Path:
    return vae.with_name(f"{vae.stem}-{kind}.pt")


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Raise what a damaged file raises as a ``ValueError`` that names the file."""
    try:
        yield
    except (yaml.YAMLError, SafetensorError, *UNPICKLING_ERRORS) as error:
        reason = str(error)
        if not isinstance(error, ValueError) or isinstance(error, UnicodeError):
            reason = f"the file is damaged ({type(error).__name__}: {first_line(error)})"
            reason += "; copy or download it again"
        raise ValueError(f"cannot read {path}: {reason}") from error


def _load_pickle(path: Path) -> Any:
    """Content of a file of ``torch.save``: tensors, plain values and ``argparse.Namespace``."""
    mmap = zipfile.is_zipfile(path)
    known: Any = [argparse.Namespace, (object, _OLD_CALLBACK)]
    with _naming(path), torch.serialization.safe_globals(known):
        try:
            return torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
        except (pickle.UnpicklingError, ValueError) as error:
            forbidden = re.search(r"GLOBAL (\S+)", str(error))
            if forbidden is None:
                raise ValueError("the file is damaged, or was not written by torch.save") from error
            raise ValueError(
                f"the file would run {forbidden[1]} when loaded; only tensors, plain values and "
                "argparse.Namespace are read. Save networks with `r3dpa fit`, or with "
                "r3dpa.checkpoints.save_checkpoint"
            ) from error


def _with_neighbours(content: Any, path: Path) -> tuple[Any, dict[str, Any]]:
    """Content with the files that belong to an official VAE, and the options of ``args.json``."""
    if "encoder.conv_in.weight" in content:
        content = {"vae": content}
        discriminator = _neighbour(path, "discriminator-ckpt")
        if discriminator.is_file():
            content["discriminator"] = _load_pickle(discriminator)
        statistics = _neighbour(path, "latents-stats")
        if statistics.is_file():
            content |= _load_pickle(statistics)
    folder = path.parent
    for options in (folder / "args.json", folder.parent / "args.json"):
        if options.is_file() and (options.parent == folder or folder.name == "checkpoints"):
            with _naming(options):
                return content, dict(json.loads(options.read_text()))
    return content, {}


def _from_ours(path: Path) -> Checkpoint:
    description = path.with_suffix(".yaml")
    with _naming(description):
        about = yaml.safe_load(description.read_text())
        if not isinstance(about, dict) or about.get("format") != _FORMAT:
            raise ValueError(f"it does not describe a {_FORMAT}")
        configs, sha256 = dict(about["networks"]), about["sha256"]
        facts = {key: about[key] for key in ("step", "official_args", "left_out")}
        facts |= recorded_facts(about, configs)
    if sha256 != sha256_of(path):
        raise ValueError(
            f"the file is not the one that {description.name} was written for (SHA-256 differs): "
            "it is incomplete, was changed, or belongs to another checkpoint"
        )
    weights: dict[str, dict[str, Tensor]] = {name: {} for name in configs}
    for full_name, value in load_file(path).items():
        name, _, key = full_name.partition(".")
        weights.setdefault(name, {})[key] = value
    networks = {name: _network(name, configs.get(name), state) for name, state in weights.items()}
    return Checkpoint(path=path, networks=networks, **facts)


def _from_lightning(content: Mapping[str, Any], path: Path) -> Checkpoint:
    weights = content["state_dict"]
    arguments, about = content.get("hyper_parameters", {}), content.get("r3dpa", {})
    networks: dict[str, NetworkState] = {}
    for name, (prefix, argument) in _LIGHTNING.items():
        state = {k.removeprefix(prefix): v for k, v in weights.items() if k.startswith(prefix)}
        of_baseline = argument in ("network", "first_stage")  # other stages have such parts too
        if not state or (of_baseline and argument not in arguments):
            continue
        config = arguments.get(argument)
        if config is None and argument == "latent_norm" and "running_mean" in state:
            config = {
                "class_path": "r3dpa.nn.latent_norm.LatentNorm",
                "init_args": {"channels": len(state["running_mean"])},
            }
        networks[name] = _network(name, config, state)
    prefixes = tuple(prefix for prefix, _ in _LIGHTNING.values())
    others = {key.split(".")[0] for key in weights if not key.startswith(prefixes)}
    facts = {"stage": arguments.get("_class_path", "unknown")}
    facts |= recorded_facts(about, {"sit": arguments.get("sit")})
    return Checkpoint(
        path=path,
        networks=networks,
        step=content.get("global_step"),
        left_out=dict.fromkeys(sorted(others), "no network that checkpoints exchange"),
        **facts,
    )


def _network(name: str, config: Any, weights: Mapping[str, Tensor]) -> NetworkState:
    if not isinstance(config, Mapping) or "class_path" not in config:
        raise ValueError(
            f"it does not say which class and arguments its {name} has (found "
            f"{reprlib.repr(config)}); train with `r3dpa fit`, which records them"
        )
    config = current_network(config)
    return NetworkState(config["class_path"], config.get("init_args") or {}, weights).checked(name)


def _from_diffusers(path: Path) -> Checkpoint:
    """Image VAE of diffusers: sizes from the weights, number of groups from its config.json."""
    weights = {
        _OLD_KEY.sub(lambda match: f"{match[1]}{_OLD_ATTENTION[match[2]]}.", key): value
        for key, value in load_file(path).items()
    }
    if _DIFFUSERS_KEY not in weights:
        raise ValueError(
            f"its description {path.with_suffix('.yaml').name} is not beside it; copy both files"
        )
    config = path.with_name("config.json")
    with _naming(config):
        about = json.loads(config.read_text()) if config.is_file() else {}
        num_groups = int(about.get("norm_num_groups", 32))
    levels = range(_count(weights, r"encoder\.down_blocks\.(\d+)\."))
    init_args = {
        "latent_channels": weights["post_quant_conv.weight"].shape[0],
        "channels": [
            len(weights[f"encoder.down_blocks.{level}.resnets.0.conv1.weight"]) for level in levels
        ],
        "num_res_blocks": _count(weights, r"encoder\.down_blocks\.0\.resnets\.(\d+)\."),
        "norm_groups": num_groups,
    }
    vae = NetworkState(path_of(ImageVAE), init_args, weights).checked("vae")
    return Checkpoint(path=path, stage="diffusers", networks={"vae": vae})


def _count(keys: Iterable[str], pattern: str) -> int:
    return len({match[1] for key in keys if (match := re.match(pattern, key))})

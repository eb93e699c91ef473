"""Checkpoint files: read every layout, write ours and the official one, convert between them."""

from __future__ import annotations

import argparse
import hashlib
import json
import pickle
import re
import reprlib
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import safetensors
import torch
import yaml
from safetensors.torch import load_file, save_file
from torch import Tensor

from r3dpa import __version__
from r3dpa.checkpoints.diffusers import from_diffusers, is_diffusers
from r3dpa.checkpoints.networks import NETWORK_NAMES, Checkpoint, NetworkState
from r3dpa.checkpoints.official import from_official, is_official
from r3dpa.io import UNPICKLING_ERRORS, atomic_path, first_line, source_commit

__all__ = [
    "official_neighbour",
    "read_checkpoint",
    "refuse_existing",
    "save_checkpoint",
]

_FORMAT = "r3dpa-checkpoint-1"
_ABOUT = (
    "stage",
    "step",
    "geometry",
    "augmentation",
    "feature_source",
    "interpolant",
    "version",
    "commit",
    "official_args",
    "left_out",
)
# Where a LightningModule keeps each network: beginning of its keys, name of its argument.
_LIGHTNING = {
    "vae": ("vae.", "vae"),
    "discriminator": ("discriminator.", "discriminator"),
    "sit": ("sit.", "sit"),
    "latent_norm": ("latent_norm.", "latent_norm"),
    "ema": ("ema.sit.", "sit"),
    "ema_latent_norm": ("ema.latent_norm.", "latent_norm"),
}


def read_checkpoint(
    path: str | Path,
    *,
    sit_args: Mapping[str, Any] | None = None,
    encoding: Literal["linear", "log2"] | None = None,
) -> Checkpoint:
    """Reads a checkpoint of any layout without running code from it.

    Known are ours (``.safetensors`` with its ``.yaml``), Lightning checkpoints of the training
    stages (``.ckpt``), official ``.pt`` files, and image VAEs of diffusers (``.safetensors``).
    Beside an official VAE ``<name>.pt`` its ``<name>-latents-stats.pt`` and
    ``<name>-discriminator-ckpt.pt`` are read if they exist; where a file has no ``args``,
    ``args.json`` in its folder, or above a folder ``checkpoints``, is.

    Args:
        path: File to read.
        sit_args: Official files only: arguments of SiT that the file does not hold.
        encoding: Official files only: range encoding, if the options do not name it.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is damaged, of no known layout, or names a class that is not
            allowed.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint file {path}; give an existing file")
    try:
        if path.suffix == ".safetensors":
            described = path.with_suffix(".yaml").is_file()
            foreign = not described and is_diffusers(path)
            return from_diffusers(path) if foreign else _read_ours(path)
        content = _load_pickle(path)
        if isinstance(content, dict) and "pytorch-lightning_version" in content:
            return _from_lightning(content, path)
        if is_official(content):
            content, args = _official_neighbours(path, content)
            return from_official(content, path, args=args, sit_args=sit_args, encoding=encoding)
    except ValueError as error:
        raise ValueError(f"cannot read {path}: {error}") from error
    found = list(content)[:10] if isinstance(content, Mapping) else type(content).__name__
    raise ValueError(
        f"cannot read {path}: it holds {found}; expected a Lightning checkpoint of r3dpa, an "
        "official R3DPA checkpoint, or a .safetensors file with its .yaml"
    )


def save_checkpoint(checkpoint: Checkpoint, path: str | Path, *, overwrite: bool = False) -> Path:
    """Writes ``<name>.safetensors`` (all weights) and ``<name>.yaml`` (everything else).

    Both appear complete or not at all; the second holds the hash of the first. Returns ``path``.

    Raises:
        ValueError: If the name ends otherwise, the files exist, or an argument of a network is no
            plain value.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ValueError(f"our checkpoints are called <name>.safetensors, got {path}")
    description = path.with_suffix(".yaml")
    refuse_existing([path, description], overwrite)
    weights = {
        f"{name}.{key}": value
        for name, state in checkpoint.networks.items()
        for key, value in state.state_dict.items()
    }
    about = {
        "format": _FORMAT,
        "stage": checkpoint.stage,
        "step": checkpoint.step,
        "version": __version__,
        "commit": source_commit(),
        "networks": {
            name: {"class_path": state.class_path, "init_args": dict(state.init_args)}
            for name, state in checkpoint.networks.items()
        },
        "geometry": checkpoint.geometry,
        "augmentation": checkpoint.augmentation,
        "feature_source": checkpoint.feature_source,
        "interpolant": checkpoint.interpolant,
        "official_args": dict(checkpoint.official_args),
        "left_out": dict(checkpoint.left_out),
    }
    with atomic_path(path) as weights_file, atomic_path(description) as description_file:
        save_file(_unshared(weights), weights_file)
        about["sha256"] = _sha256(weights_file)
        try:
            description_file.write_text(yaml.safe_dump(about, sort_keys=False))
        except yaml.YAMLError as error:
            raise ValueError(f"the checkpoint holds more than plain values: {error}") from error
    return path


def official_neighbour(vae: Path, kind: str) -> Path:
    """Name of the file that belongs to an official VAE file."""
    return vae.with_name(f"{vae.stem}-{kind}.pt")


def _official_neighbours(path: Path, content: Any) -> tuple[Any, dict[str, Any]]:
    """Content with the files that belong to an official VAE, and the options of ``args.json``."""
    if "encoder.conv_in.weight" in content:
        content = {"vae": content}
        discriminator = official_neighbour(path, "discriminator-ckpt")
        if discriminator.is_file():
            content["discriminator"] = _load_pickle(discriminator)
        statistics = official_neighbour(path, "latents-stats")
        if statistics.is_file():
            found = _load_pickle(statistics)
            if not is_official(found):
                raise ValueError(f"{statistics} holds no latent statistics")
            content |= found
    folders = [path.parent, *([path.parent.parent] if path.parent.name == "checkpoints" else [])]
    for options in (folder / "args.json" for folder in folders):
        if options.is_file():
            try:
                return content, dict(json.loads(options.read_text()))
            except (ValueError, TypeError) as error:
                raise ValueError(f"{options} holds no training options: {error}") from error
    return content, {}


def _load_pickle(path: Path) -> Any:
    """Content of a file of ``torch.save``: tensors, plain values and ``argparse.Namespace``."""
    try:
        with torch.serialization.safe_globals([argparse.Namespace]):
            return torch.load(
                path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path)
            )
    except pickle.UnpicklingError as error:
        forbidden = re.search(r"GLOBAL (\S+)", str(error))
        if forbidden is None:
            raise ValueError("the file is damaged, or was not written by torch.save") from error
        if forbidden[1].startswith(("r3dpa.", "torch.nn.")):
            raise ValueError(
                f"the file holds a pickled {forbidden[1]}, as a module built by hand saves it; "
                "train with `r3dpa fit`, or write networks with r3dpa.checkpoints.save_checkpoint"
            ) from error
        raise ValueError(
            f"the file would run {forbidden[1]} when loaded; only tensors, plain values and "
            "argparse.Namespace are read"
        ) from error
    except UNPICKLING_ERRORS as error:
        raise ValueError(f"the file is damaged or incomplete ({first_line(error)})") from error


def _from_lightning(content: Mapping[str, Any], path: Path) -> Checkpoint:
    weights = content.get("state_dict")
    if not isinstance(weights, Mapping) or not all(isinstance(key, str) for key in weights):
        raise ValueError("the Lightning checkpoint holds no state_dict")
    arguments, about = content.get("hyper_parameters", {}), content.get("r3dpa", {})
    if not isinstance(arguments, Mapping) or not isinstance(about, Mapping):
        raise ValueError("its hyper_parameters or entry r3dpa are no tables")
    networks: dict[str, NetworkState] = {}
    for name, (prefix, argument) in _LIGHTNING.items():
        own = {k.removeprefix(prefix): v for k, v in weights.items() if k.startswith(prefix)}
        if not own:
            continue
        config = arguments.get(argument)
        if config is None and argument == "latent_norm" and "running_mean" in own:
            config = {
                "class_path": "r3dpa.nn.latent_norm.LatentNorm",
                "init_args": {"channels": len(own["running_mean"])},
            }
        networks[name] = _network_state(name, config, own)
    prefixes = tuple(prefix for prefix, _ in _LIGHTNING.values())
    others = {key.split(".")[0] for key in weights if not key.startswith(prefixes)}
    return Checkpoint(
        path=path,
        stage=about.get("stage", arguments.get("_class_path", "unknown")),
        networks=networks,
        step=content.get("global_step"),
        geometry=about.get("geometry"),
        augmentation=about.get("augmentation"),
        feature_source=about.get("feature_source"),
        interpolant=about.get("interpolant", "linear"),
        version=about.get("version"),
        commit=about.get("commit"),
        left_out=dict.fromkeys(sorted(others), "no network that checkpoints exchange"),
    )


def _read_ours(path: Path) -> Checkpoint:
    description = path.with_suffix(".yaml")
    if not description.is_file():
        raise ValueError(f"its description {description.name} is not beside it; copy both files")
    try:
        about = yaml.safe_load(description.read_text())
    except (yaml.YAMLError, *UNPICKLING_ERRORS) as error:
        raise ValueError(f"{description.name} is damaged: {error}") from error
    if not isinstance(about, dict) or about.get("format") != _FORMAT:
        raise ValueError(f"{description.name} does not describe a {_FORMAT}")
    for key in ("augmentation", "feature_source"):
        about.setdefault(key, None)  # as files written before there was any
    missing = {*_ABOUT, "networks", "sha256"} - set(about)
    if missing:
        raise ValueError(f"{description.name} lacks {', '.join(sorted(missing))}")
    if about["sha256"] != _sha256(path):
        raise ValueError(
            f"the file is not the one that {description.name} was written for (SHA-256 differs): "
            "it is incomplete, was changed, or belongs to another checkpoint"
        )
    try:
        weights = load_file(path)
    except (safetensors.SafetensorError, *UNPICKLING_ERRORS) as error:
        raise ValueError(f"the file is damaged: {error}") from error
    if not isinstance(about["networks"], dict):
        raise ValueError(f"{description.name}: networks must be a table of networks by name")
    networks: dict[str, NetworkState] = {}
    for name, config in about["networks"].items():
        own = {
            key.removeprefix(f"{name}."): value
            for key, value in weights.items()
            if key.startswith(f"{name}.")
        }
        networks[name] = _network_state(name, config, own)
    orphans = [key for key in weights if key.split(".")[0] not in networks]
    if orphans:
        raise ValueError(f"{description.name} names no network for the weights {orphans[:10]}")
    return Checkpoint(path=path, networks=networks, **{key: about[key] for key in _ABOUT})


def _network_state(name: str, config: Any, weights: Mapping[str, Tensor]) -> NetworkState:
    if name not in NETWORK_NAMES:
        raise ValueError(f"unknown network {name!r}; known are {', '.join(NETWORK_NAMES)}")
    if not isinstance(config, Mapping) or "class_path" not in config:
        raise ValueError(
            f"it does not say which class and arguments its {name} has (found "
            f"{reprlib.repr(config)}); train with `r3dpa fit`, which records them"
        )
    state = NetworkState(config["class_path"], config.get("init_args") or {}, weights)
    try:
        state.check()
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    return state


def _unshared(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Contiguous CPU tensors of which no two share memory, as safetensors wants them."""
    seen: set[int] = set()
    result = {}
    for key, value in weights.items():
        own = value.detach().cpu().contiguous()
        if own.untyped_storage().data_ptr() in seen:
            own = own.clone()
        seen.add(own.untyped_storage().data_ptr())
        result[key] = own
    return result


def refuse_existing(paths: list[Path], overwrite: bool) -> None:
    """Raises a ``ValueError`` that names the files that exist, unless they may be replaced."""
    existing = [str(path) for path in paths if path.exists()]
    if existing and not overwrite:
        raise ValueError(f"{', '.join(existing)} exists already; choose another name or overwrite")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

"""Conversion between checkpoint layouts, and from RGB weights to range images."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import yaml
from torch import Tensor

from r3dpa.checkpoints.files import (
    official_neighbour,
    read_checkpoint,
    refuse_existing,
    save_checkpoint,
)
from r3dpa.checkpoints.networks import Checkpoint, NetworkState, load_into
from r3dpa.checkpoints.official import facts_of, statistics_of, to_official
from r3dpa.io import atomic_path, text_table
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.sit import SiT

__all__ = ["ConversionReport", "TransferReport", "TransferRow", "convert", "transfer_rgb"]

Result = Literal["kept", "fresh", "resized", "truncated", "extended"]
Groups = Mapping[str, Mapping[str, Tensor]]

_LOST = ("sensor and encoding", "step", "arguments of the latent statistics")
_NORM = "latent_norm."


@dataclass(frozen=True)
class TransferRow:
    """One group of weights, whose keys start alike.

    ``result`` is ``kept``; ``fresh`` (initial value of this run, that of the file is dropped);
    ``resized`` (positions, which are computed for this run's token grid); ``truncated`` or
    ``extended`` (label table).
    """

    group: str
    num_tensors: int  #: in the receiving network
    result: Result
    source: str  #: shape of the largest tensor in the RGB checkpoint, ``-`` if absent
    target: str  #: the same in the receiving network
    reason: str


@dataclass(frozen=True)
class TransferReport:
    """Result of :func:`transfer_rgb`, one row per group."""

    path: Path
    rows: tuple[TransferRow, ...]

    def table(self) -> str:
        """The report as text, one line per group."""
        heads = ("weights", "tensors", "result", "largest tensor, RGB", "here", "reason")
        rows = [tuple(map(str, astuple(row))) for row in self.rows]
        return f"RGB weights from {self.path}\n{text_table(rows, heads)}"


@dataclass(frozen=True)
class ConversionReport:
    """Files, networks and RGB transfer of one :func:`convert`."""

    source: Path
    outputs: tuple[Path, ...]
    checkpoint: Checkpoint
    transfer: TransferReport | None = None

    def table(self) -> str:
        """The report as text."""
        rows = []
        for name, state in self.checkpoint.networks.items():
            size = sum(value.numel() for value in state.state_dict.values())
            kind = state.class_path.rpartition(".")[2]
            rows.append((name, kind, str(len(state.state_dict)), f"{size:,}"))
        lines = [f"{self.source} -> {', '.join(str(path) for path in self.outputs)}"]
        lines.append(text_table(rows, ("network", "class", "tensors", "elements")))
        lines += [f"not converted: {k} ({why})" for k, why in self.checkpoint.left_out.items()]
        if self.transfer is not None:
            lines += ["", self.transfer.table()]
        return "\n".join(lines)


def convert(
    source: str | Path,
    out: str | Path,
    to: Literal["r3dpa", "official"] = "r3dpa",
    *,
    overwrite: bool = False,
    sit_args: Mapping[str, Any] | None = None,
    encoding: Literal["linear", "log2"] | None = None,
    into: str | Path | None = None,
) -> ConversionReport:
    """Rewrites a checkpoint of any layout in ours, or in the official one.

    Weights stay equal bit for bit; optimisers are left out. Official training checkpoints keep all
    facts for the way back. A checkpoint without SiT becomes the official VAE file with its
    neighbours for discriminator and latent statistics, which lose some.

    Args:
        source: Checkpoint that :func:`read_checkpoint` understands.
        out: ``.safetensors`` for ours, ``.pt`` for the official layout.
        to: Layout to write.
        overwrite: Replace existing files.
        sit_args: As for :func:`read_checkpoint`.
        encoding: As for :func:`read_checkpoint`.
        into: YAML file with ``class_path`` and ``init_args`` of a SiT, which :func:`transfer_rgb`
            initialises from the source; to ``r3dpa`` only. Weights that the source does not have
            are random, the same ones at each call.

    Raises:
        FileNotFoundError: If there is no such source.
        ValueError: If it cannot be read, has no counterpart in the other layout, or the output
            exists already.
    """
    source, out = Path(source), Path(out)
    if to not in ("r3dpa", "official"):
        raise ValueError(f"convert writes 'r3dpa' or 'official' checkpoints, got {to!r}")
    if into is not None and to != "r3dpa":
        raise ValueError(f"convert puts RGB weights into 'r3dpa' checkpoints only, got to {to!r}")
    checkpoint = read_checkpoint(source, sit_args=sit_args, encoding=encoding)
    transfer = None
    if into is not None:
        checkpoint, transfer = _transferred(checkpoint, Path(into))
    if to == "r3dpa":
        outputs = [save_checkpoint(checkpoint, out, overwrite=overwrite), out.with_suffix(".yaml")]
    else:
        outputs = _save_official(checkpoint, out, overwrite)
        if not {"sit", "ema"} & set(checkpoint.networks):
            lost = dict.fromkeys(_LOST, "official files of a VAE have no place for it")
            checkpoint = replace(checkpoint, left_out={**checkpoint.left_out, **lost})
    return ConversionReport(source, tuple(outputs), checkpoint, transfer)


def _save_official(checkpoint: Checkpoint, out: Path, overwrite: bool) -> list[Path]:
    if out.suffix != ".pt":
        raise ValueError(f"official checkpoints are called <name>.pt, got {out}")
    content = to_official(checkpoint)
    if {"model", "ema"} & set(content):
        files: dict[Path, Any] = {out: content | facts_of(checkpoint)}
    else:
        files = {out: content["vae"]} if "vae" in content else {}
        if "discriminator" in content:
            files[official_neighbour(out, "discriminator-ckpt")] = content["discriminator"]
        if "latent_norm" in checkpoint.networks:
            norm = checkpoint.network("latent_norm").state_dict
            files[official_neighbour(out, "latents-stats")] = statistics_of(norm)
    refuse_existing(list(files), overwrite)
    for path, weights in files.items():
        with atomic_path(path) as temporary:
            torch.save(weights, temporary)
    return list(files)


def _transferred(checkpoint: Checkpoint, into: Path) -> tuple[Checkpoint, TransferReport]:
    """Checkpoint with a SiT for range images that starts from the RGB weights of another."""
    try:
        config = yaml.safe_load(into.read_text(encoding="utf-8"))
        state = NetworkState(config["class_path"], config.get("init_args") or {}, {})
    except (yaml.YAMLError, UnicodeDecodeError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{into}: names no network ({type(error).__name__}: {error}); give a YAML file with "
            "class_path and init_args of a SiT, such as conf/net/sit_b2.yaml"
        ) from error
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        sit = state.new()
    if not isinstance(sit, SiT):
        raise ValueError(f"{into}: RGB weights are for a SiT, but it names {state.class_path}")
    norm = LatentNorm(sit.in_channels)
    report = transfer_rgb(checkpoint, sit, norm, keep_projector=True)
    networks = {
        "sit": NetworkState.of(sit, state.init_args),
        "latent_norm": NetworkState.of(norm, {"channels": sit.in_channels}),
    }
    others = dict.fromkeys(checkpoint.networks.keys() - networks.keys(), "no part of RGB weights")
    made = replace(
        checkpoint,
        networks=networks,
        geometry=None,  # sensor and options were those of the source
        official_args={},
        left_out={**checkpoint.left_out, **others},
    )
    return made, report


def transfer_rgb(
    checkpoint: Checkpoint, sit: SiT, latent_norm: LatentNorm, *, keep_projector: bool
) -> TransferReport:
    """Starts a range-image SiT and its latent statistics from an RGB checkpoint.

    ``sit`` and ``latent_norm`` are changed in place. Fresh, that is unchanged, stay: patch
    embedding, output layer and latent statistics if the number of latent channels differs, the
    former two also if the patch size does; the position table if the token grid differs; the
    projector without ``keep_projector``, or if it does not fit; rows of the label table that the
    file lacks. A longer label table is cut to its first rows, and its last one if this run has a
    row for "no class". All other weights must fit.

    Source: tuning stages of valeoai/R3DPA, which always cut the label table to one row and keep the
    position table of another latent size if it has as many tokens.

    Raises:
        ValueError: If the checkpoint holds no SiT, or anything beside those groups does not fit;
            nothing is changed then.
    """
    rgb, statistics = checkpoint.network("sit"), checkpoint.network("latent_norm")
    if not issubclass(rgb.kind, SiT):
        raise ValueError(
            f"{checkpoint.path} holds a {rgb.kind.__name__}, but RGB weights are those of a SiT: "
            "give a checkpoint of stage rgb_pretraining, or an official one"
        )
    theirs = _grouped(rgb.state_dict, statistics.state_dict)
    ours = _grouped(sit.state_dict(), latent_norm.state_dict())
    patch = rgb.arguments["patch_size"]
    same_grid = tuple(side // patch for side in rgb.arguments["input_size"]) == sit.grid_size
    rows: list[TransferRow] = []
    merged: dict[str, Tensor] = {}
    for group in dict.fromkeys((*ours, *theirs)):
        rgb_part, own_part = theirs.get(group, {}), ours.get(group, {})
        result, reason = _result(group, theirs, ours, keep_projector, same_grid)
        if result in ("fresh", "resized"):
            merged |= own_part
        elif result in ("truncated", "extended"):
            merged |= {key: _label_rows(rgb_part[key], value) for key, value in own_part.items()}
        else:
            merged |= rgb_part
        source, target = (str(_largest(part) or "-") for part in (rgb_part, own_part))
        rows.append(TransferRow(group, len(own_part), result, source, target, reason))
    init_args = rgb.arguments | {"input_size": sit.input_size}
    if any(row.group == "projector" and row.result == "fresh" for row in rows):
        init_args["alignment_depth"] = sit.alignment_depth  # a new head may look at another block
    norm = {k.removeprefix(_NORM): v for k, v in merged.items() if k.startswith(_NORM)}
    weights = {k: v for k, v in merged.items() if not k.startswith(_NORM)}
    merged_networks = {
        "sit": replace(rgb, init_args=init_args, state_dict=weights),
        "latent_norm": replace(statistics, state_dict=norm),
    }
    load_into(
        {"sit": sit, "latent_norm": latent_norm},
        replace(checkpoint, networks=merged_networks),
        stage="RGB transfer",
    )
    return TransferReport(checkpoint.path, tuple(rows))


def _result(
    group: str, theirs: Groups, ours: Groups, keep_projector: bool, same_grid: bool
) -> tuple[Result, str]:
    """Result of a group of weights and its reason, by the rules of the official tuning stages."""
    rgb, own = (_largest(groups.get(group, {})) for groups in (theirs, ours))
    embeddings = [_largest(groups["x_embedder"]) for groups in (theirs, ours)]
    channels, patches = ([shape[axis] for shape in embeddings] for axis in (1, 2))
    of_patches = group in ("x_embedder", "final_layer.linear")
    if (of_patches or group == "latent_norm") and channels[0] != channels[1]:
        return "fresh", "other number of latent channels"
    if of_patches and patches[0] != patches[1]:
        return "fresh", "other patch size"
    if group == "pos_embed" and not same_grid:
        return "resized", "other token grid: computed for that of this run"
    if group == "projector" and not keep_projector:
        return "fresh", "not requested"
    if group == "projector" and _shapes(theirs.get(group, {})) != _shapes(ours[group]):
        return "fresh", "requested, but its shapes differ"
    if group != "y_embedder" or rgb[0] == own[0]:
        return "kept", "fits"
    if rgb[0] < own[0]:
        return "extended", f"{own[0]} rows here: the last {own[0] - rgb[0]} stay fresh"
    if own[0] == 1:
        return "truncated", "one row here: the first is taken"
    return "truncated", f"{own[0]} rows here: the first {own[0] - 1} and the last, of no class"


def _label_rows(theirs: Tensor, ours: Tensor) -> Tensor:
    """Label table as long as ours; our last row, if not the only one, is that of no class."""
    if len(theirs) < len(ours):
        return torch.cat([theirs, ours[len(theirs) :].to(theirs)])
    return theirs[:1] if len(ours) == 1 else torch.cat([theirs[: len(ours) - 1], theirs[-1:]])


def _grouped(sit: Mapping[str, Tensor], norm: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """Weights of both networks by the part of their key that decides what happens to them."""
    groups: dict[str, dict[str, Tensor]] = {}
    for key, value in {**sit, **{_NORM + k: v for k, v in norm.items()}}.items():
        parts = key.split(".")
        group = ".".join(parts[: 2 if parts[0] == "final_layer" else 1])
        groups.setdefault(group, {})[key] = value
    return groups


def _shapes(weights: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {key: tuple(value.shape) for key, value in weights.items()}


def _largest(weights: Mapping[str, Tensor]) -> tuple[int, ...]:
    """Shape of the largest tensor; empty if there is none."""
    return max(_shapes(weights).values(), key=math.prod, default=())

"""RGB weights to range images: what is kept, and what starts afresh."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from r3dpa.checkpoints.networks import Checkpoint, format_table, load_into
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.sit import SiT

__all__ = ["TransferReport", "TransferRow", "transfer_rgb"]

Fate = Literal["kept", "fresh", "resized", "truncated", "extended"]
Groups = Mapping[str, Mapping[str, Tensor]]

_NORM = "latent_norm."


@dataclass(frozen=True)
class TransferRow:
    """One group of weights: ``num_tensors`` in the receiving network whose keys start alike.

    ``fate`` is ``kept``; ``fresh`` (initial value of this run, that of the file is dropped);
    ``resized`` (positions, which are computed for this run's token grid); ``truncated`` or
    ``extended`` (label table). ``source`` and ``target`` are the shapes of the largest tensor in
    the RGB checkpoint and in the receiving network, ``-`` if absent.
    """

    group: str
    num_tensors: int
    fate: Fate
    source: str
    target: str
    reason: str


@dataclass(frozen=True)
class TransferReport:
    """Result of :func:`transfer_rgb`, one row per group."""

    path: Path
    rows: tuple[TransferRow, ...]

    def table(self) -> str:
        """The report as text, one line per group."""
        header = ("weights", "tensors", "fate", "largest tensor, RGB", "here", "reason")
        rows = [
            (row.group, str(row.num_tensors), row.fate, row.source, row.target, row.reason)
            for row in self.rows
        ]
        return f"RGB weights from {self.path}\n{format_table(header, rows)}"


def transfer_rgb(
    checkpoint: Checkpoint,
    sit: SiT,
    latent_norm: LatentNorm,
    *,
    keep_projector: bool,
) -> TransferReport:
    """Starts a range-image SiT and its latent statistics from an RGB checkpoint.

    Patch embedding, output layer and latent statistics stay fresh if the number of latent channels
    differs, the former two also if the patch size does; the position table is that of this run if
    the token grid differs; the projector stays fresh if it is not asked for or does not fit. A
    label table is cut to its first rows; if this run has one for "no class", that is the last row
    of the file, where it has more rows. Rows that the file lacks stay fresh. All other weights must
    fit.

    Source: tuning stages of valeoai/R3DPA, which always cut the label table to one row and keep the
    position table of another latent size if it has as many tokens.

    ``sit`` and ``latent_norm`` are changed in place; fresh weights keep their values. With
    ``keep_projector`` the projector is taken too, as VAE alignment does.

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
    theirs = _grouped({**rgb.state_dict, **_prefixed(statistics.state_dict)})
    ours = _grouped({**sit.state_dict(), **_prefixed(latent_norm.state_dict())})
    patch = rgb.arguments["patch_size"]
    same_grid = tuple(side // patch for side in rgb.arguments["input_size"]) == sit.grid_size
    rows: list[TransferRow] = []
    merged: dict[str, Tensor] = {}
    for group in dict.fromkeys((*ours, *theirs)):
        rgb_part, own_part = theirs.get(group, {}), ours.get(group, {})
        fate, reason = _fate(group, theirs, ours, keep_projector, same_grid)
        if fate in ("fresh", "resized"):
            merged |= own_part
        elif fate in ("truncated", "extended"):
            merged |= {key: _rows(rgb_part[key], value) for key, value in own_part.items()}
        else:
            merged |= rgb_part
        shapes = _largest_shape(rgb_part), _largest_shape(own_part)
        rows.append(TransferRow(group, len(own_part), fate, *shapes, reason))
    init_args = rgb.arguments | {"input_size": sit.input_size}
    if any(row.group == "projector" and row.fate == "fresh" for row in rows):
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


def _fate(
    group: str, theirs: Groups, ours: Groups, keep_projector: bool, same_grid: bool
) -> tuple[Fate, str]:
    """Fate of a group of weights and its reason, by the rules of the official tuning stages."""
    of_channels = group in ("x_embedder", "final_layer.linear", "latent_norm")
    if of_channels and _length(theirs, "x_embedder", 1) != _length(ours, "x_embedder", 1):
        return "fresh", "other number of latent channels"
    of_patches = group in ("x_embedder", "final_layer.linear")
    if of_patches and _length(theirs, "x_embedder", 2) != _length(ours, "x_embedder", 2):
        return "fresh", "other patch size"
    if group == "pos_embed" and not same_grid:
        return "resized", "other token grid: computed for that of this run"
    if group == "projector" and not keep_projector:
        return "fresh", "not asked for"
    if group == "projector" and _shapes(theirs.get(group, {})) != _shapes(ours[group]):
        return "fresh", "asked for, but its shapes differ"
    if group == "y_embedder":
        return _fate_of_labels(_length(theirs, group, 0), _length(ours, group, 0))
    return "kept", "fits"


def _fate_of_labels(theirs: int, ours: int) -> tuple[Fate, str]:
    if theirs == ours:
        return "kept", "fits"
    if theirs < ours:
        return "extended", f"{ours} rows here: the last {ours - theirs} stay fresh"
    if ours == 1:
        return "truncated", "one row here: the first is taken"
    return "truncated", f"{ours} rows here: the first {ours - 1} and the last, of no class"


def _rows(theirs: Tensor, ours: Tensor) -> Tensor:
    """Label table as long as ours, see :func:`_fate_of_labels`."""
    if len(theirs) < len(ours):
        return torch.cat([theirs, ours[len(theirs) :].to(theirs)])
    return theirs[:1] if len(ours) == 1 else torch.cat([theirs[: len(ours) - 1], theirs[-1:]])


def _grouped(weights: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """Weights by the part of their key that decides their fate."""
    groups: dict[str, dict[str, Tensor]] = {}
    for key, value in weights.items():
        parts = key.split(".")
        group = ".".join(parts[: 2 if parts[0] == "final_layer" else 1])
        groups.setdefault(group, {})[key] = value
    return groups


def _prefixed(statistics: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {_NORM + key: value for key, value in statistics.items()}


def _shapes(weights: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {key: tuple(value.shape) for key, value in weights.items()}


def _length(groups: Groups, group: str, axis: int) -> int:
    """Size along an axis of a group's largest tensor; 0 if there is no such group."""
    largest = max(groups.get(group, {}).values(), key=Tensor.numel, default=None)
    return 0 if largest is None else largest.shape[axis]


def _largest_shape(weights: Mapping[str, Tensor]) -> str:
    return str(max(_shapes(weights).values(), key=math.prod, default="-"))

"""Weights of a model of other images: position tables and stems in the size of this run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import cast

import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from r3dpa.checkpoints.networks import AVERAGES, Checkpoint, NetworkState
from r3dpa.checkpoints.transfer import TransferRow
from r3dpa.nn import VAE, SiT
from r3dpa.nn.layers import Size

_POSITIONS = "pos_embed"
_INPUTS = ("encoder.conv_in.weight", "encoder.further_in.weight")
_OUTPUTS = (
    "decoder.conv_out.weight",
    "decoder.conv_out.bias",
    "decoder.further_out.weight",
    "decoder.further_out.bias",
    "decoder.further_refinement.features.weight",
    "decoder.further_refinement.features.bias",
)


def resize_to(
    networks: Mapping[str, nn.Module], checkpoint: Checkpoint, given: Checkpoint
) -> tuple[Checkpoint, list[TransferRow]]:
    """Checkpoint whose networks have the image size of the networks of this run.

    The position table of a SiT is recomputed, or interpolated where it is trained. The stem of a
    VAE, which folds blocks of pixels into channels, is interpolated over the pixels of a block.
    All other weights are kept; those that do not fit are left to :func:`load_into` to refuse.

    Args:
        networks: SiT, VAE and others by their name in the checkpoint.
        checkpoint: Weights for them.
        given: File that the weights are from, to name those that are left out.

    Returns:
        The checkpoint, and a row for each group of weights.
    """
    states = dict(checkpoint.networks)
    rows: list[TransferRow] = []
    for name, network in networks.items():
        source = name if name in states else AVERAGES.get(name, name)
        state, resized = checkpoint.network(source), dict[str, Tensor]()
        if isinstance(network, SiT) and issubclass(state.kind, SiT):
            states[source], resized = _sit_of_size(state, network)
        elif isinstance(network, VAE) and issubclass(state.kind, VAE):
            states[source], resized = _vae_of_size(state, network)
        num_kept = len(state.state_dict) - len(resized)
        rows.append(TransferRow(name, num_kept, "kept", "the same for images of any size"))
        if resized:
            layers = ", ".join(dict.fromkeys(key.rpartition(".")[0] or key for key in resized))
            reason = "other number of tokens" if _POSITIONS in resized else "other stem"
            rows.append(TransferRow(f"{name}: {layers}", len(resized), "resized", reason))
        # A stage may have made `sit` of the average in the file.
        origin = source if source in given.networks else AVERAGES.get(source, source)
        left_out = given.network(origin).state_dict.keys() - state.state_dict.keys()
        if left_out:
            group = f"{name}: {min(left_out).partition('.')[0]}"
            rows.append(TransferRow(group, len(left_out), "dropped", "not of this stage"))
    return replace(checkpoint, networks=states), rows


def _sit_of_size(state: NetworkState, sit: SiT) -> tuple[NetworkState, dict[str, Tensor]]:
    size = tuple(state.arguments["input_size"])
    if size == sit.input_size:
        return state, {}
    table = sit.pos_embed
    if isinstance(table, nn.Parameter):
        rows = size[0] // sit.patch[0]
        grid = rearrange(state.state_dict[_POSITIONS].float(), "1 (h w) D -> 1 D h w", h=rows)
        grid = F.interpolate(grid, sit.grid_size, mode="bilinear", antialias=True)
        table = rearrange(grid, "1 D h w -> 1 (h w) D")
    resized = {_POSITIONS: table.detach().clone()}
    init_args = {**state.init_args, "input_size": sit.input_size}
    return _with(state, init_args, resized), resized


def _vae_of_size(state: NetworkState, vae: VAE) -> tuple[NetworkState, dict[str, Tensor]]:
    given: Size = tuple(state.arguments["stem"])
    wanted = cast(Size, vae.encoder.stem)  # a module's attribute has no type
    if given == wanted or math.prod(given) == 1 or math.prod(wanted) == 1:
        return state, {}  # a stem of single pixels has kernels of its own
    weights = state.state_dict
    resized = {key: _inputs_of(weights[key], given, wanted) for key in _INPUTS if key in weights}
    resized |= {key: _outputs_of(weights[key], given, wanted) for key in _OUTPUTS if key in weights}
    return _with(state, {**state.init_args, "stem": wanted}, resized), resized


def _with(
    state: NetworkState, init_args: Mapping[str, object], weights: Mapping[str, Tensor]
) -> NetworkState:
    return replace(state, init_args=init_args, state_dict={**state.state_dict, **weights})


def _inputs_of(kernel: Tensor, given: Size, wanted: Size) -> Tensor:
    """Kernel ``(O, C * p * q, k, l)`` over blocks, interpolated as one ``(O, C, k p, l q)``."""
    rows, columns = kernel.shape[2:]
    pixels = rearrange(kernel.float(), "O (C p q) k l -> O C (k p) (l q)", p=given[0], q=given[1])
    size = (rows * wanted[0], columns * wanted[1])
    pixels = F.interpolate(pixels, size, mode="bilinear", antialias=True)
    pixels = pixels * (math.prod(given) / math.prod(wanted))  # a constant image gives the same
    return rearrange(pixels, "O C (k p) (l q) -> O (C p q) k l", p=wanted[0], q=wanted[1])


def _outputs_of(values: Tensor, given: Size, wanted: Size) -> Tensor:
    """Weight or bias ``(C * p * q, ...)`` of outputs, interpolated over the pixels of a block."""
    rest = values.shape[1:]
    flat = values.float().reshape(len(values), -1)
    pixels = rearrange(flat, "(C p q) R -> C R p q", p=given[0], q=given[1])
    pixels = F.interpolate(pixels, wanted, mode="bilinear", antialias=True)
    return rearrange(pixels, "C R p q -> (C p q) R").reshape(-1, *rest)

"""Weights of another model: to start from, of RGB or fewer channels, or to guide by."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

from torch import Tensor

from r3dpa.checkpoints.files import read_checkpoint
from r3dpa.checkpoints.networks import Checkpoint, NetworkState, load_into, shapes_of
from r3dpa.io import weights_sha256
from r3dpa.nn import VAE, LatentNorm, SiT, VelocityNetwork

Weights = Mapping[str, Tensor]
Result = Literal["kept", "fresh", "resized", "truncated", "dropped"]
# Largest difference between channels in how the latent scales of two models differ: on a frozen
# VAE, running statistics 100 to 900 steps apart differ by up to 0.031 (batch 4) or 0.014 (32).
NORM_TOLERANCE = 0.05
_NORM = "latent_norm."
_PROJECTOR = "projector."
_FURTHER_INPUT, _FIRST_BIAS = "encoder.further_in", "encoder.conv_in.bias"
_REFINEMENT = "further_refinement."


class TransferRow(NamedTuple):
    """One group of weights, whose keys start alike, and where its values come from."""

    group: str
    num_tensors: int  #: in the receiving network
    result: Result  #: ``fresh``: initial value; ``resized``: in the size of this run's images
    reason: str


def transfer_rgb(
    checkpoint: Checkpoint, sit: SiT, latent_norm: LatentNorm, keep_projector: bool
) -> list[TransferRow]:
    """Start a range-image SiT and its latent statistics from an RGB checkpoint.

    ``sit`` and ``latent_norm`` are changed in place. Some groups keep their initial values
    ("fresh"): patch embedding and output layer if the number of latent channels or the patch size
    differs; latent statistics if the number of latent channels differs; the projector without
    ``keep_projector``, or if it does not fit. The position table is computed anew ("resized") if
    the token grid differs. A label table is cut to its first row if this run has one. All other
    weights must fit. Returns a row for each group of weights.

    Source: tuning stages of valeoai/R3DPA, which keep the position table of another latent size if
    it has as many tokens.

    Raises:
        ValueError: If the checkpoint was trained on scans or holds no SiT, or anything beside those
            groups does not fit; nothing is changed then.
    """
    if checkpoint.geometry is not None:
        raise ValueError(
            f"{checkpoint.path} is of stage {checkpoint.stage} and was trained on range images: "
            "rgb_weights takes a checkpoint of stage rgb_pretraining, or an official one; give "
            "a checkpoint of a stage before as --model.init_args.init_from"
        )
    rgb, statistics = checkpoint.network("sit"), checkpoint.network("latent_norm")
    if not issubclass(rgb.kind, SiT):
        raise ValueError(
            f"{checkpoint.path} holds a {rgb.kind.__name__}, but RGB weights must belong to a SiT: "
            "give a checkpoint of stage rgb_pretraining, or an official one"
        )
    theirs = _group_weights(rgb.state_dict, statistics.state_dict)
    ours = _group_weights(sit.state_dict(), latent_norm.state_dict())
    patch = rgb.arguments["patch_size"]
    patch = (patch, patch) if isinstance(patch, int) else patch
    size = rgb.arguments["input_size"]
    same_grid = (size[0] // patch[0], size[1] // patch[1]) == sit.grid_size
    init_args = rgb.arguments | {"input_size": sit.input_size}
    rows: list[TransferRow] = []
    merged: dict[str, Tensor] = {}
    for group in dict.fromkeys((*ours, *theirs)):
        rgb_part, own_part = theirs.get(group, {}), ours.get(group, {})
        result, reason = _transfer_result(group, theirs, ours, keep_projector, same_grid)
        if result in ("fresh", "resized"):
            merged |= own_part
            if group == "projector":  # a new head may look at another block
                init_args["alignment_depth"] = sit.alignment_depth
        elif result == "kept":
            merged |= rgb_part
        else:
            merged |= {key: value[:1] for key, value in rgb_part.items()}
        rows.append(TransferRow(group, len(own_part), result, reason))
    norm = {k.removeprefix(_NORM): v for k, v in merged.items() if k.startswith(_NORM)}
    weights = {k: v for k, v in merged.items() if not k.startswith(_NORM)}
    networks = {
        "sit": replace(rgb, init_args=init_args, state_dict=weights),
        "latent_norm": replace(statistics, state_dict=norm),
    }
    fitting = replace(checkpoint, networks=networks)
    load_into({"sit": sit, "latent_norm": latent_norm}, fitting, stage="RGB transfer")
    return rows


def with_further_channels(checkpoint: Checkpoint, vae: VAE) -> Checkpoint:
    """Checkpoint of a VAE with the intensity, class and refinement that ``vae`` has and it lacks.

    The layers of these parts have the values that they have in ``vae``, all others stay: the
    encoder gives the same latents, and the decoder the same ranges and returns. Unchanged where the
    checkpoint lacks no such layer.
    """
    weights = checkpoint.network("vae").state_dict
    layers = {
        key: value
        for key, value in vae.state_dict().items()
        if ".further_" in key and key not in weights
    }
    return _with_channels_of(checkpoint, vae, {**weights, **layers}) if layers else checkpoint


def without_further_channels(checkpoint: Checkpoint, vae: VAE) -> Checkpoint:
    """Checkpoint whose VAE has no refinement, intensity and class that ``vae`` lacks.

    All else stays; intensity and class are left out together. An encoder that saw them becomes one
    that gives the latents of images in which neither is known.
    """
    if not vae.refinement:
        checkpoint = _without_refinement(checkpoint)
    state = checkpoint.network("vae")
    weights, has_further = state.state_dict, vae.image_channels > vae.in_channels
    if not (has_further and vae.encode_further):
        weights = _without_further_input(state)
    if not has_further:
        weights = {key: value for key, value in weights.items() if ".further_" not in key}
    if len(weights) == len(state.state_dict):
        return checkpoint
    return _with_channels_of(checkpoint, vae, weights)


def _without_further_input(state: NetworkState) -> Weights:
    """Weights of a VAE whose encoder sees range and return alone.

    What the encoder adds for an intensity of -1 and no class, which stand for unknown, is the same
    everywhere: it moves into the bias of the first layer.
    """
    weights = dict(state.state_dict)
    if f"{_FURTHER_INPUT}.weight" not in weights:
        return weights
    kernel, added = (weights.pop(f"{_FURTHER_INPUT}.{name}").float() for name in ("weight", "bias"))
    if state.arguments["intensity"]:
        added = added - kernel[:, : math.prod(state.arguments["stem"])].sum(dim=(1, 2, 3))
    weights[_FIRST_BIAS] = weights[_FIRST_BIAS] + added
    return weights


def _without_refinement(checkpoint: Checkpoint) -> Checkpoint:
    state = checkpoint.network("vae")
    rest = {key: value for key, value in state.state_dict.items() if _REFINEMENT not in key}
    if len(rest) == len(state.state_dict):
        return checkpoint
    plain = replace(state, init_args={**state.init_args, "refinement": 0}, state_dict=rest)
    return replace(checkpoint, networks={**checkpoint.networks, "vae": plain})


def _with_channels_of(checkpoint: Checkpoint, vae: VAE, weights: Weights) -> Checkpoint:
    """Checkpoint with these weights of a VAE, and the parts beside ranges that ``vae`` has."""
    state = checkpoint.network("vae")
    further = ("intensity", "num_classes", "encode_further", "refinement")
    init_args = {**state.init_args, **{name: getattr(vae, name) for name in further}}
    changed = replace(state, init_args=init_args, state_dict=weights)
    geometry = checkpoint.geometry
    if geometry is not None:
        channels = {"intensity_channel": vae.intensity, "num_classes": vae.num_classes}
        geometry = {**geometry, "codec": {**geometry["codec"], **channels}}
    return replace(checkpoint, networks={**checkpoint.networks, "vae": changed}, geometry=geometry)


def with_projector_of(checkpoint: Checkpoint, sit: SiT, aligns: bool) -> Checkpoint:
    """Checkpoint whose SiTs have the head of ``sit`` if their own differ and are not needed.

    They are needed in a run that ``aligns`` if they have learned, from 3D features or officially.
    Otherwise features of another width, a head of another kind or after another block may follow.
    """
    learned = checkpoint.feature_source is not None or checkpoint.stage == "official"
    if aligns and learned:
        return checkpoint
    head = {k: v for k, v in sit.state_dict().items() if k.startswith(_PROJECTOR)}
    networks = dict(checkpoint.networks)
    for name, state in checkpoint.networks.items():
        if not issubclass(state.kind, SiT):
            continue
        rest = {k: v for k, v in state.state_dict.items() if not k.startswith(_PROJECTOR)}
        before = {k: v for k, v in state.state_dict.items() if k not in rest}
        same_block = state.arguments["alignment_depth"] == sit.alignment_depth
        if shapes_of(before) != shapes_of(head) or not same_block:
            init_args = {**state.init_args, "alignment_depth": sit.alignment_depth}
            networks[name] = replace(state, init_args=init_args, state_dict=rest | head)
    return replace(checkpoint, networks=networks)


def _transfer_result(
    group: str,
    theirs: Mapping[str, Weights],
    ours: Mapping[str, Weights],
    keep_projector: bool,
    same_grid: bool,
) -> tuple[Result, str]:
    """Result of a group of weights and its reason, by the rules of the official tuning stages."""
    rgb, new = (_largest(groups.get(group, {})) for groups in (theirs, ours))
    embeddings = [_largest(groups["x_embedder"]) for groups in (theirs, ours)]
    channels, patches = ([shape[axis] for shape in embeddings] for axis in (1, 2))
    of_patches = group in ("x_embedder", "final_layer.linear")
    if (of_patches or group == "latent_norm") and channels[0] != channels[1]:
        return "fresh", "other number of latent channels"
    if of_patches and patches[0] != patches[1]:
        return "fresh", "other patch size"
    if group == "pos_embed" and not same_grid:
        return "resized", "other token grid: recomputed for this run"
    if group == "projector" and not keep_projector:
        return "fresh", "not requested"
    if group == "projector" and shapes_of(theirs.get(group, {})) != shapes_of(ours[group]):
        return "fresh", "requested, but its shapes differ"
    if group == "y_embedder" and new[0] == 1 < rgb[0]:
        return "truncated", "one row here: the first is taken"
    return "kept", "fits"


def _group_weights(sit: Weights, norm: Weights) -> dict[str, dict[str, Tensor]]:
    """Weights of both networks by the part of their key that decides what happens to them."""
    groups: dict[str, dict[str, Tensor]] = {}
    for key, value in {**sit, **{_NORM + k: v for k, v in norm.items()}}.items():
        parts = key.split(".")
        group = ".".join(parts[: 2 if parts[0] == "final_layer" else 1])
        groups.setdefault(group, {})[key] = value
    return groups


def _largest(weights: Weights) -> tuple[int, ...]:
    return max(shapes_of(weights).values(), key=math.prod, default=())


@dataclass(frozen=True)
class WeakModel:
    """Averaged network in evaluation mode on the CPU, with facts about its training.

    Where the model that it guides has normalised ``latents``, it has ``scale * latents + shift``,
    see :func:`r3dpa.flow.renormalised`; ``shift`` is ``(C,)`` float32.
    """

    sit: VelocityNetwork
    scale: float
    shift: Tensor
    step: int | None


def read_snapshot(
    path: str | Path,
    strong: Checkpoint,
    weights: Literal["ema", "last"] = "ema",
) -> WeakModel:
    """Read a weak model that may guide a given one.

    Both models have one VAE, which stage ``flow_matching`` freezes; normalisations that drifted
    apart are converted, up to ``NORM_TOLERANCE``.

    Args:
        path: File of :class:`r3dpa.callbacks.EMASnapshots`, or any checkpoint with an average.
        strong: Checkpoint of the model to be guided.
        weights: Whether it uses the latent statistics of the average or of the last step.
    """
    weak = read_checkpoint(path)
    if not {"ema", "ema_latent_norm"} <= set(weak.networks):
        raise ValueError(
            f"{path} is of stage {weak.stage} and holds no averaged SiT with its statistics, "
            f"only {', '.join(weak.networks)}; give a file of a run's snapshots"
        )
    sit_name, norm_name = ("ema", "ema_latent_norm") if weights == "ema" else ("sit", "latent_norm")
    size, strong_size = _latent_size(weak, "ema"), _latent_size(strong, sit_name)
    if (size, weak.interpolant) != (strong_size, strong.interpolant):
        raise ValueError(
            f"{path} is a model of latents {size} on the {weak.interpolant} path, {strong.path} "
            f"one of {strong_size} on the {strong.interpolant} path; give a snapshot of a run with "
            "the same VAE, range images and path"
        )
    norm, strong_norm = _norm(weak, "ema_latent_norm"), _norm(strong, norm_name)
    # A normalised latent is (raw - mean) / deviation. The scale is the geometric mean over the
    # channels, the spread how far a channel is from it at most, relative to it.
    deviation = (norm.running_var + norm.eps).double().sqrt()
    ratios = (strong_norm.running_var + strong_norm.eps).double().sqrt() / deviation
    scale = ratios.log().mean().exp()
    spread = (ratios / scale - 1).abs().max().item()
    shift = ((strong_norm.running_mean - norm.running_mean).double() / deviation).float()
    reason = ""
    vae = _vae_note(weak)
    if vae is None or vae != _vae_note(strong):
        reason = "its latents come from another VAE, as within stage joint"
    elif spread > NORM_TOLERANCE:
        limit = f"{NORM_TOLERANCE:.0%}"
        reason = f"the scales of its latents differ by {spread:.1%} between channels, over {limit}"
    if reason:
        raise ValueError(
            f"{path} cannot guide {strong.path}: {reason}. Give a snapshot of stage flow_matching "
            "on this VAE"
        )
    sit = weak.network("ema").build()
    assert isinstance(sit, VelocityNetwork)  # _latent_size
    sit.eval().requires_grad_(False)
    return WeakModel(sit, scale.item(), shift, weak.step)


def vae_fingerprint(vae: Weights) -> str:
    """Description of a VAE that a snapshot leaves out: the hash of its weights."""
    return f"not kept in a snapshot; SHA-256 of its weights: {weights_sha256(vae)}"


def _vae_note(checkpoint: Checkpoint) -> str | None:
    if "vae" in checkpoint.networks:
        return vae_fingerprint(checkpoint.network("vae").state_dict)
    return checkpoint.left_out.get("vae")


def _latent_size(checkpoint: Checkpoint, name: str) -> tuple[int, ...]:
    state = checkpoint.network(name)
    if not issubclass(state.kind, VelocityNetwork):
        raise ValueError(f"{checkpoint.path}: {name} is a {state.class_path}, no velocity network")
    return (state.arguments["in_channels"], *state.arguments["input_size"])


def _norm(checkpoint: Checkpoint, name: str) -> LatentNorm:
    norm = checkpoint.network(name).build()
    if not isinstance(norm, LatentNorm) or not norm.fitted:
        raise ValueError(f"{checkpoint.path}: {name} holds no fitted latent statistics")
    return norm

"""Early averages of the SiT read back as weak models for autoguidance."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from r3dpa.checkpoints.files import read_checkpoint
from r3dpa.checkpoints.networks import Checkpoint, weights_sha256
from r3dpa.nn import LatentNorm, VelocityNetwork

__all__ = ["NORM_TOLERANCE", "WeakModel", "read_snapshot", "vae_fingerprint"]

NORM_TOLERANCE = 0.05
"""Largest difference between channels in how the latent scales of two models differ.

On the latents of a frozen VAE at demo size, two running statistics 100 to 900 steps apart differ by
up to 0.031 at batch 4 and 0.014 at batch 32. For Gaussian latents a difference d moves what the
weak model expects by at most 0.77 d standard deviations.
"""


@dataclass(frozen=True)
class WeakModel:
    """Averaged network in evaluation mode on the CPU, with facts about its training.

    Its normalised latents are ``scale * latents + shift`` of those of the model that it guides,
    see :func:`r3dpa.flow.renormalised`; ``shift`` is ``(C,)`` float32.
    """

    path: Path
    sit: VelocityNetwork
    scale: float
    shift: Tensor
    step: int | None
    feature_source: str | None


def read_snapshot(
    path: str | Path,
    strong: Checkpoint,
    weights: Literal["ema", "last"] = "ema",
    allow: bool = False,
) -> WeakModel:
    """Reads a weak model that may guide a given one; any checkpoint with an average will do.

    If both models have one VAE, which stage ``flow_matching`` freezes, normalisations that drifted
    apart are converted, up to :data:`NORM_TOLERANCE`. With another VAE, as after a snapshot of
    stage ``joint``, no conversion exists: the normalised latents of both are equated, which removes
    the drift of mean and scale only, and is refused unless allowed.

    Args:
        path: File of :class:`r3dpa.callbacks.EMASnapshots`, or another checkpoint.
        strong: Checkpoint of the model to be guided.
        weights: Whose latent statistics it uses, those of the average or of the last step.
        allow: Warn of latents that differ instead of refusing them.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file has no average or no fitted statistics, or another latent size, path
            or VAE, or statistics further apart than the tolerance.
    """
    checkpoint = read_checkpoint(path)
    if not {"ema", "ema_latent_norm"} <= set(checkpoint.networks):
        raise ValueError(
            f"{path} is of stage {checkpoint.stage} and holds no averaged SiT with its statistics, "
            f"only {', '.join(checkpoint.networks)}; give a file of a run's snapshots, or a "
            "checkpoint of stage joint or flow_matching"
        )
    sit_name, norm_name = ("ema", "ema_latent_norm") if weights == "ema" else ("sit", "latent_norm")
    size, own_size = _latent_size(checkpoint, "ema"), _latent_size(strong, sit_name)
    if size != own_size:
        raise ValueError(
            f"{path} is a model of latents {size}, {strong.path} one of {own_size}; give a "
            "snapshot of a run with the same VAE and range images"
        )
    if checkpoint.interpolant != strong.interpolant:
        raise ValueError(
            f"{path} was trained on the {checkpoint.interpolant} path, {strong.path} on the "
            f"{strong.interpolant} one; give a snapshot of the same path"
        )
    norms = _norm(checkpoint, "ema_latent_norm"), _norm(strong, norm_name)
    scale, shift, spread = _conversion(*norms)
    problem = None
    vae = _vae_note(checkpoint)
    if vae is None or vae != _vae_note(strong):
        problem = "its latents are those of another VAE, as within stage joint"
        scale, shift = 1.0, torch.zeros_like(shift)
    elif spread > NORM_TOLERANCE:
        problem = (
            f"the scales of its latents differ by {spread:.1%} between channels, more than "
            f"{NORM_TOLERANCE:.0%}"
        )
    if problem is not None:
        problem = f"{path} cannot guide {strong.path} exactly: {problem}"
        if not allow:
            raise ValueError(
                f"{problem}. Give a snapshot of a run of stage flow_matching on this VAE, or allow "
                "the approximation"
            )
        warnings.warn(f"{problem}; allowed: an approximation", stacklevel=2)
    sit = checkpoint.network("ema").build()
    assert isinstance(sit, VelocityNetwork)  # _latent_size
    sit.eval().requires_grad_(False)
    return WeakModel(Path(path), sit, scale, shift, checkpoint.step, checkpoint.feature_source)


def _vae_note(checkpoint: Checkpoint) -> str | None:
    """Fingerprint of the VAE of a checkpoint, None if it has none."""
    if "vae" in checkpoint.networks:
        return vae_fingerprint(checkpoint.network("vae").state_dict)
    return checkpoint.left_out.get("vae")


def vae_fingerprint(vae: Mapping[str, Tensor]) -> str:
    """Description of a VAE that a snapshot leaves out: the hash of its weights."""
    return f"not kept in a snapshot; SHA-256 of its weights: {weights_sha256(vae)}"


def _latent_size(checkpoint: Checkpoint, name: str) -> tuple[int, ...]:
    state = checkpoint.network(name)
    if not issubclass(state.kind, VelocityNetwork):
        raise ValueError(f"{checkpoint.path}: {name} is a {state.class_path}, no velocity network")
    return (state.arguments["in_channels"], *state.arguments["input_size"])


def _norm(checkpoint: Checkpoint, name: str) -> LatentNorm:
    norm = checkpoint.network(name).build()
    if not isinstance(norm, LatentNorm) or not norm.fitted:
        raise ValueError(
            f"{checkpoint.path}: {name} holds no fitted latent statistics; give a checkpoint of "
            "stage joint or flow_matching"
        )
    return norm


def _conversion(weak: LatentNorm, strong: LatentNorm) -> tuple[float, Tensor, float]:
    """From the latents of ``strong`` to those of ``weak``: scale, shift, spread of the scale.

    A latent is ``(raw - mean) / deviation``. The scale is the geometric mean over the channels; the
    spread is how far a channel is from it at most, relative to it.
    """
    deviations = [(norm.running_var + norm.eps).double().sqrt() for norm in (weak, strong)]
    ratios = deviations[1] / deviations[0]
    scale = ratios.log().mean().exp()
    shift = (strong.running_mean - weak.running_mean).double() / deviations[0]
    return scale.item(), shift.float(), (ratios / scale - 1).abs().max().item()

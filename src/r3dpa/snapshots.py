"""Early averages of the SiT: kept while training, read back as weak models for autoguidance."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import lightning as L
import torch
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor

from r3dpa.checkpoints import (
    Checkpoint,
    NetworkState,
    read_checkpoint,
    save_checkpoint,
    weights_sha256,
)
from r3dpa.modules import GenerativeModule
from r3dpa.nn import LatentNorm, VelocityNetwork

__all__ = ["NORM_TOLERANCE", "EMASnapshots", "WeakModel", "read_snapshot"]

NORM_TOLERANCE = 0.05
"""Largest difference between channels in how the latent scales of two models differ.

On the latents of a frozen VAE at demo size, two running statistics 100 to 900 steps apart differ by
up to 0.031 at batch 4 and 0.014 at batch 32. For Gaussian latents a difference d moves what the
weak model expects by at most 0.77 d standard deviations.
"""

_NORM_ARGS = ("channels", "eps", "momentum", "legacy_inverse", "replace_non_finite")


class EMASnapshots(L.Callback):
    """Keeps the averaged SiT at a few early steps, as weak models for autoguidance.

    Each step makes ``<run_dir>/<folder>/step_<step>.safetensors`` with its ``.yaml``: average,
    latent statistics, geometry, and a hash of the VAE, which is not kept. SiT-B/2 takes 550 MB. A
    file that exists is never replaced, so a resumed run adds those that are missing and still
    ahead. A stage without average, or without a SiT, keeps none and says so.

    Source: Karras et al. 2024 guide EDM2-S best by a model after 1/16 of its training.

    Args:
        fractions: Steps as parts of ``trainer.max_steps``, each in (0, 1].
        steps: Optimiser steps, at least 1; where given, ``fractions`` do not count.
        folder: Below the folder of the run.

    Raises:
        ValueError: If a number is out of its range.
    """

    def __init__(
        self,
        fractions: Sequence[float] = (1 / 32, 1 / 16, 1 / 8),
        steps: Sequence[int] | None = None,
        folder: str = "snapshots",
    ) -> None:
        if not all(0 < fraction <= 1 for fraction in fractions):
            raise ValueError(f"snapshot fractions must be in (0, 1], got {list(fractions)}")
        if steps is not None and not all(step >= 1 for step in steps):
            raise ValueError(f"snapshot steps must be at least 1, got {list(steps)}")
        self.fractions = tuple(fractions)
        self.steps = None if steps is None else frozenset(steps)
        self.folder = folder
        self._due: frozenset[int] = frozenset()

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Works out the steps, and refuses early what could not be written.

        Raises:
            ValueError: If the number of steps is not known, or the module not its configuration.
        """
        self._due = frozenset()
        if not isinstance(pl_module, GenerativeModule) or pl_module.ema is None:
            stage = getattr(pl_module, "stage", type(pl_module).__name__)
            rank_zero_info(f"stage {stage} averages no SiT: no snapshots are kept")
            return
        _sit_config(pl_module)
        if cast(Any, trainer).fast_dev_run:
            return
        if self.steps is not None:
            self._due = self.steps
        elif trainer.max_steps > 0:
            self._due = frozenset(max(1, round(f * trainer.max_steps)) for f in self.fractions)
        else:
            raise ValueError(
                f"EMASnapshots needs to know the length of the training, but trainer.max_steps is "
                f"{trainer.max_steps}: set it, or give the callback steps"
            )

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Writes the snapshot of this step if one is due and not there yet."""
        if trainer.global_step not in self._due or not trainer.is_global_zero:
            return
        assert isinstance(pl_module, GenerativeModule)
        step = trainer.global_step
        path = Path(trainer.default_root_dir) / self.folder / f"step_{step:07d}.safetensors"
        if not path.exists():  # with accumulated gradients, several batches end at one step
            # A description without weights may be left of a run that was killed: overwrite.
            save_checkpoint(_checkpoint(pl_module, path, step), path, overwrite=True)


@dataclass(frozen=True)
class WeakModel:
    """What :func:`read_snapshot` reads.

    Args:
        path: Its file.
        sit: Averaged network, in evaluation mode on the CPU.
        scale: Its normalised latents are ``scale * latents + shift`` of those of the model that it
            guides, see :func:`r3dpa.flow.autoguidance.renormalised`.
        shift: ``(C,)`` float32.
        step: Optimiser steps that it was trained for, if known.
        feature_source: Feature source of its training, if known.
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

    Latents mean the same to both only if one VAE made them: then normalisations that drifted apart
    are converted exactly but for differences between channels, see :data:`NORM_TOLERANCE`. Stage
    ``flow_matching`` freezes the VAE. In stage ``joint`` the VAE moves between a snapshot and the
    end, and no conversion exists: guidance is a guess there, and refused unless allowed. It then
    takes each model's normalised latents for the same, since the normalisation removes at least
    what moved in mean and scale.

    Args:
        path: File of :class:`EMASnapshots`, or another checkpoint.
        strong: Checkpoint of the model to be guided.
        weights: Whose latent statistics it uses, those of the average or of the last step.
        allow: Warn of latents that differ instead of refusing them.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no weak model of this one: no average or no fitted statistics, other
            latent size or path, other VAE, or statistics further apart than the tolerance.
    """
    checkpoint = read_checkpoint(path)
    if not {"ema", "ema_latent_norm"} <= set(checkpoint.networks):
        raise ValueError(
            f"{path} is of stage {checkpoint.stage} and holds no averaged SiT with its statistics, "
            f"only {', '.join(checkpoint.networks)}; give a file of a run's snapshots, or a "
            "checkpoint of stage joint or flow_matching"
        )
    names = ("ema", "ema_latent_norm") if weights == "ema" else ("sit", "latent_norm")
    sizes = [_latent_size(c, name) for c, name in ((checkpoint, "ema"), (strong, names[0]))]
    if sizes[0] != sizes[1]:
        raise ValueError(
            f"{path} is a model of latents {sizes[0]}, {strong.path} one of {sizes[1]}; give a "
            "snapshot of a run with the same VAE and range images"
        )
    if checkpoint.interpolant != strong.interpolant:
        raise ValueError(
            f"{path} was trained on the {checkpoint.interpolant} path, {strong.path} on the "
            f"{strong.interpolant} one; give a snapshot of the same path"
        )
    norm = _norm(checkpoint, "ema_latent_norm")
    scale, shift, spread = _conversion(norm, _norm(strong, names[1]))
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


def _checkpoint(module: GenerativeModule, path: Path, step: int) -> Checkpoint:
    assert module.ema is not None
    about: dict[str, Any] = {"state_dict": {}}
    module.on_save_checkpoint(about)
    config, sit, norm = _sit_config(module), module.ema.sit, module.ema.latent_norm
    networks = {
        "ema": NetworkState(config["class_path"], config.get("init_args") or {}, sit.state_dict()),
        "ema_latent_norm": NetworkState.of(
            norm, {name: getattr(norm, name) for name in _NORM_ARGS}
        ),
    }
    return Checkpoint(
        path=path,
        networks=networks,
        step=step,
        left_out={"vae": _note(module.vae.state_dict())},
        **about["r3dpa"],
    )


def _sit_config(module: GenerativeModule) -> Mapping[str, Any]:
    """Class and arguments of the SiT, as ``r3dpa fit`` records them."""
    config = module.hparams["sit"]
    if not isinstance(config, Mapping):
        raise ValueError(
            "EMASnapshots writes class and arguments of the SiT, which a module built by hand does "
            "not know; train with `r3dpa fit`, or leave the callback out"
        )
    return config


def _vae_note(checkpoint: Checkpoint) -> str | None:
    """What tells the VAE of a checkpoint from others; None if nothing does, which is no VAE's."""
    if "vae" in checkpoint.networks:
        return _note(checkpoint.network("vae").state_dict)
    return checkpoint.left_out.get("vae")


def _note(vae: Mapping[str, Tensor]) -> str:
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

"""Early averages of the SiT, kept while training as weak models for autoguidance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import lightning as L
from jsonargparse.typing import ClosedUnitInterval, PositiveInt
from lightning.pytorch.utilities import rank_zero_info

from r3dpa.checkpoints import Checkpoint, NetworkState, save_checkpoint, vae_fingerprint
from r3dpa.modules import GenerativeModule
from r3dpa.nn import EMA

_NORM_ARGS = ("channels", "eps", "momentum", "legacy_inverse", "replace_non_finite")


class EMASnapshots(L.Callback):
    """Keeps the averaged SiT at a few early steps, as weak models for autoguidance.

    Each step makes ``<run_dir>/snapshots/step_<step>.safetensors`` with its ``.yaml``: average,
    latent statistics, geometry, and a hash of the VAE, which is not kept. SiT-B/2 takes 550 MB. A
    run that is resumed from an earlier step replaces them. A stage without average writes none, nor
    does one that trains its VAE: no later SiT would have the same latents.

    Source: Karras et al. 2024 guide EDM2-S best by a model after 1/16 of its training.

    Args:
        fractions: Steps as parts of ``trainer.max_steps``, in [0, 1].
        steps: Optimiser steps, 1 or greater; overrides ``fractions``.
    """

    def __init__(
        self,
        fractions: Sequence[ClosedUnitInterval] = (1 / 32, 1 / 16, 1 / 8),
        steps: Sequence[PositiveInt] | None = None,
    ) -> None:
        self.fractions = tuple(fractions)
        self.steps = None if steps is None else frozenset(steps)
        self._due: frozenset[int] = frozenset()
        self._step = 0  # after the last batch

    @staticmethod
    def average_of(module: L.LightningModule) -> EMA | None:
        """Average of a stage, None where it has none or trains the VAE that gives the latents."""
        if not isinstance(module, GenerativeModule) or "vae" in module.trainable():
            return None
        return module.ema

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Determine the steps, and refuse early what could not be written."""
        self._due = frozenset()
        if self.average_of(pl_module) is None:
            stage = getattr(pl_module, "stage", type(pl_module).__name__)
            rank_zero_info(
                f"stage {stage} averages no SiT over fixed latents: no snapshots are kept"
            )
            return
        assert isinstance(pl_module, GenerativeModule)
        _sit_config(pl_module)
        if cast(Any, trainer).fast_dev_run:
            return
        run_dir = Path(trainer.default_root_dir).resolve()
        folder = run_dir / "snapshots"
        resumed = run_dir in Path(trainer.ckpt_path or "").resolve().parents
        if not resumed and any(folder.glob("step_*")):
            raise ValueError(
                f"{folder} holds snapshots of an earlier run: delete them, or give "
                "another --run_dir"
            )
        if self.steps is not None:
            self._due = self.steps
        elif trainer.max_steps > 0:
            self._due = frozenset(max(1, round(f * trainer.max_steps)) for f in self.fractions)
        else:
            raise ValueError(
                "EMASnapshots needs to know the length of the training, but --trainer.max_steps "
                f"is {trainer.max_steps}: set it, or give the callback steps"
            )

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Record the step that training resumes from; its snapshot is not rewritten."""
        self._step = trainer.global_step

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any, **kwargs: Any
    ) -> None:
        """Write the snapshot of this step if one is due."""
        step = trainer.global_step
        if step == self._step:  # with accumulated gradients, several batches end at one step
            return
        self._step = step
        if step not in self._due or not trainer.is_global_zero:
            return
        assert isinstance(pl_module, GenerativeModule)
        path = Path(trainer.default_root_dir) / "snapshots" / f"step_{step:07d}.safetensors"
        # Of a run that was killed, one may be left of steps after its last checkpoint: overwrite.
        save_checkpoint(_checkpoint(pl_module, path, step), path, overwrite=True)


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
        left_out={"vae": vae_fingerprint(module.vae.state_dict())},
        **about["r3dpa"],
    )


def _sit_config(module: GenerativeModule) -> Mapping[str, Any]:
    config = module.hparams["sit"]
    if not isinstance(config, Mapping):
        raise ValueError(
            "EMASnapshots writes class and arguments of the SiT, which a module built by hand does "
            "not know; train with `r3dpa fit`, or leave the callback out"
        )
    return config

"""Files of the batches that broke a training step, complete enough to run them again."""

from __future__ import annotations

import math
import pickle
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule
from torch import Tensor

from r3dpa.io import save_tensors
from r3dpa.modules import GenerativeModule
from r3dpa.modules.stage import PathDraws


def save_bad_batch(
    folder: Path, module: GenerativeModule, batch: Mapping[str, Any], number: int, losses: Any
) -> Path:
    """Write a batch with the draws, loss weights and losses of its step; return the file."""
    tensors = {key: value for key, value in batch.items() if isinstance(value, Tensor)}
    draws = module.draw_path(len(next(iter(tensors.values()))), number)
    weights = asdict(module.weights)
    weights["adversarial_start"] -= module.global_step  # it is run again at step 0
    weights["alignment_stop"] = 0 if module.alignment_ended else None
    content = {
        "stage": module.stage,
        "step": module.global_step,
        "precision": str(module.trainer.precision),
        "path": module.interpolant.path,
        "losses": losses,
        "weights": weights,
        "latent_noise": module.latent_noise,
        "further_dropout": module.further_dropout,
        "batch": {key: value.cpu() for key, value in tensors.items()},
        "draws": {key: value.cpu() for key, value in draws._asdict().items()},
    }
    path = folder / f"step_{module.global_step:07d}_batch_{number:07d}_rank_{module.global_rank}.pt"
    save_tensors(content, path)
    return path


def list_bad_batches(folder: Path) -> list[Path]:
    """Files of :func:`save_bad_batch` in a folder, the newest last."""
    return sorted(folder.glob("step_*.pt"), key=lambda path: (path.stat().st_mtime_ns, path))


def read_bad_batch(path: Path) -> dict[str, Any]:
    """Read a file of :func:`save_bad_batch`.

    Raises:
        ValueError: If it is a folder, or the file is damaged; the error names it.
    """
    if path.is_dir():
        names = ", ".join(file.name for file in list_bad_batches(path))
        what = f"give one of its files: {names}" if names else "it holds no saved batch"
        raise ValueError(f"{path} is a folder; {what}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        return content | {"draws": PathDraws(**content["draws"])}
    except (pickle.UnpicklingError, RuntimeError, LookupError, TypeError, EOFError) as error:
        raise ValueError(f"{path} is no saved batch of r3dpa, or damaged: {error}") from error


def report_bad_batches(
    module: LightningModule,
    batches: list[tuple[int, Any, dict[str, Tensor]]],
    norms: str,
    most: int,
) -> None:
    """Report and save the batches with a non-finite loss, or all batches if none has one."""
    folder = Path(module.trainer.default_root_dir) / "bad_batches"
    entries = [
        (number, batch, {name: float(loss) for name, loss in losses.items()})
        for number, batch, losses in batches
    ]
    broken = [entry for entry in entries if not all(map(math.isfinite, entry[2].values()))]
    for number, batch, losses in broken or entries:
        names = list(batch.get("name", ())) if isinstance(batch, dict) else []
        place = "not saved"
        num_saved = len(list(folder.glob(f"step_*_rank_{module.global_rank}.pt")))
        if num_saved < most and isinstance(module, GenerativeModule):
            try:
                place = f"saved in {save_bad_batch(folder, module, batch, number, losses)}"
            except OSError as error:  # a full disk is no reason to end a run that could go on
                place = f"not saved: {error}"
        warnings.warn(
            f"step {module.global_step} was skipped: losses {format_values(losses)}; "
            f"gradient norms {norms}; samples {', '.join(names) or 'without names'} "
            f"(batch {number}, process {module.global_rank}), {place}",
            stacklevel=2,
        )


def format_values(values: Mapping[str, float]) -> str:
    """Write names and values in one line."""
    return ", ".join(f"{name} {value:.3g}" for name, value in values.items()) or "unknown"

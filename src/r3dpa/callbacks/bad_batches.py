"""Files of the batches that broke a training step, complete enough to run them again."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from r3dpa.io import atomic_path
from r3dpa.modules import GenerativeModule
from r3dpa.modules.settings import LossWeights
from r3dpa.modules.steps import PathDraws

_FORMAT = "r3dpa bad batch 1"


@dataclass(frozen=True)
class BadBatch:
    """One process's batch of a skipped step, with its draws, losses and settings."""

    tensors: dict[str, Tensor]
    draws: PathDraws
    weights: LossWeights
    about: dict[str, Any]  # see _bad_batch

    def save(self, folder: Path) -> Path:
        """Writes ``<folder>/step_<step>_batch_<number>_rank_<rank>.safetensors``."""
        name = "step_{step:07d}_batch_{number:07d}_rank_{rank}.safetensors".format(**self.about)
        about = self.about | {"format": _FORMAT, "weights": asdict(self.weights)}
        tensors = {f"batch.{key}": value for key, value in self.tensors.items()}
        tensors |= {f"draws.{key}": value for key, value in self.draws._asdict().items()}
        tensors = {key: value.detach().cpu().contiguous() for key, value in tensors.items()}
        with atomic_path(folder / name) as temporary:
            save_file(tensors, temporary, {"r3dpa": json.dumps(about)})
        return folder / name

    @classmethod
    def read(cls, path: Path) -> BadBatch:
        """Reads what :meth:`save` wrote; another or a damaged file is named in a ValueError."""
        try:
            with safe_open(path, framework="pt") as file:
                about = json.loads((file.metadata() or {}).get("r3dpa", "{}"))
                if about.pop("format", None) != _FORMAT:
                    raise ValueError("it was not written by a training of r3dpa")
                found = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
            draws, tensors = (
                {k.removeprefix(part): v for k, v in found.items() if k.startswith(part)}
                for part in ("draws.", "batch.")
            )
            return cls(tensors, PathDraws(**draws), LossWeights(**about.pop("weights")), about)
        except (SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} is no saved batch of r3dpa, or damaged: {error}") from error


def report_skipped(
    module: Any,
    batches: Iterable[tuple[int, Any, Mapping[str, Tensor]]],
    norms: dict[str, float],
    most: int,
) -> None:
    """Names and keeps those batches of a skipped step that have a non-finite loss, or all."""
    values = [(n, batch, {k: float(v) for k, v in ls.items()}) for n, batch, ls in batches]
    broken = [value for value in values if not all(map(math.isfinite, value[2].values()))]
    folder, rank = Path(module.trainer.default_root_dir) / "bad_batches", module.global_rank
    for number, batch, losses in broken or values:
        names = list(batch.get("name", ())) if isinstance(batch, dict) else []
        if not isinstance(module, GenerativeModule):
            kept = "not kept: only batches of range images are"
        elif len(list(folder.glob(f"step_*_rank_{rank}.safetensors"))) >= most:
            kept = f"not kept: {folder} holds enough"
        else:
            try:
                about = {"number": number, "losses": losses, "grad_norms": norms, "names": names}
                kept = f"kept in {_bad_batch(module, batch, about).save(folder)}"
            except OSError as error:  # a full disk is no reason to end a run that could go on
                kept = f"not kept: {error}"
        warnings.warn(
            f"step {module.global_step} was skipped: losses {listed(losses)}; gradient norms "
            f"{listed(norms)}; samples {', '.join(names) or 'without names'} (batch {number}, "
            f"process {rank}), {kept}",
            stacklevel=2,
        )


def _bad_batch(module: GenerativeModule, batch: Mapping[str, Any], about: Any) -> BadBatch:
    about |= {
        "stage": module.stage,
        "step": module.global_step,
        "seed": module.seed,
        "rank": module.global_rank,
        "world_size": module.trainer.world_size,
        "precision": str(module.trainer.precision),
        "path": module.interpolant.path,
    }
    tensors = {key: value for key, value in batch.items() if isinstance(value, Tensor)}
    draws = module.draw_path(len(next(iter(tensors.values()))), about["number"])
    return BadBatch(tensors, draws, module.weights, about)


def listed(values: Mapping[str, float]) -> str:
    """Names and values in one line."""
    return ", ".join(f"{name} {value:.3g}" for name, value in values.items()) or "unknown"

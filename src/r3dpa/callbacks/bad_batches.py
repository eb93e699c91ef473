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
from r3dpa.modules.settings import LossWeights, PathName
from r3dpa.modules.steps import PathDraws

_FORMAT = "r3dpa bad batch 1"


@dataclass(frozen=True)
class BadBatch:
    """One process's batch of a skipped step: its tensors on the CPU, draws, losses and settings."""

    tensors: dict[str, Tensor]
    names: list[str]
    draws: PathDraws
    stage: str
    step: int
    number: int
    seed: int
    rank: int
    world_size: int
    precision: str
    path: PathName
    weights: LossWeights
    losses: dict[str, float]
    grad_norms: dict[str, float]

    def save(self, folder: Path) -> Path:
        """Writes ``<folder>/step_<step>_batch_<number>_rank_<rank>.safetensors``."""
        name = f"step_{self.step:07d}_batch_{self.number:07d}_rank_{self.rank}.safetensors"
        skipped = ("tensors", "draws", "weights")
        about = {key: value for key, value in vars(self).items() if key not in skipped}
        about |= {"format": _FORMAT, "weights": asdict(self.weights)}
        tensors = {f"batch.{key}": value for key, value in self.tensors.items()}
        tensors |= {f"draws.{key}": value for key, value in self.draws._asdict().items()}
        tensors = {key: value.detach().cpu().contiguous() for key, value in tensors.items()}
        with atomic_path(folder / name) as temporary:
            save_file(tensors, temporary, {"r3dpa": json.dumps(about)})
        return folder / name

    @classmethod
    def read(cls, path: Path) -> BadBatch:
        """Reads what :meth:`save` wrote.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it is damaged or another file; it is named.
        """
        if not path.is_file():
            raise FileNotFoundError(f"no file {path}; give one of <run_dir>/bad_batches")
        try:
            with safe_open(path, framework="pt") as file:
                about = json.loads((file.metadata() or {}).get("r3dpa", "{}"))
                if about.pop("format", None) != _FORMAT:
                    raise ValueError("it was not written by a training of r3dpa")
                found = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
            draws = PathDraws(*(found.pop(f"draws.{key}") for key in PathDraws._fields))
            tensors = {key.removeprefix("batch."): value for key, value in found.items()}
            weights = LossWeights(**about.pop("weights"))
            return cls(tensors=tensors, draws=draws, weights=weights, **about)
        except (SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} is no saved batch of r3dpa, or damaged: {error}") from error


def report_skipped(
    module: Any,
    batches: Iterable[tuple[int, Any, Mapping[str, Tensor]]],
    grad_norms: Mapping[str, float],
    most: int,
) -> None:
    """Warns of the batches of a skipped step that are at fault, and keeps them.

    Those are the ones with a loss that is not finite, or all where the fault came with the
    gradients.

    Args:
        module: Module in training.
        batches: Number, content and losses of each batch of the step.
        grad_norms: Gradient norm by network.
        most: Files of this process that ``<run_dir>/bad_batches`` may hold.
    """
    values = [(n, content, {k: float(v) for k, v in ls.items()}) for n, content, ls in batches]
    broken = [batch for batch in values if not all(map(math.isfinite, batch[2].values()))]
    for number, content, losses in broken or values:
        names = list(content.get("name", ())) if isinstance(content, dict) else []
        try:
            kept = _keep(module, content, names, number, losses, dict(grad_norms), most)
        except OSError as error:  # a full disk is no reason to end a run that could go on
            kept = f"not kept: {error}"
        warnings.warn(
            f"step {module.global_step} was skipped: losses {listed(losses)}; gradient norms "
            f"{listed(grad_norms)}; samples {', '.join(names) or 'without names'} (batch {number}, "
            f"process {module.global_rank}), {kept}",
            stacklevel=2,
        )


def _keep(
    module: Any,
    content: Any,
    names: list[str],
    number: int,
    losses: dict[str, float],
    grad_norms: dict[str, float],
    most: int,
) -> str:
    if not isinstance(module, GenerativeModule):
        return "not kept: only batches of range images are"
    folder = Path(module.trainer.default_root_dir) / "bad_batches"
    if len(list(folder.glob(f"step_*_rank_{module.global_rank}.safetensors"))) >= most:
        return f"not kept: {folder} holds enough"
    tensors = {key: value for key, value in content.items() if isinstance(value, Tensor)}
    batch = BadBatch(
        tensors=tensors,
        names=names,
        draws=module.draw_path(len(next(iter(tensors.values()))), number),
        stage=module.stage,
        step=module.global_step,
        number=number,
        seed=module.seed,
        rank=module.global_rank,
        world_size=module.trainer.world_size,
        precision=str(module.trainer.precision),
        path=module.interpolant.path,
        weights=module.weights,
        losses=losses,
        grad_norms=grad_norms,
    )
    return f"kept in {batch.save(folder)}"


def listed(values: Mapping[str, float]) -> str:
    """Names and values in one line."""
    return ", ".join(f"{name} {value:.3g}" for name, value in values.items()) or "unknown"

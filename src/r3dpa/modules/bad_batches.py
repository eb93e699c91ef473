"""Files of the batches that broke a training step, complete enough to run them again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from r3dpa.io import atomic_path
from r3dpa.modules.settings import LossWeights, PathName
from r3dpa.modules.step_losses import PathDraws

__all__ = ["BadBatch"]

_FORMAT = "r3dpa bad batch 1"


@dataclass(frozen=True)
class BadBatch:
    """One process's batch of a step that was skipped.

    Args:
        tensors: Its tensors by the names of :class:`r3dpa.data.LidarBatch`, on the CPU.
        names: Names of the scans.
        draws: Random numbers of the step for these scans.
        stage: Stage that was trained.
        step: Optimiser step, counting skipped ones.
        number: Number of the batch since the start of training.
        seed: Key of the training draws.
        rank: Process that had the batch, of ``world_size``.
        world_size: Number of processes.
        precision: Of the trainer.
        path: Interpolant.
        weights: Loss weights.
        losses: Losses as they were, without weights; ``loss`` is the weighted sum.
        grad_norms: Gradient norm by network, of all batches of the step together.
    """

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

    @property
    def content(self) -> dict[str, Any]:
        """The batch as the training step received it."""
        return {**self.tensors, "name": self.names}

    def save(self, folder: Path, most: int) -> Path | None:
        """Writes the batch unless the folder holds ``most`` of this process.

        Returns:
            ``<folder>/step_<step>_batch_<number>_rank_<rank>.safetensors``, or None.

        Raises:
            OSError: If it cannot be written.
        """
        if len(list(folder.glob(f"step_*_rank_{self.rank}.safetensors"))) >= most:
            return None
        name = f"step_{self.step:07d}_batch_{self.number:07d}_rank_{self.rank}.safetensors"
        about: dict[str, Any] = {
            key: getattr(self, key)
            for key in self.__dataclass_fields__
            if key not in ("tensors", "draws", "weights")
        }
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
                tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
            draws = PathDraws(*(tensors.pop(f"draws.{key}") for key in PathDraws._fields))
            return cls(
                tensors={key.removeprefix("batch."): value for key, value in tensors.items()},
                draws=draws,
                weights=LossWeights(**about.pop("weights")),
                **about,
            )
        except (SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} is no saved batch of r3dpa, or damaged: {error}") from error


def tensors_of(batch: Mapping[str, Any]) -> dict[str, Tensor]:
    """The tensors of a batch."""
    return {key: value for key, value in batch.items() if isinstance(value, torch.Tensor)}

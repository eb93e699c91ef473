"""Registry of the stages whose checkpoints are sampled: R3DPA's own, and the baselines."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from r3dpa.checkpoints import Checkpoint
from r3dpa.flow.sampler import Quality, SamplerConfig
from r3dpa.generation import SceneGenerator, open_checkpoint

if TYPE_CHECKING:
    from r3dpa.baselines import BaselineGenerator

BASELINE_STAGES = ("r2dm", "r2flow", "lidm")


def published_sampler(checkpoint: Checkpoint) -> SamplerConfig:
    """Sampler of the paper or the released script of a baseline."""
    from r3dpa.baselines import baseline_of

    return baseline_of(checkpoint).published


def scene_generator(
    checkpoint: str | Path | Checkpoint,
    sampler: SamplerConfig | Quality | None = None,
    *,
    weights: Literal["ema", "last"] = "ema",
    device: str = "auto",
    **options: Any,
) -> SceneGenerator | BaselineGenerator:
    """Generator of a checkpoint, by the stage that it names.

    Args:
        checkpoint: File, name or content.
        sampler: Solver and steps, or a quality, which was measured for R3DPA alone. Default:
            ``good``, or the published sampler of a baseline.
        weights: Averaged or last weights.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
        **options: See :meth:`r3dpa.SceneGenerator.from_checkpoint`, or
            :class:`r3dpa.baselines.BaselineGenerator`.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read, or lacks something to sample from.
    """
    checkpoint = open_checkpoint(checkpoint)
    if checkpoint.stage in BASELINE_STAGES:
        from r3dpa.baselines import baseline_generator

        return baseline_generator(checkpoint, sampler, weights=weights, device=device, **options)
    return SceneGenerator.from_checkpoint(
        checkpoint, sampler or "good", weights=weights, device=device, **options
    )

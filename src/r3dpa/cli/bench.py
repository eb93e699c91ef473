"""``r3dpa bench``: speed and accuracy of sampling, cost of training steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from r3dpa.cli.options import check_file, check_folder

__all__ = ["sampling", "training"]


def training(
    *,
    conf: Path | None = None,
    stages: tuple[str, ...] = ("vae_alignment", "joint", "flow_matching"),
    batch_size: int = 1,
    steps: int = 2,
    precision: Literal["32-true", "bf16-mixed"] = "32-true",
    device: Literal["auto", "cpu", "cuda"] = "auto",
    out: Path | None = None,
    quick: bool = False,
) -> Any:
    """Train each stage for a few steps at its real size; print time, memory, work and speed.

    Args:
        conf: Folder of the configurations; default: those of the package.
        stages: Experiments below ``<conf>/experiment``; one process each.
        batch_size: Scans per step.
        steps: Optimiser steps; two are needed for the peak memory of a long run.
        precision: Precision as the Trainer names it.
        device: ``cpu``, ``cuda``, or ``auto`` for the GPU if there is one.
        out: JSON file for the same figures.
        quick: The demo's networks.
    """
    from r3dpa.bench.training import StepSettings
    from r3dpa.bench.training import training as measure
    from r3dpa.cli.stages import conf_folder

    check_file(out)
    settings = StepSettings(batch_size, steps, precision, device, quick)
    return measure(conf or conf_folder(), stages, settings, out)


def sampling(
    *,
    out: Path,
    ckpt: Path | None = None,
    quick: bool = False,
    scenes: int | None = None,
    batch_size: int | None = None,
    rounds: int | None = None,
    nfe: list[int] | None = None,
    reference_steps: int | None = None,
    device: str = "auto",
) -> Any:
    """Measure accuracy against time for an exact velocity and a trained model; draw both.

    The same command completes an interrupted run.

    Args:
        out: Folder for tables, pictures and ``quality.json``.
        ckpt: Checkpoint of stage joint or flow_matching; default: only a mixture of Gaussians
            whose velocity is exact.
        quick: Few scenes, steps and rounds: minutes on a CPU.
        scenes: Scenes of each sampler; default: 256, or 8 with ``--quick``.
        batch_size: Scenes computed together; default: 64 on a GPU, 4 on a CPU.
        rounds: Rounds of the timing; default: 20, or 3 with ``--quick``.
        nfe: Network evaluations per scene; default: 2 to 256, or 4 to 32 with ``--quick``.
        reference_steps: Heun steps of the converged solution, an even number; default: 1000, or
            200 with ``--quick``.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    from r3dpa.bench.sampling import sampling as measure

    check_folder(out)
    effort = {
        "samples": scenes,
        "reference_steps": reference_steps,
        "evaluations": None if nfe is None else tuple(sorted(set(nfe))),
        "rounds": rounds,
        "batch": batch_size,
    }
    return measure(out, ckpt, quick, effort, device)

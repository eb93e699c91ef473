"""The commands of ``r3dpa bench``; heavy imports stay inside."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from r3dpa.cli.files import check_file, check_folder, print_text

__all__ = ["BENCHES"]


def bench_training(
    conf: Path = Path("conf"),
    stages: tuple[str, ...] = ("vae_alignment", "joint", "flow_matching"),
    batch_size: int = 1,
    steps: int = 2,
    precision: Literal["32-true", "bf16-mixed"] = "32-true",
    device: Literal["auto", "cpu", "cuda"] = "auto",
    out: Path | None = None,
    quick: bool = False,
) -> None:
    """Train each stage for a few steps at its real size; print time, memory, work and speed.

    Args:
        conf: Folder of the configurations.
        stages: Experiments below ``<conf>/experiment``, such as ``[joint]``; one process each.
        batch_size: Scans per step.
        steps: Optimiser steps; two are needed for the peak memory of a long run.
        precision: Precision as the Trainer names it.
        device: ``cpu``, ``cuda``, or ``auto`` for the GPU where there is one.
        out: JSON file for the same figures.
        quick: The demo's networks.
    """
    from r3dpa.bench.training import StepSettings, training

    check_file(out)
    settings = StepSettings(batch_size, steps, precision, device, quick)
    print_text(training(conf, stages, settings, out))


def bench_sampling(
    out: Path,
    ckpt: Path | None = None,
    quick: bool = False,
    scenes: int | None = None,
    batch_size: int | None = None,
    rounds: int | None = None,
    nfe: list[int] | None = None,
    reference_steps: int | None = None,
    device: str = "auto",
) -> None:
    """Measure what accuracy costs in time, for an exact velocity and a trained model; draw it.

    Interrupted, the same command goes on.

    Args:
        out: Folder for tables, pictures and ``quality.json``.
        ckpt: Checkpoint of stage joint or flow_matching; without one only a mixture of Gaussians
            whose velocity is exact.
        quick: Few scenes, steps and rounds: minutes on a CPU.
        scenes: Solved by each way to sample; 256, or 8 with ``--quick``.
        batch_size: Scenes computed together; 64 on a GPU, 4 on a CPU.
        rounds: Of the timing; 20, or 3 with ``--quick``.
        nfe: Network evaluations a scene; 2 to 256, or 4 to 32 with ``--quick``.
        reference_steps: Heun steps of the converged solution, an even number; 1000, or 200 with
            ``--quick``.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    from r3dpa.bench.sampling import sampling

    check_folder(out)
    effort = {
        "samples": scenes,
        "reference_steps": reference_steps,
        "evaluations": None if nfe is None else tuple(sorted(set(nfe))),
        "rounds": rounds,
        "batch": batch_size,
    }
    print_text(sampling(out, ckpt, quick, effort, device))


BENCHES: dict[str, Callable[..., None]] = {
    "training": bench_training,
    "sampling": bench_sampling,
}

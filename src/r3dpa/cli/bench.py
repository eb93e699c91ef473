"""``r3dpa bench`` and ``ablate``: cost of sampling and training, and the paper's ablations."""

from __future__ import annotations

import shlex
import sys
import warnings
from collections.abc import Sequence
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any, Literal

import yaml
from jsonargparse.typing import PositiveInt

from r3dpa.cli.messages import suggestion
from r3dpa.cli.presets import conf_folder, shipped
from r3dpa.io import check_file, check_folder


def training(
    *,
    stages: tuple[str, ...] = ("vae_alignment", "joint", "flow_matching"),
    batch_size: PositiveInt = 1,
    steps: PositiveInt = 2,
    precision: Literal["32-true", "bf16-mixed"] = "32-true",
    device: Literal["auto", "cpu", "cuda"] = "auto",
    out: Path | None = None,
    quick: bool = False,
) -> Any:
    """Train each stage for a few steps at its real size; print time, memory, work and speed.

    Args:
        stages: Experiments below ``conf/experiment``; one process each.
        batch_size: Scans per step.
        steps: Optimiser steps; two are needed for the peak memory of a long run.
        precision: Precision as the Trainer names it.
        device: ``cpu``, ``cuda``, or ``auto`` for the GPU if there is one.
        out: JSON file for the same figures.
        quick: The demo's networks.
    """
    from r3dpa.bench import training as bench

    check_file(out)
    settings = bench.StepSettings(batch_size, steps, precision, device, quick)
    return bench.training(conf_folder(), stages, settings, out)


def sampling(
    *,
    out: Path,
    ckpt: Path | None = None,
    quick: bool = False,
    scenes: PositiveInt | None = None,
    batch_size: PositiveInt | None = None,
    rounds: PositiveInt | None = None,
    nfe: list[PositiveInt] | None = None,
    reference_steps: PositiveInt | None = None,
    device: str = "auto",
) -> Any:
    """Measure accuracy against time for an exact velocity and a trained model; draw both.

    The same command completes an interrupted run. Numbers of scenes, rounds, evaluations and steps
    are for the model, and refused without ``--ckpt``.

    Args:
        out: Folder for table, picture and figures.
        ckpt: Checkpoint of stage joint, flow_matching or few_step, such as ``r3dpa-s``; default:
            only a mixture of Gaussians whose velocity is exact.
        quick: Few scenes, steps and rounds: minutes on a CPU.
        scenes: Scenes of each sampler; default: 256, or 8 with ``--quick``.
        batch_size: Scenes computed together; default: 64 on a GPU, 4 on a CPU.
        rounds: Rounds of the timing; default: 20, or 3 with ``--quick``.
        nfe: Network evaluations per scene; default: 2 to 256, or 4 to 32 with ``--quick``.
        reference_steps: Heun steps of the converged solution, an even number; default: 1000, or
            200 with ``--quick``.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    check_folder(out)
    options = {
        "--num": scenes,
        "--batch_size": batch_size,
        "--rounds": rounds,
        "--nfe": nfe,
        "--reference_steps": reference_steps,
    }
    given = [option for option, value in options.items() if value is not None]
    if given and ckpt is None:
        raise ValueError(f"{', '.join(given)}: for a model, give --ckpt, such as r3dpa-s")
    from r3dpa.bench.sampling import sampling as measure

    effort = {
        "samples": scenes,
        "reference_steps": reference_steps,
        "evaluations": tuple(sorted(set(nfe))) if nfe else None,
        "rounds": rounds,
        "batch": batch_size,
    }
    return measure(out, ckpt, quick, effort, device)


def ablate(
    tables: Path,
    *,
    scale: str = "demo",
    seeds: tuple[int, ...] = (0,),
    out: Path | None = None,
    jobs: PositiveInt = 1,
    rgb_weights: Path | None = None,
    released: dict[str, Path] | None = None,
    wandb: Literal["offline", "online", "off"] = "offline",
    budget_only: bool = False,
) -> None:
    """Train, test and compare the rows of the paper's ablations.

    Prints number and length of the trainings, runs each once, however many rows and tables share
    it, and writes ``<table>.md``, ``.tex``, ``.csv`` and ``.json``. The same command continues an
    interrupted run. A row that fails does not stop the others; the exit status is then 1.

    Args:
        tables: A table, such as ``conf/ablation/table_3`` (also found in the package), or a folder
            of tables: ``conf/ablation``.
        scale: ``demo`` for CPU cores, ``s`` for the data and the SiT of ``make r3dpa-s``,
            ``small`` for half an hour of one GPU, ``paper``; or a YAML file of that kind.
        seeds: Train and test every row for each, such as ``0 1 2``.
        out: Folder for everything; default: ``runs/ablation/<scale>``.
        jobs: Trainings and tests at a time; they share the cores, and all use the first GPU.
        rgb_weights: RGB-pretrained SiT, official ``.pt`` or ours, instead of pretraining one.
        released: Released checkpoint to sample, or folder of released samples, by the name of the
            row that it stands for, such as ``--released.r2dm r2dm-h-kitti360-300k.pth``.
        wandb: One run for each row and seed, ``offline`` in ``<out>/wandb`` for ``wandb sync``, or
            ``online``.
        budget_only: Print number and length of the trainings, and start nothing.
    """
    tables, scale_file = _find_tables(tables), Path(scale)
    if scale_file.suffix not in (".yaml", ".yml"):
        parent = tables if tables.is_dir() else tables.parent
        scale_file = parent / "scale" / f"{scale}.yaml"
    if not scale_file.is_file():
        known = sorted(path.stem for path in scale_file.parent.glob("*.yaml"))
        choices = ", ".join(known) or "your files"
        raise ValueError(
            f"unknown scale '{scale}'{suggestion(scale, known)}; choose from {choices}"
        )
    from r3dpa import ablation
    from r3dpa.io import only_writer

    folder = out or Path("runs/ablation") / scale_file.stem
    check_folder(folder)
    plan = ablation.make_plan(
        tables, scale_file, seeds, folder, resolve_config, rgb_weights, released
    )
    _say(ablation.budget_of(plan))
    if budget_only:
        return
    with only_writer(folder / ".ablate.lock", f"runs r3dpa ablate in {folder}"):
        failed = ablation.run_plan(plan, _say, jobs)
        for table in plan.tables:
            text, results = ablation.write_table(plan, table, failed)
            _say(f"\n{text}")
            if wandb != "off":
                ablation.log_rows(plan, table, results, wandb)
    for name, reason in failed.items():
        _say(f"failed: {name}: {reason}")
    files = [folder / f"{table.name}.md" for table in plan.tables]
    _say(f"tables: {', '.join(str(file) for file in files if file.is_file()) or 'none'}")
    if failed:
        sys.exit(1)


def _find_tables(tables: Path) -> Path:
    """Return the file or folder of tables, here or in the package.

    Raises:
        ValueError: If there is none.
    """
    path = shipped(tables)
    if not path.exists() and not path.suffix:
        path = shipped(f"{tables}.yaml")
    if not path.exists():
        known = sorted(table.stem for table in (conf_folder() / "ablation").glob("*.yaml"))
        near = suggestion(tables.stem, known, "conf/ablation/")
        raise ValueError(
            f"{tables}: no table or folder of tables{near}; choose from conf/ablation (all tables) "
            f"and its {', '.join(known)}, or give a YAML of that kind"
        )
    return path


def resolve_config(words: Sequence[str]) -> dict[str, Any]:
    """Configuration that a command line of a stage amounts to."""
    from r3dpa.cli.stages import run

    with redirect_stdout(StringIO()) as printed, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Lightning: the process has other words
        try:
            run([*words, "--print_config"])
        except SystemExit as ended:
            if ended.code:
                raise ValueError(f"invalid command: r3dpa {shlex.join(words)}") from None
    return dict(yaml.safe_load(printed.getvalue()))


def _say(text: Any) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()  # into a log file at once

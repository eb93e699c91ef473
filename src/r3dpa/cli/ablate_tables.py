"""``r3dpa ablate``: the paper's ablation tables, from the cost of the trainings to the files."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch

from r3dpa.ablation import RunSettings, budget_of, log_rows, make_plan, read_scale, run_plan
from r3dpa.ablation.report import write_table
from r3dpa.cli.files import check_folder, print_text
from r3dpa.io import command, machine, only_writer, versions

__all__ = ["ablate_tables"]


def ablate_tables(
    tables: Path,
    scale: str,
    seeds: Sequence[int],
    out: Path | None,
    jobs: int,
    devices: int,
    rgb_weights: Path | None,
    wandb: Literal["offline", "online", "off"],
    budget_only: bool,
) -> bool:
    """Runs the command; see ``r3dpa ablate --help``.

    Returns:
        Whether every row and seed has a result.

    Raises:
        ValueError: If an argument or a file is not as it must be.
    """
    found = read_scale(_scale_file(tables, scale))
    folder = out or Path("runs/ablation") / found.name
    check_folder(folder)
    settings = RunSettings(folder, jobs, devices, wandb == "online")
    plan = make_plan(tables, found, seeds, rgb_weights)
    _say(str(budget_of(plan)))
    if budget_only:
        return True
    if plan.missing_weights:
        listed = ", ".join(map(str, plan.missing_weights))
        raise ValueError(f"scale {found.name} needs files that are not there: {listed}")
    with only_writer(folder / ".ablate.lock", f"runs r3dpa ablate in {folder}"):
        failed = run_plan(plan, settings, _say)
        results = {}
        about = {"command": command(), "machine": machine(), "versions": versions(torch)}
        for table in plan.tables:
            text, results[table.name] = write_table(plan, table, folder, failed, about)
            _say(f"\n{text}")
        if wandb != "off":
            for table in plan.tables:
                log_rows(plan, table, results[table.name], folder, wandb)
    for name, reason in failed.items():
        _say(f"failed: {name}: {reason}")
    files = [folder / f"{table.name}.md" for table in plan.tables]
    _say(f"tables: {', '.join(str(file) for file in files if file.is_file()) or 'none'}")
    return not failed


def _scale_file(tables: Path, scale: str) -> Path:
    """The YAML file of a scale: itself, or by its name in the folder of the tables."""
    if not tables.is_dir():
        raise ValueError(f"{tables}: is no folder; give that of a table, or of several")
    if Path(scale).suffix in (".yaml", ".yml"):
        return Path(scale)
    near = [folder / "scale" for folder in (tables, tables.resolve().parent)]
    place = next((folder for folder in near if folder.is_dir()), near[-1])
    return place / f"{scale}.yaml"


def _say(text: str) -> None:
    """A line for whoever waits: at once, also where it goes to a file."""
    print_text(text)
    sys.stdout.flush()

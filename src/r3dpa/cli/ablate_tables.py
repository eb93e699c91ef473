"""``r3dpa ablate``: the paper's ablation tables, from the cost of the trainings to the files."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from r3dpa.ablation import RunSettings, budget_of, log_rows, make_plan, read_scale, run_plan
from r3dpa.ablation.report import write_table
from r3dpa.atomic import only_writer
from r3dpa.cli.files import check_folder, print_text

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
    with only_writer(folder / ".ablate.lock", f"runs r3dpa ablate in {folder}"):
        outcome = run_plan(plan, settings, _say)
        for table in plan.tables:
            text, results = write_table(plan, table, folder, outcome.failed)
            _say(f"\n{text}")
            if wandb != "off":
                log_rows(plan, table, results, folder, wandb)
    for name, reason in outcome.failed.items():
        _say(f"failed: {name}: {reason}")
    _say(f"tables: {', '.join(str(folder / f'{table.name}.md') for table in plan.tables)}")
    return not outcome.failed


def _scale_file(tables: Path, scale: str) -> Path:
    """The YAML file of a scale: itself, or by its name in the folder of the tables."""
    if Path(scale).suffix in (".yaml", ".yml"):
        return Path(scale)
    near = [folder / "scale" for folder in (tables, tables.parent)]
    place = next((folder for folder in near if folder.is_dir()), near[-1])
    return place / f"{scale}.yaml"


def _say(text: str) -> None:
    """A line for whoever waits: at once, also where it goes to a file."""
    print_text(text)
    sys.stdout.flush()

"""Each row of a table as a run of wandb, so that its page shows the table."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any, Literal

from r3dpa.ablation.curves import curves_of
from r3dpa.ablation.plan import Plan, Row, Stage, Table
from r3dpa.ablation.report import Results
from r3dpa.io import atomic_path

__all__ = ["log_rows"]


def log_rows(
    plan: Plan, table: Table, results: Results, out: Path, mode: Literal["offline", "online"]
) -> None:
    """Writes a run for each row and seed: group, configuration, curves, metrics as its summary.

    A run that is there already is not written again, and takes the place of an offline one of the
    same row and seed with other numbers. Offline ones lie in ``<out>/wandb``; ``wandb sync``
    uploads them.

    Args:
        plan: The plan that was run.
        table: Its rows; the group of the runs has its name and that of the scale.
        results: Of the rows.
        out: Folder of the ablation.
        mode: Whether to write to disk or to send.
    """
    for row in table.rows:
        for seed, evaluation in results[row.key].items():
            metrics = {r.name.replace(" ", "_"): r.value for r in evaluation.rows}
            summary: dict[str, Any] = {k: v for k, v in metrics.items() if v is not None}
            stages = [stage.name for stage in row.stages[seed]]
            told = json.dumps([table.name, row.key, seed, stages, plan.scale.scorer])
            run_id = hashlib.sha256(told.encode()).hexdigest()[:12]
            note = out / "wandb" / f"{table.name}-{row.key}-{seed}.{mode}.json"
            text = json.dumps({"id": run_id, "summary": summary})
            if note.is_file():
                if (before := note.read_text(encoding="utf-8")) == text:
                    continue
                for stale in note.parent.glob(f"offline-run-*-{json.loads(before)['id']}"):
                    shutil.rmtree(stale)
            _log_row(plan, table, row, seed, summary, out, run_id, mode)
            with atomic_path(note) as temporary:
                temporary.write_text(text, encoding="utf-8")


def _log_row(
    plan: Plan,
    table: Table,
    row: Row,
    seed: int,
    summary: dict[str, Any],
    out: Path,
    run_id: str,
    mode: Literal["offline", "online"],
) -> None:
    import wandb  # seconds, where nothing is logged

    stages = row.stages[seed]
    config = {
        "table": table.name,
        "row": row.key,
        "label": row.label,
        "scale": plan.scale.name,
        "seed": seed,
        "stages": {stage.experiment: stage.config for stage in stages},
        "runs": [stage.name for stage in stages],
        "starts": {
            stage.name: {
                key: start.name if isinstance(start, Stage) else str(start)
                for key, start in stage.starts.items()
            }
            for stage in stages
        },
    }
    with wandb.init(
        project="r3dpa",
        group=f"{table.name} {plan.scale.name}",
        job_type="row",
        name=f"{row.label}, seed {seed}",
        id=run_id,
        resume="allow" if mode == "online" else None,
        dir=out,
        mode=mode,
        config=config,
        settings=wandb.Settings(silent=True, console="off"),
    ) as run:
        for stage in stages:
            step_name = f"{stage.experiment}/step"
            run.define_metric(f"{stage.experiment}/*", step_metric=step_name)
            for step, values in _by_step(out, stage):
                run.log({step_name: step, **values})
        run.summary.update(summary)


def _by_step(out: Path, stage: Stage) -> list[tuple[int, dict[str, float]]]:
    """What a stage logged at each step."""
    found: dict[int, dict[str, float]] = {}
    for name, values in curves_of(out, stage).items():
        for step, value in values.items():
            found.setdefault(step, {})[f"{stage.experiment}/{name}"] = value
    return sorted(found.items())

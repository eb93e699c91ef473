"""Rows of a table as runs of wandb, so that its project page shows the table."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any, Literal

from r3dpa.ablation.plan import Plan, Row, Stage, Table
from r3dpa.ablation.run import commit_of, evaluation_of
from r3dpa.ablation.tables import Results, curves_of
from r3dpa.io import atomic_path

__all__ = ["log_rows"]


def log_rows(
    plan: Plan, table: Table, results: Results, out: Path, mode: Literal["offline", "online"]
) -> None:
    """Logs a run for each row and seed: group, configuration, curves, pictures, metrics.

    A run that was logged before is not logged again; with other numbers it replaces the offline run
    of the same row and seed. Offline runs are in ``<out>/wandb``, for ``wandb sync``.
    """
    for row in table.rows:
        for seed, evaluation in results[row.key].items():
            metrics = {r.name.replace(" ", "_"): r.value for r in evaluation.rows}
            summary: dict[str, Any] = {k: v for k, v in metrics.items() if v is not None}
            stages = [stage.name for stage in row.stages[seed]]
            text = json.dumps([table.name, row.key, seed, stages, plan.scale.scorer])
            run_id = hashlib.sha256(text.encode()).hexdigest()[:12]
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
    import wandb  # takes seconds

    stages = row.stages[seed]
    starts = {
        stage.name: {
            key: start.name if isinstance(start, Stage) else str(start)
            for key, start in stage.starts.items()
        }
        for stage in stages
    }
    config = {
        "table": table.name,
        "row": row.key,
        "label": row.label,
        "scale": plan.scale.name,
        "seed": seed,
        "stages": {stage.experiment: stage.config for stage in stages},
        "runs": [stage.name for stage in stages],
        "commits": [commit_of(out, stage) for stage in stages],
        "starts": starts,
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
            by_step: dict[int, dict[str, float]] = {}
            for name, values in curves_of(out, stage).items():
                for step, value in values.items():
                    by_step.setdefault(step, {})[f"{stage.experiment}/{name}"] = value
            for step, logged in sorted(by_step.items()):
                run.log({step_name: step, **logged})
        for path in sorted(evaluation_of(out, row.tested(seed)).parent.rglob("*.png")):
            run.log({f"samples/{path.stem}": wandb.Image(str(path))})
        run.summary.update(summary)

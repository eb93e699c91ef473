"""Logged quantities of a stage, over all its starts."""

from __future__ import annotations

from pathlib import Path

from r3dpa import viz
from r3dpa.ablation.plan import Stage
from r3dpa.ablation.runner import stage_folder

__all__ = ["curves_of"]


def curves_of(out: Path, stage: Stage) -> dict[str, dict[int, float]]:
    """Values by step, for each quantity.

    A stage that went on after an interrupt repeats the steps since its last checkpoint: what was
    logged last counts.

    Args:
        out: Folder of the ablation.
        stage: Of it; without any value if it was not started.
    """
    found: dict[str, dict[int, float]] = {}
    paths = stage_folder(out, stage).glob("version_*/metrics.csv")
    for path in sorted(paths, key=lambda path: path.stat().st_mtime):
        for name, (steps, values) in viz.read_metrics(path).items():
            known = found.setdefault(name, {})
            known.update(zip(map(int, steps), map(float, values), strict=True))
    return {name: dict(sorted(values.items())) for name, values in found.items()}

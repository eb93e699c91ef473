"""Rows of an ablation table at several budgets: what alignment is worth per step and per hour.

    python tests/bench/alignment_budgets.py runs/ablation/s --table table_3 --base none \
        --steps 1000 2000 --scenes 500 --out budgets.json --picture budgets.png

After ``r3dpa ablate conf/ablation/table_3 --scale s --seeds 0 1 2``, whose trainings keep their
checkpoints. Tests those of each budget that are not tested yet (an interrupted call goes on); the
last budget is the table's own. Hours are budget times the least time of a step of the row, from the
times of its checkpoints: of the stage alone, without the stages before it, which rows share. At
equal hours, the base row is interpolated. Differences are paired by seed, with Student's 95 %
interval.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from statistics import fmean, stdev

import numpy as np
from matplotlib.figure import Figure

from r3dpa.metrics.resampling import quantile_of_t
from r3dpa.metrics.results import Evaluation

METRICS = ("FWID", "FWID_JUDGE", "FGEO")


def evaluation_at(stage, steps, last, reference, scenes):
    """Evaluation of a training after some steps; tests its checkpoint if nothing has."""
    if steps == last:
        return Evaluation.load(stage / "evaluation" / "evaluation.json")
    folder = stage / f"step_{steps}_{scenes}"
    path = folder / "evaluation" / "evaluation.json"
    if not path.is_file():
        words = ["test", "--config", stage / "config.yaml", "--run_dir", folder]
        words += ["--ckpt_path", stage / "checkpoints" / f"step={steps:07d}.ckpt"]
        words += ["--scorer.reference", reference, "--scorer.num_scenes", scenes]
        words += ["--trainer.logger", "false", "--trainer.enable_progress_bar", "false"]
        subprocess.run([sys.executable, "-m", "r3dpa", *map(str, words)], check=True)
    return Evaluation.load(path)


def step_seconds(stages):
    """Least time of a step between two checkpoints, over trainings of one row."""
    rates = []
    for stage in stages:
        files = sorted((stage / "checkpoints").glob("step=*.ckpt"))
        marks = [(int(file.stem.partition("=")[2]), file.stat().st_mtime) for file in files]
        rates += [(end - start) / (to - since) for (since, start), (to, end) in pairwise(marks)]
    return min(rates)


def changes(values, base):
    """Mean relative change by seed, and its interval; None with a single seed."""
    each = [(values[seed] - base[seed]) / base[seed] for seed in values if seed in base]
    mean, interval = fmean(each), None
    if len(each) > 1:
        half = quantile_of_t(len(each) - 1) * stdev(each) / len(each) ** 0.5
        interval = [mean - half, mean + half]
    return {"change": mean, "interval": interval}


def compare(rows, base, seconds):
    """Rows with changes to the base at equal steps and at equal hours.

    ``rows`` are values by row, steps, metric and seed. The base is interpolated between its
    budgets; beyond them, ``equal_hours`` is None.
    """
    base_hours = [steps * seconds[base] / 3600 for steps in rows[base]]
    results = {}
    for name, by_steps in rows.items():
        results[name] = {}
        for steps, by_metric in by_steps.items():
            hours = steps * seconds[name] / 3600
            row = {"hours": hours}
            for metric, values in by_metric.items():
                same = rows[base][steps][metric]
                row[metric] = {"mean": fmean(values.values()), "values": values}
                row[metric] |= {"equal_steps": changes(values, same), "equal_hours": None}
                if base_hours[0] <= hours <= base_hours[-1]:
                    at_hours = {
                        seed: np.interp(
                            hours, base_hours, [of[metric][seed] for of in rows[base].values()]
                        )
                        for seed in same
                    }
                    row[metric]["equal_hours"] = changes(values, at_hours)
            results[name][steps] = row
    return results


def draw(results, metric, path):
    """Picture of a metric over the hours of each row."""
    figure = Figure((5, 4), layout="constrained")
    axes = figure.add_subplot(xlabel="hours of a core", ylabel=metric)
    for name, by_steps in results.items():
        hours = [row["hours"] for row in by_steps.values()]
        axes.plot(hours, [row[metric]["mean"] for row in by_steps.values()], "o-", label=name)
    figure.legend(loc="outside upper center", ncols=2)
    figure.savefig(path, dpi=150)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="folder of r3dpa ablate")
    parser.add_argument("--table", default="table_3")
    parser.add_argument("--base", default="none", help="row that the others are compared with")
    parser.add_argument(
        "--steps", type=int, nargs="+", required=True, help="budgets before the last"
    )
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args(arguments)
    table = json.loads((options.folder / f"{options.table}.json").read_text())
    rows, seconds = {}, {}
    for row in table["rows"]:
        stages = {s: options.folder / "stages" / names[-1] for s, names in row["stages"].items()}
        seconds[row["key"]] = step_seconds(stages.values())
        reference = options.folder / "reference.safetensors"
        first = next(iter(stages.values()))
        final = Evaluation.load(first / "evaluation" / "evaluation.json")
        last = final.about["extra"]["step"]
        names = [name for name in METRICS if final.row(name) is not None]
        by_steps = rows[row["key"]] = {}
        for steps in (*options.steps, last):
            found = {
                seed: evaluation_at(stage, steps, last, reference, options.scenes)
                for seed, stage in stages.items()
            }
            by_steps[steps] = {n: {s: e.row(n).value for s, e in found.items()} for n in names}
    results = compare(rows, options.base, seconds)
    text = json.dumps({"base": options.base, "scenes": options.scenes, "rows": results}, indent=1)
    sys.stdout.write(text + "\n")
    if options.out is not None:
        options.out.write_text(text + "\n")
    if options.picture is not None:
        draw(results, METRICS[0], options.picture)


if __name__ == "__main__":
    main()

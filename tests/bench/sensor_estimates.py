"""Sensors estimated from simulated scans, against the presets that made them.

    python tests/bench/sensor_estimates.py [--out FOLDER] [--presets hdl32e vlp16]

Each preset gives three scans, which are estimated together in five forms: as the simulator writes
them (ring after ring), shuffled with a ring column, shuffled without one, with noise (5 cm along
the ray and 2 mm along each axis), and with a third of the points lost. Beams: how many were found,
of how many with a return. Error: the largest difference of an inclination from the nearest one of
the preset, in hundredths of a degree. Kept: the share of points that come back from an image of the
estimated sensor. Times are on one core.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidarsim import Simulator, load_sensor
from lidarsim.clouds import PointCloud
from lidarsim.sensors import PRESETS, SpinningLidar, estimate
from lidarsim.sensors.beams import nearest_line
from r3dpa.geometry import BeamProjection, share_kept
from r3dpa.io import text_table, write_text

FORMS = ("in order", "ring, shuffled", "shuffled", "noise", "a third lost")
NUM_SCANS, STRIDE, SEED = 3, 40, 3
LOST_SHARE, RANGE_NOISE_M, AXIS_NOISE_M = 1 / 3, 0.05, 0.002


def beams_of(rows: np.ndarray, truth: SpinningLidar) -> np.ndarray:
    """Beam ``(P,)`` of simulated points."""
    lasers = truth.lasers
    tables = np.array(lasers.inclination_rad), np.array(lasers.height_m)
    distance_m = np.hypot(rows[:, 0], rows[:, 1]).astype(float)
    return nearest_line(*tables, distance_m, rows[:, 2].astype(float))[0]


def in_form(form: str, rows: np.ndarray, truth: SpinningLidar) -> PointCloud:
    """Cloud of simulated points in one of the forms."""
    generator = np.random.default_rng(0)
    order = generator.permutation(len(rows))
    if form == "ring, shuffled":
        return PointCloud.of(rows[order], ring=beams_of(rows, truth)[order].astype(np.uint16))
    if form == "shuffled":
        return PointCloud.of(rows[order])
    if form == "noise":
        noisy = rows.copy()
        range_m = np.linalg.norm(noisy[:, :3], axis=1)
        noisy[:, :3] *= (1 + generator.normal(0, RANGE_NOISE_M, len(rows)) / range_m)[:, None]
        noisy[:, :3] += generator.normal(0, AXIS_NOISE_M, (len(rows), 3))
        return PointCloud.of(noisy)
    if form == "a third lost":
        return PointCloud.of(rows[generator.random(len(rows)) > LOST_SHARE])
    return PointCloud.of(rows)


def measure(scans: list[np.ndarray], form: str, truth: SpinningLidar) -> dict[str, Any]:
    """Estimate from scans in a form, beside the truth."""
    clouds = [in_form(form, rows, truth) for rows in scans]
    num_seen = len(np.unique(np.concatenate([beams_of(rows, truth) for rows in scans])))
    started = time.perf_counter()
    try:
        found = estimate(clouds)
    except ValueError as error:
        return {"form": form, "refused": str(error)}
    seconds = (time.perf_counter() - started) / len(clouds)
    lasers, true = found.sensor.lasers, np.degrees(truth.lasers.inclination_rad)
    degrees = np.degrees(lasers.inclination_rad)
    # Of each beam found, the distance to the nearest one of the truth.
    off = np.abs(degrees[:, None] - true).min(axis=1).max()
    projection = BeamProjection.of(found.sensor)
    points = torch.from_numpy(clouds[0].points.astype(np.float32))
    return {
        "form": form,
        "beams": len(degrees),
        "beams_seen": num_seen,
        "largest_error_deg": float(off),
        "columns": found.sensor.shots,
        "kept": share_kept(points, projection),
        "seconds_per_scan": seconds,
    }


def table_of(results: dict[str, list[dict[str, Any]]]) -> str:
    """Table in Markdown."""
    rows = []
    for name, measured in results.items():
        columns = load_sensor(name).shots
        for result in measured:
            if "refused" in result:
                rows.append([name, result["form"], "refused", "", "", "", ""])
                continue
            rows.append(
                [
                    name,
                    result["form"],
                    f"{result['beams']} of {result['beams_seen']}",
                    f"{100 * result['largest_error_deg']:.2f}",
                    f"{result['columns']} of {columns}",
                    f"{result['kept']:.2%}",
                    f"{result['seconds_per_scan']:.2f}",
                ]
            )
    heads = ["preset", "scans", "beams", "error, 0.01 deg", "columns", "kept", "s per scan"]
    return text_table(rows, heads, "llrrrrr", "github")


def main() -> None:
    """Measure all presets; write a table and all numbers."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("notebooks/results/sensors"))
    parser.add_argument("--presets", nargs="+", default=list(PRESETS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, list[dict[str, Any]]] = {}
    for name in options.presets:
        truth = load_sensor(name)
        simulator = Simulator(SEED, sensor=name)
        scans = [simulator.scan(STRIDE * number).points for number in range(NUM_SCANS)]
        results[name] = [measure(scans, form, truth) for form in FORMS]
        sys.stdout.write(table_of({name: results[name]}) + "\n")
        sys.stdout.flush()
    about = "Estimates of three simulated scans per preset; see tests/bench/sensor_estimates.py."
    write_text(options.out / "estimates.json", json.dumps(results, indent=1) + "\n")
    write_text(options.out / "estimates.md", f"{about}\n\n{table_of(results)}\n")


if __name__ == "__main__":
    main()

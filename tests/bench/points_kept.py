"""Share of the points of real scans that come back from an image, per projection.

    python tests/bench/points_kept.py NAME=GLOB [NAME=GLOB ...] [--out FOLDER]

The sensor of each set is estimated from its files. Default: rows of equal pitch, 64 x 1024, +3 to
-25 degrees, 1 to 56 m. Equal pitch: rows of equal pitch in the field of view of the sensor, a
column per shot. Beams: a row per beam, a column per shot; the same with 1024 columns. Shares are of
the points within the range limits of each image; "default" also of all points.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidarsim.clouds import read_cloud
from lidarsim.sensors import estimate
from r3dpa.geometry import (
    BeamProjection,
    LidarSensor,
    SphericalProjection,
    in_range,
    share_kept,
    unproject,
)
from r3dpa.geometry.projection import range_image
from r3dpa.io import text_table, write_text

HEADS = ["set", "files", "image", "default, of all", "equal pitch", "beams", "beams, 1024", "off"]


def measure(files: list[str]) -> dict[str, Any]:
    """Shares kept of the files of one sensor, each the mean and the least."""
    sensor = estimate(files).sensor
    view = LidarSensor.of(sensor)
    beams = BeamProjection.of(sensor)
    projections = {
        "equal_pitch": SphericalProjection(view),
        "beams": beams,
        "beams_1024": BeamProjection.of(sensor, 1024),
    }
    shares: dict[str, list[float]] = {name: [] for name in ("default", *projections)}
    off_deg = []
    for file in files:
        cloud = read_cloud(file, drop_nan=True, with_labels=False)
        points = torch.from_numpy(cloud.points.astype(np.float32))
        points = points[points.any(dim=1)]
        default = SphericalProjection(LidarSensor())
        num_back = int((range_image(points, default)[0] > 0).sum())
        shares["default"].append(num_back / len(points))
        for name, projection in projections.items():
            shares[name].append(share_kept(points, projection))
        off_deg.append(_angle_off(points, beams))
    return {
        "files": len(files),
        "image": [beams.sensor.beams, beams.sensor.columns],
        "off_deg": float(np.mean(off_deg)),
        **{f"{name}_mean": float(np.mean(values)) for name, values in shares.items()},
        **{f"{name}_least": min(values) for name, values in shares.items()},
    }


def _angle_off(points: torch.Tensor, projection: BeamProjection) -> float:
    """Median angle in degrees between points and where the image puts them."""
    image, _ = range_image(points, projection)
    row, column = projection.pixel_of(points)
    back = unproject(image, projection)[row, column]
    range_m = points.norm(dim=1)
    own = in_range(points, projection.sensor) & ((image[row, column] - range_m).abs() < 1e-3)
    return float(((back - points).norm(dim=1) / range_m)[own].median().rad2deg())


def table_of(results: dict[str, dict[str, Any]]) -> str:
    """Table in Markdown: means, and the least in brackets."""
    rows = []
    for name, result in results.items():
        shares = [
            f"{result[f'{key}_mean']:.2%} ({result[f'{key}_least']:.2%})"
            for key in ("default", "equal_pitch", "beams", "beams_1024")
        ]
        beams, columns = result["image"]
        image, off = f"{beams} x {columns}", f"{result['off_deg']:.3f} deg"
        rows.append([name, f"{result['files']}", image, *shares, off])
    return text_table(rows, HEADS, "lrrrrrrr", "github")


def main() -> None:
    """Measure all sets; write a table and all numbers."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("sets", nargs="+", metavar="NAME=GLOB")
    parser.add_argument("--out", type=Path, default=Path("notebooks/results/sensors"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = {}
    for given in options.sets:
        name, _, pattern = given.partition("=")
        files = sorted(map(str, Path(pattern).parent.glob(Path(pattern).name)))
        if not files:
            raise SystemExit(f"{pattern}: no such files")
        results[name] = measure(files)
        sys.stdout.write(table_of({name: results[name]}).splitlines()[-1] + "\n")
        sys.stdout.flush()
    about = (
        "Points that come back from an image: mean over the files, and the least. Off: median "
        "angle between a point and its place. See tests/bench/points_kept.py."
    )
    write_text(options.out / "points_kept.json", json.dumps(results, indent=1) + "\n")
    write_text(options.out / "points_kept.md", f"{about}\n\n{table_of(results)}\n")


if __name__ == "__main__":
    main()

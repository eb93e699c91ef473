"""Real and simulated scans side by side, as range images and from above.

    python tests/bench/draw_beside_real.py REAL SIMULATED --out FOLDER [--num 10] [--tag NAME]

Writes ``range_real_TAG.png``, ``range_simulated_TAG.png``, ``above_real_TAG.png`` and
``above_simulated_TAG.png``, with as many scans of each folder, evenly spread. From above only
points of 0.3 to 3 m above the ground are drawn, where streets differ most, up to 30 m to each side.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from matplotlib.figure import Figure
from street_fullness import height_above_ground, shorten

from lidarsim.scan_files import read_scan
from r3dpa.data.scans import evenly, find_scans
from r3dpa.geometry import LidarSensor, SphericalProjection, range_image
from r3dpa.viz import birds_eye_picture, range_image_picture, save

PROJECTION = SphericalProjection(LidarSensor(range_max_m=80.0))
HEIGHTS_M = (0.3, 3.0)
EXTENT_M = 30.0


def range_images(scans):
    """Figure with a range image for each scan."""
    figure = Figure(figsize=(20, 1.75 * len(scans)), layout="constrained", dpi=75)
    for axes, scan in zip(figure.subplots(len(scans), 1, squeeze=False)[:, 0], scans, strict=True):
        points = torch.from_numpy(read_scan(scan.path)[:, :3])
        range_m = range_image(points, PROJECTION)[0]
        axes.imshow(range_image_picture(range_m, PROJECTION.sensor), aspect="auto")
        axes.set_title(shorten(scan.name), fontsize=8)
        axes.set(xticks=[], yticks=[0, 8, 16, 24, 32])
    return figure


def views_from_above(scans):
    """Figure with a view from above for each scan."""
    columns = 5
    rows = -(-len(scans) // columns)
    figure = Figure(figsize=(4 * columns, 4.2 * rows), layout="constrained", dpi=75)
    cells = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in cells:
        axes.axis("off")
    for axes, scan in zip(cells, scans, strict=False):
        points = read_scan(scan.path)
        height_m = height_above_ground(points)
        standing = points[(height_m > HEIGHTS_M[0]) & (height_m < HEIGHTS_M[1])]
        axes.imshow(birds_eye_picture(standing, EXTENT_M, pixels=400))
        axes.set_title(shorten(scan.name), fontsize=8)
    return figure


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("real", type=Path)
    parser.add_argument("simulated", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--num", type=int, default=10)
    parser.add_argument("--tag", default="base", help="end of the names of the files")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for kind, folder in (("real", arguments.real), ("simulated", arguments.simulated)):
        scans = evenly(find_scans(folder), arguments.num)
        pictures = {"range": range_images(scans), "above": views_from_above(scans)}
        for name, figure in pictures.items():
            save(figure, arguments.out / f"{name}_{kind}_{arguments.tag}.png")


if __name__ == "__main__":
    main()

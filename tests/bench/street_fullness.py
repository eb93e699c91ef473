"""How full the streets of scans are: depth edges, spikes and lost shots, set beside set.

    python tests/bench/street_fullness.py REAL SIMULATED [SIMULATED ...] [--limit 100] [--by-drive]

Every recording (sub-folder) of an ordinary folder is a column of its own, and a folder in the
layout of KITTI-360 is one column (with ``--by-drive`` one for each drive). A value outside the
bounds is marked with ``*``. Definitions, all on range images of 64 x 1024 pixels, +3 to -25
degrees, nearest return of 1 to 80 m in each pixel:

- edge: neighbouring pixels of a row, both with a return, whose ranges differ by more than 0.5 m;
- spike: a pixel that differs by more than 0.5 m from both neighbours of its row, of the pixels
  whose neighbours have a return as well;
- run of lost shots: pixels without a return between two pixels with one, in rows with a return in
  more than 30 % of the pixels; a row is a circle.

Heights are of the nearer pixel above the ground plane of the scan. "k shots apart" are returns of
one laser with no lost shot between them (one column of the image is two shots): where an edge is an
outline, twice the distance meets nearly twice as many; flicker from shot to shot does not grow.
"Next ring" is the return of nearest azimuth of the laser below.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import torch

from lidarsim.scan_files import read_beside, read_scan
from lidarsim.scan_structure import Ground, fit_ground, sweep_of
from r3dpa.data.scans import RAW, Scan, evenly, find_scans
from r3dpa.editing.objects import CLASS_NAMES
from r3dpa.geometry import LidarSensor, SphericalProjection, range_image
from r3dpa.io import text_table

PROJECTION = SphericalProjection(LidarSensor(range_min_m=1.0, range_max_m=80.0))
EDGE_M = 0.5
HIT_ROW_SHARE = 0.3
MOUNT_HEIGHT_M = 1.73  # of the sensor above the ground, where no plane is found

ROWS = {"rows 8-15": (8, 16), "rows 16-23": (16, 24), "rows 24-31": (24, 32)}
RANGES_M = {"nearer 5-10 m": (5, 10), "nearer 10-20 m": (10, 20), "nearer 20-30 m": (20, 30)}
SPIKES, RUNS = "single-pixel spikes", "mean run of lost shots"

#: Lowest and highest of four recordings (99 scans of an HDL-64E, of which 30 are at hand), and for
#: the last two the span to aim at.
BOUNDS = {
    "rows 8-15": (0.128, 0.191),
    "rows 16-23": (0.058, 0.098),
    "rows 24-31": (0.010, 0.037),
    "nearer 5-10 m": (0.011, 0.031),
    "nearer 10-20 m": (0.059, 0.115),
    "nearer 20-30 m": (0.179, 0.218),
    SPIKES: (0.016, 0.028),
    RUNS: (10.5, 13.0),
}
HEIGHT_RANGE_M = (5, 30)  # of the nearer pixel, where edges are counted by height
HEIGHTS_M = {
    "below 0": (-np.inf, 0.0),
    "0-0.3 m": (0.0, 0.3),
    "0.3-1 m": (0.3, 1.0),
    "1-2 m": (1.0, 2.0),
    "2-3 m": (2.0, 3.0),
    "above 3 m": (3.0, np.inf),
}
LAGS_SHOTS = (1, 2, 4, 8)
STANDING_M = 0.3  # what stands on the ground reaches higher than this

#: Shares of points by class in the training scans of SemanticKITTI (HDL-64E, KITTI odometry), from
#: "content" of its semantic-kitti.yaml; trunks count as vegetation, what moves as what stands.
SEMANTIC_KITTI_SHARES = {
    0: 0.0192,
    6: 0.0039,
    7: 0.1988,
    8: 0.1439,
    9: 0.0147,
    11: 0.1327,
    13: 0.0724,
    17: 0.0029,
    20: 0.0006,
    21: 0.2729,
    22: 0.0781,
    24: 0.0003,
    25: 0.0002,
    26: 0.0426,
    27: 0.0022,
    32: 0.0004,
    33: 0.0002,
    42: 0.0024,
    43: 0.0018,
    44: 0.0099,
}
#: Occupied voxels of 0.2 m by class, in thousands, in SSCBench-KITTI-360 (NeurIPS datasets 2024),
#: made from the accumulated labels of KITTI-360. Not shares of returns: near surfaces count less.
KITTI360_KILOVOXELS = {
    6: 14454,
    7: 105541,
    8: 45297,
    9: 16292,
    11: 110397,
    13: 6766,
    17: 1561,
    20: 406,
    21: 295883,
    22: 50038,
    24: 125,
    26: 20099,
    27: 1149,
    32: 96,
    33: 105,
    42: 30516,
    43: 4051,
    44: 1950,
}


class Fullness:
    """Counts over scans: each name has a number of hits and a number of cases."""

    def __init__(self):
        self.num_scans = 0
        self.hits = Counter()
        self.cases = Counter()
        self.classes = Counter()  # returns by class, of scans with labels

    def add_scan(self, points, labels):
        """Counts of one scan ``(P, 4)``; labels ``(P,)`` or None."""
        self.num_scans += 1
        range_m, height = range_image(
            torch.from_numpy(points[:, :3].copy()),
            PROJECTION,
            torch.from_numpy(height_above_ground(points)[:, None]),
        )
        range_m, height_m = range_m.numpy(), height.numpy()[0]
        self._count_edges(range_m, height_m)
        self._count_spikes(range_m)
        lengths = lost_runs(range_m > 0)
        self._count(RUNS, lengths.sum(), len(lengths))
        self._count_along_rings(points)
        if labels is not None:
            distance_m = np.linalg.norm(points[:, :3], axis=1)
            self.classes.update((labels[distance_m < 80] & 0xFFFF).tolist())

    def share(self, name):
        """Hits per case; NaN without a case."""
        return self.hits[name] / self.cases[name] if self.cases[name] else np.nan

    def _count(self, name, hits, cases):
        self.hits[name] += int(hits)
        self.cases[name] += int(cases)

    def _count_edges(self, range_m, height_m):
        next_m, next_height_m = np.roll(range_m, -1, axis=1), np.roll(height_m, -1, axis=1)
        both = (range_m > 0) & (next_m > 0)
        edge = both & (np.abs(next_m - range_m) > EDGE_M)
        nearer_m = np.minimum(range_m, next_m)
        for name, (first, end) in ROWS.items():
            self._count(name, edge[first:end].sum(), both[first:end].sum())
        for name, (low, high) in RANGES_M.items():
            inside = both & (nearer_m >= low) & (nearer_m < high)
            self._count(name, (edge & inside).sum(), inside.sum())

        nearer_height_m = np.where(range_m <= next_m, height_m, next_height_m)
        low, high = HEIGHT_RANGE_M
        near = both & (nearer_m >= low) & (nearer_m < high)
        for name, (low, high) in HEIGHTS_M.items():
            inside = near & (nearer_height_m >= low) & (nearer_height_m < high)
            self._count(f"edges {name}", (edge & inside).sum(), inside.sum())
            self._count(f"pixels {name}", inside.sum(), both.sum())

    def _count_spikes(self, range_m):
        before_m, after_m = np.roll(range_m, 1, axis=1), np.roll(range_m, -1, axis=1)
        known = (before_m > 0) & (range_m > 0) & (after_m > 0)
        differs = np.minimum(np.abs(range_m - before_m), np.abs(range_m - after_m)) > EDGE_M
        self._count(SPIKES, (known & differs).sum(), known.sum())

    def _count_along_rings(self, points):
        distance_m = np.linalg.norm(points[:, :3], axis=1)
        returns = points[(distance_m > 1.0) & (distance_m < 80.0)]
        xyz = returns[:, :3].astype(np.float64)
        sweep = sweep_of(xyz, PROJECTION.sensor)
        if sweep is None:
            return
        height_m = height_above_ground(returns)[sweep.order]
        range_m = np.linalg.norm(xyz[sweep.order], axis=1)
        low, high = HEIGHT_RANGE_M
        unbroken = np.ones(len(range_m), dtype=bool)
        others = {}
        for lag in range(1, max(LAGS_SHOTS) + 1):
            unbroken &= sweep.missing[sweep.neighbour(lag - 1)] == 0
            if lag in LAGS_SHOTS:
                others[f"{lag} shots apart"] = sweep.neighbour(lag), unbroken.copy()
        others["next ring"] = sweep.other_ring(1)
        for name, (other, known) in others.items():
            nearer_m = np.minimum(range_m, range_m[other])
            nearer_height_m = np.where(range_m <= range_m[other], height_m, height_m[other])
            inside = known & (nearer_m >= low) & (nearer_m < high) & (nearer_height_m >= STANDING_M)
            edge = np.abs(range_m - range_m[other]) > EDGE_M
            self._count(name, (edge & inside).sum(), inside.sum())


def height_above_ground(points):
    """Height ``(P,)`` float32 of points ``(P, 4)`` above the plane of the ground, metres."""
    xyz = points[:, :3].astype(np.float64)
    distance_m = np.linalg.norm(xyz, axis=1)
    ground = fit_ground(xyz[distance_m > 1.0]) or Ground(0.0, 0.0, -MOUNT_HEIGHT_M)
    return ground.height_m(xyz).astype(np.float32)


def lost_runs(hit):
    """Lengths of the runs of False in the rows of ``(H, W)`` that are mostly True."""
    lengths = []
    for row in hit[hit.mean(axis=1) > HIT_ROW_SHARE]:
        from_a_hit = np.roll(row, -int(row.argmax())).astype(np.int64)
        steps = np.diff(np.append(from_a_hit, 1))  # closed by the hit with which the row begins
        lengths.append(np.flatnonzero(steps == 1) - np.flatnonzero(steps == -1))
    return np.concatenate(lengths) if lengths else np.zeros(0, dtype=np.int64)


def recordings(folder: Path, by_drive: bool) -> dict[str, list[Scan]]:
    """Scans of a folder by column of the table."""
    scans = find_scans(folder)
    if (folder / RAW).is_dir() and not by_drive:
        return {folder.name: scans}
    groups = defaultdict(list)
    for scan in scans:
        groups[scan.drive if scan.drive != "." else folder.name].append(scan)
    return dict(groups)


def measure(scans):
    """Counts of some scans."""
    counts = Fullness()
    for scan in scans:
        counts.add_scan(read_scan(scan.path), read_beside(scan.path, "labels"))
    return counts


def tables(columns: dict[str, Fullness]) -> str:
    """Tables: against the bounds, by height, along the rings, and returns by class."""
    names = [shorten(name) for name in columns]
    rows = [["scans", *[str(counts.num_scans) for counts in columns.values()], ""]]
    for name, (low, high) in BOUNDS.items():
        digits = 1 if name == RUNS else 3
        values = [counts.share(name) for counts in columns.values()]
        marks = ["" if low <= round(value, digits) <= high else " *" for value in values]
        cells = [f"{value:.{digits}f}{mark}" for value, mark in zip(values, marks, strict=True)]
        rows.append([name, *cells, f"{low:.{digits}f} to {high:.{digits}f}"])
    parts = [text_table(rows, ["", *names, "bounds"], style="pipe")]

    rows = []
    for kind in ("edges", "pixels"):
        for height in HEIGHTS_M:
            name = f"{kind} {height}"
            rows.append([name, *[f"{counts.share(name):.3f}" for counts in columns.values()]])
    parts.append(text_table(rows, ["nearer pixel at 5-30 m, by height", *names], style="pipe"))

    rows = []
    for name in [*[f"{lag} shots apart" for lag in LAGS_SHOTS], "next ring"]:
        rows.append([name, *[f"{counts.share(name):.3f}" for counts in columns.values()]])
    heads = ["edges along and across rings, nearer return at 5-30 m, above 0.3 m", *names]
    parts.append(text_table(rows, heads, style="pipe"))

    labelled = {name: counts for name, counts in columns.items() if counts.classes}
    if labelled:
        parts.append(class_table(labelled))
    return "\n\n".join(parts)


def class_table(labelled: dict[str, Fullness]) -> str:
    """Shares of returns by class, beside published ones."""
    shares = {
        shorten(name): {
            number: count / counts.classes.total() for number, count in counts.classes.items()
        }
        for name, counts in labelled.items()
    }
    num_voxels = sum(KITTI360_KILOVOXELS.values())
    shares["SemanticKITTI points"] = SEMANTIC_KITTI_SHARES
    shares["KITTI-360 voxels"] = {
        number: count / num_voxels for number, count in KITTI360_KILOVOXELS.items()
    }
    rows = []
    for number in sorted(set().union(*shares.values())):
        cells = [f"{of_class.get(number, 0.0):.4f}" for of_class in shares.values()]
        rows.append([f"{number} {CLASS_NAMES.get(number, 'unlabelled')}", *cells])
    return text_table(rows, ["share of returns", *shares], style="pipe")


def shorten(name):
    """Name of a column without what all drives of KITTI-360 share."""
    return name.removeprefix("2013_05_28_drive_").split("_sync")[0].removesuffix("/velodyne")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--limit", type=int, help="scans of each column at most, evenly spread")
    parser.add_argument("--by-drive", action="store_true", help="one column for each drive")
    arguments = parser.parse_args()
    columns = {}
    for folder in arguments.folders:
        of_folder = recordings(folder, arguments.by_drive)
        for name, scans in of_folder.items():
            column = f"{folder.name}/{name}" if name in columns else name
            columns[column] = measure(evenly(scans, arguments.limit))
    sys.stdout.write(tables(columns) + "\n")


if __name__ == "__main__":
    main()

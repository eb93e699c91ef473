"""How often the 95 % intervals of the metrics hold the mean of the value over repeated draws.

``python tests/bench/interval_coverage.py after.json 1000`` writes the study, which
``notebooks/results/interval_coverage.json`` holds for two commits. Each row has the metric, the
case, what is drawn anew, the share of intervals that hold the mean, and their width over that of
the central 95 % of a normal distribution with the spread of the values.
"""

import json
import subprocess
import sys
from collections import defaultdict
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from r3dpa.geometry import LidarSensor, points_of
from r3dpa.metrics.distances import (
    RANGE_BIN_M,
    BaselineDistances,
    BEVHistogramDistance,
    MinimumMatchingDistance,
    RangeHistogramDistance,
)
from r3dpa.metrics.feature_distances import (
    FrechetDistance,
    FrechetInfinity,
    PolynomialMMD,
    PrecisionRecall,
)
from r3dpa.metrics.functional_bev import BEVGrid, chamfer_squared
from r3dpa.metrics.resampling import Resampling
from r3dpa.metrics.results import MetricResult
from r3dpa.metrics.scene import DEFAULT

NUM_GROUPS, NUM_REAL = 16, 300
GRID = BEVGrid(half_m=50.0, cell_m=4.0)
PROTOCOL = replace(DEFAULT, sensor=LidarSensor(beams=4, columns=64), voxel_m=2.0)


def range_images(num, widening_m):
    """Range images ``(num, 4, 64)`` in streets of random width."""
    width_m = 4 + 6 * torch.rand(num, 1, 1) + widening_m
    along = width_m / (0.2 + torch.linspace(-3, 3, 64).sin().abs())
    return (along + torch.rand(num, 4, 64)).clamp(max=48)


def features(num, width, shift):
    return torch.randn(num, width, dtype=torch.float64) + shift


def clouds(images):
    return [points_of(image, PROTOCOL.projection) for image in images]


def evaluate_histogram(new_metric, real, population, num):
    """Rows of a draw of generated scenes; so are those of all functions below."""
    metric = new_metric()
    metric.real_bins.copy_(real.sum(dim=0))
    metric.real_count.fill_(len(real))
    drawn = population[torch.randint(len(population), (num,))]
    metric.generated_bins.index_add_(0, torch.arange(num) % NUM_GROUPS, drawn)
    metric.generated_count.fill_(num)
    return metric.results(Resampling())


def occupied_cells(images):
    """Which cells each scene occupies: ``(N, cells)``."""
    occupied = torch.zeros(len(images), GRID.side**2, dtype=torch.int32)
    for row, cloud in zip(occupied, clouds(images), strict=True):
        row[GRID.cells(cloud)] = 1
    return occupied


def range_bins(images):
    """Histograms of the ranges of each scene: ``(N, bins)``."""
    bins = torch.zeros(len(images), 560, dtype=torch.int64)
    index = (images.flatten(1) / RANGE_BIN_M).long()
    return bins.scatter_add_(1, index, torch.ones_like(index))


def evaluate_baselines(num, widening_m):
    metric = BaselineDistances(PROTOCOL)
    metric.update(REAL_IMAGES[:8], real=True)
    metric.update(range_images(num, widening_m), real=False)
    return metric.results(Resampling())[:2]  # the third is a mean over the real scans


def evaluate_features(kind, num, width, shift, draw="generated"):
    """``draw``: which of the two sides is drawn anew, or both."""
    real, generated = features(num, width, 0), features(num, width, shift)
    if draw == "generated":
        real = FIXED[:NUM_REAL, :width]
    elif draw == "real":
        generated = FIXED[-num:, :width] + shift
    metric = kind(width, "FD" if kind is FrechetDistance else "")
    metric.update(real, real=True)
    metric.update(generated, real=False)
    return metric.results(Resampling())


def evaluate_matching(num, values):
    """Values of real scans and their nearest generated ones, which are fixed."""
    rows = []
    for name, of_pair in values.items():
        drawn = of_pair[torch.randint(len(of_pair), (num,))]
        interval = Resampling().of_mean(drawn)
        rows.append(MetricResult(name, drawn.mean().item(), interval))
    return rows


def evaluate_mean(num):
    drawn = features(num, 1, 0)[:, 0]
    return [MetricResult("mean", drawn.mean().item(), Resampling().of_mean(drawn))]


def evaluate_share(num, share):
    metric = PrecisionRecall(1, "")
    # A fixed ball around 0 holds a generated sample with this probability, and none beyond.
    metric.update(torch.linspace(-1, 1, 20, dtype=torch.float64)[:, None], real=True)
    inside = torch.rand(num) < share
    positions = torch.where(inside, 0.001, 1000.0 + torch.rand(num))
    metric.update(positions[:, None].double(), real=False)
    return metric.results(Resampling())[:1]


def matching_values():
    metric = MinimumMatchingDistance(PROTOCOL)
    metric.update(range_images(1000, 0), real=True)
    metric.update(range_images(40, 0), real=False)
    matching = metric.matching()
    real, made = (metric.clouds(side) for side in ("real", "generated"))
    pairs = zip(real, matching.nearest.tolist(), strict=True)
    chamfer = [chamfer_squared(cloud, made[index]) for cloud, index in pairs]
    return {"MMD": matching.squared_normalised, "CD 3D": torch.tensor(chamfer).double()}


def cases():
    """Label of a case, what is drawn anew, and the function of one draw."""
    yield "64 normals", "generated", partial(evaluate_mean, 64)
    for share in (0.02, 0.1, 0.98):
        yield f"share {share} of 64", "generated", partial(evaluate_share, 64, share)
    values = matching_values()
    for num in (64, 200):
        yield f"{num} real scans", "real", partial(evaluate_matching, num, values)
    for label, widening_m in (("at the floor", 0.0), ("far", 1.0)):
        generated = range_images(4000, widening_m)
        for num in (16, 256):
            case = f"{num} scenes, {label}"
            metric = partial(BEVHistogramDistance, GRID, NUM_GROUPS)
            histograms = occupied_cells(REAL_IMAGES), occupied_cells(generated)
            yield case, "generated", partial(evaluate_histogram, metric, *histograms, num)
            metric = partial(RangeHistogramDistance, 56.0, NUM_GROUPS)
            histograms = range_bins(REAL_IMAGES), range_bins(generated)
            yield case, "generated", partial(evaluate_histogram, metric, *histograms, num)
        case = f"16 scenes, {label}"
        yield case, "generated", partial(evaluate_baselines, 16, widening_m)
    for label, shift in (("at the floor", 0.0), ("far", 0.5)):
        for num, width in ((64, 16), (50, 64)):
            case = f"{num} scenes, {width} features, {label}"
            function = partial(evaluate_features, FrechetDistance, num, width, shift)
            yield case, "generated", function
        case = f"64 scenes, 4 features, {label}"
        for kind in (FrechetInfinity, PolynomialMMD):
            yield case, "generated", partial(evaluate_features, kind, 64, 4, shift)
        case = f"64 scenes, 8 features, {label}"
        for draw in ("generated", "real", "both"):
            function = partial(evaluate_features, PrecisionRecall, 64, 8, shift, draw)
            yield case, draw, function


def measure_coverage(function, num_draws):
    """Coverage and width of each row that the function returns."""
    values, ends = defaultdict(list), defaultdict(list)
    for _ in range(num_draws):
        for row in function():
            values[row.name.strip()].append(row.value)
            ends[row.name.strip()].append(row.interval)
    found = {}
    for name in values:
        drawn = torch.tensor(values[name], dtype=torch.float64)
        low, high = torch.tensor(ends[name], dtype=torch.float64).T
        mean, spread = drawn.mean(), drawn.std()
        coverage = ((low <= mean) & (mean <= high)).double().mean().item()
        width = ((high - low).median() / (2 * 1.96 * spread)).item()
        found[name] = {"coverage": round(coverage, 3), "width": round(width, 2)}
    return found


def main(out, num_draws):
    rows = []
    for case, draw, function in cases():
        for name, numbers in measure_coverage(function, num_draws).items():
            rows.append({"metric": name, "case": case, "drawn_anew": draw, **numbers})
            print(rows[-1], flush=True)  # noqa: T201
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True)
    study = {"draws": num_draws, "commit": commit.stdout.strip(), "rows": rows}
    Path(out).write_text(json.dumps(study, indent=1) + "\n")


torch.manual_seed(0)
REAL_IMAGES, FIXED = range_images(NUM_REAL, 0), features(2000, 64, 0)

if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))

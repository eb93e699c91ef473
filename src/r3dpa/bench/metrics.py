"""What the metrics cost: networks, histograms and matching of cells, and sparse convolution.

Where a result has a plain way to be computed, both run here, must agree, and are timed together.
Sets of scenes are made from one scan by turning it about the sensor.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from scipy.spatial.distance import jensenshannon
from torch import Tensor
from torch.nn import functional as F

from r3dpa.bench.features import comparison_table, simulated_scan
from r3dpa.bench.metric_networks import NETWORKS, MetricNetworkCost, metric_network_cost
from r3dpa.bench.point_network import now
from r3dpa.bench.timing import Comparison, compare
from r3dpa.checkpoints.networks import format_table
from r3dpa.data import read_scan
from r3dpa.geometry import LidarSensor
from r3dpa.io import atomic_path, one_line, provenance
from r3dpa.metrics.functional_bev import (
    BEVGrid,
    MatchingTiming,
    chamfer_cells,
    histogram_distance,
    minimum_matching,
    timing_against_brute_force,
)
from r3dpa.metrics.protocol import PUBLISHED
from r3dpa.metrics.scene import EvaluationScene, through_sensor
from r3dpa.nn.backbones.sparse import SparseConv, Voxels
from r3dpa.nn.backbones.sparse_features import voxelize

_TINY = 1e-300  # instead of 0 below a fraction

__all__ = ["Agreement", "convolution", "histograms", "matching", "metrics", "turned"]


@dataclass(frozen=True)
class _Sizes:
    """Effort of the parts; ``box`` is that of the dense convolution, in voxels."""

    networks: tuple[str, ...] = tuple(NETWORKS)
    passes: int = 3
    scenes: int = 120
    rounds: int = 9
    references: int = 10
    samples: int = 20
    pairs: tuple[int, int] = (2, 3)
    match_rounds: int = 5
    box: tuple[int, int, int] = (128, 128, 64)
    channels: int = 16
    cell_m: float = PUBLISHED.voxel_m
    small: bool = False


_QUICK = _Sizes(("SPVCNN",), 1, 4, 2, 2, 3, (2, 2), 2, (16, 16, 8), 4, 0.5, True)


@dataclass(frozen=True)
class Agreement:
    """Two ways to one result, and how long each takes.

    Args:
        comparison: Processor times; the first case is ours.
        largest_difference: Between the results, relative to the largest one.
        about: Sizes.
    """

    comparison: Comparison
    largest_difference: float
    about: dict[str, Any]


def metrics(scan: Path | None = None, out: Path | None = None, quick: bool = False) -> str:
    """Measure all parts and say what they cost.

    Args:
        scan: KITTI ``.bin`` file; a simulated scan where None.
        out: JSON file for the same figures, without rounding.
        quick: Small sizes, only to try it.

    Returns:
        A table for each part, and a line each about scan, machine and versions.

    Raises:
        ScanError: If the scan cannot be used.
    """
    sizes = _QUICK if quick else _Sizes()
    points = simulated_scan() if scan is None else torch.from_numpy(read_scan(scan, LidarSensor()))
    facts = provenance(scan, len(points), np, scipy)
    grid = BEVGrid(cell_m=sizes.cell_m)
    clouds = turned(points, max(sizes.scenes, sizes.references + sizes.samples))
    conv = convolution(points, sizes.box, sizes.channels, sizes.rounds)
    jsd = histograms(clouds[: sizes.scenes], grid, sizes.rounds)
    cells = [grid.cells(cloud) for cloud in clouds[: sizes.references + sizes.samples]]
    references, samples = cells[: sizes.references], cells[sizes.references :]
    mmd, timing, compared = matching(references, samples, grid, sizes.pairs, sizes.match_rounds)
    networks = {
        name: metric_network_cost(name, points, sizes.passes, sizes.small)
        for name in sizes.networks
    }
    full = _extrapolated(jsd, mmd, timing)
    if out is not None:
        content = {
            **facts,
            "networks": {name: asdict(cost) for name, cost in networks.items()},
            "jsd": asdict(jsd),
            "mmd": asdict(mmd)
            | {"pair_costs": asdict(timing), "searched": compared, "cells_m": sizes.cell_m},
            "extrapolated_seconds": full,
            "sparse_convolution": asdict(conv),
        }
        with atomic_path(out) as temporary:
            temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    parts = [_network_tables(networks)]
    for title, found in (("JSD", jsd), ("MMD", mmd), ("convolution of size 3", conv)):
        sized = f"{title}, core time: {one_line(found.about)}"
        agreed = f"largest relative difference of the results: {found.largest_difference:.3g}"
        parts.append(f"{comparison_table(sized, found.comparison)}\n{agreed}")
    parts.append(
        "seconds of one core for the published protocol, extrapolated from scenes and pairs\n"
        + format_table(
            ["", "ours", "brute force", "ratio"],
            [
                [name, f"{ours:.4g}", f"{brute:.4g}", f"{brute / ours:.3g}"]
                for name, (ours, brute) in full.items()
            ],
        )
        + f"\n{one_line(compared)}"
    )
    parts.append("\n".join(f"{name}: {one_line(values)}" for name, values in facts.items()))
    return "\n\n".join(parts)


def turned(points: Tensor, count: int) -> list[Tensor]:
    """Scenes ``(P, 3)`` as evaluations see them: a scan, turned about z by even steps.

    Args:
        points: ``(P, 3)`` or more columns, metres.
        count: How many; the first is the scan itself.
    """
    scenes = []
    for index in range(count):
        angle = 2 * math.pi * index / count
        sine, cosine = math.sin(angle), math.cos(angle)
        x, y, z = points[:, :3].float().unbind(dim=1)
        moved = torch.stack([cosine * x - sine * y, sine * x + cosine * y, z], dim=1)
        seen = through_sensor(EvaluationScene(str(index), moved), PUBLISHED).points
        assert seen is not None
        scenes.append(seen)
    return scenes


def histograms(clouds: Sequence[Tensor], grid: BEVGrid, rounds: int) -> Agreement:
    """JSD of the first half of the clouds from the second, with sparse and with dense counts.

    The dense way adds one image of all cells per cloud and compares whole images, as LiDM and
    R3DPA do. Both start from points.

    Args:
        clouds: At least two, ``(P, 3)``.
        grid: Cells.
        rounds: How often each way is run.
    """
    half = len(clouds) // 2
    parts = (clouds[:half], clouds[half:])

    def counts() -> list[Tensor]:
        return [grid.histogram(part) for part in parts]

    def dense_counts() -> list[NDArray[np.float64]]:
        sums = []
        for part in parts:
            total = np.zeros(grid.shape)
            for cloud in part:
                image = np.zeros(grid.shape, np.float32)
                cells = grid.cells(cloud).numpy()
                image[cells // grid.shape[1], cells % grid.shape[1]] = 1
                total += image
            sums.append(total)
        return sums

    def distance(sums: list[Tensor]) -> float:
        return histogram_distance(*sums).jsd_distance

    def dense_distance(sums: list[NDArray[np.float64]]) -> float:
        return float(jensenshannon(*(total.ravel() for total in sums)))

    sums, dense_sums = counts(), dense_counts()
    for sparse, dense in zip(sums, dense_sums, strict=True):
        assert np.array_equal(sparse.numpy(), dense)
    value, brute = distance(sums), dense_distance(dense_sums)
    comparison = compare(
        {
            "ours": core_case(lambda: distance(counts())),
            "dense images": core_case(lambda: dense_distance(dense_counts())),
        },
        rounds,
    )
    # What is paid once must not be multiplied by the scenes.
    once = compare(
        {
            "ours": core_case(lambda: distance(sums)),
            "dense images": core_case(lambda: dense_distance(dense_sums)),
        },
        rounds,
    )
    about = {
        "scenes": len(clouds),
        "cells": math.prod(grid.shape),
        **{f"ms once, {name}": round(ms.median, 3) for name, ms in once.ms.items()},
    }
    return Agreement(comparison, abs(value - brute) / max(brute, _TINY), about)


def matching(
    references: Sequence[Tensor],
    samples: Sequence[Tensor],
    grid: BEVGrid,
    pairs: tuple[int, int],
    rounds: int,
) -> tuple[Agreement, MatchingTiming, dict[str, Any]]:
    """MMD by distance transforms, and by comparing all cells with all.

    Args:
        references: R vectors of occupied cells.
        samples: S vectors of occupied cells.
        grid: Theirs, square.
        pairs: References and samples of these that all cells are compared of.
        rounds: How often each way is run on those.

    Returns:
        Both ways on the few; costs per cloud and pair of the few; and how much of all pairs the
        search over all references and samples looked at, with its core seconds.
    """
    few = references[: pairs[0]], samples[: pairs[1]]

    def brute() -> Tensor:
        rows = [[chamfer_cells(a, b, grid) for b in few[1]] for a in few[0]]
        return torch.tensor(rows, dtype=torch.float64).amin(dim=1)

    exact = brute()
    difference = minimum_matching(*few, grid).squared_normalised - exact
    comparison = compare(
        {
            "ours": core_case(lambda: minimum_matching(*few, grid)),
            "all cells with all": core_case(brute),
        },
        rounds,
    )
    about = {"references": pairs[0], "samples": pairs[1], "cells of a scene": len(few[0][0])}
    largest = float(difference.abs().max() / exact.abs().max().clamp(min=_TINY))
    timing = timing_against_brute_force(*few, grid)
    start = now()[1]
    found = minimum_matching(references, samples, grid)
    took = now()[1] - start
    searched = {
        "references": len(references),
        "samples": len(samples),
        "core_seconds": took,
        "core_seconds_by_pair_costs": timing.extrapolate(len(references), len(samples))[0],
        "second_direction_share": found.num_compared / (len(references) * len(samples)),
    }
    return Agreement(comparison, largest, about), timing, searched


def core_case(function: Callable[[], object]) -> Callable[[], float]:
    """The function as a case of :func:`compare` whose time is that of the processor.

    Everything compared here is measured so: other work on the machine does not count.
    """

    def run() -> float:
        start = now()[1]
        function()
        return now()[1] - start

    return run


def convolution(points: Tensor, box: tuple[int, int, int], channels: int, rounds: int) -> Agreement:
    """A sparse convolution of size 3 and the dense one, at the occupied voxels of a box.

    Args:
        points: ``(P, 3)`` or more columns, metres.
        box: Voxels along x, y, z, around the occupied one next to the middle of the scan.
        channels: Of input and result.
        rounds: How often each way is run.
    """
    voxels, _ = voxelize(points)
    size = torch.tensor(box)
    away = (voxels - voxels.median(dim=0).values).abs().sum(dim=1)
    corner = voxels[away.argmin()] - size // 2
    inside = ((voxels >= corner) & (voxels < corner + size)).all(dim=1)
    xyz = voxels[inside] - corner
    place = Voxels.from_coordinates(F.pad(xyz, (0, 1)))[0]
    x, y, z = place.coordinates[:, :3].unbind(dim=1)
    torch.manual_seed(0)
    layer = SparseConv(channels, channels, 3)
    values = torch.randn(len(place), channels)
    dense = torch.zeros(1, channels, *box)
    dense[0, :, x, y, z] = values.T
    # The kernel has x fastest among its offsets, z slowest.
    weight = layer.kernel.view(3, 3, 3, channels, channels).permute(4, 3, 2, 1, 0).contiguous()

    with torch.inference_mode():
        kernel_map = place.neighbors
        expected = F.conv3d(dense, weight, padding=1)[0, :, x, y, z].T
        difference = (layer(values, kernel_map) - expected).abs().max() / expected.abs().max()
        comparison = compare(
            {
                "ours, map known": core_case(lambda: layer(values, kernel_map)),
                "ours with the map": core_case(lambda: layer(values, Voxels(place.keys).neighbors)),
                "dense conv3d": core_case(lambda: F.conv3d(dense, weight, padding=1)),
            },
            rounds,
        )
    about = {
        "box": "x".join(map(str, box)),
        "channels": channels,
        "voxels": len(place),
        "occupied": round(len(place) / math.prod(box), 6),
        "neighbours": round(
            sum(len(pair[0]) if pair else len(place) for pair in kernel_map.pairs) / len(place), 3
        ),
    }
    return Agreement(comparison, float(difference), about)


def _extrapolated(
    jsd: Agreement, mmd: Agreement, timing: MatchingTiming
) -> dict[str, tuple[float, float]]:
    """Seconds of ours and of the plain way at the sizes of the published protocol."""
    once = [jsd.about[f"ms once, {name}"] / 1000 for name in jsd.comparison.ms]
    each = [
        (case.median / 1000 - fixed) / jsd.about["scenes"]
        for case, fixed in zip(jsd.comparison.ms.values(), once, strict=True)
    ]
    # The median of the rounds: pair costs are measured once, and may be off by several times.
    pairs = mmd.about["references"] * mmd.about["samples"]
    brute = mmd.comparison.ms["all cells with all"].median / 1000 / pairs
    count = PUBLISHED.num_samples
    references, samples = PUBLISHED.num_mmd_references, PUBLISHED.num_mmd_samples
    return {
        f"JSD, {count} scenes": (once[0] + count * each[0], once[1] + count * each[1]),
        f"MMD, {samples} x {references}": (
            timing.extrapolate(references, samples)[0],
            references * samples * brute,
        ),
    }


def _network_tables(networks: Mapping[str, MetricNetworkCost]) -> str:
    """Time and memory of the networks, and the parts of each."""
    rows = [
        [
            name,
            *(f"{value:.3g}" for value in cost.seconds),
            f"{cost.core_seconds:.3g}",
            f"{cost.first_seconds:.3g}",
            f"{cost.peak_host_bytes / 2**30:.2f}",
            f"{cost.before_host_bytes / 2**30:.2f}",
            f"{cost.parameters / 1e6:.1f}",
        ]
        for name, cost in networks.items()
    ]
    header = ["one scan", "median s", "min", "max", "core s", "first s", "peak GiB", "before"]
    lines = [format_table([*header, "M weights"], rows)]
    for name, cost in networks.items():
        whole = sum(part.core_seconds for part in cost.parts.values())
        shares = ", ".join(
            f"{key} {part.core_seconds:.3g} core s ({part.core_seconds / whole:.0%})"
            for key, part in cost.parts.items()
        )
        lines.append(f"{name}: {shares}")
    return "\n".join(lines)

"""What alignment targets cost: building feature grids, reading them back, and one network pass.

Grid building starts from the points and features of one scan in memory and ends with the mean of
each cell. Its floor is one sum over all features: no algorithm can do without reading each of them
once, and nothing here reads faster. The sum over points (one grid cell) is given beside it.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from r3dpa.bench.point_network import NetworkCost, network_cost
from r3dpa.bench.timing import Comparison, compare, seconds
from r3dpa.checkpoints.networks import format_table
from r3dpa.data import FeatureGrids, FeatureGridWriter, GridSettings, read_scan
from r3dpa.data.scans import Scan
from r3dpa.geometry import LidarSensor, SphericalProjection, in_range, pool_cells
from r3dpa.io import atomic_path, one_line, provenance
from r3dpa.nn.backbones import GeometricFeatures
from r3dpa.simulation import Street, Weather, hdl64e, simulate_scan

__all__ = ["features", "grid_building", "grid_reading", "open_seconds"]

_PROJECTION = SphericalProjection(LidarSensor())
_GRID_SIZE = (8, 64)
_BYTES = 16  # what the scans of the stores pretend to have
#: Formats of grids on disk: two of ours, and one file a scan as the official code writes it.
_STORES = ("float16", "int8")
_NPZ = {"npz float16": np.float16, "npz float64": np.float64}


@dataclass(frozen=True)
class _Sizes:
    """Effort: feature width, rounds of grid building; scans, reads and rounds of the stores."""

    dim: int = 768
    rounds: int = 15
    scans: int = 192
    reads: int = 96
    read_rounds: int = 9
    open_rows: int = 80_000


_QUICK = _Sizes(dim=8, rounds=3, scans=6, reads=4, read_rounds=2, open_rows=500)


def features(
    scan: Path | None = None, out: Path | None = None, quick: bool = False, wi48: bool = False
) -> str:
    """Measure all parts and say what they cost.

    Args:
        scan: KITTI ``.bin`` file; a simulated scan where None.
        out: JSON file for the same figures, without rounding.
        quick: Small sizes, only to try it.
        wi48: One pass of WI-48-768, too: minutes.

    Returns:
        A table for each part, and a line each about scan, machine and versions.

    Raises:
        ScanError: If the scan cannot be used.
    """
    sizes = _QUICK if quick else _Sizes()
    points = simulated_scan() if scan is None else torch.from_numpy(read_scan(scan, LidarSensor()))
    threads_given, cores = torch.get_num_threads(), os.cpu_count() or 1
    building = {}
    # A few threads on a busy machine wait for each other, for seconds: not when only trying.
    for threads in (threads_given,) if quick else sorted({1, cores}):
        torch.set_num_threads(threads)
        building[threads] = grid_building(points, sizes.dim, sizes.rounds)
    torch.set_num_threads(threads_given)
    with tempfile.TemporaryDirectory(prefix="r3dpa_bench_") as folder:
        store = Path(folder) / "grids"
        sizes_on_disk = _write_grids(store, sizes.scans, sizes.dim)
        reading = grid_reading(store, sizes.scans, sizes.reads, sizes.read_rounds)
        opening = open_seconds(Path(folder) / "long", sizes.open_rows)
    # The long pass last, so that nothing else runs on a machine that it has warmed up.
    names = ["wi3-24"] if quick else ["waffleiron-s", *(["wi48-768"] if wi48 else [])]
    networks = {name: network_cost(name, points) for name in names}

    facts = provenance(scan, len(points), np)
    if out is not None:
        content = {
            **facts,
            "grid_building": {f"{n} threads": asdict(case) for n, case in building.items()},
            "grid_reading": {
                "bytes_per_scan": sizes_on_disk,
                "reads_per_round": sizes.reads,
                **{name: asdict(case) for name, case in reading.items()},
            },
            "opening": {"rows": sizes.open_rows, "seconds": opening},
            "networks": {name: asdict(cost) for name, cost in networks.items()},
        }
        with atomic_path(out) as temporary:
            temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    lines: list[str] = []
    for threads, comparison in building.items():
        title = f"grid of {len(points)} points x {sizes.dim}, {threads} thread(s)"
        lines += [comparison_table(title, comparison), ""]
    for name, comparison in reading.items():
        lines += [_reading_table(name, comparison, sizes.reads, sizes_on_disk), ""]
    lines += [f"opening a store of {sizes.open_rows} grids: {opening:.3g} s", ""]
    for name, cost in networks.items():
        lines += [_network_table(name, cost), ""]
    return "\n".join([*lines, *(f"{name}: {one_line(values)}" for name, values in facts.items())])


def grid_building(points: Tensor, dim: int, rounds: int) -> Comparison:
    """Means of random features over the cells: ours, the floor, and a loop over the cells.

    Args:
        points: ``(P, 4)`` x, y, z in metres, intensity.
        dim: Width of the features.
        rounds: How often each case is run.
    """
    xyz = points[:, :3].contiguous()
    values = torch.randn(len(xyz), dim, generator=torch.Generator().manual_seed(0))
    ours, _ = pool_cells(xyz, values, _PROJECTION, _GRID_SIZE)
    torch.testing.assert_close(ours, _loop_over_cells(xyz, values), atol=1e-5, rtol=1e-4)
    return compare(
        {
            "ours": seconds(lambda: pool_cells(xyz, values, _PROJECTION, _GRID_SIZE)),
            "floor: read all features": seconds(values.sum),
            "sum over points": seconds(lambda: values.sum(dim=0)),
            "loop over cells": seconds(lambda: _loop_over_cells(xyz, values)),
        },
        rounds,
    )


def _loop_over_cells(xyz: Tensor, values: Tensor) -> Tensor:
    """The same grid as the official code makes it: a mask and a mean for each cell."""
    rows, columns = _PROJECTION.sensor.cell_size(_GRID_SIZE)
    row, column = _PROJECTION.pixel_of(xyz)
    cell = row // rows * _GRID_SIZE[1] + column // columns
    cell[~in_range(xyz, _PROJECTION.sensor)] = -1
    grid = values.new_zeros(_GRID_SIZE[0] * _GRID_SIZE[1], values.shape[1])
    for index in range(len(grid)):
        members = cell == index
        if members.any():
            grid[index] = values[members].mean(dim=0)
    return grid


def simulated_scan() -> Tensor:
    """A scan of a dry street."""
    scene = Street(0, 0, Weather()).scene(0)
    return torch.from_numpy(simulate_scan(scene, hdl64e(), (0, "effects", 0, 0)).points)


def _scan(number: int) -> Scan:
    return Scan("0000", f"{number:010d}", Path(f"{number:010d}.bin"))


def _write_grids(folder: Path, num_scans: int, dim: int) -> dict[str, float]:
    """The same random grids in each format; bytes on disk per scan of each."""
    generator = torch.Generator().manual_seed(0)
    samples = [(_scan(number), _BYTES) for number in range(num_scans)]
    extractor = GeometricFeatures(dim)
    with ExitStack() as stack:
        writers = [
            stack.enter_context(
                FeatureGridWriter(
                    folder / name, GridSettings.of(extractor, _PROJECTION, _GRID_SIZE, name)
                )
            )
            for name in _STORES
        ]
        for scan, num_bytes in samples:
            grid = torch.randn(1, _GRID_SIZE[0] * _GRID_SIZE[1], dim, generator=generator)
            for writer in writers:
                writer.add([(scan, num_bytes)], grid)
            for name, dtype in _NPZ.items():
                path = folder / name / f"{scan.frame}.npz"
                path.parent.mkdir(exist_ok=True)
                np.savez(path, feats=grid[0].numpy().astype(dtype))
    names = (*_STORES, *_NPZ)
    return {name: sum(map(_size, _files(folder / name))) / num_scans for name in names}


def grid_reading(folder: Path, num_scans: int, reads: int, rounds: int) -> dict[str, Comparison]:
    """Time to read random grids in each format, by cache and number of processes.

    Each process opens the format, which does not count, and reads its share of the grids as
    float32 tensors. "Cold" reads come after the files have left the page cache of this system; the
    host of a virtual machine may still hold them.

    Args:
        folder: What :func:`_write_grids` wrote.
        num_scans: Number of grids in each format.
        reads: Grids read in each round, by all processes together.
        rounds: How often each case is run.
    """
    order = np.random.default_rng(0)
    caches = ("warm", "cold") if hasattr(os, "posix_fadvise") else ("warm",)
    results = {}
    with ExitStack() as stack:
        # One pool each: of a pool of two, one process may take the work of both.
        pools = [
            stack.enter_context(
                ProcessPoolExecutor(1, get_context("spawn"), torch.set_num_threads, (1,))
            )
            for _ in range(2)
        ]

        def read_by(pools: Sequence[ProcessPoolExecutor], path: Path, cold: bool) -> float:
            picked = order.integers(0, num_scans, (len(pools), reads // len(pools))).tolist()
            if cold:
                _leave_cache(path)
            tasks = [
                pool.submit(_read_grids, path, num_scans, share)
                for pool, share in zip(pools, picked, strict=True)
            ]
            begin, end = zip(*(task.result() for task in tasks), strict=True)
            return max(end) - min(begin)

        for cache in caches:
            for processes in (1, 2):
                cases = {
                    name: lambda name=name, processes=processes, cache=cache: read_by(
                        pools[:processes], folder / name, cache == "cold"
                    )
                    for name in (*_STORES, *_NPZ)
                }
                results[f"{cache}, {processes} process(es)"] = compare(cases, rounds)
    return results


def _read_grids(path: Path, num_scans: int, numbers: Sequence[int]) -> tuple[float, float]:
    """When this process began to read the grids of these scans, and when it had them all.

    The clock is that of the system, the same for all processes.
    """
    read = _reader(path, num_scans)
    begin = time.monotonic()
    for number in numbers:
        read(number)
    return begin, time.monotonic()


def _reader(path: Path, num_scans: int) -> Callable[[int], Tensor]:
    if path.name in _STORES:
        scans = [_scan(number) for number in range(num_scans)]
        store = FeatureGrids(path, scans, _PROJECTION, _GRID_SIZE)
        return lambda number: store.read(scans[number], _BYTES)

    def read(number: int) -> Tensor:
        with np.load(path / f"{_scan(number).frame}.npz") as content:
            return torch.from_numpy(content["feats"].astype(np.float32))

    return read


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*") if path.is_file())


def _size(path: Path) -> int:
    return path.stat().st_size


def _leave_cache(folder: Path) -> None:
    """Drop the pages of all files from the page cache; only what is on disk can leave it."""
    for path in _files(folder):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        finally:
            os.close(descriptor)


def open_seconds(folder: Path, rows: int) -> float:
    """Median of three times to open a store of many grids, each of two numbers."""
    extractor, samples = GeometricFeatures(2), [(_scan(number), _BYTES) for number in range(rows)]
    with FeatureGridWriter(folder, GridSettings.of(extractor, _PROJECTION, (1, 1))) as writer:
        writer.add(samples, torch.zeros(rows, 1, 2))
    scans = [scan for scan, _ in samples]
    opened = seconds(lambda: FeatureGrids(folder, scans, _PROJECTION, (1, 1), extractor))
    return sorted(opened() for _ in range(3))[1]


def _verdict(comparison: Comparison) -> str:
    repeat = comparison.repeat
    found = f"{repeat.value:.3f} ({repeat.low:.3f}..{repeat.high:.3f})"
    end = "" if comparison.sound else ": the machine was too busy, claim nothing"
    return f"first case over itself: {found}{end}"


def comparison_table(title: str, comparison: Comparison) -> str:
    """Times and ratios of the cases."""
    rows = []
    for name, ms in comparison.ms.items():
        ratio = comparison.over_first.get(name)
        cell = "1" if ratio is None else f"{ratio.value:.3g} ({ratio.low:.3g}..{ratio.high:.3g})"
        rows.append([name, *(f"{value:.2f}" for value in (ms.median, ms.min, ms.max)), cell])
    header = [title, "median ms", "min", "max", "over the first"]
    return f"{format_table(header, rows)}\n{_verdict(comparison)}"


def _reading_table(
    title: str, comparison: Comparison, reads: int, num_bytes: Mapping[str, float]
) -> str:
    """Reads per second and bytes of the formats."""
    rows = []
    for name, ms in comparison.ms.items():
        ratio = comparison.over_first.get(name)
        cells = [f"{1000 * reads / ms.median:.0f}", f"{num_bytes[name] / 1000:.0f}"]
        rows.append([name, *cells, "1" if ratio is None else f"{ratio.value:.3g}"])
    header = [f"reading, {title}", "grids/s", "kB/grid", "time over the first"]
    return f"{format_table(header, rows)}\n{_verdict(comparison)}"


def _network_table(name: str, cost: NetworkCost) -> str:
    """Time, work and floor of the parts of a network."""
    rows = [
        [
            part,
            f"{spent.seconds:.3g}",
            f"{spent.core_seconds:.3g}",
            f"{spent.core_seconds / cost.core_seconds:.1%}",
            f"{spent.flop / 1e9:.4g}",
            f"{spent.num_bytes / 1e9:.3g}",
            f"{spent.flop / max(spent.core_seconds, 1e-9) / 1e9:.3g}",
            f"{spent.floor_core_seconds:.3g}",
        ]
        for part, spent in cost.parts.items()
    ]
    header = [name, "wall s", "core s", "share", "GFLOP", "GB", "GFLOP/s", "floor core s"]
    total, seen = cost.points
    return "\n".join(
        [
            format_table(header, rows),
            f"{cost.seconds:.3g} s, {cost.core_seconds:.3g} core s for {total} points ({seen} "
            f"seen), peak {cost.peak_host_bytes / 2**30:.2f} GiB; per core second: matrix product "
            f"{cost.gflop_s:.3g} GFLOP, memory {cost.read_gb_s:.3g} GB",
        ]
    )

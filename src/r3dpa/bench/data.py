"""What the data cost: scans per second of each step from the simulator to a training batch."""

from __future__ import annotations

import json
import logging
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import cast

import lightning as L
import torch
from torch.utils.data import DataLoader

from r3dpa.bench.timing import Comparison, compare, seconds
from r3dpa.checkpoints.networks import format_table
from r3dpa.data import CachedTensors, FeatureGrids, TensorCache, read_scan
from r3dpa.data.datamodules import LidarDataModule
from r3dpa.data.datasets import LidarDataset
from r3dpa.data.scans import Scan
from r3dpa.geometry import LidarSensor, range_image
from r3dpa.io import atomic_path, one_line, provenance
from r3dpa.nn.backbones import GeometricFeatures
from r3dpa.simulation import simulate

__all__ = ["data"]

_LATENT_CHANNELS = 8
_STRIDE = (4, 8)  # of the VAE h2p4d8
_BATCH_SIZE = 4

Cases = dict[str, Callable[[], float]]


def data(quick: bool = False, out: Path | None = None) -> str:
    """Simulate, read, project and load scans; count the scans per second of each step.

    The steps run in turn, round by round, see :mod:`r3dpa.bench.timing`. What is read was read
    before: it comes from memory, not from a disk.

    Args:
        quick: Eight scans as 32 x 256 images and few rounds in place of 32 as 64 x 1024.
        out: JSON file for the same figures.

    Returns:
        A table of the steps in one process, one of whole loaders, and a line each about settings,
        machine and versions. ``time`` is that of the row over that of the first one of its table,
        with its 95 % interval.
    """
    # How many grids and images were made: beside the point here.
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    num_scans, rounds, loader_rounds = (8, 5, 3) if quick else (32, 20, 8)
    sensor = LidarSensor(beams=32, columns=256) if quick else LidarSensor()
    with tempfile.TemporaryDirectory(prefix="r3dpa_bench_") as name:
        folder = Path(name)
        start = time.perf_counter()
        simulate(folder / "scans", scans=num_scans)
        simulated = num_scans / (time.perf_counter() - start)
        projecting, caching = (
            _data(folder, sensor, images_dir) for images_dir in (None, str(folder / "images"))
        )
        scans = _set_of(projecting).scans
        num_points = len(read_scan(scans[0].path))
        steps = compare(_steps(projecting, caching, folder), rounds)
        loaders = compare(_loaders(projecting, caching), loader_rounds)
    settings = {
        "scans": num_scans,
        "image": f"{sensor.beams} x {sensor.columns}",
        "rounds": rounds,
        "loader_rounds": loader_rounds,
        "batch_size": _BATCH_SIZE,
    }
    about = {"settings": settings, **provenance(None, num_points, L)}
    if out is not None:
        content = {
            **about,
            "simulated_scans_per_second": simulated,
            "scans_per_second": _rates(steps, num_scans) | _rates(loaders, num_scans),
            "steps": asdict(steps),
            "loaders": asdict(loaders),
        }
        with atomic_path(out) as temporary:
            temporary.write_text(json.dumps(content, indent=2) + "\n")
    lines = [
        f"simulate: {simulated:.3g} scans/s",
        _table("step", steps, num_scans),
        _table("loader", loaders, num_scans),
        *(f"{key}: {one_line(value)}" for key, value in about.items()),
    ]
    return "\n".join(lines)


def _data(folder: Path, sensor: LidarSensor, images_dir: str | None) -> LidarDataModule:
    datamodule = LidarDataModule(
        str(folder / "scans"),
        sensor=sensor,
        grid_size=(sensor.beams // 8, sensor.columns // 16),
        extractor=GeometricFeatures(768),
        batch_size=_BATCH_SIZE,
        val_every=None,
        images_dir=images_dir,
    )
    datamodule.prepare_data()
    datamodule.setup("fit")
    return datamodule


def _set_of(datamodule: LidarDataModule) -> LidarDataset:
    return cast(LidarDataset, datamodule.train_set)


def _steps(projecting: LidarDataModule, caching: LidarDataModule, folder: Path) -> Cases:
    """All scans through each step of a loader, one after the other."""
    projected, cached = _set_of(projecting), _set_of(caching)
    scans, images = projected.scans, cast(CachedTensors, cached.images)
    grids = cast(FeatureGrids, projected.grids)
    sizes = [scan.path.stat().st_size for scan in scans]
    points = [torch.from_numpy(read_scan(scan.path)[:, :3]) for scan in scans]
    sensor = projecting.sensor
    shape = (2 * _LATENT_CHANNELS, sensor.beams // _STRIDE[0], sensor.columns // _STRIDE[1])
    cache: TensorCache[Scan] = TensorCache(folder, "posterior", {}, shape)
    with cache.writer() as add:
        add(scans, torch.zeros(len(scans), *shape))
    posteriors = CachedTensors(cache, scans)

    def project() -> None:
        for each in points:
            projecting.codec.encode(range_image(each, projecting.projection)[0])

    return {
        "read .bin": seconds(lambda: [read_scan(scan.path, sensor) for scan in scans]),
        "project": seconds(project),
        "read a feature grid": seconds(
            lambda: [grids.read(scan, size) for scan, size in zip(scans, sizes, strict=True)]
        ),
        "read a cached image": seconds(lambda: [images.read(scan) for scan in scans]),
        "read a cached posterior": seconds(lambda: [posteriors.read(scan) for scan in scans]),
        "sample, projected": seconds(lambda: [projected[i] for i in range(len(scans))]),
        "sample, cached": seconds(lambda: [cached[i] for i in range(len(scans))]),
    }


def _loaders(projecting: LidarDataModule, caching: LidarDataModule) -> Cases:
    """An epoch of training batches; loader processes are started before the first that counts."""
    cases = {}
    for kind, datamodule in (("projected", projecting), ("cached", caching)):
        for workers in (0, 1, 2):
            datamodule.num_workers = workers
            loader = datamodule.train_dataloader()
            cases[f"{kind}, {workers} workers"] = seconds(partial(_drain, loader))
    return cases


def _drain(loader: DataLoader[object]) -> None:
    for _ in loader:
        pass


def _rates(comparison: Comparison, num_scans: int) -> dict[str, float]:
    return {name: 1000 * num_scans / times.median for name, times in comparison.ms.items()}


def _table(name: str, comparison: Comparison, num_scans: int) -> str:
    rows = []
    for case, rate in _rates(comparison, num_scans).items():
        ratio = comparison.over_first.get(case)
        time_ = "1" if ratio is None else f"{ratio.value:.3g} [{ratio.low:.3g}, {ratio.high:.3g}]"
        rows.append([case, f"{rate:.4g}", time_])
    again = comparison.repeat
    sound = "sound" if comparison.sound else "NOT SOUND: the ratios are no evidence"
    check = f"first case again: {again.value:.3g} [{again.low:.3g}, {again.high:.3g}], {sound}"
    return f"{format_table([name, 'scans/s', 'time'], rows)}\n{check}"

"""``r3dpa data``: simulated scans, checks of data sets, and mean features of object classes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from r3dpa.cli.parser import check_file

if TYPE_CHECKING:  # read by jsonargparse for the options of `simulate`
    from r3dpa.simulation import Weather
MYPY = False  # true for mypy alone
if MYPY:
    from r3dpa.data.objects import ObjectLibrary
    from r3dpa.geometry import LidarSensor

__all__ = ["check", "objects", "simulate"]


def simulate(
    *,
    out: Path,
    scans: int = 100,
    seed: int = 0,
    workers: int = 1,
    drives: list[str] | None = None,
    sensor: str = "hdl64e",
    return_mode: Literal["strongest", "dual"] = "strongest",
    effects: dict[str, str | bool] | None = None,
    weather: Weather | None = None,
) -> Any:
    """Write simulated scans in the KITTI-360 layout.

    The same command completes an interrupted run. Prints the cost of each effect, which
    ``report.json`` keeps; ``sim/*.json`` has it for each scan.

    Args:
        out: Root of the data set to write.
        scans: Number of scans over all drives.
        seed: Seed of streets and instrument.
        workers: Processes; the bytes written do not depend on it.
        drives: Four-digit drives to fill, such as ``0000 0003``; default: all official ones.
        sensor: ``hdl64e``, ``hdl32e``, ``vls128``, or a calibration YAML as ``velodyne_pointcloud``
            reads, for an HDL-64E.
        return_mode: Strongest return of each shot, or the two strongest.
        effects: ``auto``, ``on`` or ``off`` by effect, such as ``--effects.fog off``; default: an
            effect runs where the scene calls for it.
        weather: Weather of all scans, such as ``--weather.rain_mm_h 10``; default: random.
    """
    from r3dpa.simulation import load_sensor
    from r3dpa.simulation import simulate as write

    lidar = load_sensor(sensor, return_mode=return_mode)
    return write(out, scans, seed, workers, drives, lidar, effects, weather)


def check(path: Path) -> None:
    """List every bad scan and missing folder of a data set; exit with 1 if there is any.

    Args:
        path: Root in the KITTI-360 layout, or any folder of ``.bin`` scans.
    """
    from r3dpa.data.checks import check as check_scans

    report = check_scans(path)
    sys.stdout.write(f"{report}\n")
    if not report.ok:
        sys.exit(1)


def objects(
    *,
    data: str,
    out: Path,
    like: Path | None = None,
    source: str = "geometric",
    features_ckpt: Path | None = None,
    classes: list[str] | None = None,
    limit: int = 200,
    dim: int = 768,
    grid_size: tuple[int, int] = (8, 64),
    device: str = "auto",
) -> str:
    """Write the mean feature of each class of labelled scans, for ``r3dpa edit inpaint``.

    Args:
        data: Folder, file or glob of scans with labels beside them: of ``r3dpa simulate``,
            KITTI-360, SemanticKITTI, or the boxes of the KITTI object benchmark.
        out: File to write, ``.safetensors``.
        like: Checkpoint of a model that the objects are for; gives source, dim, sensor and
            grid_size.
        source: Feature source: ``geometric``, ``waffleiron-s`` or ``scalr``.
        features_ckpt: Weights of the feature source, if it has none of its own.
        classes: Names of classes; default: all in the scans.
        limit: Number of scans at most, evenly spread.
        dim: Width of the features.
        grid_size: Rows and columns of the cells.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    from tqdm import tqdm

    from r3dpa.data import find_scans
    from r3dpa.data.objects import object_library
    from r3dpa.data.scans import evenly
    from r3dpa.geometry import LidarSensor, SphericalProjection
    from r3dpa.io import usable_device
    from r3dpa.nn.backbones import feature_source

    check_file(out)
    if out.suffix != ".safetensors":
        raise ValueError(f"the library is a .safetensors file, got {out}")
    if limit < 1:
        raise ValueError(f"limit must be at least 1, got {limit}")
    sensor = LidarSensor()
    if like is not None:
        source, dim, sensor, grid_size = _settings_of(like)
    scans = evenly(find_scans(data), limit)
    extractor: Any = feature_source(source, features_ckpt, dim).to(usable_device(device))
    shown = tqdm(scans, unit="scan", desc="objects", disable=None)
    projection = SphericalProjection(sensor)
    library = object_library(iter(shown), extractor, projection, grid_size, classes)
    library.save(out)
    return f"{_table(library)}\n\n{len(scans)} scans, features of {source}, written to {out}"


def _settings_of(ckpt: Path) -> tuple[str, int, LidarSensor, tuple[int, int]]:
    """Feature source, width, sensor and grid size of a checkpoint."""
    from r3dpa.checkpoints import read_checkpoint
    from r3dpa.cli.edit_session import without_features
    from r3dpa.generation import SceneGenerator

    checkpoint = read_checkpoint(ckpt)
    generator = SceneGenerator.from_checkpoint(checkpoint, device="cpu")
    if checkpoint.feature_source is None:
        raise ValueError(without_features(ckpt))
    sit, sensor = generator.sit, generator.geometry.projection.sensor
    return checkpoint.feature_source, sit.feature_dim, sensor, sit.grid_size


def _table(library: ObjectLibrary) -> str:
    """Classes with their counts, and the nearest other class of each."""
    import torch.nn.functional as F
    from tabulate import tabulate

    directions = F.normalize(library.features, dim=1)
    cosines = (directions @ directions.T).fill_diagonal_(-1)
    rows: list[Sequence[Any]] = []
    for index, entry in enumerate(library.classes):
        other = int(cosines[index].argmax())
        nearest = f"{library.names[other]} ({cosines[index, other]:.2f})"
        counts = entry.num_scans, entry.num_cells, entry.num_points
        alone = len(library.names) == 1
        rows.append([entry.name, *counts, f"{entry.spread:.3f}", "-" if alone else nearest])
    head = ["class", "scans", "cells", "points", "spread", "nearest class (cosine)"]
    table = tabulate(rows, head, tablefmt="plain", disable_numparse=True, stralign="right")
    return f"{table}\n\nSpread: mean of 1 - cosine between the class's feature and its cells."

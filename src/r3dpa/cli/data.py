"""``r3dpa data``: checks of data sets, and mean features of object classes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from r3dpa.cli.parser import check_file, check_least

MYPY = False  # true for mypy; jsonargparse would run a TYPE_CHECKING block, and import torch
if MYPY:
    from r3dpa.data.objects import ObjectLibrary

__all__ = ["check", "objects"]


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

    from r3dpa.checkpoints import read_checkpoint
    from r3dpa.cli.edit_session import source_of
    from r3dpa.data import find_scans
    from r3dpa.data.objects import object_library
    from r3dpa.data.scans import evenly
    from r3dpa.generation import SceneGenerator
    from r3dpa.geometry import LidarSensor, SphericalProjection
    from r3dpa.io import usable_device
    from r3dpa.nn.backbones import feature_source

    check_file(out)
    if out.suffix != ".safetensors":
        raise ValueError(f"the library is a .safetensors file, got {out}")
    check_least(1, limit=limit)
    sensor = LidarSensor()
    if like is not None:
        generator = SceneGenerator.from_checkpoint(like, device="cpu")
        source = source_of(read_checkpoint(like))
        dim, grid_size = generator.sit.feature_dim, generator.sit.grid_size
        sensor = generator.geometry.projection.sensor
    scans = evenly(find_scans(data), limit)
    extractor: Any = feature_source(source, features_ckpt, dim).to(usable_device(device))
    shown = tqdm(scans, unit="scan", desc="objects", disable=None)
    projection = SphericalProjection(sensor)
    library = object_library(iter(shown), extractor, projection, grid_size, classes)
    library.save(out)
    return f"{_table(library)}\n\n{len(scans)} scans, features of {source}, written to {out}"


def _table(library: ObjectLibrary) -> str:
    """Classes with their counts, and the nearest other class of each."""
    import torch.nn.functional as F

    from r3dpa.io import text_table

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
    table = text_table(rows, head, "rrrrrr", "plain")
    return f"{table}\n\nSpread: mean of 1 - cosine between the class's feature and its cells."

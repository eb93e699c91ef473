"""``r3dpa objects``: mean features of classes of objects, from labelled scans."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch.nn.functional as F
from tqdm import tqdm

from r3dpa.data import Scan, find_scans
from r3dpa.data.objects import ObjectLibrary, object_library
from r3dpa.data.scans import evenly
from r3dpa.geometry import LidarSensor, SphericalProjection
from r3dpa.io import usable_device
from r3dpa.nn.backbones import feature_source

__all__ = ["objects"]


def objects(
    data: str | Sequence[str],
    out: Path,
    source: str = "geometric",
    ckpt: Path | None = None,
    classes: Sequence[str] = (),
    limit: int | None = 200,
    dim: int = 768,
    sensor: LidarSensor | None = None,
    grid_size: tuple[int, int] = (8, 64),
    device: str = "auto",
) -> str:
    """Write an object library: the mean feature of each class over labelled scans.

    Args:
        data: Folder, file, glob or list of ``.bin`` scans with labels beside them: of ``r3dpa
            simulate``, KITTI-360, SemanticKITTI, or the boxes of the KITTI object benchmark.
        out: File to write, ``.safetensors``.
        source: Feature source, that of the checkpoint which the library is for; see
            :func:`r3dpa.nn.backbones.feature_source`.
        ckpt: Weights of the source.
        classes: Names of classes; all that the scans show where empty.
        limit: Use this many scans at most, evenly spread; all where None.
        dim: Width of the features.
        sensor: Of the range images, on which the cells lie; the default one where None.
        grid_size: Rows and columns of the cells.
        device: Where the features are computed; ``auto`` for the GPU where there is one.

    Returns:
        A table with a row for each class, and what was made from what.

    Raises:
        ScanError: If a scan or its labels cannot be used; names the file.
        ValueError: If a name or number is not one that can be used; tells which.
    """
    if out.suffix != ".safetensors":
        raise ValueError(f"the library is a .safetensors file, got {out}")
    if limit is not None and limit < 1:
        raise ValueError(f"limit must be 1 or greater, got {limit}")
    device = usable_device(device)
    scans = evenly(find_scans(data), limit)
    extractor: Any = feature_source(source, ckpt, dim).to(device)
    projection = SphericalProjection(sensor or LidarSensor())
    library = object_library(_shown(scans), extractor, projection, grid_size, list(classes) or None)
    library.save(out)
    return f"{_table(library)}\n\n{len(scans)} scans, features of {source}, written to {out}"


def _shown(scans: Sequence[Scan]) -> Iterator[Scan]:
    yield from tqdm(scans, unit="scan", desc="objects", disable=None)


def _table(library: ObjectLibrary) -> str:
    """Classes, what they were made from, and the class that is nearest to each."""
    directions = F.normalize(library.features, dim=1)
    cosines = (directions @ directions.T).fill_diagonal_(-1)
    rows = [["class", "scans", "cells", "points", "spread", "nearest class (cosine)"]]
    for index, entry in enumerate(library.classes):
        other = int(cosines[index].argmax())
        nearest = f"{library.names[other]} ({cosines[index, other]:.2f})"
        counts = [str(n) for n in (entry.num_scans, entry.num_cells, entry.num_points)]
        alone = len(library.names) == 1
        rows.append([entry.name, *counts, f"{entry.spread:.3f}", "-" if alone else nearest])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True))
        for row in rows
    ]
    lines += ["", "Spread: mean of 1 - cosine between the class's feature and those of its cells."]
    return "\n".join(lines)

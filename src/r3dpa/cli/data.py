"""``r3dpa data``: checks and views of data sets, and mean features of object classes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from r3dpa.cli.parser import check_file, check_folder, check_least

MYPY = False  # true for mypy; jsonargparse would run a TYPE_CHECKING block, and import torch
if MYPY:
    from collections.abc import Callable

    from r3dpa import viz
    from r3dpa.data.objects import ObjectLibrary

__all__ = ["check", "objects", "view"]


def check(path: Path) -> None:
    """List every bad scan and missing folder of a data set; exit with 1 if there is any.

    Args:
        path: Root in the KITTI-360 layout, or any folder of ``.bin`` scans.
    """
    from r3dpa.data.scans import check as check_scans

    report = check_scans(path)
    sys.stdout.write(f"{report}\n")
    if not report.ok:
        sys.exit(1)


def view(
    source: Path, *, out: Path | None = None, num: int = 8, reference: Path | None = None
) -> str:
    """Draw scans as range images, from above, and as a page with point clouds to turn.

    Args:
        source: A ``.bin``, ``.ply`` or ``.npz`` file, or a folder of ``.bin`` scans in any layout.
        out: Folder for the pictures and the page; default: ``view/<name of the source>``.
        num: Scans to show at most, evenly spread over the folder.
        reference: Scan to show beside the others, such as a real one beside simulated ones.
    """
    from r3dpa import viz
    from r3dpa.cli.scene_files import write_page
    from r3dpa.data.scans import evenly
    from r3dpa.geometry import LidarSensor, SphericalProjection

    check_least(1, num=num)
    check_folder(out)
    readers = _readers(source)
    scans = [read() for read in evenly(readers, num)]
    beside = None
    if reference is not None:
        first = _readers(reference)[0]()
        beside = replace(first, name=f"reference: {first.name}")  # unlike every other name
    drawn = {scan.name: scan.points for scan in [*scans, *([beside] if beside else [])]}
    resolved = source.resolve()
    out = out or Path("view") / (resolved.name if resolved.is_dir() else resolved.stem)
    pictures = {
        "range_images.png": viz.range_strips(drawn, SphericalProjection(LidarSensor())),
        "birds_eye.png": viz.birds_eye_sheet(drawn),
    }
    paths = [viz.save(figure, out / name) for name, figure in pictures.items()]
    paths.append(write_page(out / "view.html", scans, f"{resolved.name} - r3dpa view", beside))
    lines = [f"{len(scans)} of {len(readers)} scans in {source}"]
    if beside:
        lines.append(beside.name)
    return "\n".join([*lines, *map(str, paths), "open the .html file in a browser"])


def _readers(source: Path) -> list[Callable[[], viz.PageScan]]:
    """Readers of the scans of a folder or file, in order."""
    from r3dpa import viz
    from r3dpa.cli.scene_files import read_clouds
    from r3dpa.data.scans import find_scans, read_beside

    def read(name: str, path: Path) -> viz.PageScan:
        (points,) = read_clouds(path).values()
        if path.suffix == ".ply":
            return viz.PageScan(name, points)
        return viz.PageScan(name, points, read_beside(path, "labels"), read_beside(path, "origins"))

    if source.suffix == ".npz" and source.is_file():
        clouds = read_clouds(source).items()
        return [partial(viz.PageScan, f"{source.stem}/{name}", points) for name, points in clouds]
    scans = find_scans(source)
    if not source.is_file():
        return [partial(read, scan.name, scan.path) for scan in scans]
    path = scans[0].path
    in_layout = path.parts[-3:-1] == ("velodyne_points", "data")  # of KITTI-360
    parent = path.parents[2] if in_layout else path.parent
    return [partial(read, f"{parent.name}/{path.stem}", path)]


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
            KITTI-360 or SemanticKITTI.
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

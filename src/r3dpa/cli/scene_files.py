"""Files that several commands read or write: clouds, pictures of scenes, pages, provenance."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

import r3dpa
from lidarsim import Origin, Semantic
from lidarsim.scan_files import read_beside, read_clouds
from r3dpa import viz
from r3dpa.baselines import BaselineGenerator
from r3dpa.checkpoints import Checkpoint
from r3dpa.cli.parser import SceneOptions
from r3dpa.data.scans import find_scans
from r3dpa.data.scene_writer import SceneWriter
from r3dpa.generation import SceneGenerator
from r3dpa.geometry import ScanGeometry, points_of
from r3dpa.io import source_commit, write_text
from r3dpa.pretrained import without_features

# Colours that people expect (plants are green), and quiet ones for what is everywhere; a category
# that is not named here takes one of the palette.
_COLOURS = dict(
    re.findall(
        r"(\w+) (#\w+)",
        "UNLABELED #8a8f98 ROAD #75688f SIDEWALK #c77dba TERRAIN #a7c957 BUILDING #c9b48c "
        "WALL #a08c80 FENCE #c08552 POLE #f2f2f2 SIGN #ffd84d VEGETATION #46b36b PERSON #ff5c5c "
        "RIDER #ff9f1c CAR #4e9bff TRUCK #2459c4 BUS #00b8a9 BICYCLE #e056fd EGO_VEHICLE #3d4450 "
        "PARKING #8f7fae TRAFFIC_LIGHT #ff8c42 CARAVAN #86b8ff TRAILER #6f83d6 MOTORCYCLE #a23bbf "
        "GARAGE #b59a72 GATE #dba15f STOP #2fd6c4 SMALL_POLE #d9d9d9 LAMP #fff3b0 "
        "TRASH_BIN #9c6644 BOX #bc8f5f UNKNOWN_CONSTRUCTION #d4a373 UNKNOWN_OBJECT #c9ada7 "
        "SURFACE #56606e "
        "MIXED #ffb000 FOLIAGE #46b36b GLASS #5ce1e6 MIRROR #c792ea FOG #aab4c8 RAIN #4e9bff "
        "SNOW #ffffff SPRAY #7fd1ff BLOOMING #ff6b6b SUN #ffe14d SECOND_RETURN #f78fb3",
    )
)
_ON_SHEET, _ON_PAGE = 16, 8


def written(path: Path) -> str:
    """Time of the last change of a file: the same name may hold other weights later."""
    return datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat()


def feature_source_of(checkpoint: Checkpoint) -> str:
    """Feature source of a checkpoint; raises a ValueError if it was trained without."""
    if checkpoint.feature_source is None:
        raise without_features(checkpoint.path)
    return checkpoint.feature_source


def provenance(
    checkpoint: Checkpoint, options: SceneOptions, num: int, device: str, geometry: ScanGeometry
) -> dict[str, Any]:
    """Checkpoint, request, geometry and versions, as the metadata of scenes holds them."""
    trained = ("stage", "step", "feature_source", "interpolant")
    about = {name: getattr(checkpoint, name) for name in trained}
    about |= {name: getattr(options, name) for name in ("weights", "seed", "batch_size")}
    return about | {
        "checkpoint": str(options.ckpt),
        "checkpoint_written": written(checkpoint.path),
        "num": num,
        "device": device,
        "formats": list(options.formats),
        "geometry": geometry.to_dict(),
        "r3dpa": r3dpa.__version__,
        "commit": source_commit(),
        "torch": torch.__version__,
    }


def generate_all(
    generator: SceneGenerator | BaselineGenerator, writer: SceneWriter, batch_size: int, seed: int
) -> dict[str, Any]:
    """Generates and writes the missing scenes; returns evaluations and time."""
    first_index, start = writer.num_done, time.perf_counter()
    with tqdm(
        total=writer.num, initial=first_index, unit="scene", desc="sampling", disable=None
    ) as progress:
        for first in range(first_index, writer.num, batch_size):
            indices = range(first, min(first + batch_size, writer.num))
            batch = generator.generate(indices, seed)
            writer.put(batch.range_m, batch.nfe, batch.intensity, batch.labels)
            progress.update(len(indices))
    writer.close()
    elapsed, drawn = time.perf_counter() - start, writer.num - first_index
    nfe = writer.evaluations / writer.num  # a fraction only if a solver chooses its steps
    return {
        "nfe": int(nfe) if nfe.is_integer() else nfe,
        "drawn_by_last_run": drawn,
        "seconds_per_scene": elapsed / drawn if drawn else None,
        "threads": torch.get_num_threads(),
    }


def draw_scene(out: Path, index: int, range_m: Tensor, geometry: ScanGeometry) -> None:
    """Pictures of a scene ``(H, W)``: range image, from above and from behind."""
    sensor, points = geometry.projection.sensor, points_of(range_m, geometry.projection)
    picture = viz.range_image_picture(range_m, sensor, scale=max(1, 1024 // sensor.columns))
    viz.save(picture, out / "range" / f"{index:06d}.png")
    viz.save(viz.birds_eye_view(points), out / "birds_eye" / f"{index:06d}.png")
    viz.save(viz.scene_3d(points), out / "scene_3d" / f"{index:06d}.png")


def draw_all(out: Path, range_path: Path, pictures: int, geometry: ScanGeometry) -> str:
    """Draws the first scenes, a sheet of them and a page; returns what to open."""
    ranges = np.load(range_path, mmap_mode="r")
    drawn = [torch.from_numpy(np.array(range_m)) for range_m in ranges[:pictures]]
    if not drawn:
        return ""
    for index, range_m in enumerate(drawn):
        draw_scene(out, index, range_m, geometry)
    viz.save(viz.scenes_sheet(drawn[:_ON_SHEET], geometry.projection), out / "scenes.png")
    scans = [
        viz.PageScan(
            f"scene {index:06d}",
            points_of(image, geometry.projection).numpy(),
            _written_labels(out, index),
        )
        for index, image in enumerate(drawn[:_ON_PAGE])
        if (image > 0).any()  # neither empty nor NaN
    ]
    if not scans:
        return f"open {out / 'scenes.png'}"
    page = write_page(out / "scenes.html", scans, f"{out.resolve().name} - r3dpa sample")
    return f"open {out / 'scenes.png'} and {page}"


def _written_labels(out: Path, index: int) -> NDArray | None:
    """Labels of the points of a scene that a writer has written, if scenes have them."""
    path = out / "labels" / f"{index:06d}.label"
    return np.fromfile(path, dtype="<u4") if path.exists() else None


def page_scans(source: Path, columns: Sequence[str] = ()) -> list[Callable[[], viz.PageScan]]:
    """Readers of the scans of a folder or file, in order."""

    def read(name: str, path: Path) -> viz.PageScan:
        (points,) = read_clouds(path, columns).values()
        if path.suffix != ".bin":
            return viz.PageScan(name, points)
        return viz.PageScan(name, points, read_beside(path, "labels"), read_beside(path, "origins"))

    if source.suffix == ".npz" and source.is_file():
        clouds = read_clouds(source, columns).items()
        return [partial(viz.PageScan, f"{source.stem}/{name}", points) for name, points in clouds]
    return [partial(read, scan.name, scan.path) for scan in find_scans(source)]


def write_page(
    path: Path,
    scans: Sequence[viz.PageScan],
    title: str,
    origins: Mapping[int, viz.Category] | None = None,
    **options: Any,
) -> Path:
    """Writes a page of point clouds, coloured by the classes and origins of the simulator too.

    ``origins`` are further ones; ``options`` those of :func:`r3dpa.viz.scan_page`.
    """
    made_by = _categories(Origin) | dict(origins or {})
    page = viz.scan_page(scans, title, _categories(Semantic), made_by, **options)
    write_text(path, page)
    return path


def _categories(names: type[IntEnum]) -> dict[int, viz.Category]:
    return {
        int(member): viz.Category(member.name.lower().replace("_", " "), _COLOURS.get(member.name))
        for member in names
    }

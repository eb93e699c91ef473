"""Scenes and scans as files to look at: pictures, a sheet of them, and a page to turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray
from torch import Tensor

from lidarsim import Origin, Semantic
from r3dpa.geometry import Projection, ScanGeometry, points_of
from r3dpa.io import write_text
from r3dpa.viz.figures import birds_eye_view, scenes_sheet, strip_sheet
from r3dpa.viz.page import Category, PageScan, category_rows, scan_page
from r3dpa.viz.pictures import as_bytes, range_image_picture, save, scene_3d

# Colours that people expect (plants are green), and quiet ones for what is everywhere; a category
# without one takes a colour of the palette.
COLOURS = {
    "UNLABELED": "#8a8f98",
    "ROAD": "#75688f",
    "SIDEWALK": "#c77dba",
    "TERRAIN": "#a7c957",
    "BUILDING": "#c9b48c",
    "WALL": "#a08c80",
    "FENCE": "#c08552",
    "POLE": "#f2f2f2",
    "SIGN": "#ffd84d",
    "VEGETATION": "#46b36b",
    "PERSON": "#ff5c5c",
    "RIDER": "#ff9f1c",
    "CAR": "#4e9bff",
    "TRUCK": "#2459c4",
    "BUS": "#00b8a9",
    "BICYCLE": "#e056fd",
    "EGO_VEHICLE": "#3d4450",
    "PARKING": "#8f7fae",
    "TRAFFIC_LIGHT": "#ff8c42",
    "CARAVAN": "#86b8ff",
    "TRAILER": "#6f83d6",
    "MOTORCYCLE": "#a23bbf",
    "GARAGE": "#b59a72",
    "GATE": "#dba15f",
    "STOP": "#2fd6c4",
    "SMALL_POLE": "#d9d9d9",
    "LAMP": "#fff3b0",
    "TRASH_BIN": "#9c6644",
    "BOX": "#bc8f5f",
    "UNKNOWN_CONSTRUCTION": "#d4a373",
    "UNKNOWN_OBJECT": "#c9ada7",
    "SURFACE": "#56606e",
    "MIXED": "#ffb000",
    "FOLIAGE": "#46b36b",
    "GLASS": "#5ce1e6",
    "MIRROR": "#c792ea",
    "FOG": "#aab4c8",
    "RAIN": "#4e9bff",
    "SNOW": "#ffffff",
    "SPRAY": "#7fd1ff",
    "BLOOMING": "#ff6b6b",
    "SUN": "#ffe14d",
    "SECOND_RETURN": "#f78fb3",
}
_ON_SHEET, _ON_PAGE = 16, 8


def draw_scene(out: Path, index: int, range_m: Tensor, geometry: ScanGeometry) -> None:
    """Draw pictures of a scene ``(H, W)``: range image, from above and from behind."""
    sensor = geometry.projection.sensor
    points = points_of(range_m, geometry.projection)
    picture = range_image_picture(range_m, sensor, scale=max(1, 1024 // sensor.columns))
    save(picture, out / "range" / f"{index:06d}.png")
    save(birds_eye_view(points), out / "birds_eye" / f"{index:06d}.png")
    save(scene_3d(points), out / "scene_3d" / f"{index:06d}.png")


def draw_scenes(out: Path, range_path: Path, pictures: int, geometry: ScanGeometry) -> str:
    """Draw the first scenes of ``range_m.npy``, a sheet and a page; return what to open."""
    ranges = np.load(range_path, mmap_mode="r")
    drawn = [torch.from_numpy(np.array(range_m)) for range_m in ranges[:pictures]]
    if not drawn:
        return ""
    for index, range_m in enumerate(drawn):
        draw_scene(out, index, range_m, geometry)
    save(scenes_sheet(drawn[:_ON_SHEET], geometry.projection), out / "scenes.png")
    shown = [(image, _written_labels(out, index)) for index, image in enumerate(drawn[:_ON_PAGE])]
    labelled = [(image, labels) for image, labels in shown if labels is not None]
    opened = f"open {out / 'scenes.png'}"
    if labelled:
        sheet = classes_sheet(labelled, geometry.projection)
        opened += f", {save(sheet, out / 'classes.png')}"
    scans = [
        PageScan(f"scene {index:06d}", points_of(image, geometry.projection).numpy(), labels)
        for index, (image, labels) in enumerate(shown)
        if (image > 0).any()  # neither empty nor NaN
    ]
    if not scans:
        return opened
    page = write_page(out / "scenes.html", scans, f"{out.resolve().name} - r3dpa sample")
    return f"{opened} and {page}"


def classes_sheet(scenes: Sequence[tuple[Tensor, NDArray]], projection: Projection) -> Figure:
    """Range image and classes of each scene, one below the other.

    Args:
        scenes: Range image ``(H, W)`` in metres, and the labels ``(P,)`` of its points.
        projection: Projection of the images.
    """
    numbers = [labels & 0xFFFF for _, labels in scenes]
    rows = category_rows(categories(Semantic), numbers)
    colours = {number: to_rgb(colour) for number, _, colour in rows}
    columns, strips = projection.column_order(), []
    for index, ((range_m, _), classes) in enumerate(zip(scenes, numbers, strict=True)):
        turned = np.zeros((*range_m.shape, 3))
        of_returns = [colours[number] for number in classes.tolist()]
        turned[(range_m[:, columns] > 0).numpy()] = np.reshape(of_returns, (-1, 3))
        picture = np.empty_like(turned)
        picture[:, columns.numpy()] = turned
        strips.append((f"scene {index}", range_image_picture(range_m, projection.sensor)))
        strips.append((f"classes of scene {index}", as_bytes(picture)))
    figure, _ = strip_sheet(strips, projection.sensor, below_in=0.5)
    entries = [Patch(color=colour, label=name) for _, name, colour in rows]
    figure.legend(handles=entries, loc="outside lower center", ncols=8, frameon=False)
    return figure


def _written_labels(out: Path, index: int) -> NDArray | None:
    """Labels of the points of a scene that a writer has written, if scenes have them."""
    path = out / "labels" / f"{index:06d}.label"
    return np.fromfile(path, dtype="<u4") if path.exists() else None


def write_page(
    path: Path,
    scans: Sequence[PageScan],
    title: str,
    origins: Mapping[int, Category] | None = None,
    **options: Any,
) -> Path:
    """Write a page of point clouds, coloured by the classes and origins of the simulator too.

    ``origins`` are further ones; ``options`` go to :func:`r3dpa.viz.scan_page`.
    """
    made_by = categories(Origin) | dict(origins or {})
    page = scan_page(scans, title, categories(Semantic), made_by, **options)
    write_text(path, page)
    return path


def categories(names: type[IntEnum]) -> dict[int, Category]:
    """Categories of classes or origins by number, in their colours."""
    return {
        int(member): Category(member.name.lower().replace("_", " "), COLOURS.get(member.name))
        for member in names
    }

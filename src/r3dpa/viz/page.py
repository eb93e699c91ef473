"""One self-contained HTML page that shows scans as point clouds.

The page is ``page.html`` with ``page_cloud.js`` (points to pixels) and ``page_viewer.js`` (panes,
camera, legend); it loads nothing and needs no GPU.
"""

from __future__ import annotations

import base64
import html
import io
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.colors import Colormap
from numpy.typing import NDArray

from r3dpa.geometry import LidarSensor, Projection, points_of, values_at_returns
from r3dpa.viz.figures import part_colours
from r3dpa.viz.pictures import (
    BACKGROUND,
    EGO_OUTLINE_M,
    HEIGHT_LIMITS_M,
    HEIGHT_MAP,
    PALETTE,
    Array,
    Pixels,
    as_numpy,
    bright_part,
    palette_image,
    range_ticks,
)

#: Step of the coordinates in a page, metres; larger only for a scan that int16 could not hold.
STEP_M = 0.005
GROUND_M = -1.73  # KITTI's Velodyne stands 1.73 m above the road
# As RANGE_MAP, but its far end stands out from the dark also where it is a few thin points.
PAGE_RANGE_MAP = bright_part("plasma", 0.15).reversed()
INTENSITY_MAP = bright_part("inferno", 0.25)
_SCRIPTS = ("page_cloud.js", "page_viewer.js")


class Tile(NamedTuple):
    """Strip of a gallery: number of the scan that a click shows, note, and pictures by name."""

    scan: int
    note: str
    pictures: Mapping[str, Pixels]


class Category(NamedTuple):
    """Name of a category number, and its colour ``#rrggbb`` (one of the palette if None)."""

    name: str
    colour: str | None = None


@dataclass(frozen=True)
class PageScan:
    """One scan of a page.

    Args:
        name: Shown as it is.
        points: ``(P, 3)`` x forward, y left, z up in metres, or ``(P, 4)`` with the intensity.
        labels: ``(P,)`` semantic class in the lower 16 bits, instance in the upper 16.
        origins: ``(P,)`` number from 0 to 255 of what made the point.
    """

    name: str
    points: Array
    labels: NDArray[np.integer] | None = None
    origins: NDArray[np.integer] | None = None


def scan_page(
    scans: Sequence[PageScan],
    title: str,
    semantics: Mapping[int, Category],
    origins: Mapping[int, Category],
    beside: Sequence[PageScan] | None = None,
    sensor: LidarSensor | None = None,
    gallery: Mapping[str, Sequence[Tile]] | None = None,
    about: Sequence[str] = (),
    mode: str = "height",
) -> str:
    """HTML page with one scan at a time, turned, moved and coloured by the reader.

    Coordinates are rounded to 5 mm (more beyond 163 m). 120 000 points take half a megabyte.

    Args:
        scans: At least one.
        title: Shown on top.
        semantics: Categories of the labels by number; other numbers are shown as such.
        origins: Categories of the origins by number, likewise.
        beside: Scan to show beside each scan, or one for all, seen by the same camera.
        sensor: Gives the limits of the range colours; default: the default sensor.
        gallery: Tiles by heading, shown in a column beside the cloud; default: no column.
        about: Lines on top of that column.
        mode: Colours at first: ``height``, ``range``, ``intensity``, ``semantic`` or ``origin``.

    Raises:
        ValueError: If there is no scan, or one is empty, of another shape than above or not finite.
    """
    if not scans:
        raise ValueError("scan_page got no scan; give at least one")
    others = list(beside or ())
    if others and len(others) not in (1, len(scans)):
        raise ValueError(
            f"{len(scans)} scans need 1 or {len(scans)} scans beside them, got {len(others)}"
        )
    shown = [*scans, *others]
    packed = [pack_scan(scan) for scan in shown]
    labels = [scan.labels.astype(np.int64) & 0xFFFF for scan in shown if scan.labels is not None]
    made_by = [scan.origins for scan in shown if scan.origins is not None]
    heights_m = np.arange(HEIGHT_LIMITS_M[0], HEIGHT_LIMITS_M[1] + 1).tolist()
    brightest = max(header["intensity_max"] for header, _ in packed)
    page = {
        "background": BACKGROUND,
        "ground_m": GROUND_M,
        "ego": [(x, y) for y, x in EGO_OUTLINE_M],
        "mode": mode,
        "scales": {
            "height": _scale("height above the sensor (m)", HEIGHT_MAP, 1.0, heights_m),
            "range": _scale("range (m)", PAGE_RANGE_MAP, 0.5, range_ticks(sensor or LidarSensor())),
            "intensity": _scale("intensity", INTENSITY_MAP, 0.5, [0, brightest / 4, brightest]),
        },
        "categories": {
            "semantic": category_rows(semantics, labels),
            "origin": category_rows(origins, made_by),
        },
        "scans": [header for header, _ in packed],
        "shown": len(scans),
        "beside": [len(scans) + n % len(others) for n in range(len(scans))] if others else [],
        "film": None if gallery is None else {"about": list(about), "groups": _groups(gallery)},
    }
    # JSON may hold "<" within strings only, where its escape means the same: no name ends a script.
    text = json.dumps(page, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    points = (
        f'<script type="text/plain" id="points-{number}">{data}</script>'
        for number, (_, data) in enumerate(packed)
    )
    folder = files("r3dpa.viz")
    parts = {
        "title": html.escape(title),
        "background": "#{:02x}{:02x}{:02x}".format(*BACKGROUND),
        "page": text,
        "points": "\n".join(points),
        "script": "\n".join((folder / name).read_text("utf-8") for name in _SCRIPTS),
    }
    template = (folder / "page.html").read_text("utf-8")
    # In one pass, so that a part that holds such a placeholder stays as it is.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)


def edit_page(
    before: Mapping[str, Array],
    after: Mapping[str, Array],
    parts: NDArray[np.integer] | None,
    part_names: Sequence[str],
    projection: Projection,
    title: str,
) -> str:
    """HTML page that opens on the first result, with the first scan beside it.

    Args:
        before: Range images ``(H, W)`` of the scans by name, may be empty; shown after the results.
        after: Range images of the results. Images without a return are left out.
        parts: ``(H, W)`` part number of each pixel, for the colours; default: no parts.
        part_names: Names of the parts by number.
        projection: Makes the points.
        title: Title of the page.

    Raises:
        ValueError: If no image has a return.
    """
    shown = []
    for name, range_m in {**after, **before}.items():
        image, labels = torch.as_tensor(range_m), None
        if parts is not None:
            numbers = torch.from_numpy(parts.astype(np.int64))
            labels = values_at_returns(numbers, image, projection).numpy()
        if (image > 0).any():
            shown.append(PageScan(name, points_of(image, projection), labels))
    named = zip(part_names, part_colours(part_names), strict=True)
    categories = {number: Category(*part) for number, part in enumerate(named)}
    first = next((scan for scan in shown if scan.name in before), None)
    beside = None if first is None else [replace(first, name=f"before: {first.name}")]
    return scan_page(shown, title, categories, {}, beside, projection.sensor)


def pack_scan(scan: PageScan) -> tuple[dict[str, Any], str]:
    """Header and data of a scan as the page holds it.

    The data are little-endian columns, deflated (zlib), in base64: x, y and z as int16 steps, each
    the difference from the point before; then, where known, semantic and instance as uint16,
    intensity and origin as uint8.
    """
    points = as_numpy(scan.points, ("P", "3 or 4"))
    count = len(points)
    if points.shape[1] not in (3, 4) or not count:
        raise ValueError(f"{scan.name}: points must be (P, 3) or (P, 4), got {points.shape}")
    if not np.isfinite(points).all():
        raise ValueError(f"{scan.name}: has NaN or infinite values; drop these points first")
    for name, values in (("labels", scan.labels), ("origins", scan.origins)):
        if values is not None and values.shape != (count,):
            raise ValueError(f"{scan.name}: {name} must be ({count},), got {values.shape}")
    step_m = max(STEP_M, float(np.abs(points[:, :3]).max()) / 32767)
    steps = np.rint(points[:, :3] / step_m).astype("<i2")
    columns = ["x", "y", "z"]
    data = [column.tobytes() for column in np.diff(steps, axis=0, prepend=np.int16(0)).T]
    if scan.labels is not None:
        labels = scan.labels.astype(np.int64)
        columns += ["semantic", "instance"]
        data += [(labels & 0xFFFF).astype("<u2").tobytes(), (labels >> 16).astype("<u2").tobytes()]
    intensity_max = 1.0
    if points.shape[1] == 4:
        intensity_max = max(1.0, float(points[:, 3].max()))
        columns.append("intensity")
        share = np.clip(points[:, 3], 0, None) / intensity_max
        data.append(np.rint(255 * share).astype(np.uint8).tobytes())
    if scan.origins is not None:
        columns.append("origin")
        data.append(scan.origins.astype(np.uint8).tobytes())
    header = {"name": scan.name, "count": count, "step_m": step_m}
    header |= {"intensity_max": intensity_max, "columns": columns}
    return header, base64.b64encode(zlib.compress(b"".join(data), 9)).decode("ascii")


def _groups(gallery: Mapping[str, Sequence[Tile]]) -> list[dict[str, Any]]:
    """Tiles with their pictures as PNG in data addresses."""
    return [
        {
            "title": title,
            "tiles": [
                {
                    "scan": tile.scan,
                    "note": tile.note,
                    "pictures": [(name, _png(pixels)) for name, pixels in tile.pictures.items()],
                }
                for tile in tiles
            ],
        }
        for title, tiles in gallery.items()
    ]


def _png(pixels: Pixels) -> str:
    data = io.BytesIO()
    palette_image(pixels).save(data, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(data.getvalue()).decode('ascii')}"


def _scale(label: str, colours: Colormap, power: float, ticks: Sequence[float]) -> dict[str, Any]:
    rgb = colours(np.arange(256), bytes=True)[:, :3]
    return {
        "label": label,
        "low": ticks[0],
        "high": ticks[-1],
        "power": power,
        "ticks": [(tick, f"{tick:.3g}") for tick in ticks],
        "rgb": base64.b64encode(rgb.tobytes()).decode("ascii"),
    }


def category_rows(
    categories: Mapping[int, Category], used: Sequence[NDArray[np.integer]]
) -> list[tuple[int, str, str]]:
    """Number, name and colour of the categories that occur; missing colours from the palette."""
    present = {int(number) for values in used for number in np.unique(values)}
    taken = {category.colour for category in categories.values()}
    free = cycle([colour for colour in PALETTE if colour not in taken] or PALETTE)
    rows = []
    for number in sorted({*categories, *present}):
        name, colour = categories.get(number, Category(f"number {number}"))
        rows.append((number, name, colour or next(free)))
    return [row for row in rows if row[0] in present]

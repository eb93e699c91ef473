"""Figures and pages of edited scans: before, mask and result.

Letters: H beams, W columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from r3dpa.geometry import Projection, points_of
from r3dpa.viz.figures import range_bar
from r3dpa.viz.page import PALETTE, Category, PageScan, scan_page
from r3dpa.viz.pixels import Array, Pixels, as_bytes, as_numpy
from r3dpa.viz.scans import range_image_picture

_TINT = 0.55  # share of the colour of a part
_GREY_SHARES = (0.299, 0.587, 0.114)  # of red, green and blue in their brightness
_MOST_BORDERS = 0.2  # of the pixels: lines between every few beams would hide the picture
_KEPT, _GREY = "kept", "#8a8f98"
_AXES = ("H", "W")


class EditRow(NamedTuple):
    """A range image of a sheet.

    Attributes:
        name: Shown above it.
        range_m: ``(H, W)`` metres, not above 0 without a return.
        parts: ``(H, W)`` part number of each pixel, shown as a tint of a grey picture.
        outline: ``(H, W)`` likewise; only the borders between parts are drawn, over the range
        colours.
    """

    name: str
    range_m: Array
    parts: NDArray[np.integer] | None = None
    outline: NDArray[np.integer] | None = None


def _part_colours(names: Sequence[str]) -> list[str]:
    """A colour ``#rrggbb`` for each part; grey for ``kept``."""
    free = iter(("#ff6b6b", *PALETTE))
    return [_GREY if name == _KEPT else next(free) for name in names]


def edit_sheet(
    rows: Sequence[EditRow], part_names: Sequence[str], projection: Projection
) -> Figure:
    """Range images one below the other under their names, with the tints of their parts.

    Args:
        rows: At least one. Azimuths are written below the last.
        part_names: Names of the parts by number; empty where no row has any.
        projection: Gives the limits of the colour scale.

    Raises:
        ValueError: If there is no row, or an image has other than two axes.
    """
    if not rows:
        raise ValueError("edit_sheet got no range image; give at least one")
    height_in = 1.2 * len(rows) + (0.9 if part_names else 0.6)
    figure = Figure(figsize=(13.0, height_in), dpi=110, layout="constrained")
    sensor = projection.sensor
    colours = _part_colours(part_names)
    cells = figure.subplots(len(rows), 1, squeeze=False)[:, 0]
    for row, axes in zip(rows, cells, strict=True):
        picture = range_image_picture(row.range_m, sensor)
        if row.parts is not None:
            picture = _tinted(picture, row.parts, part_names)
        # One pixel is a unit wide, so that borders of pixels have whole numbers.
        size = (0, picture.shape[1], picture.shape[0], 0)
        axes.imshow(picture, aspect="auto", interpolation="nearest", extent=size)
        if row.outline is not None:
            axes.add_collection(LineCollection(_borders(row.outline), colors="white", lw=1.2))
        axes.set(xticks=[], yticks=[])
        axes.set_title(row.name, loc="left", fontsize=10, parse_math=False)
    _azimuth_ticks(cells[-1], projection)
    range_bar(figure, sensor, ax=list(cells), pad=0.01, aspect=9 * len(rows))
    if part_names:
        handles = [Patch(color=c, label=n) for n, c in zip(part_names, colours, strict=True)]
        figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False)
    return figure


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
        after: Those of the results; images without a return are left out.
        parts: ``(H, W)`` part number of each pixel, for the colours; None for none.
        part_names: Names of the parts by number.
        projection: Makes the points.
        title: Of the page.

    Raises:
        ValueError: If nothing holds a return.
    """
    order = projection.column_order().numpy()

    def scan(name: str, range_m: Array) -> PageScan:
        image = torch.as_tensor(range_m)
        labels = None
        if parts is not None:
            labels = parts[:, order][(image[:, order] > 0).numpy()].astype(np.uint32)
        return PageScan(name, points_of(image, projection), labels)

    images = {**after, **before}
    shown = [
        scan(name, image) for name, image in images.items() if (as_numpy(image, _AXES) > 0).any()
    ]
    colours = _part_colours(part_names)
    categories = {
        number: Category(name, colour)
        for number, (name, colour) in enumerate(zip(part_names, colours, strict=True))
    }
    first = next((one for one in shown if one.name in before), None)
    reference = None if first is None else replace(first, name=f"before: {first.name}")
    return scan_page(shown, title, categories, {}, reference, projection.sensor)


def _azimuth_ticks(axes: Axes, projection: Projection) -> None:
    """Ticks at eighths of a turn, in degrees as the commands take them."""
    azimuth = projection.ray_angles()[1].rad2deg().numpy()
    wanted = np.arange(135, -180, -45)
    apart = (azimuth[:, None] - wanted + 180) % 360 - 180
    columns = np.abs(apart).argmin(axis=0) + 0.5
    axes.set_xticks(columns, [f"{value}°" for value in wanted], fontsize=8)
    axes.tick_params(length=2, pad=2)


def _borders(parts: NDArray[np.integer]) -> list[list[tuple[int, int]]]:
    """Lines ``(x, y)`` between pixels of different parts; none if there are too many."""
    upright, level = parts[:, 1:] != parts[:, :-1], parts[1:] != parts[:-1]
    if level.mean() > _MOST_BORDERS:
        return []
    lines = [[(x + 1, y), (x + 1, y + 1)] for y, x in np.argwhere(upright).tolist()]
    return lines + [[(x, y + 1), (x + 1, y + 1)] for y, x in np.argwhere(level).tolist()]


def _tinted(picture: Pixels, parts: NDArray[np.integer], names: Sequence[str]) -> Pixels:
    """The picture in grey, tinted by part except where it is ``kept``."""
    picture = (picture @ np.array(_GREY_SHARES))[..., None]
    over = np.array([to_rgb(colour) for colour in _part_colours(names)])[parts]
    share = np.array([0.0 if name == _KEPT else _TINT for name in names])[parts][..., None]
    return as_bytes((1 - share) * picture / 255 + share * over)

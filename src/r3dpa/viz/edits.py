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
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from r3dpa.geometry import Projection, points_of
from r3dpa.viz.figures import strip_sheet
from r3dpa.viz.page import PALETTE, Category, PageScan, scan_page
from r3dpa.viz.pictures import Array, Pixels, as_bytes, range_image_picture

_TINT = 0.55  # share of the colour of a part
_GREY_SHARES = (0.299, 0.587, 0.114)  # of red, green and blue in their brightness
_MOST_BORDERS = 0.2  # of the pixels: lines between every few beams would hide the picture
_KEPT, _GREY = "kept", "#8a8f98"


class EditRow(NamedTuple):
    """A range image of a sheet, ``(H, W)`` metres, and its name.

    ``parts`` is the part number of each pixel, ``(H, W)``, shown as a tint of a grey picture;
    ``outline`` likewise, but only the borders between parts are drawn, over the range colours.
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
    """
    pictures = []
    for row in rows:
        picture = range_image_picture(row.range_m, projection.sensor)
        tinted = picture if row.parts is None else _tinted(picture, row.parts, part_names)
        pictures.append((row.name, tinted))
    figure, cells = strip_sheet(pictures, projection.sensor, 0.3 if part_names else 0.0)
    for row, axes in zip(rows, cells, strict=True):
        outline = row.outline
        if outline is not None and (np.diff(outline, axis=0) != 0).mean() < _MOST_BORDERS:
            for part in np.unique(outline)[1:]:
                axes.contour(outline == part, [0.5], colors="white", linewidths=1.2)
    _azimuth_ticks(cells[-1], projection)
    if part_names:
        named = zip(part_names, _part_colours(part_names), strict=True)
        handles = [Patch(color=colour, label=name) for name, colour in named]
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
    order = projection.column_order()
    shown = []
    for name, range_m in {**after, **before}.items():
        image = torch.as_tensor(range_m)
        filled = (image[:, order] > 0).numpy()
        labels = None if parts is None else parts[:, order.numpy()][filled].astype(np.uint32)
        if filled.any():
            shown.append(PageScan(name, points_of(image, projection), labels))
    named = zip(part_names, _part_colours(part_names), strict=True)
    categories = {number: Category(*part) for number, part in enumerate(named)}
    first = next((one for one in shown if one.name in before), None)
    reference = None if first is None else replace(first, name=f"before: {first.name}")
    return scan_page(shown, title, categories, {}, reference, projection.sensor)


def _azimuth_ticks(axes: Axes, projection: Projection) -> None:
    """Ticks at eighths of a turn, in degrees as the commands take them."""
    azimuth = projection.ray_angles()[1].rad2deg().numpy()
    wanted = np.arange(135, -180, -45)
    apart = (azimuth[:, None] - wanted + 180) % 360 - 180
    axes.set_xticks(np.abs(apart).argmin(axis=0), [f"{value}°" for value in wanted], fontsize=8)
    axes.tick_params(length=2, pad=2)


def _tinted(picture: Pixels, parts: NDArray[np.integer], names: Sequence[str]) -> Pixels:
    """The picture in grey, tinted by part except where it is ``kept``."""
    picture = (picture @ np.array(_GREY_SHARES))[..., None]
    over = np.array([to_rgb(colour) for colour in _part_colours(names)])[parts]
    share = np.array([0.0 if name == _KEPT else _TINT for name in names])[parts][..., None]
    return as_bytes((1 - share) * picture / 255 + share * over)

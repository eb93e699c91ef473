"""Figures of scans, scenes and edits; a collection holds one scan or image at least."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon
from numpy.typing import NDArray

from r3dpa.geometry import LidarSensor, Projection, points_of, range_image
from r3dpa.viz.pictures import (
    BACKGROUND,
    EGO_OUTLINE_M,
    HEIGHT_LIMITS_M,
    HEIGHT_MAP,
    PALETTE,
    RANGE_MAP,
    Array,
    Pixels,
    as_bytes,
    as_numpy,
    birds_eye_picture,
    bright_part,
    paint,
    range_image_picture,
    range_scale,
    range_ticks,
    scene_3d,
)

ERROR_LIMIT_M = 2.0
EXTENT_M = 50.0  # shown from above, to each side
ONLY_INPUT = (0.80, 0.80, 0.80)
ONLY_RECONSTRUCTION = (0.95, 0.45, 0.75)
ERROR_MAP = bright_part("viridis", 0.0)
_TINT = 0.55  # share of the colour of a part
_GREY_SHARES = (0.299, 0.587, 0.114)  # of red, green and blue in their brightness
_MOST_BORDERS = 0.2  # of the pixels: lines between every few beams would hide the picture
_KEPT, _GREY = "kept", "#8a8f98"
_STRIP_IN = 1.2  # height of a range image with its name, a whole turn wide


def birds_eye_view(points: Array, extent_m: float = EXTENT_M) -> Figure:
    """Points ``(P, 3+)`` in metres seen from above, up to ``extent_m`` to each side, with axes."""
    figure = Figure(figsize=(7.4, 6.4), layout="constrained")
    axes = figure.add_subplot()
    draw_birds_eye(axes, points, extent_m)
    axes.set(xlabel="y, left (m)", ylabel="x, forward (m)")
    axes.set_title(f"{len(points):,} points, seen from above")
    _height_bar(figure, ax=axes, extend="both", shrink=0.85)
    return figure


def scenes_sheet(range_images_m: Sequence[Array], projection: Projection) -> Figure:
    """A row for each range image ``(H, W)`` in metres, with its points from above and in 3D."""
    count = len(range_images_m)
    top_in, bottom_in = 0.4, 0.75
    height_in = top_in + count * 1.85 + bottom_in
    figure = Figure(figsize=(17.5, height_in))
    places = {"left": 0.025, "right": 0.995, "wspace": 0.02, "hspace": 0.04}
    places |= {"top": 1 - top_in / height_in, "bottom": bottom_in / height_in}
    widths = (10.6, 1.8, 3.2)
    cells = figure.subplots(count, 3, squeeze=False, width_ratios=widths, gridspec_kw=places)
    for number, (range_m, row) in enumerate(zip(range_images_m, cells, strict=True)):
        ranges = torch.as_tensor(as_numpy(range_m, ("H", "W")), dtype=torch.float32)
        points = points_of(ranges, projection)
        image, above, scene = row
        draw_panorama(image, range_image_picture(ranges, projection.sensor))
        image.set_ylabel(str(number), rotation=0, ha="right", va="center", fontsize=11)
        draw_birds_eye(above, points, EXTENT_M, pixels=180)
        scene.imshow(scene_3d(points, size=(310, 550)), aspect="auto")
        for axes in (above, scene):
            axes.set(xticks=[], yticks=[])
    titles = ("range image", f"from above, {2 * EXTENT_M:g} m wide", "from behind")
    for axes, title in zip(cells[0], titles, strict=True):
        axes.set_title(title, fontsize=11)
    for left, bar in ((0.15, _range_bar), (0.70, _height_bar)):
        place = figure.add_axes((left, 0.45 / height_in, 0.22, 0.13 / height_in))
        bar(figure, projection.sensor, cax=place, orientation="horizontal")
    return figure


def reconstruction_figure(
    range_m: Array,
    reconstruction_m: Array,
    sensor: LidarSensor,
    mean_absolute_error_m: float,
    valid_agreement: float,
) -> Figure:
    """A range image, its reconstruction and the absolute error, each with its scale in metres.

    Args:
        range_m: ``(H, W)`` metres; not above 0 without a return.
        reconstruction_m: ``(H, W)`` likewise.
        sensor: Gives the limits of the colour scale.
        mean_absolute_error_m: Over the pixels valid in both, for the title.
        valid_agreement: Share in [0, 1] of pixels valid in both or empty in both, for the title.
    """
    before, after = as_numpy(range_m, ("H", "W")), as_numpy(reconstruction_m, ("H", "W"))
    error_scale = Normalize(0.0, ERROR_LIMIT_M)
    error = paint(np.abs(before - after), ERROR_MAP, error_scale)
    returns = before > 0, after > 0
    error[~returns[0] & ~returns[1]] = BACKGROUND
    error[returns[0] & ~returns[1]] = np.array(ONLY_INPUT) * 255
    error[~returns[0] & returns[1]] = np.array(ONLY_RECONSTRUCTION) * 255
    figure = Figure(figsize=(13.0, 6.6), layout="constrained")
    figure.suptitle(
        f"mean absolute range error {mean_absolute_error_m:.3f} m over pixels valid in both, "
        f"valid masks agree on {100 * valid_agreement:.1f} % of the pixels"
    )
    upper, middle, lower = figure.subplots(3, 1)
    draw_panorama(upper, range_image_picture(before, sensor), "input")
    draw_panorama(middle, range_image_picture(after, sensor), "reconstruction")
    draw_panorama(lower, error, "absolute error")
    _range_bar(figure, sensor, ax=[upper, middle], pad=0.01)
    mappable = ScalarMappable(error_scale, ERROR_MAP)
    figure.colorbar(mappable, ax=lower, label="error (m)", extend="max", pad=0.01)
    entries = [
        Patch(color=ONLY_INPUT, label="return only in the input"),
        Patch(color=ONLY_RECONSTRUCTION, label="return only in the reconstruction"),
        Patch(color="black", label="no return in either"),
    ]
    figure.legend(handles=entries, loc="outside lower center", ncols=3, frameon=False)
    return figure


def range_strips(scans: Mapping[str, Array], projection: Projection) -> Figure:
    """Range images of scans ``(P, 3+)`` by name, one below the other, with the range scale."""
    pictures, shares = [], []
    for name, points in scans.items():
        range_m, _ = range_image(torch.from_numpy(as_numpy(points, ("P", "3+"))[:, :3]), projection)
        pictures.append((name, range_image_picture(range_m, projection.sensor)))
        shares.append(float((range_m > 0).double().mean()))
    figure, cells = strip_sheet(pictures, projection.sensor)
    for axes, share in zip(cells, shares, strict=True):
        axes.set_title(f"{share:.0%} of the pixels have a return", loc="right", fontsize=9)
    return figure


def birds_eye_sheet(scans: Mapping[str, Array]) -> Figure:
    """Scans ``(P, 3+)`` by name seen from above, up to four in a row, with the height scale."""
    count = len(scans)
    columns = count if count <= 4 else min((4, 3), key=lambda width: -count % width)  # fewest gaps
    side_in = 7.0 if columns == 1 else 4.0
    size_in = (columns * side_in + 0.9, math.ceil(count / columns) * (side_in + 0.3))
    figure = Figure(figsize=size_in, dpi=110, layout="constrained")
    cells = figure.subplots(math.ceil(count / columns), columns, squeeze=False).ravel()
    for axes in cells[count:]:
        axes.set_visible(False)
    for (name, points), axes in zip(scans.items(), cells, strict=False):
        draw_birds_eye(axes, points, EXTENT_M, round(95 * side_in))
        axes.set(xticks=[], yticks=[])
        axes.set_title(name, loc="left", fontsize=10, parse_math=False)
        axes.set_xlabel(f"{2 * EXTENT_M:g} m, {len(points):,} points", fontsize=9)
    _height_bar(figure, ax=list(cells), extend="both", shrink=0.8, pad=0.02)
    return figure


class EditRow(NamedTuple):
    """A range image of a sheet, ``(H, W)`` metres, and its name.

    ``parts`` is the part number of each pixel, ``(H, W)``, shown as a tint of a grey picture;
    ``outline`` likewise, but only the borders between parts are drawn, over the range colours.
    """

    name: str
    range_m: Array
    parts: NDArray[np.integer] | None = None
    outline: NDArray[np.integer] | None = None


def edit_sheet(
    rows: Sequence[EditRow], part_names: Sequence[str], projection: Projection
) -> Figure:
    """Range images one below the other under their names, with the tints of their parts.

    Where all parts but the first lie in a small piece of the turn, that piece and its surroundings
    are shown.

    Args:
        rows: At least one. Azimuths are written below the last.
        part_names: Names of the parts by number; empty where no row has any.
        projection: Gives the limits of the colour scale.
    """
    pictures = []
    for row in rows:
        picture = range_image_picture(row.range_m, projection.sensor)
        tinted = picture if row.parts is None else _tint_parts(picture, row.parts, part_names)
        pictures.append((row.name, tinted))
    columns = _columns_around_parts(rows)
    below_in = 0.3 if part_names else 0.0
    height_in = _STRIP_IN if columns is None else 2 * _STRIP_IN
    figure, cells = strip_sheet(pictures, projection.sensor, below_in, height_in)
    for row, axes in zip(rows, cells, strict=True):
        if columns is not None:
            axes.set_xlim(*columns)
        outline = row.outline
        if outline is not None and (np.diff(outline, axis=0) != 0).mean() < _MOST_BORDERS:
            for part in np.unique(outline)[1:]:
                axes.contour(outline == part, [0.5], colors="white", linewidths=1.2)
    _azimuth_ticks(cells[-1], projection, 45 if columns is None else 15)
    if part_names:
        named = zip(part_names, part_colours(part_names), strict=True)
        handles = [Patch(color=colour, label=name) for name, colour in named]
        figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False)
    return figure


def _columns_around_parts(rows: Sequence[EditRow]) -> tuple[int, int] | None:
    """First and last column to show of rows with a small part; None for the whole turn."""
    parts = [part for row in rows for part in (row.parts, row.outline) if part is not None]
    if not parts:
        return None
    changed = np.flatnonzero(np.any(parts, axis=(0, 1)))
    total = parts[0].shape[1]
    if not len(changed):
        return None
    first, last = int(changed[0]), int(changed[-1])
    beside = max(last - first, total // 16)
    if last - first + 2 * beside > total // 2:
        return None
    return max(0, first - beside), min(total - 1, last + beside)


def part_colours(names: Sequence[str]) -> list[str]:
    """A colour ``#rrggbb`` for each part; grey for ``kept``."""
    free = cycle(dict.fromkeys(("#ff6b6b", *PALETTE)))
    return [_GREY if name == _KEPT else next(free) for name in names]


def strip_sheet(
    pictures: Sequence[tuple[str, Pixels]],
    sensor: LidarSensor,
    below_in: float = 0.0,
    height_in: float = _STRIP_IN,
) -> tuple[Figure, list[Axes]]:
    """Pictures of range images under their names, with the range scale; inches left below."""
    count = len(pictures)
    size_in = 13.0, height_in * count + 0.6 + below_in
    figure = Figure(figsize=size_in, dpi=110, layout="constrained")
    cells = list(figure.subplots(count, 1, squeeze=False)[:, 0])
    for (name, picture), axes in zip(pictures, cells, strict=True):
        draw_panorama(axes, picture, name)
    _range_bar(figure, sensor, ax=cells, pad=0.01, aspect=9 * count)
    return figure, cells


def draw_panorama(axes: Axes, picture: Pixels, title: str | None = None) -> None:
    """One turn of the sensor over the whole width, without ticks."""
    axes.imshow(picture, aspect="auto", interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    if title is not None:
        axes.set_title(title, loc="left", fontsize=10, parse_math=False)


def draw_birds_eye(
    axes: Axes, points: Array, extent_m: float, pixels: int = 500, colours: Array | None = None
) -> None:
    """Points from above in metres, with the outline of the ego vehicle to scale."""
    axes.imshow(
        birds_eye_picture(points, extent_m, pixels, colours),
        extent=(extent_m, -extent_m, -extent_m, extent_m),  # +y is to the left
        interpolation="nearest",
    )
    axes.add_patch(Polygon(EGO_OUTLINE_M, facecolor="tab:red", edgecolor="white", lw=0.5))


def _azimuth_ticks(axes: Axes, projection: Projection, spacing_deg: int) -> None:
    """Ticks at multiples of the spacing in the columns that are shown."""
    azimuth = projection.ray_angles()[1].rad2deg().numpy()
    wanted = np.arange(180 - spacing_deg, -180, -spacing_deg)
    apart = (azimuth[:, None] - wanted + 180) % 360 - 180
    columns = np.abs(apart).argmin(axis=0)
    first, last = axes.get_xlim()
    shown = (columns >= first) & (columns <= last)
    axes.set_xticks(columns[shown], [f"{value}°" for value in wanted[shown]], fontsize=8)
    axes.tick_params(length=2, pad=2)


def _tint_parts(picture: Pixels, parts: NDArray[np.integer], names: Sequence[str]) -> Pixels:
    """The picture in grey, tinted by part except where it is ``kept``."""
    picture = (picture @ np.array(_GREY_SHARES))[..., None]
    over = np.array([to_rgb(colour) for colour in part_colours(names)])[parts]
    share = np.array([0.0 if name == _KEPT else _TINT for name in names])[parts][..., None]
    return as_bytes((1 - share) * picture / 255 + share * over)


def _range_bar(figure: Figure, sensor: LidarSensor, **place: object) -> None:
    """Colour bar of ranges; ``place`` as for :meth:`Figure.colorbar`."""
    mappable = ScalarMappable(range_scale(sensor), RANGE_MAP)
    ticks = range_ticks(sensor)
    figure.colorbar(mappable, label="range (m)", ticks=ticks, format="%g", **place)  # type: ignore[arg-type]


def _height_bar(figure: Figure, sensor: LidarSensor | None = None, **place: object) -> None:
    mappable = ScalarMappable(Normalize(*HEIGHT_LIMITS_M), HEIGHT_MAP)
    figure.colorbar(mappable, label="height above the sensor (m)", **place)  # type: ignore[arg-type]

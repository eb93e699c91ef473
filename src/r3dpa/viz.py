"""Pictures of scans, scenes, reconstructions, features and losses.

Every function takes arrays or tensors and returns a matplotlib ``Figure`` or the pixels of a
picture, ``(rows, columns, 3)`` uint8 RGB; only :func:`save` and :func:`read_metrics` touch files.
Colours are perceptually uniform and safe for colour-blind readers, on scales fixed in metres, so
pictures of different scenes can be compared. Dark means that there is no return.

Letters: H beams, W columns, P points, N tokens = feature-grid cells, D feature width, C latent
channels, h w latent size.
"""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, ListedColormap, Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from r3dpa.atomic import atomic_path
from r3dpa.geometry.projection import Projection, points_of
from r3dpa.geometry.sensor import LidarSensor

__all__ = [
    "birds_eye_picture",
    "birds_eye_view",
    "encoded_picture",
    "feature_grid_picture",
    "latents_picture",
    "loss_curves",
    "pca_colours",
    "range_image_picture",
    "read_metrics",
    "reconstruction_figure",
    "save",
    "scene_3d",
    "scenes_sheet",
]

Array = Tensor | NDArray[np.generic]
Pixels = NDArray[np.uint8]
Series = tuple[Sequence[float], Sequence[float]]

BACKGROUND = (10, 10, 14)  # RGB of "no return"; darker than every colour of the maps below
HEIGHT_LIMITS_M = (-2.0, 3.0)  # relative to the sensor, which stands about 1.7 m above the road
ERROR_LIMIT_M = 2.0
CAMERA_EYE_M = (-20.0, 0.0, 10.5)
CAMERA_TARGET_M = (12.0, 0.0, -1.0)
CAMERA_WIDTH_DEG = 58.0
EGO_OUTLINE_M = ((0.0, 2.5), (-0.9, 1.0), (-0.9, -2.0), (0.9, -2.0), (0.9, 1.0))  # (y, x)
POINT_WIDTH_M = 0.11  # drawn width of a point in the 3D picture
MAX_POINT_PIXELS = 6  # before the averaging over 2 x 2
DARKEST_FEATURE = 0.15  # keeps every filled cell brighter than an empty one
ONLY_INPUT = (0.80, 0.80, 0.80)
ONLY_RECONSTRUCTION = (0.95, 0.45, 0.75)


def _bright_part(name: str, start: float) -> Colormap:
    """The part of a named colour map from ``start`` in [0, 1] on, to stand out from the dark."""
    return ListedColormap(matplotlib.colormaps[name](np.linspace(start, 1.0, 256)))


RANGE_MAP = _bright_part("plasma", 0.0).reversed()  # near is bright
HEIGHT_MAP = _bright_part("viridis", 0.3)
ERROR_MAP = _bright_part("viridis", 0.0)


def range_image_picture(range_m: Array, sensor: LidarSensor, scale: int = 1) -> Pixels:
    """Colours of a range image, pixel for pixel.

    The colour follows the square root of the range from ``range_min_m`` (bright) to
    ``range_max_m``, because most returns are near; ranges beyond the limits take the end colours.

    Args:
        range_m: ``(H, W)`` range in metres; not above 0 where there is no return.
        sensor: Gives the limits of the colour scale.
        scale: Side of the square drawn for one pixel, at least 1.

    Returns:
        ``(H * scale, W * scale, 3)`` uint8; pixels without a return have the dark background.

    Raises:
        ValueError: If ``range_m`` has other than two axes or ``scale`` is below 1.
    """
    ranges = _numpy(range_m, ("H", "W"))
    picture = _paint(ranges, RANGE_MAP, _range_scale(sensor))
    picture[~(ranges > 0)] = BACKGROUND
    return _enlarge(picture, scale)


def encoded_picture(image: Array) -> Pixels:
    """Gray values of an encoded range image: [-1, 1] becomes 0 to 255, rounded down.

    Source: the PNG that ``generate.py`` of valeoai/R3DPA writes; same bytes.

    Args:
        image: ``(H, W)`` encoded range; values outside [-1, 1] are clipped.

    Returns:
        ``(H, W)`` uint8.

    Raises:
        ValueError: If ``image`` has other than two axes.
    """
    values = _numpy(image, ("H", "W")).astype(np.float32)  # its rounding decides the last bit
    return np.clip((values + 1) / 2 * 255, 0, 255).astype(np.uint8)


def birds_eye_picture(
    points: Array, extent_m: float = 50.0, pixels: int = 500, colours: Array | None = None
) -> Pixels:
    """Points seen from above, forward up and left to the left; the highest point of a pixel shows.

    Args:
        points: ``(P, 3+)`` x forward, y left, z up, metres; further columns are not used.
        extent_m: Half side of the square around the sensor that is shown.
        pixels: Side of the picture.
        colours: ``(P, 3)`` RGB in [0, 1] of the points, by default from their height.

    Returns:
        ``(pixels, pixels, 3)`` uint8.

    Raises:
        ValueError: If the shapes of ``points`` and ``colours`` are not as above.
    """
    xyz, rgb = _coloured_points(points, colours)
    row = np.floor((extent_m - xyz[:, 0]) / (2 * extent_m) * pixels)
    column = np.floor((extent_m - xyz[:, 1]) / (2 * extent_m) * pixels)
    inside = (row >= 0) & (row < pixels) & (column >= 0) & (column < pixels)
    order = np.flatnonzero(inside)[np.argsort(xyz[inside, 2], kind="stable")]
    picture = np.full((pixels, pixels, 3), BACKGROUND, dtype=np.uint8)
    picture[row[order].astype(int), column[order].astype(int)] = rgb[order]
    return picture


def birds_eye_view(points: Array, extent_m: float = 50.0) -> Figure:
    """Points seen from above with axes in metres, the ego vehicle and the height scale.

    Args:
        points: ``(P, 3+)`` x forward, y left, z up, metres.
        extent_m: Half side of the square around the sensor that is shown.

    Returns:
        Figure of 7.4 x 6.4 inches.

    Raises:
        ValueError: If ``points`` is not of shape ``(P, 3+)``.
    """
    figure = Figure(figsize=(7.4, 6.4), layout="constrained")
    axes = figure.add_subplot()
    _draw_birds_eye(axes, points, extent_m)
    axes.set_xlabel("y, left (m)")
    axes.set_ylabel("x, forward (m)")
    axes.set_title(f"{len(points):,} points, seen from above")
    figure.colorbar(
        ScalarMappable(Normalize(*HEIGHT_LIMITS_M), HEIGHT_MAP),
        ax=axes,
        label="height above the sensor (m)",
        extend="both",
        shrink=0.85,
    )
    return figure


def scene_3d(
    points: Array, colours: Array | None = None, size: tuple[int, int] = (540, 960)
) -> Pixels:
    """Points seen by a pinhole camera behind and above the ego vehicle, looking forward.

    Near points hide far ones and are drawn larger; colours fade with distance.

    Args:
        points: ``(P, 3+)`` x forward, y left, z up, metres.
        colours: ``(P, 3)`` RGB in [0, 1] of the points, by default from their height.
        size: Rows and columns of the picture.

    Returns:
        ``(*size, 3)`` uint8 on a dark background.

    Raises:
        ValueError: If the shapes of ``points`` and ``colours`` are not as above.
    """
    xyz, rgb = _coloured_points(points, colours)
    height, width = 2 * size[0], 2 * size[1]  # averaged over 2 x 2 at the end, against jagged edges
    focal = 0.5 * width / math.tan(math.radians(CAMERA_WIDTH_DEG) / 2)
    from_eye = (xyz - np.array(CAMERA_EYE_M)) @ _camera_axes()
    order = np.argsort(-from_eye[:, 2])  # far to near: the rank of a point tells what hides what
    order = order[from_eye[order, 2] > 1.0]
    right, up, depth = from_eye[order].T
    side = np.clip(np.rint(POINT_WIDTH_M * focal / depth), 1, MAX_POINT_PIXELS).astype(int)
    row = np.floor(height / 2 - focal * up / depth).astype(int) - side // 2
    column = np.floor(width / 2 + focal * right / depth).astype(int) - side // 2

    nearest = np.full(height * width, -1)
    for down, across in itertools.product(range(MAX_POINT_PIXELS), repeat=2):
        drawn = (side > max(down, across)) & (row + down >= 0) & (row + down < height)
        drawn &= (column + across >= 0) & (column + across < width)
        layer = np.full(height * width, -1)
        ranks = np.flatnonzero(drawn)
        layer[(row[ranks] + down) * width + column[ranks] + across] = ranks
        np.maximum(nearest, layer, out=nearest)

    background = np.array([BACKGROUND], dtype=np.float64)
    haze = np.clip((depth[:, None] - 25.0) / 90.0, 0.0, 0.75)
    shaded = (1 - haze) * rgb[order] + haze * background
    picture = np.concatenate([shaded, background])[nearest]  # index -1 is the background
    picture = picture.reshape(size[0], 2, size[1], 2, 3).mean(axis=(1, 3))
    return np.rint(picture).astype(np.uint8)


def scenes_sheet(
    range_images_m: Sequence[Array], projection: Projection, extent_m: float = 50.0
) -> Figure:
    """Contact sheet of scenes, one per row: range image, seen from above, seen in 3D.

    Args:
        range_images_m: Range images ``(H, W)`` in metres, at least one.
        projection: Projection of the range images; gives the points and the colour scale.
        extent_m: Half side of the square shown from above.

    Returns:
        Figure, 17.5 inches wide and 1.85 inches high per scene.

    Raises:
        ValueError: If there is no scene, or an image does not fit the projection.
    """
    count = len(range_images_m)
    if count == 0:
        raise ValueError("scenes_sheet got no scene; give at least one range image (H, W)")
    row_in, top_in, bottom_in, width_in = 1.85, 0.4, 0.75, 17.5
    height_in = top_in + count * row_in + bottom_in
    figure = Figure(figsize=(width_in, height_in))
    cells = figure.subplots(
        count,
        3,
        squeeze=False,
        width_ratios=(10.6, 1.8, 3.2),
        gridspec_kw={
            "left": 0.025,
            "right": 0.995,
            "top": 1 - top_in / height_in,
            "bottom": bottom_in / height_in,
            "wspace": 0.02,
            "hspace": 0.04,
        },
    )
    for number, (range_m, (image, above, scene)) in enumerate(
        zip(range_images_m, cells, strict=True)
    ):
        ranges = torch.as_tensor(_numpy(range_m, ("H", "W")), dtype=torch.float32)
        points = points_of(ranges, projection)
        image.imshow(
            range_image_picture(ranges, projection.sensor), aspect="auto", interpolation="nearest"
        )
        image.set_ylabel(str(number), rotation=0, ha="right", va="center", fontsize=11)
        _draw_birds_eye(above, points, extent_m, pixels=180)
        scene.imshow(scene_3d(points, size=(310, 550)), aspect="auto")
        for axes in (image, above, scene):
            axes.set(xticks=[], yticks=[])
    titles = ("range image", f"from above, {2 * extent_m:g} m wide", "from behind")
    for axes, title in zip(cells[0], titles, strict=True):
        axes.set_title(title, fontsize=11)
    _bar_below(
        figure,
        0.15,
        RANGE_MAP,
        _range_scale(projection.sensor),
        "range (m)",
        ticks=_range_ticks(projection.sensor),
    )
    _bar_below(figure, 0.70, HEIGHT_MAP, Normalize(*HEIGHT_LIMITS_M), "height above the sensor (m)")
    return figure


def reconstruction_figure(
    range_m: Array,
    reconstruction_m: Array,
    sensor: LidarSensor,
    mean_absolute_error_m: float,
    valid_agreement: float,
) -> Figure:
    """A range image, its reconstruction and the absolute error between the two.

    Args:
        range_m: ``(H, W)`` range in metres; not above 0 where there is no return.
        reconstruction_m: ``(H, W)`` reconstructed range, same convention.
        sensor: Gives the limits of the colour scale.
        mean_absolute_error_m: Mean absolute error over the pixels valid in both, for the title.
        valid_agreement: Share in [0, 1] of pixels valid in both or empty in both, for the title.

    Returns:
        Figure of three panels with colour bars in metres; errors above 2 m take the end colour.

    Raises:
        ValueError: If the two images do not have the same shape ``(H, W)``.
    """
    before, after = _numpy(range_m, ("H", "W")), _numpy(reconstruction_m, ("H", "W"))
    if before.shape != after.shape:
        raise ValueError(
            f"range_m is {before.shape} but reconstruction_m is {after.shape}; "
            "give two range images of the same sensor"
        )
    error_scale = Normalize(0.0, ERROR_LIMIT_M)
    error = _paint(np.abs(before - after), ERROR_MAP, error_scale)
    error[~(before > 0) & ~(after > 0)] = BACKGROUND
    error[(before > 0) & ~(after > 0)] = np.array(ONLY_INPUT) * 255
    error[~(before > 0) & (after > 0)] = np.array(ONLY_RECONSTRUCTION) * 255

    figure = Figure(figsize=(13.0, 6.6), layout="constrained")
    figure.suptitle(
        f"mean absolute range error {mean_absolute_error_m:.3f} m over pixels valid in both, "
        f"valid masks agree on {100 * valid_agreement:.1f} % of the pixels"
    )
    upper, middle, lower = figure.subplots(3, 1)
    for axes, picture, title in (
        (upper, range_image_picture(before, sensor), "input"),
        (middle, range_image_picture(after, sensor), "reconstruction"),
        (lower, error, "absolute error"),
    ):
        axes.imshow(picture, aspect="auto", interpolation="nearest")
        axes.set(xticks=[], yticks=[])
        axes.set_title(title, loc="left", fontsize=10)
    figure.colorbar(
        ScalarMappable(_range_scale(sensor), RANGE_MAP),
        ax=[upper, middle],
        label="range (m)",
        pad=0.01,
        ticks=_range_ticks(sensor),
    )
    figure.colorbar(
        ScalarMappable(error_scale, ERROR_MAP), ax=lower, label="error (m)", extend="max", pad=0.01
    )
    figure.legend(
        handles=[
            Patch(color=ONLY_INPUT, label="return only in the input"),
            Patch(color=ONLY_RECONSTRUCTION, label="return only in the reconstruction"),
            Patch(color="black", label="no return in either"),
        ],
        loc="outside lower center",
        ncols=3,
        frameon=False,
    )
    return figure


def loss_curves(curves: str | Path | Mapping[str, Series]) -> Figure:
    """One small panel per logged quantity: every value, faint, and a centred running mean.

    The title of a panel gives the first and the last value. The axis is logarithmic where all
    values are positive and differ.

    Args:
        curves: ``metrics.csv`` of Lightning's ``CSVLogger``, or name -> (steps, values).

    Returns:
        Figure of up to four panels per row.

    Raises:
        ValueError: If there is nothing to draw or the file is not such a table.
    """
    series = curves if isinstance(curves, Mapping) else read_metrics(curves)
    if not series:
        raise ValueError(f"no logged values in {curves!r}; train with a CSVLogger for some steps")
    columns = min(4, len(series))
    rows = math.ceil(len(series) / columns)
    figure = Figure(figsize=(3.6 * columns + 0.2, 2.6 * rows + 0.2), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (name, (steps, values)) in zip(panels, series.items(), strict=False):
        _draw_curve(axes, name, np.asarray(steps, float), np.asarray(values, float))
    for axes in panels[len(series) :]:
        axes.set_visible(False)
    return figure


def read_metrics(path: str | Path) -> dict[str, Series]:
    """Logged quantities of a ``metrics.csv`` of Lightning's ``CSVLogger``.

    A quantity has its own steps: blank and missing cells are left out, and so is a last line
    without an end, which a run that was stopped while writing leaves.

    Args:
        path: File whose first line names the columns, ``step`` among them.

    Returns:
        Name -> (steps, values) in the order of the columns, without ``step`` and ``epoch`` and
        without columns that hold no value.

    Raises:
        ValueError: If there is no column ``step``, or a cell is not a number.
    """
    with Path(path).open(newline="", encoding="utf-8") as file:
        lines = [line for line in file if line.endswith("\n")]
    rows = csv.DictReader(lines, restval="")
    if "step" not in (rows.fieldnames or ()):
        raise ValueError(
            f"{path} has no column 'step' but {rows.fieldnames}; give metrics.csv of a CSVLogger"
        )
    series: dict[str, tuple[list[float], list[float]]] = {}
    for row in rows:
        for name in rows.fieldnames or ():
            if name in ("step", "epoch") or not row[name].strip():
                continue
            try:
                step, value = float(row["step"]), float(row[name])
            except ValueError as error:
                raise ValueError(
                    f"{path}, line {rows.line_num}, column {name!r}: {error}"
                ) from None
            steps, values = series.setdefault(name, ([], []))
            steps.append(step)
            values.append(value)
    return {name: series[name] for name in rows.fieldnames or () if name in series}


def pca_colours(features: Array) -> NDArray[np.float64]:
    """First three principal components of features as colours.

    Rows of zeros are empty cells: they do not count for the components and are black. Of each
    component the 1st to 99th percentile becomes 0.15 to 1; a component without variance is 0.575.
    The sign makes the largest loading of a component positive. To compare several scenes, give
    their rows together.

    Source: R3DPA (ICRA 2026), figure of the 3D features and their projection.

    Args:
        features: ``(N, D)``.

    Returns:
        ``(N, 3)`` RGB in [0, 1].

    Raises:
        ValueError: If ``features`` has other than two axes or holds a value that is not finite.
    """
    rows = _numpy(features, ("N", "D"))
    if not np.isfinite(rows).all():
        raise ValueError(
            f"{np.count_nonzero(~np.isfinite(rows))} of {rows.size} features are not finite; "
            "find out where they come from before drawing them"
        )
    colours = np.zeros((len(rows), 3))
    filled = np.any(rows != 0, axis=1)
    if not filled.any():
        return colours
    centred = rows[filled] - rows[filled].mean(axis=0)
    _, vectors = np.linalg.eigh(centred.T @ centred)
    loadings = vectors[:, ::-1][:, :3]  # eigh sorts upwards
    largest = np.take_along_axis(loadings, np.abs(loadings).argmax(axis=0)[None], axis=0)
    components = np.zeros((len(centred), 3))
    components[:, : loadings.shape[1]] = centred @ (loadings * np.sign(largest))
    low, high = np.percentile(components, [1, 99], axis=0)
    varies = high - low > 1e-9 * np.abs(rows).max()
    share = np.where(varies, (components - low) / np.where(varies, high - low, 1.0), 0.5)
    colours[filled] = DARKEST_FEATURE + (1 - DARKEST_FEATURE) * np.clip(share, 0, 1)
    return colours


def feature_grid_picture(grid: Array, grid_size: tuple[int, int], scale: int = 12) -> Pixels:
    """Feature grid as a picture: principal components as colours, empty cells black.

    Args:
        grid: ``(N, D)`` cells row by row, zeros where a cell is empty.
        grid_size: Rows and columns of the grid, with product N.
        scale: Side in pixels of the square drawn for one cell.

    Returns:
        ``(rows * scale, columns * scale, 3)`` uint8.

    Raises:
        ValueError: If ``grid`` does not have ``rows * columns`` cells.
    """
    rows, columns = grid_size
    if len(grid) != rows * columns:
        raise ValueError(
            f"{len(grid)} cells do not fill a grid of {rows} x {columns}; "
            "give grid_size as (rows, columns) with product N"
        )
    return _enlarge(_bytes(pca_colours(grid)).reshape(rows, columns, 3), scale)


def latents_picture(latents: Array, scale: int = 8) -> Pixels:
    """Latents of one scene as a picture: principal components of the channels as colours.

    Source: R3DPA (ICRA 2026), figure of the effect of end-to-end training on latents.

    Args:
        latents: ``(C, h, w)``, raw or normalised.
        scale: Side in pixels of the square drawn for one latent pixel.

    Returns:
        ``(h * scale, w * scale, 3)`` uint8.

    Raises:
        ValueError: If ``latents`` has other than three axes.
    """
    channels = _numpy(latents, ("C", "h", "w"))
    count, *latent_size = channels.shape
    colours = pca_colours(channels.reshape(count, -1).T)
    return _enlarge(_bytes(colours).reshape(*latent_size, 3), scale)


def save(picture: Figure | Pixels, path: str | Path) -> Path:
    """Writes a figure or a picture; a reader never sees half a file.

    The file is written under a temporary name in the same folder, which is made if missing, and
    then renamed.

    Args:
        picture: Figure, or uint8 pixels ``(rows, columns)`` or ``(rows, columns, 3)``.
        path: Where to; the suffix gives the format (``.png``; figures also ``.pdf``, ``.svg``).

    Returns:
        The path.

    Raises:
        ValueError: If the suffix is not a known format or the pixels are not uint8.
    """
    path = Path(path)
    with atomic_path(path) as temporary:
        if isinstance(picture, Figure):
            picture.savefig(temporary)
        elif picture.dtype == np.uint8:
            Image.fromarray(picture).save(temporary)
        else:
            raise ValueError(f"pixels are {picture.dtype}; give uint8 from 0 to 255")
    return path


def _numpy(array: Array, axes: tuple[str, ...]) -> NDArray[np.float64]:
    """The array in float64 on the CPU, checked to have the named axes."""
    if array.ndim != len(axes):
        raise ValueError(f"expected shape ({', '.join(axes)}), got {tuple(array.shape)}")
    if isinstance(array, Tensor):
        return array.detach().double().cpu().numpy()
    return array.astype(np.float64)


def _coloured_points(
    points: Array, colours: Array | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Finite points ``(P, 3)`` and their RGB ``(P, 3)`` from 0 to 255, by default from height."""
    given = _numpy(points, ("P", "3+"))
    if given.shape[1] < 3:
        raise ValueError(f"points need columns x, y, z, got shape {given.shape}")
    xyz = given[:, :3]
    if colours is None:
        rgb = _paint(xyz[:, 2], HEIGHT_MAP, Normalize(*HEIGHT_LIMITS_M))
    else:
        rgb = _bytes(_numpy(colours, ("P", "3")))
    if rgb.shape != xyz.shape:
        raise ValueError(f"colours are {rgb.shape} but points {xyz.shape}; give one RGB per point")
    finite = np.isfinite(xyz).all(axis=1)
    return xyz[finite], rgb[finite].astype(np.float64)


def _camera_axes() -> NDArray[np.float64]:
    """Right, up and forward of the 3D camera as columns, in the sensor frame."""
    forward = np.subtract(CAMERA_TARGET_M, CAMERA_EYE_M)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward], axis=1)


def _paint(values: NDArray[np.float64], colour_map: Colormap, scale: Normalize) -> Pixels:
    """RGB bytes of values; values outside the scale take the end colours."""
    return colour_map(scale(values), bytes=True)[..., :3]


def _bytes(colours: NDArray[np.float64]) -> Pixels:
    """RGB in [0, 1] as uint8."""
    return np.rint(np.clip(colours, 0, 1) * 255).astype(np.uint8)


def _enlarge(picture: Pixels, scale: int) -> Pixels:
    """Every pixel as a square of ``scale`` x ``scale``."""
    if scale < 1:
        raise ValueError(f"scale is {scale}; give a whole number of at least 1")
    return picture.repeat(scale, axis=0).repeat(scale, axis=1)


def _range_scale(sensor: LidarSensor) -> Normalize:
    return PowerNorm(0.5, sensor.range_min_m, sensor.range_max_m)


def _range_ticks(sensor: LidarSensor) -> list[float]:
    """Labels of the square-root scale; matplotlib would leave out the near ranges."""
    wanted = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 50.0, 80.0, 120.0, 200.0)
    return [tick for tick in wanted if sensor.range_min_m <= tick <= sensor.range_max_m]


def _draw_birds_eye(axes: Axes, points: Array, extent_m: float, pixels: int = 500) -> None:
    """Points from above in metres, with the outline of the ego vehicle to scale."""
    axes.imshow(
        birds_eye_picture(points, extent_m, pixels),
        extent=(extent_m, -extent_m, -extent_m, extent_m),  # +y is to the left
        interpolation="nearest",
    )
    axes.add_patch(Polygon(EGO_OUTLINE_M, facecolor="tab:red", edgecolor="white", linewidth=0.5))


def _draw_curve(
    axes: Axes, name: str, steps: NDArray[np.float64], values: NDArray[np.float64]
) -> None:
    """One panel of the loss curves."""
    axes.plot(steps, values, color="tab:blue", alpha=0.3, linewidth=0.8)
    axes.plot(
        steps,
        _running_mean(values, width=max(1, len(values) // 20)),
        color="tab:blue",
        linewidth=1.5,
        marker="o" if len(values) <= 20 else None,
        markersize=3,
    )
    axes.set_title(f"{name}\n{values[0]:.4g} → {values[-1]:.4g}", fontsize=10)
    axes.tick_params(labelsize=8)
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.set_xlabel("step", fontsize=8)
    axes.grid(alpha=0.3)
    finite = values[np.isfinite(values)]
    if len(finite) and 0 < finite.min() < finite.max():
        axes.set_yscale("log")
        spread = finite.max() / finite.min()
        if spread < 100:  # powers of ten alone would leave the axis with one label or none
            axes.yaxis.set_major_locator(
                MaxNLocator(4) if spread < 5 else LogLocator(subs=(1.0, 2.0, 5.0))
            )
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}"))
        axes.yaxis.set_minor_locator(NullLocator())


def _running_mean(values: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Mean of up to ``width`` finite values around each; stays blank where a value is."""
    finite = np.isfinite(values)
    window = np.ones(width)
    total = np.convolve(np.where(finite, values, 0.0), window, mode="same")
    count = np.convolve(finite.astype(np.float64), window, mode="same")
    return np.where(finite, total / np.maximum(count, 1.0), np.nan)


def _bar_below(
    figure: Figure,
    left: float,
    colour_map: Colormap,
    scale: Normalize,
    label: str,
    ticks: Sequence[float] | None = None,
) -> None:
    """Horizontal colour bar 0.45 inches above the lower edge of the figure."""
    height_in = figure.get_figheight()
    axes = figure.add_axes((left, 0.45 / height_in, 0.22, 0.13 / height_in))
    figure.colorbar(
        ScalarMappable(scale, colour_map),
        cax=axes,
        orientation="horizontal",
        label=label,
        ticks=ticks,
    )

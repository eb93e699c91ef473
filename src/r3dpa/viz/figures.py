"""Figures of scans with axes, scales and titles.

Letters: H beams, W columns, P points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon

from r3dpa.geometry import LidarSensor, Projection, points_of
from r3dpa.viz.pixels import BACKGROUND, Array, as_numpy, bright_part, paint
from r3dpa.viz.scans import (
    HEIGHT_LIMITS_M,
    HEIGHT_MAP,
    RANGE_MAP,
    birds_eye_picture,
    range_image_picture,
    range_scale,
    scene_3d,
)

ERROR_LIMIT_M = 2.0
EGO_OUTLINE_M = ((0.0, 2.5), (-0.9, 1.0), (-0.9, -2.0), (0.9, -2.0), (0.9, 1.0))  # (y, x)
ONLY_INPUT = (0.80, 0.80, 0.80)
ONLY_RECONSTRUCTION = (0.95, 0.45, 0.75)
ERROR_MAP = bright_part("viridis", 0.0)


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
        ranges = torch.as_tensor(as_numpy(range_m, ("H", "W")), dtype=torch.float32)
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
        range_scale(projection.sensor),
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
    before, after = as_numpy(range_m, ("H", "W")), as_numpy(reconstruction_m, ("H", "W"))
    if before.shape != after.shape:
        raise ValueError(
            f"range_m is {before.shape} but reconstruction_m is {after.shape}; "
            "give two range images of the same sensor"
        )
    error_scale = Normalize(0.0, ERROR_LIMIT_M)
    error = paint(np.abs(before - after), ERROR_MAP, error_scale)
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
        ScalarMappable(range_scale(sensor), RANGE_MAP),
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

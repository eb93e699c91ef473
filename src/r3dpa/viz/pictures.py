"""Range images and points as pixels, and pixels as files."""

from __future__ import annotations

import io
import itertools
import math
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.colors import Colormap, ListedColormap, Normalize, PowerNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from r3dpa.geometry import LidarSensor
from r3dpa.io import atomic_path

Array = Tensor | NDArray[np.generic]
Pixels = NDArray[np.uint8]

BACKGROUND = (10, 10, 14)  # RGB of "no return"; darker than every colour of the maps


def bright_part(name: str, start: float) -> Colormap:
    """The part of a named colour map from ``start`` in [0, 1] on, to stand out from the dark."""
    return ListedColormap(matplotlib.colormaps[name](np.linspace(start, 1.0, 256)))


HEIGHT_LIMITS_M = (-2.0, 3.0)  # relative to the sensor, which stands about 1.7 m above the road
EGO_OUTLINE_M = ((0.0, 2.5), (-0.9, 1.0), (-0.9, -2.0), (0.9, -2.0), (0.9, 1.0))  # (y, x)
# Distinct on the dark background; for categories that come without a colour.
PALETTE = (
    "#4e9bff",
    "#ffb000",
    "#3ddc97",
    "#ff6b6b",
    "#c792ea",
    "#5ce1e6",
    "#f78fb3",
    "#b5e853",
    "#ff8c42",
    "#9fa8da",
    "#e6d690",
    "#8bd3c7",
)
CAMERA_EYE_M = (-20.0, 0.0, 10.5)
CAMERA_TARGET_M = (12.0, 0.0, -1.0)
CAMERA_WIDTH_DEG = 58.0
POINT_WIDTH_M = 0.11  # drawn width of a point in the 3D picture
MAX_POINT_PIXELS = 6  # before the averaging over 2 x 2
RANGE_MAP = bright_part("plasma", 0.0).reversed()  # near is bright
HEIGHT_MAP = bright_part("viridis", 0.3)


def range_image_picture(range_m: Array, sensor: LidarSensor, scale: int = 1) -> Pixels:
    """Colours ``(H * scale, W * scale, 3)`` uint8 of a range image, bright where near.

    ``range_m`` is ``(H, W)`` metres, not above 0 without a return (dark background). Colours follow
    the square root of the range between the limits of the sensor.
    """
    ranges = as_numpy(range_m, ("H", "W"))
    picture = paint(ranges, RANGE_MAP, range_scale(sensor))
    picture[~(ranges > 0)] = BACKGROUND
    return enlarge(picture, scale)


def encoded_picture(image: Array) -> Pixels:
    """Gray values of an encoded range image ``(H, W)``: [-1, 1] becomes 0 to 255, rounded down.

    Source: the PNG that ``generate.py`` of valeoai/R3DPA writes; same bytes.
    """
    values = as_numpy(image, ("H", "W")).astype(np.float32)  # its rounding decides the last bit
    return np.clip((values + 1) / 2 * 255, 0, 255).astype(np.uint8)


def birds_eye_picture(
    points: Array, extent_m: float = 50.0, pixels: int = 500, colours: Array | None = None
) -> Pixels:
    """Points seen from above, forward up; the highest point of a pixel shows.

    Args:
        points: ``(P, 3+)`` x forward, y left, z up, metres.
        extent_m: Half side of the square around the sensor that is shown.
        pixels: Side of the picture, ``(pixels, pixels, 3)`` uint8.
        colours: ``(P, 3)`` RGB in [0, 1] of the points, by default from their height.
    """
    xyz, rgb = _coloured_points(points, colours)
    row = np.floor((extent_m - xyz[:, 0]) / (2 * extent_m) * pixels)
    column = np.floor((extent_m - xyz[:, 1]) / (2 * extent_m) * pixels)
    inside = (row >= 0) & (row < pixels) & (column >= 0) & (column < pixels)
    order = np.flatnonzero(inside)[np.argsort(xyz[inside, 2], kind="stable")]
    picture = np.full((pixels, pixels, 3), BACKGROUND, dtype=np.uint8)
    picture[row[order].astype(int), column[order].astype(int)] = rgb[order]
    return picture


def scene_3d(
    points: Array, colours: Array | None = None, size: tuple[int, int] = (540, 960)
) -> Pixels:
    """Points seen by a pinhole camera behind and above the ego vehicle, looking forward.

    Near points hide far ones and are drawn larger; colours fade with distance. Arguments as in
    :func:`birds_eye_picture`; ``size`` is rows and columns of the picture, ``(*size, 3)`` uint8.
    """
    xyz, rgb = _coloured_points(points, colours)
    height, width = 2 * size[0], 2 * size[1]  # averaged over 2 x 2 at the end, against jagged edges
    focal = 0.5 * width / math.tan(math.radians(CAMERA_WIDTH_DEG) / 2)
    from_eye = (xyz - np.array(CAMERA_EYE_M)) @ _camera_axes()
    order = np.argsort(-from_eye[:, 2])  # far to near: the rank of a point tells what hides what
    order = order[from_eye[order, 2] > 1.0]
    right, up, depth = from_eye[order].T
    # A point is a square of side x side pixels, whose first corner is (row, column).
    side = np.clip(np.rint(POINT_WIDTH_M * focal / depth), 1, MAX_POINT_PIXELS).astype(int)
    row = np.floor(height / 2 - focal * up / depth).astype(int) - side // 2
    column = np.floor(width / 2 + focal * right / depth).astype(int) - side // 2

    # Rank of the nearest point of each pixel, -1 for none; one layer for each pixel of the squares.
    nearest = np.full(height * width, -1)
    for down, across in itertools.product(range(MAX_POINT_PIXELS), repeat=2):
        drawn = (side > max(down, across)) & (row + down >= 0) & (row + down < height)
        drawn &= (column + across >= 0) & (column + across < width)
        layer = np.full(height * width, -1)
        ranks = np.flatnonzero(drawn)
        layer[(row[ranks] + down) * width + column[ranks] + across] = ranks  # the last one stays
        np.maximum(nearest, layer, out=nearest)

    background = np.array([BACKGROUND], dtype=np.float64)
    haze = np.clip((depth[:, None] - 25.0) / 90.0, 0.0, 0.75)
    shaded = (1 - haze) * rgb[order] + haze * background
    picture = np.concatenate([shaded, background])[nearest]  # index -1 is the background
    picture = picture.reshape(size[0], 2, size[1], 2, 3).mean(axis=(1, 3))
    return np.rint(picture).astype(np.uint8)


def save(picture: Figure | Pixels, path: str | Path) -> Path:
    """Write a figure, or pixels ``(rows, columns[, 3])``, atomically; return ``path``.

    The suffix names the format.

    Raises:
        ValueError: If the format is unknown.
    """
    path = Path(path)
    with atomic_path(path) as temporary:
        if isinstance(picture, Figure):
            picture.savefig(temporary)
        else:
            Image.fromarray(picture).save(temporary)
    return path


def palette_image(picture: Figure | Pixels, colours: int = 64) -> Image.Image:
    """The picture with few colours, a third of the size as PNG: for notebooks."""
    if isinstance(picture, Figure):
        file = io.BytesIO()
        picture.savefig(file, format="png")
        return Image.open(file).convert("RGB").quantize(colours)
    return Image.fromarray(picture).quantize(colours)


def as_numpy(array: Array, axes: tuple[str, ...]) -> NDArray[np.float64]:
    """The array in float64 on the CPU, checked to have as many axes as there are names."""
    if array.ndim != len(axes):
        raise ValueError(f"expected shape ({', '.join(axes)}), got {tuple(array.shape)}")
    if isinstance(array, Tensor):
        return array.detach().double().cpu().numpy()
    return array.astype(np.float64)


def paint(values: NDArray[np.float64], colour_map: Colormap, scale: Normalize) -> Pixels:
    """RGB bytes of values; values outside the scale take the end colours."""
    return colour_map(scale(values), bytes=True)[..., :3]


def as_bytes(colours: NDArray[np.float64]) -> Pixels:
    """RGB in [0, 1] as uint8."""
    return np.rint(np.clip(colours, 0, 1) * 255).astype(np.uint8)


def enlarge(picture: Pixels, scale: int) -> Pixels:
    """Every pixel as a square of ``scale`` x ``scale``."""
    return picture.repeat(scale, axis=0).repeat(scale, axis=1)


def range_scale(sensor: LidarSensor) -> Normalize:
    """Square-root scale between the range limits of a sensor."""
    return PowerNorm(0.5, sensor.range_min_m, sensor.range_max_m)


def range_ticks(sensor: LidarSensor) -> list[float]:
    """Labels of the range scale: both limits, and round ranges between that do not touch them."""
    low, high = sensor.range_min_m, sensor.range_max_m
    return [low, *(tick for tick in (5.0, 10.0, 20.0, 30.0) if 2 * low < tick < 0.75 * high), high]


def _coloured_points(
    points: Array, colours: Array | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Finite points ``(P, 3)`` and their RGB ``(P, 3)`` from 0 to 255, by default from height."""
    xyz = as_numpy(points, ("P", "3+"))[:, :3]
    if colours is None:
        rgb = paint(xyz[:, -1], HEIGHT_MAP, Normalize(*HEIGHT_LIMITS_M))
    else:
        rgb = as_bytes(as_numpy(colours, ("P", "3")))
    if rgb.shape != xyz.shape:
        raise ValueError(
            f"colours are {rgb.shape} but points {xyz.shape}: give x, y, z and one RGB"
        )
    finite = np.isfinite(xyz).all(axis=1)
    return xyz[finite], rgb[finite].astype(np.float64)


def _camera_axes() -> NDArray[np.float64]:
    """Right, up and forward of the 3D camera as columns, in the sensor frame."""
    forward = np.subtract(CAMERA_TARGET_M, CAMERA_EYE_M)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward], axis=1)

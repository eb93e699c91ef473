"""Features of points or of N feature-grid cells, and latents, as colours."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from r3dpa.geometry import Projection, range_image
from r3dpa.viz.figures import draw_birds_eye, draw_panorama
from r3dpa.viz.pictures import (
    Array,
    Pixels,
    as_bytes,
    as_numpy,
    bright_part,
    enlarge,
    paint,
    scene_3d,
)

Rows = NDArray[np.floating]

DARKEST_FEATURE = 0.15  # keeps every filled cell brighter than an empty one
SIMILARITY_MAP = bright_part("viridis", 0.1)
FRAME = (255, 60, 60)  # a colour that the map does not hold


def fit_colours(features: Array) -> Callable[[Array], NDArray[np.float64]]:
    """Colours by the principal components of features ``(N, D)``, in float32 or wider.

    The result maps any features of that width to RGB in [0, 1]. Rows of zeros are empty cells: they
    are left out of the fit and drawn black. The 1st to 99th percentile of each component becomes
    0.15 to 1, clipped; a component without variance is 0.575. The sign makes the largest loading of
    a component positive.

    Source: R3DPA (ICRA 2026), figure of the 3D features and their projection.
    """
    fitted = _rows(features)
    width = fitted.shape[1]
    fitted = fitted[_occupied_cells(fitted)]
    mean, loadings = np.zeros(width, fitted.dtype), np.zeros((width, 0), fitted.dtype)
    low = high = np.zeros(0)
    if len(fitted):
        mean = fitted.mean(axis=0, dtype=np.float64).astype(fitted.dtype)
        centred = fitted - mean
        _, vectors = np.linalg.eigh((centred.T @ centred).astype(np.float64))
        loadings = vectors[:, ::-1][:, :3]  # eigh sorts upwards
        largest = np.take_along_axis(loadings, np.abs(loadings).argmax(axis=0)[None], axis=0)
        loadings = (loadings * np.sign(largest)).astype(fitted.dtype)
        low, high = np.percentile(centred @ loadings, [1, 99], axis=0)
        # Below the rounding of float32 a component holds no variance but noise.
        flat = high - low <= 1e-6 * np.abs(fitted).max()
        loadings[:, flat], low[flat], high[flat] = 0.0, -1.0, 1.0

    def colours_of(features: Array) -> NDArray[np.float64]:
        rows = _rows(features)
        share = np.full((len(rows), 3), 0.5)
        share[:, : len(low)] = ((rows - mean) @ loadings - low) / (high - low)
        colours = DARKEST_FEATURE + (1 - DARKEST_FEATURE) * np.clip(share, 0, 1)
        colours[~_occupied_cells(rows)] = 0.0
        return colours

    return colours_of


def pca_colours(features: Array) -> NDArray[np.float64]:
    """RGB ``(N, 3)`` in [0, 1] of features ``(N, D)`` by their own :func:`fit_colours`."""
    return fit_colours(features)(features)


def similarity_picture(
    grid: Array, grid_size: tuple[int, int], cell: tuple[int, int], scale: int = 12
) -> Pixels:
    """Cosine of each cell of a feature grid ``(N, D)`` with one ``cell`` (row, column).

    Cosine 1 is bright, 0 and below dark, empty cells black; the cell itself has a red frame.
    The result is ``(rows * scale, columns * scale, 3)`` uint8.
    """
    values = _rows(grid)
    (row, column), (rows, columns) = cell, grid_size
    filled = _occupied_cells(values)
    chosen = row * columns + column
    if not filled[chosen]:
        raise ValueError(f"cell {cell} is empty; choose one that holds points")
    unit = values / np.where(filled, np.linalg.norm(values, axis=1), 1.0)[:, None]
    picture = paint(unit @ unit[chosen], SIMILARITY_MAP, Normalize(0.0, 1.0))
    picture[~filled] = 0
    picture = enlarge(picture.reshape(rows, columns, 3), scale)
    frame = picture[row * scale : (row + 1) * scale, column * scale : (column + 1) * scale]
    width = max(1, scale // 6)
    inside = frame[width:-width, width:-width].copy()
    frame[:] = FRAME
    frame[width:-width, width:-width] = inside
    return picture


def feature_figure(
    points: Array,
    features: Array,
    grid: Array,
    projection: Projection,
    grid_size: tuple[int, int] = (8, 64),
) -> Figure:
    """Features of a scan on its points, on its range image and averaged over the grid.

    All pictures share the principal components of the points, so that one colour means one feature.

    Args:
        points: ``(P, 3+)`` x forward, y left, z up, metres.
        features: ``(P, D)`` of the points.
        grid: ``(N, D)`` means over the cells, row by row, zeros where a cell is empty.
        projection: Projection of the range image below the grid.
        grid_size: Rows and columns of the grid, with product N.
    """
    colours = fit_colours(features)
    of_points = colours(features)
    xyz = torch.from_numpy(as_numpy(points, ("P", "3+"))[:, :3])
    _, nearest = range_image(xyz, projection, torch.from_numpy(of_points))
    assert nearest is not None
    panorama = as_bytes(nearest.movedim(0, -1).numpy())
    beams, columns = panorama.shape[:2]
    figure = Figure(figsize=(13.0, 7.6), dpi=110, layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(4.5, 3.1))[:, 0]
    behind, above = upper.subplots(1, 2, width_ratios=(8.6, 4.4))
    image, cells = lower.subplots(2, 1)
    picture = scene_3d(points, of_points, size=(480, 920))
    draw_panorama(behind, picture, f"{len(xyz):,} points, from behind")
    draw_birds_eye(above, points, 40.0, 480, of_points)
    above.set(xticks=[], yticks=[])
    above.set_title("from above, 80 m wide", loc="left", fontsize=10)
    title = f"range image, {beams} x {columns} pixels: feature of the nearest point"
    draw_panorama(image, panorama, title)
    title = f"feature grid, {grid_size[0]} x {grid_size[1]} cells: mean of their points"
    draw_panorama(cells, as_bytes(colours(grid)).reshape(*grid_size, 3), title)
    return figure


def latents_picture(latents: Array, scale: int = 8) -> Pixels:
    """Principal components of the channels of latents ``(C, h, w)`` as colours.

    Returns ``(h * scale, w * scale, 3)`` uint8. Source: R3DPA (ICRA 2026), figure of the effect of
    end-to-end training on latents.
    """
    pixels = np.moveaxis(as_numpy(latents, ("C", "h", "w")), 0, -1)
    colours = pca_colours(pixels.reshape(-1, pixels.shape[-1]))
    return enlarge(as_bytes(colours).reshape(*pixels.shape[:2], 3), scale)


def _rows(features: Array) -> Rows:
    """The features as float32, or float64 where they are wider than that."""
    if isinstance(features, torch.Tensor):
        features = features.detach().cpu()
        features = (features if features.dtype == torch.float64 else features.float()).numpy()
    return features.astype(np.result_type(features.dtype, np.float32), copy=False)


def _occupied_cells(rows: Rows) -> NDArray[np.bool_]:
    return np.any(rows != 0, axis=1)

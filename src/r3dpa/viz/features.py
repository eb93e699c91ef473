"""Features and latents as colours.

Letters: N tokens = feature-grid cells, D feature width, C latent channels, h w latent size.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from r3dpa.viz.pixels import Array, Pixels, as_bytes, as_numpy, enlarge

DARKEST_FEATURE = 0.15  # keeps every filled cell brighter than an empty one


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
    rows = as_numpy(features, ("N", "D"))
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
    return enlarge(as_bytes(pca_colours(grid)).reshape(rows, columns, 3), scale)


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
    channels = as_numpy(latents, ("C", "h", "w"))
    count, *latent_size = channels.shape
    colours = pca_colours(channels.reshape(count, -1).T)
    return enlarge(as_bytes(colours).reshape(*latent_size, 3), scale)

"""Pictures of arrays or tensors: a matplotlib ``Figure`` or pixels ``(rows, columns, 3)`` uint8.

Colours are safe for colour-blind readers, on scales fixed in metres. Dark means no return.
"""

from r3dpa.viz.curves import (
    ParetoPoint,
    Series,
    beam_residuals,
    loss_curves,
    pareto_figure,
    read_curves,
    read_metrics,
)
from r3dpa.viz.features import feature_figure, latents_picture, pca_colours, similarity_picture
from r3dpa.viz.figures import (
    EditRow,
    birds_eye_sheet,
    birds_eye_view,
    edit_sheet,
    range_strips,
    reconstruction_figure,
    scenes_sheet,
)
from r3dpa.viz.page import Category, PageScan, Tile, edit_page, scan_page
from r3dpa.viz.pictures import (
    birds_eye_picture,
    encoded_picture,
    palette_image,
    range_image_picture,
    save,
    scene_3d,
)

__all__ = [
    "Category",
    "EditRow",
    "PageScan",
    "ParetoPoint",
    "Series",
    "Tile",
    "beam_residuals",
    "birds_eye_picture",
    "birds_eye_sheet",
    "birds_eye_view",
    "edit_page",
    "edit_sheet",
    "encoded_picture",
    "feature_figure",
    "latents_picture",
    "loss_curves",
    "palette_image",
    "pareto_figure",
    "pca_colours",
    "range_image_picture",
    "range_strips",
    "read_curves",
    "read_metrics",
    "reconstruction_figure",
    "save",
    "scan_page",
    "scene_3d",
    "scenes_sheet",
    "similarity_picture",
]

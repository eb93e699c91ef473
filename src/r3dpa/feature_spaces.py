"""Names of the feature spaces, known before torch is imported.

:mod:`r3dpa.metrics.scene_features` describes them.
"""

from __future__ import annotations

from typing import Literal, get_args

FeatureSpace = Literal[
    "frid",
    "fld",
    "fsvd",
    "fpvd",
    "fwid",
    "fgeo",
    "frd",
    "frid_r2flow",
    "frid_lidm",
    "fpd",
]
SPACES: tuple[FeatureSpace, ...] = get_args(FeatureSpace)
"""All of them, in the order of tables."""
FREE_SPACES: tuple[FeatureSpace, ...] = ("fwid", "fgeo")
"""The ones that need no weights from elsewhere."""

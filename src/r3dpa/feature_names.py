"""Names of feature sources and feature spaces, known before torch is imported.

:mod:`r3dpa.features.scalr` makes the sources, :mod:`r3dpa.metrics.scene_features` describes the
spaces.
"""

from __future__ import annotations

from typing import Literal, get_args

SOURCES = ("scalr", "waffleiron-s", "waffleiron-s-2", "geometric")
"""Extractors of point features that the method aligns with."""
OWN_WEIGHTS = SOURCES[1:]
"""Sources that need no file: their weights come with the package, or they have none."""

FeatureSpace = Literal[
    "frid",
    "fld",
    "fsvd",
    "fpvd",
    "fwid",
    "fwid_judge",
    "fgeo",
    "frd",
    "frid_r2flow",
    "frid_lidm",
    "fpd",
]
SPACES: tuple[FeatureSpace, ...] = get_args(FeatureSpace)
"""All spaces, in the order of tables."""
FREE_SPACES: tuple[FeatureSpace, ...] = ("fwid", "fwid_judge", "fgeo")
"""Spaces that need no weights from elsewhere."""
DEFAULT_SPACES: tuple[FeatureSpace, ...] = ("fwid", "fgeo")
"""Spaces that a comparison has unless others are named."""

"""Measures of how realistic scans are, and of what point features know of a scene."""

from r3dpa.metrics.features import curves
from r3dpa.metrics.measures import (
    MEASURES,
    Measure,
    curve_rmse,
    jensen_shannon,
    known,
    wasserstein_1,
)
from r3dpa.metrics.probe import (
    ProbeScores,
    SourceProbe,
    empty_share,
    linear_probe,
    neighbour_cosine,
    probe_source,
)
from r3dpa.metrics.realism import RealismRow, RealismTable, realism_table
from r3dpa.metrics.scan_statistics import ScanStatistics, scan_statistics

__all__ = [
    "MEASURES",
    "Measure",
    "ProbeScores",
    "RealismRow",
    "RealismTable",
    "ScanStatistics",
    "SourceProbe",
    "curve_rmse",
    "curves",
    "empty_share",
    "jensen_shannon",
    "known",
    "linear_probe",
    "neighbour_cosine",
    "probe_source",
    "realism_table",
    "scan_statistics",
    "wasserstein_1",
]

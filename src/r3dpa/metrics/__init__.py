"""Measures of how realistic scans are."""

from r3dpa.metrics.features import curves
from r3dpa.metrics.measures import (
    MEASURES,
    Measure,
    curve_rmse,
    jensen_shannon,
    known,
    wasserstein_1,
)
from r3dpa.metrics.realism import RealismRow, RealismTable, realism_table
from r3dpa.metrics.scan_statistics import ScanStatistics, scan_statistics

__all__ = [
    "MEASURES",
    "Measure",
    "RealismRow",
    "RealismTable",
    "ScanStatistics",
    "curve_rmse",
    "curves",
    "jensen_shannon",
    "known",
    "realism_table",
    "scan_statistics",
    "wasserstein_1",
]

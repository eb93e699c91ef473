"""How realistic scans are, and how near generated scenes are to real ones."""

from r3dpa.metrics.distances import (
    BEVHistogramDistance,
    MinimumMatchingDistance,
    RangeHistogramDistance,
)
from r3dpa.metrics.evaluation import evaluate, scene_distance
from r3dpa.metrics.feature_distances import (
    FrechetDistance,
    FrechetInfinity,
    PolynomialMMD,
    PrecisionRecall,
)
from r3dpa.metrics.realism import measures, realism_table
from r3dpa.metrics.results import Evaluation
from r3dpa.metrics.scan_statistics import ScanStatistics, scan_statistics
from r3dpa.metrics.scene import DEFAULT, PUBLISHED, EvaluationScene, Protocol

__all__ = [
    "DEFAULT",
    "PUBLISHED",
    "BEVHistogramDistance",
    "Evaluation",
    "EvaluationScene",
    "FrechetDistance",
    "FrechetInfinity",
    "MinimumMatchingDistance",
    "PolynomialMMD",
    "PrecisionRecall",
    "Protocol",
    "RangeHistogramDistance",
    "ScanStatistics",
    "evaluate",
    "measures",
    "realism_table",
    "scan_statistics",
    "scene_distance",
]

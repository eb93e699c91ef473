"""How realistic scans are, and how near generated scenes are to real ones."""

from r3dpa.metrics.bootstrap import Resampling
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
from r3dpa.metrics.functional_bev import BEVGrid
from r3dpa.metrics.realism import measures, realism_table
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.results import Evaluation, EvaluationTable
from r3dpa.metrics.scan_statistics import ScanStatistics, scan_statistics
from r3dpa.metrics.scene import DEFAULT, PUBLISHED, EvaluationScene, Protocol

__all__ = [
    "DEFAULT",
    "PUBLISHED",
    "BEVGrid",
    "BEVHistogramDistance",
    "Evaluation",
    "EvaluationScene",
    "EvaluationTable",
    "FrechetDistance",
    "FrechetInfinity",
    "MinimumMatchingDistance",
    "PolynomialMMD",
    "PrecisionRecall",
    "Protocol",
    "RangeHistogramDistance",
    "ReferenceStatistics",
    "Resampling",
    "ScanStatistics",
    "evaluate",
    "measures",
    "realism_table",
    "scan_statistics",
    "scene_distance",
]

"""How realistic scans are, how near generated scenes are to real ones, what features know."""

from r3dpa.metrics.bootstrap import Interval, bootstrap_interval
from r3dpa.metrics.distribution import (
    BEVHistogramDistance,
    MinimumMatchingDistance,
    PolynomialMMD,
    PrecisionRecall,
)
from r3dpa.metrics.evaluation import Comparison, evaluate
from r3dpa.metrics.features import curves
from r3dpa.metrics.frechet import FrechetDistance
from r3dpa.metrics.functional import (
    Moments,
    fd_infinity,
    frechet_distance,
    frechet_distance_of,
    polynomial_mmd,
    squared_mmd,
    wasserstein_1_of_values,
)
from r3dpa.metrics.functional_bev import (
    BEVGrid,
    chamfer_squared,
    histogram_distance,
    minimum_matching,
)
from r3dpa.metrics.functional_manifold import precision_recall
from r3dpa.metrics.measures import (
    MEASURES,
    Measure,
    curve_rmse,
    jensen_shannon,
    known,
    wasserstein_1,
)
from r3dpa.metrics.protocol import DEFAULT, PUBLISHED, Protocol
from r3dpa.metrics.realism import RealismRow, RealismTable, realism_table
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.result_table import EvaluationTable
from r3dpa.metrics.results import Evaluation, MetricResult, published_evaluations
from r3dpa.metrics.scan_statistics import ScanStatistics, scan_statistics
from r3dpa.metrics.scene import EvaluationScene
from r3dpa.metrics.scene_features import SceneFeatures, scene_features

__all__ = [
    "DEFAULT",
    "MEASURES",
    "PUBLISHED",
    "BEVGrid",
    "BEVHistogramDistance",
    "Comparison",
    "Evaluation",
    "EvaluationScene",
    "EvaluationTable",
    "FrechetDistance",
    "Interval",
    "Measure",
    "MetricResult",
    "MinimumMatchingDistance",
    "Moments",
    "PolynomialMMD",
    "PrecisionRecall",
    "Protocol",
    "RealismRow",
    "RealismTable",
    "ReferenceStatistics",
    "ScanStatistics",
    "SceneFeatures",
    "bootstrap_interval",
    "chamfer_squared",
    "curve_rmse",
    "curves",
    "evaluate",
    "fd_infinity",
    "frechet_distance",
    "frechet_distance_of",
    "histogram_distance",
    "jensen_shannon",
    "known",
    "minimum_matching",
    "polynomial_mmd",
    "precision_recall",
    "published_evaluations",
    "realism_table",
    "scan_statistics",
    "scene_features",
    "squared_mmd",
    "wasserstein_1",
    "wasserstein_1_of_values",
]

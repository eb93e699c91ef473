"""How realistic scans are, and how near generated scenes are to real ones."""

from r3dpa.metrics.bootstrap import Resampling
from r3dpa.metrics.distances import (
    BEVHistogramDistance,
    MinimumMatchingDistance,
    RangeHistogramDistance,
)
from r3dpa.metrics.evaluation import Comparison, evaluate, feature_spaces, scene_distance
from r3dpa.metrics.feature_distances import (
    FrechetDistance,
    FrechetInfinity,
    PolynomialMMD,
    PrecisionRecall,
    scene_metrics,
)
from r3dpa.metrics.functional import (
    Moments,
    curve_rmse,
    fd_infinity,
    frechet_distance,
    frechet_distance_of,
    jensen_shannon,
    polynomial_mmd,
    precision_recall,
    squared_mmd,
    wasserstein_1,
)
from r3dpa.metrics.functional_bev import (
    BEVGrid,
    chamfer_squared,
    histogram_distance,
    minimum_matching,
)
from r3dpa.metrics.realism import (
    Measure,
    RealismRow,
    RealismTable,
    measures,
    realism_table,
)
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.results import (
    Evaluation,
    EvaluationTable,
    MetricResult,
    published_evaluations,
)
from r3dpa.metrics.scan_statistics import ScanStatistics, scan_statistics
from r3dpa.metrics.scene import DEFAULT, PUBLISHED, EvaluationScene, Protocol
from r3dpa.metrics.scene_features import SceneFeatures, scene_features

__all__ = [
    "DEFAULT",
    "PUBLISHED",
    "BEVGrid",
    "BEVHistogramDistance",
    "Comparison",
    "Evaluation",
    "EvaluationScene",
    "EvaluationTable",
    "FrechetDistance",
    "FrechetInfinity",
    "Measure",
    "MetricResult",
    "MinimumMatchingDistance",
    "Moments",
    "PolynomialMMD",
    "PrecisionRecall",
    "Protocol",
    "RangeHistogramDistance",
    "RealismRow",
    "RealismTable",
    "ReferenceStatistics",
    "Resampling",
    "ScanStatistics",
    "SceneFeatures",
    "chamfer_squared",
    "curve_rmse",
    "evaluate",
    "fd_infinity",
    "feature_spaces",
    "frechet_distance",
    "frechet_distance_of",
    "histogram_distance",
    "jensen_shannon",
    "measures",
    "minimum_matching",
    "polynomial_mmd",
    "precision_recall",
    "published_evaluations",
    "realism_table",
    "scan_statistics",
    "scene_distance",
    "scene_features",
    "scene_metrics",
    "squared_mmd",
    "wasserstein_1",
]

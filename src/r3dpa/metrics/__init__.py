"""How near generated scenes are to real ones.

FWID is the Fréchet distance between scenes described by WaffleIron-S, FGEO the one between scenes
described by geometric features: the point features of each scene, averaged over its points, give
one vector of 128 or 64 numbers, and the distance is that of two Gaussians fitted to the vectors of
both sets. Neither needs a file from elsewhere, and neither has published numbers. How a scene
becomes a vector stands in :mod:`r3dpa.metrics.scene_features`, the formula in
:func:`r3dpa.metrics.functional.frechet_distance`.
"""

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
from r3dpa.metrics.results import Evaluation
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
    "evaluate",
    "scene_distance",
]

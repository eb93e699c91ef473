"""How near generated scenes are to real ones.

FWID and FGEO are Fréchet distances between two sets of scenes in a feature space. A scene is the
mean of its point features, 128 numbers of WaffleIron-S (FWID) or 64 geometric ones (FGEO), and a
Gaussian is fitted to the vectors of each set. Neither needs weights from elsewhere, and neither has
published numbers. :mod:`r3dpa.metrics.scene_features` turns scenes into vectors,
:func:`r3dpa.metrics.functional.frechet_distance` has the formula.
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

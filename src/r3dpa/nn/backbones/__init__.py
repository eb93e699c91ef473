"""Frozen point-feature extractors."""

from r3dpa.nn.backbones.geometric import GeometricFeatures

__all__ = ["GeometricFeatures"]

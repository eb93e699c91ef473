"""Frozen networks that only the published metrics need."""

from r3dpa.metrics.networks.liploc import LIPLoc
from r3dpa.metrics.networks.minkowski import SPVCNN, MinkowskiNet
from r3dpa.metrics.networks.pointnet import PointNet
from r3dpa.metrics.networks.rangenet import RangeNet
from r3dpa.metrics.networks.rangevit import RangeViT

__all__ = ["SPVCNN", "LIPLoc", "MinkowskiNet", "PointNet", "RangeNet", "RangeViT"]

"""Flow matching without networks: paths, solvers, guidance and editing over velocity functions."""

from r3dpa.flow.editing import pnp_flow_feature, transport_to_time
from r3dpa.flow.guidance import FeatureGuidance, GuidanceRecord
from r3dpa.flow.interpolant import Interpolant, PathCoefficients, sample_time
from r3dpa.flow.solvers import (
    CountingVelocity,
    DriftChange,
    Velocity,
    euler,
    euler_maruyama,
    heun,
    ode_times,
    sde_times,
)

__all__ = [
    "CountingVelocity",
    "DriftChange",
    "FeatureGuidance",
    "GuidanceRecord",
    "Interpolant",
    "PathCoefficients",
    "Velocity",
    "euler",
    "euler_maruyama",
    "heun",
    "ode_times",
    "pnp_flow_feature",
    "sample_time",
    "sde_times",
    "transport_to_time",
]

"""Flow matching without networks: paths, solvers, guidance and editing over velocity functions."""

from r3dpa.flow.autoguidance import autoguided, renormalised
from r3dpa.flow.editing import pnp_flow_feature, transport_to_time
from r3dpa.flow.guidance import FeatureGuidance, GuidanceRecord
from r3dpa.flow.interpolant import Interpolant, PathCoefficients, sample_time
from r3dpa.flow.mixture import GaussianMixture, toy_mixture
from r3dpa.flow.sde import DriftChange, RestartPlan, euler_maruyama, restart
from r3dpa.flow.solvers import (
    ODE_SOLVERS,
    CountingVelocity,
    OdeSolver,
    Velocity,
    ab2,
    ab3,
    dopri5,
    dpm_solver_pp_2m,
    euler,
    evaluations,
    heun,
    midpoint,
    ode_solver,
    steps_for,
    unipc,
)
from r3dpa.flow.times import ode_times, sde_times

__all__ = [
    "ODE_SOLVERS",
    "CountingVelocity",
    "DriftChange",
    "FeatureGuidance",
    "GaussianMixture",
    "GuidanceRecord",
    "Interpolant",
    "OdeSolver",
    "PathCoefficients",
    "RestartPlan",
    "Velocity",
    "ab2",
    "ab3",
    "autoguided",
    "dopri5",
    "dpm_solver_pp_2m",
    "euler",
    "euler_maruyama",
    "evaluations",
    "heun",
    "midpoint",
    "ode_solver",
    "ode_times",
    "pnp_flow_feature",
    "renormalised",
    "restart",
    "sample_time",
    "sde_times",
    "steps_for",
    "toy_mixture",
    "transport_to_time",
    "unipc",
]

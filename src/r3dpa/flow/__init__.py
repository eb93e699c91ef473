"""Flow matching without networks: paths, solvers, guidance and editing over velocity functions.

Arguments outside the ranges and shapes that the docstrings state are a ``ValueError``.
"""

from r3dpa.flow.autoguidance import autoguided, renormalised
from r3dpa.flow.average_velocity import average_times, average_velocity_steps
from r3dpa.flow.editing import invert, kept, pnp_flow_feature, renoised, spherical_mean
from r3dpa.flow.guidance import FeatureGuidance, FeatureTarget
from r3dpa.flow.interpolant import Interpolant, sample_time
from r3dpa.flow.sde import euler_maruyama
from r3dpa.flow.solvers import (
    ODE_SOLVERS,
    Velocity,
    ab2,
    ab3,
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
    "FeatureGuidance",
    "FeatureTarget",
    "Interpolant",
    "Velocity",
    "ab2",
    "ab3",
    "autoguided",
    "average_times",
    "average_velocity_steps",
    "dpm_solver_pp_2m",
    "euler",
    "euler_maruyama",
    "evaluations",
    "heun",
    "invert",
    "kept",
    "midpoint",
    "ode_solver",
    "ode_times",
    "pnp_flow_feature",
    "renoised",
    "renormalised",
    "sample_time",
    "sde_times",
    "spherical_mean",
    "steps_for",
    "unipc",
]

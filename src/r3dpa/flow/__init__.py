"""Flow matching without networks: paths, solvers and guidance over velocity functions.

Arguments outside the ranges and shapes that the docstrings state raise a ValueError.
"""

from r3dpa.flow.autoguidance import (
    PerturbedAttention,
    autoguided,
    renormalised,
    renormalised_times,
)
from r3dpa.flow.average_velocity import average_times, average_velocity_steps
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
    evaluation_times,
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
    "PerturbedAttention",
    "Velocity",
    "ab2",
    "ab3",
    "autoguided",
    "average_times",
    "average_velocity_steps",
    "dpm_solver_pp_2m",
    "euler",
    "euler_maruyama",
    "evaluation_times",
    "evaluations",
    "heun",
    "midpoint",
    "ode_solver",
    "ode_times",
    "renormalised",
    "renormalised_times",
    "sample_time",
    "sde_times",
    "steps_for",
    "unipc",
]

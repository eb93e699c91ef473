"""Sampler settings: one solver with its steps, from noise to latents."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.resources import files
from numbers import Integral
from typing import Any, Literal, Self, get_args

import torch
from torch import Tensor

from r3dpa.flow.average_velocity import AVERAGE_STEPS, average_times, average_velocity_steps
from r3dpa.flow.interpolant import Interpolant
from r3dpa.flow.sde import ancestral, euler_maruyama
from r3dpa.flow.solvers import ODE_SOLVERS, evaluation_times, evaluations, ode_solver
from r3dpa.flow.times import ode_times, sde_times

OdeSolverName = Literal["euler", "heun", "midpoint", "ab2", "ab3", "dpmpp_2m", "unipc"]
Solver = Literal[OdeSolverName, "euler_maruyama", "ddpm", "ddim", "average_velocity"]
Quality = Literal["instant", "draft", "good", "best"]
SDELast = Literal["denoise", "mean"]
_SETTINGS = ("shift", "eta", "sde_last", "sde_last_time")


def settings_of(solver: str) -> tuple[str, ...]:
    """Settings that a solver reads, beside its steps."""
    others: dict[str, tuple[str, ...]] = {
        "euler_maruyama": ("eta", "sde_last", "sde_last_time"),
        "ddpm": ("shift", "eta"),
        "average_velocity": (),
    }
    return others.get(solver, ("shift",))


@dataclass(frozen=True)
class SamplerConfig:
    """Solver, steps and schedule that turn noise into latents.

    Args:
        solver: ``euler_maruyama`` solves the SDE, ``ddpm`` takes ancestral steps, the others solve
            the ODE; ``ddim`` are ancestral steps without noise, ``average_velocity`` needs a
            network of stage few_step and takes 1, 2, 4 or 8 steps.
        steps: Solver steps.
        sde_last_time: Time from which the SDE takes its last, noise-free step.
        sde_last: ``denoise``, or ``mean`` as in the official sampler.
        shift: Finer steps near noise (above 1) or data (below 1); not of the SDE.
        eta: Strength of the noise of the SDE or of ancestral steps; 1 as published, 0 for none.

    Raises:
        ValueError: If the solver is unknown, a number out of its range, or a setting other than its
            default is one that the solver does not read.

    Example:
        >>> SamplerConfig("heun", steps=8).nfe
        15
    """

    solver: Solver = "euler_maruyama"
    steps: int = 256
    sde_last_time: float = 0.04
    sde_last: SDELast = "denoise"
    shift: float = 1.0
    eta: float = 1.0

    def __post_init__(self) -> None:
        if self.solver not in get_args(Solver):
            raise ValueError(
                f"solver must be one of {', '.join(get_args(Solver))}, got {self.solver!r}"
            )
        whole = isinstance(self.steps, Integral) and self.steps >= 1
        if not (whole and 0 < self.shift < math.inf and 0 <= self.eta < math.inf):
            raise ValueError(
                "a sampler needs a whole number of steps >= 1, and finite shift > 0 and eta >= 0, "
                f"got {self.steps}, {self.shift} and {self.eta}"
            )
        if self.sde_last not in get_args(SDELast):
            raise ValueError(
                f"sde_last must be one of {', '.join(get_args(SDELast))}, got {self.sde_last!r}"
            )
        if not 0 < self.sde_last_time < 1:
            raise ValueError(f"sde_last_time must lie in (0, 1), got {self.sde_last_time}")
        if self.solver == "ddpm" and self.eta > 1:
            raise ValueError(f"eta of ancestral steps must lie in [0, 1], got {self.eta}")
        averages = self.solver == "average_velocity"
        if averages and self.steps not in AVERAGE_STEPS:
            raise ValueError(
                f"average_velocity takes {', '.join(map(str, AVERAGE_STEPS))} steps, as "
                f"stage few_step trains them, got {self.steps}"
            )
        read = settings_of(self.solver)
        for name in _SETTINGS:
            if name not in read and getattr(self, name) != getattr(type(self), name):
                readers = [k for k in get_args(Solver) if name in settings_of(k)]
                raise ValueError(
                    f"solver {self.solver} does not read {name}, which is for "
                    f"{', '.join(readers)}; drop one"
                )

    @property
    def nfe(self) -> int:
        """Network evaluations per sample."""
        return evaluations(self.solver, self.steps) if self.solver in ODE_SOLVERS else self.steps

    @classmethod
    def of_quality(cls, quality: Quality) -> Self:
        """The cheapest sampler of a quality, from the table ``quality.json`` of this package."""
        levels = _qualities()["levels"]
        if quality not in levels:
            raise ValueError(f"unknown quality {quality!r}; choose from {', '.join(levels)}")
        level = levels[quality]
        return cls(solver=level["solver"], steps=level["steps"], shift=level["shift"])

    def changed(self, **settings: Any) -> Self:
        """This sampler with other settings; another solver keeps the settings that it reads."""
        solver = settings.get("solver", self.solver)
        read = ("steps", *settings_of(solver))
        kept = {name: getattr(self, name) for name in read}
        return type(self)(**{"solver": solver, **kept, **settings})

    @property
    def summary(self) -> str:
        """Solver, steps, and the settings that differ from their defaults, in one line."""
        parts = [str(self.solver), f"{self.steps} steps"]
        for name in _SETTINGS:
            if getattr(self, name) != getattr(type(self), name):
                parts.append(f"{name} {getattr(self, name)}")
        return ", ".join(parts)

    @staticmethod
    def quality_line(quality: Quality) -> str:
        """One line of text about the sampler of :meth:`of_quality`."""
        table = _qualities()
        level = table["levels"][quality]
        return (
            f"quality {quality}: {level['solver']}, {level['steps']} steps, "
            f"shift {level['shift']:g}: error {level['error']:.2g}, "
            f"{level['seconds_share']:.0%} of the time of best "
            f"(measured on: {table['measured_on']})"
        )

    def times(self) -> Tensor:
        """Times ``(nfe,)`` float64 at which the velocity is evaluated, in order.

        For ``average_velocity`` these are the starts of its steps, each of which ends at the next.
        """
        if self.solver == "average_velocity":
            return average_times(self.steps)[:-1]
        if self.solver == "euler_maruyama":
            return sde_times(self.steps, self.sde_last_time)[:-1]
        grid = ode_times(self.steps, shift=self.shift)
        if self.solver in ("ddpm", "ddim"):
            return grid[:-1]
        return evaluation_times(self.solver, grid)

    def solve(
        self,
        velocity: Callable[..., Tensor],
        noise: Tensor,
        draws: torch.Generator | Iterable[Tensor],
        interpolant: Interpolant,
    ) -> Tensor:
        """Carry noise ``(B, ...)`` at t = 1 to data; further noise comes from ``draws``.

        ``average_velocity`` calls ``velocity(x, time, target)``, the others ``velocity(x, time)``.
        """
        if self.solver == "average_velocity":
            return average_velocity_steps(velocity, noise, average_times(self.steps))
        if self.solver == "euler_maruyama":
            return euler_maruyama(
                velocity,
                noise,
                sde_times(self.steps, self.sde_last_time),
                draws,
                interpolant=interpolant,
                last=self.sde_last,
                eta=self.eta,
            )
        times = ode_times(self.steps, shift=self.shift)
        if self.solver in ("ddpm", "ddim"):
            eta = self.eta if self.solver == "ddpm" else 0.0
            return ancestral(velocity, noise, times, draws, eta=eta, interpolant=interpolant)
        return ode_solver(self.solver, interpolant)(velocity, noise, times)


def _qualities() -> dict[str, Any]:
    return json.loads((files("r3dpa") / "quality.json").read_text(encoding="utf-8"))

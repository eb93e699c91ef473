"""Samplers that add noise on the way from t = 1 (noise) to t = 0 (data): SDE and Restart.

They follow the conventions of :mod:`r3dpa.flow.solvers`. Letters: B batch, ``...`` further axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from r3dpa.flow.interpolant import Interpolant
from r3dpa.flow.solvers import AfterStep, Velocity, evaluations, ode_solver, unchanged
from r3dpa.flow.times import batch_time, ode_times, step_pairs

__all__ = ["DriftChange", "RestartPlan", "euler_maruyama", "restart"]

DriftChange = Callable[[Tensor, Tensor, Tensor], Tensor]

_LINEAR = Interpolant("linear")


@torch.no_grad()
def euler_maruyama(
    velocity: Velocity,
    x: Tensor,
    times: Tensor,
    noise: torch.Generator | Iterable[Tensor],
    *,
    eta: float = 1.0,
    interpolant: Interpolant = _LINEAR,
    last: Literal["denoise", "mean"] = "denoise",
    change_drift: DriftChange | None = None,
    after_step: AfterStep = unchanged,
) -> Tensor:
    """Solve the reverse SDE with diffusion ``w = 2 eta t`` by Euler-Maruyama steps.

    All eta have the same marginals. The drift is ``v - (w / 2) score``, and linear in eta::

        drift = (1 - eta) v + eta (v - t score)

    One evaluation per step; every step but the last adds ``sqrt(w |dt|)`` times a Gaussian draw.

    Source: SiT (Ma et al. 2024), eq. 6; ``last="mean"`` with ``eta=1`` is the published sampler
    of R3DPA.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
        x: ``(B, ...)`` Gaussian noise, the state at t = 1.
        times: ``(T,)`` decreasing times, see :func:`r3dpa.flow.times.sde_times`.
        noise: The T - 2 Gaussian draws ``(B, ...)`` in order, or where to draw them from. Draws
            that are given per sample make a sample independent of its batch.
        eta: How much noise is added and removed again; 0 is the ODE, and then
            :func:`r3dpa.flow.solvers.euler` but for ``change_drift``.
        interpolant: Path of the velocity.
        last: Noise-free last step. ``denoise`` goes to the expected data; ``mean`` takes a full
            step of drift, which for ``eta=1`` removes the noise twice and shrinks detail (data of
            standard deviation 0.1 comes out at 0.077 from t = 0.04).
        change_drift: ``(drift, x, time) -> drift`` applied in every step but the last.
        after_step: See :mod:`r3dpa.flow.solvers`.

    Returns:
        ``(B, ...)`` state at the last time, dtype of ``x``.

    Raises:
        ValueError: If ``times`` do not decrease, the ``denoise`` step does not end at 0, ``last``
            is unknown, ``eta`` is below 0, or the draws do not suffice or have another shape.
    """
    if last not in ("denoise", "mean"):
        raise ValueError(f"last must be 'denoise' or 'mean', got {last!r}")
    if not 0 <= eta < math.inf:
        raise ValueError(f"eta must be 0 or above, got {eta}")
    *steps, (now, then) = step_pairs(times)
    if then >= now:
        raise ValueError(
            f"the SDE runs from noise to data: its times must decrease, got {times.tolist()}"
        )
    if last == "denoise" and then != 0:
        raise ValueError(f"last='denoise' ends at t = 0, but the last time is {then}")

    def drift_of(slope: Tensor, time: Tensor) -> Tensor:
        return (1 - eta) * slope + eta * interpolant.sde_drift(slope, x, time)

    draws = _draws(noise, x, len(steps))
    for index, (step_now, step_then) in enumerate(steps, 1):
        time = batch_time(step_now, x)
        drift = drift_of(velocity(x, time), time)
        if change_drift is not None:
            drift = change_drift(drift, x, time)
        step = step_then - step_now
        spread = math.sqrt(2 * eta * step_now * -step)
        x = after_step(x + step * drift.to(x.dtype) + spread * next(draws), step_then, index)
    time = batch_time(now, x)
    final_velocity = velocity(x, time)
    if last == "denoise":
        x = interpolant.denoise(final_velocity, x, time).to(x.dtype)
    else:
        x = x + (then - now) * drift_of(final_velocity, time).to(x.dtype)
    return after_step(x, then, len(steps) + 1)


@dataclass(frozen=True)
class RestartPlan:
    """Where Restart goes back to noise, how often, and how it solves.

    Args:
        lower: Time to jump from, in (0, 1).
        upper: Time to jump to, above ``lower``, at most 1.
        rounds: Number of jumps K.
        round_steps: Equidistant steps of every way back from ``upper`` to ``lower``.
        solver: A key of :data:`r3dpa.flow.solvers.ODE_SOLVERS`.

    Raises:
        ValueError: If the times are out of order, a count is below 1 or the solver is unknown.
    """

    lower: float = 0.06
    upper: float = 0.23
    rounds: int = 2
    round_steps: int = 4
    solver: str = "ab2"

    def __post_init__(self) -> None:
        """Check times, counts and the name."""
        if not 0 < self.lower < self.upper <= 1:
            raise ValueError(
                f"Restart needs 0 < lower < upper <= 1, got {self.lower} and {self.upper}"
            )
        if self.rounds < 1:
            raise ValueError(f"Restart needs at least one round, got {self.rounds}")
        evaluations(self.solver, self.round_steps)

    def evaluations(self, times: Tensor) -> int:
        """Network evaluations per sample of :func:`restart` on that main grid.

        Args:
            times: ``(T,)`` times of the main way.

        Returns:
            The NFE.

        Raises:
            ValueError: If the times do not decrease through ``lower``.
        """
        down, on = self.parts(times)
        main = evaluations(self.solver, len(down) - 1) + evaluations(self.solver, len(on) - 1)
        return main + self.rounds * evaluations(self.solver, self.round_steps)

    def parts(self, times: Tensor) -> tuple[Tensor, Tensor]:
        """The main way cut at ``lower``, which becomes a time of both parts.

        Args:
            times: ``(T,)`` times of the main way.

        Returns:
            Times from the first one to ``lower`` and from there to the last one; together T
            steps, or T - 1 if ``lower`` is one of the times.

        Raises:
            ValueError: If the times do not decrease through ``lower``.
        """
        step_pairs(times)
        if not times[0] > self.lower > times[-1]:
            raise ValueError(
                f"the times of Restart must decrease through {self.lower}, got {times.tolist()}"
            )
        cut = times.new_tensor([self.lower])
        return torch.cat([times[times > cut], cut]), torch.cat([cut, times[times < cut]])


_DEFAULT_PLAN = RestartPlan()


@torch.no_grad()
def restart(
    velocity: Velocity,
    x: Tensor,
    times: Tensor,
    noise: torch.Generator | Iterable[Tensor],
    *,
    plan: RestartPlan = _DEFAULT_PLAN,
    interpolant: Interpolant = _LINEAR,
) -> Tensor:
    """Solve the ODE, but on the way go back to noise a few times and solve again.

    The jump from ``lower`` to ``upper`` adds just the noise that keeps the marginals: a sample
    ``alpha_l data + sigma_l noise`` becomes one of the later time by::

        x_u = a x_l + b draw        a = alpha_u / alpha_l        b^2 = sigma_u^2 - a^2 sigma_l^2

    so that the errors made so far shrink, as those of an SDE do, while the steps between stay
    those of an ODE solver.

    Source: Restart (Xu et al. 2023), alg. 1; the jump re-derived for paths that scale the data.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
        x: ``(B, ...)`` Gaussian noise, the state at t = 1.
        times: ``(T,)`` decreasing times of the main way, which is cut at ``plan.lower``.
        noise: One Gaussian draw ``(B, ...)`` per round, or where to draw them from.
        plan: The interval, the rounds and the solver.
        interpolant: Path of the velocity.

    Returns:
        ``(B, ...)`` state at the last time, dtype of ``x``.

    Raises:
        ValueError: If ``times`` do not decrease through ``plan.lower`` or the draws do not suffice
            or have another shape.
    """
    down, on = plan.parts(times)
    again = ode_times(plan.round_steps, start=plan.upper, stop=plan.lower)
    ends = interpolant.coefficients(torch.tensor([plan.lower, plan.upper], dtype=torch.float64))
    (alpha_lower, alpha_upper), (sigma_lower, sigma_upper) = (
        ends.alpha.tolist(),
        ends.sigma.tolist(),
    )
    kept = alpha_upper / alpha_lower
    spread = math.sqrt(sigma_upper**2 - (kept * sigma_lower) ** 2)
    solver = ode_solver(plan.solver, interpolant)
    draws = _draws(noise, x, plan.rounds)
    x = solver(velocity, x, down)
    for _ in range(plan.rounds):
        x = solver(velocity, kept * x + spread * next(draws), again)
    return solver(velocity, x, on)


def _draws(
    noise: torch.Generator | Iterable[Tensor], x: Tensor, num_draws: int
) -> Iterator[Tensor]:
    """Draws of the shape, dtype and device of ``x``, taken one by one as they are asked for."""
    given = iter(()) if isinstance(noise, torch.Generator) else iter(noise)
    for index in range(num_draws):
        draw: Tensor | None
        if isinstance(noise, torch.Generator):
            draw = torch.randn(x.shape, generator=noise, device=noise.device, dtype=x.dtype)
        else:
            draw = next(given, None)
        if draw is None or draw.shape != x.shape:
            got = f"{index} draws" if draw is None else f"a draw of shape {tuple(draw.shape)}"
            raise ValueError(f"{num_draws} draws of shape {tuple(x.shape)} are needed, got {got}")
        yield draw.to(x.device, x.dtype)

"""ODE solvers over a velocity function, between t = 1 (noise) and t = 0 (data).

A solver knows neither network nor guidance: what changes the velocity wraps the velocity function.
Letters: B batch, ``...`` any further axes. The state keeps the dtype of the given ``x``; the
velocity function receives it together with ``(B,)`` times in at least float32, and may answer in
any dtype. Every solver is called ``(velocity, x, times) -> x`` with

* ``velocity``: ``(x (B, ...), time (B,)) -> (B, ...)``;
* ``x``: ``(B, ...)`` state at the first time;
* ``times``: ``(T,)`` times that all increase or all decrease, see
  :func:`r3dpa.flow.times.ode_times`;

returns the ``(B, ...)`` state at the last time, and raises a ValueError for other times. The
orders hold on grids whose steps shrink alike. On a fixed grid ``after_step(x, time, index)`` gets
the state at ``times[index]`` after every step and returns the state to continue from; multistep
solvers keep the velocities that they have seen. No solver waits for a GPU.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from r3dpa.flow.interpolant import LINEAR, Interpolant, PathCoefficients
from r3dpa.flow.times import batch_time, step_pairs

Velocity = Callable[[Tensor, Tensor], Tensor]
OdeSolver = Callable[[Velocity, Tensor, Tensor], Tensor]
AfterStep = Callable[[Tensor, float, int], Tensor]


def unchanged(x: Tensor, time: float, index: int) -> Tensor:
    """The :data:`AfterStep` that does nothing."""
    return x


@torch.no_grad()
def euler(
    velocity: Velocity, x: Tensor, times: Tensor, *, after_step: AfterStep = unchanged
) -> Tensor:
    """Euler steps; order 1, one evaluation per step."""
    for index, (now, then) in enumerate(step_pairs(times), 1):
        x = after_step(x + (then - now) * _slope(velocity, x, now), then, index)
    return x


@torch.no_grad()
def heun(
    velocity: Velocity,
    x: Tensor,
    times: Tensor,
    *,
    corrector_velocity: Velocity | None = None,
    after_step: AfterStep = unchanged,
) -> Tensor:
    """Heun steps; order 2, two evaluations per step but the last.

    The last step is an Euler step, as in EDM (Karras et al. 2022, alg. 1) and R3DPA: a single
    local error of order 2 does not lower the order. ``corrector_velocity`` gives the second slope;
    default: ``velocity``.
    """
    corrector_velocity = corrector_velocity or velocity
    *steps, (now, then) = step_pairs(times)
    for index, (step_now, step_then) in enumerate(steps, 1):
        step = step_then - step_now
        slope = _slope(velocity, x, step_now)
        second = _slope(corrector_velocity, x + step * slope, step_then)
        x = after_step(x + step * 0.5 * (slope + second), step_then, index)
    return after_step(x + (then - now) * _slope(velocity, x, now), then, len(steps) + 1)


@torch.no_grad()
def midpoint(
    velocity: Velocity, x: Tensor, times: Tensor, *, after_step: AfterStep = unchanged
) -> Tensor:
    """Explicit midpoint rule; order 2, two evaluations per step, none at the last time."""
    for index, (now, then) in enumerate(step_pairs(times), 1):
        middle = (now + then) / 2
        halfway = x + (middle - now) * _slope(velocity, x, now)
        x = after_step(x + (then - now) * _slope(velocity, halfway, middle), then, index)
    return x


def ab2(
    velocity: Velocity, x: Tensor, times: Tensor, *, after_step: AfterStep = unchanged
) -> Tensor:
    """Adams-Bashforth method; order 2, one evaluation per step.

    With step ``h`` and the step before ``h0``, after one Euler step::

        x <- x + h ((1 + h / 2 h0) v_n - (h / 2 h0) v_{n-1})
    """
    return _adams_bashforth(velocity, x, times, after_step, order=2)


def ab3(
    velocity: Velocity, x: Tensor, times: Tensor, *, after_step: AfterStep = unchanged
) -> Tensor:
    """Adams-Bashforth method; order 3, one evaluation per step.

    The parabola through the last three velocities is integrated. The first step is an Euler step,
    the second an AB2 step. The error of the Euler step alone would leave order 2; the second
    evaluation amends it to the trapezoidal rule, ``x <- x + h0 / 2 (v_1 - v_0)``.
    """
    return _adams_bashforth(velocity, x, times, after_step, order=3)


def dpm_solver_pp_2m(
    velocity: Velocity,
    x: Tensor,
    times: Tensor,
    *,
    interpolant: Interpolant = LINEAR,
    after_step: AfterStep = unchanged,
) -> Tensor:
    """DPM-Solver++(2M) on the path of ``interpolant``; order 2, one evaluation per step.

    With the expected data ``D(x, t)`` and ``lambda = log(alpha / sigma)`` the ODE is
    ``d(x / sigma) = D d(alpha / sigma)``: where D is constant a step of any length is exact, and
    where D leaves a line in lambda the step knows its slope from the step before. From s to t::

        x_t = alpha_t D_s + sigma_t N_s + g (h / 2 h0) (D_s - D_{s-1})
        g = alpha_t - alpha_s sigma_t / sigma_s          h, h0: this and the last step in lambda

    with the noise ``N = (x - alpha D) / sigma``, taken from x and v without that division. On the
    linear path ``D = x - t v``, ``N = x + (1 - t) v``, and the first two terms are an Euler step.

    Ends: the step that starts from pure noise has ``h = inf``, and so has ``h0`` of the next one,
    where ``h / h0 -> 0``: both are of first order (on the linear path Euler) without further
    care. For the step that reaches the data ``h / h0 -> inf``: it is of first order by choice, as
    published for few steps (``lower_order_final``), and returns ``D_s``. The same holds from data
    to noise. Steps in lambda do not shrink at the ends however many there are, which costs the
    order 2 a logarithm: measured 1.6 to 1.8 over all of [0, 1].

    Source: DPM-Solver++ (Lu et al. 2022), alg. 2.
    """
    return _data_prediction(velocity, x, times, interpolant, after_step, correct=False)


def unipc(
    velocity: Velocity,
    x: Tensor,
    times: Tensor,
    *,
    interpolant: Interpolant = LINEAR,
    after_step: AfterStep = unchanged,
) -> Tensor:
    """UniPC-2 with ``B_2(h)`` on the path of ``interpolant``; one evaluation per step.

    Its predictor is :func:`dpm_solver_pp_2m`. The evaluation at the predicted point serves twice:
    as the start of the next step, and before that to correct the last one by the parabola through
    ``D_{s-1}, D_s, D_t`` in lambda, integrated exactly; in the first step by the mean of ``D_s``
    and ``D_t``. As nothing is evaluated at the last time, the last step is not corrected. Order 3
    where lambda stays finite; with the first-order steps at both ends of [0, 1] order 2.

    Source: UniPC (Zhao et al. 2023), alg. 5 to 8, multistep with data prediction.
    """
    return _data_prediction(velocity, x, times, interpolant, after_step, correct=True)


ODE_SOLVERS: dict[str, Callable[..., Tensor]] = {
    "euler": euler,
    "heun": heun,
    "midpoint": midpoint,
    "ab2": ab2,
    "ab3": ab3,
    "dpmpp_2m": dpm_solver_pp_2m,
    "unipc": unipc,
}


def ode_solver(
    name: str, interpolant: Interpolant = LINEAR, after_step: AfterStep = unchanged
) -> OdeSolver:
    """The solver of that name, for velocities of that path."""
    _check_name(name)
    if name in ("dpmpp_2m", "unipc"):
        return partial(ODE_SOLVERS[name], interpolant=interpolant, after_step=after_step)
    return partial(ODE_SOLVERS[name], after_step=after_step)


def evaluations(solver: str, steps: int) -> int:
    """Network evaluations per sample of a solver, known before it runs."""
    _check_name(solver)
    if steps < 1:
        raise ValueError(f"a solver needs at least one step, got {steps}")
    return {"heun": 2 * steps - 1, "midpoint": 2 * steps}.get(solver, steps)


def evaluation_times(solver: str, times: Tensor) -> Tensor:
    """Times ``(T,)`` float64 at which a solver evaluates the velocity on a grid, in order."""
    _check_name(solver)
    steps = step_pairs(times)
    if solver == "heun":
        ends = [time for step in steps for time in step][:-1]
    elif solver == "midpoint":
        ends = [time for now, then in steps for time in (now, (now + then) / 2)]
    else:
        ends = [now for now, _ in steps]
    return torch.tensor(ends, dtype=torch.float64)


def steps_for(solver: str, nfe: int) -> int:
    """Largest number of steps of a solver within a number of network evaluations."""
    _check_name(solver)
    steps = {"heun": (nfe + 1) // 2, "midpoint": nfe // 2}.get(solver, nfe)
    if steps < 1:
        raise ValueError(f"{solver} cannot make a step with {nfe} network evaluations")
    return steps


@torch.no_grad()
def _adams_bashforth(
    velocity: Velocity, x: Tensor, times: Tensor, after_step: AfterStep, *, order: int
) -> Tensor:
    nodes: deque[float] = deque(maxlen=order)
    slopes: deque[Tensor] = deque(maxlen=order)
    for index, (now, then) in enumerate(step_pairs(times), 1):
        nodes.appendleft(now)
        slopes.appendleft(_slope(velocity, x, now))
        if order == 3 and len(slopes) == 2:
            x = x + (nodes[0] - nodes[1]) / 2 * (slopes[0] - slopes[1])
        weights = _adams_bashforth_weights(list(nodes), then)
        x = x + sum(weight * slope for weight, slope in zip(weights, slopes, strict=True))
        x = after_step(x, then, index)
    return x


def _adams_bashforth_weights(nodes: list[float], then: float) -> list[float]:
    """Weights of the slopes at ``nodes``, newest first, in a step from ``nodes[0]`` to ``then``.

    They integrate every polynomial of degree below ``len(nodes)`` exactly. In units of the step,
    from its start, the moments are ``1, 1/2, 1/3, ...``.
    """
    step = then - nodes[0]
    powers = torch.arange(len(nodes), dtype=torch.float64)
    places = (torch.tensor(nodes, dtype=torch.float64) - nodes[0]) / step
    weights = torch.linalg.solve(places ** powers[:, None], 1 / (powers + 1))
    return (step * weights).tolist()


def _path_nodes(
    interpolant: Interpolant, times: Tensor
) -> tuple[list[PathCoefficients], list[float]]:
    """Coefficients, as numbers, at each time, and the width of each step in lambda."""
    time = times.double().cpu()
    path = interpolant.coefficients(time)
    log_snr = (path.alpha / path.sigma).log()
    # Rounding keeps it finite on the cosine path, and diffusions end just before both.
    log_snr[time == 1] = -math.inf
    log_snr[time == 0] = math.inf
    nodes = [PathCoefficients(*row) for row in torch.stack(path, dim=1).tolist()]
    return nodes, log_snr.diff().tolist()


@torch.no_grad()
def _data_prediction(
    velocity: Velocity,
    x: Tensor,
    times: Tensor,
    interpolant: Interpolant,
    after_step: AfterStep,
    *,
    correct: bool,
) -> Tensor:
    """Multistep method in the expected data, see :func:`dpm_solver_pp_2m` and :func:`unipc`.

    Every step takes the mean of D over the step as ``D_s`` plus a bend: from the step before when
    it predicts, from the next evaluation too when it corrects.
    """
    steps, ratio = step_pairs(times), 0.0
    nodes, widths = _path_nodes(interpolant, times)
    data = change = bend = torch.zeros_like(x)
    bend_factor: Any = 0.0
    for index, (now, then) in enumerate(steps):
        here, there = nodes[index : index + 2]
        before, past_change = data, change
        data, noise = here.data_and_noise(x, _slope(velocity, x, now))
        change = data - before
        if correct and index > 0:
            corrected = _corrected_bend(widths[index - 1], ratio, past_change, change)
            noise = noise + bend_factor / here.sigma * (corrected - bend)
        neighbours = widths[max(index - 1, 0) : index + 1]
        known = index > 0 and all(map(math.isfinite, neighbours))
        ratio = neighbours[1] / neighbours[0] if known else 0.0
        bend = ratio / 2 * change
        # From the data itself (sigma = 0) the step is of first order, there is nothing to bend.
        bend_factor = there.alpha - here.alpha * there.sigma / here.sigma if now else 0.0
        x = there.alpha * data + there.sigma * noise + bend_factor * bend
        x = after_step(x, then, index + 1)
    return x


def _corrected_bend(width: float, ratio: float, past_change: Tensor, change: Tensor) -> Tensor:
    """Mean of D over a finished step minus its start, by the parabola in lambda through three D.

    The mean is weighted by ``exp(lambda)``. ``width`` and ``ratio`` are ``h`` and ``h / h0`` of the
    step, 0 if the step before is not known; D changes over the step before and over this step.
    """
    if ratio == 0:
        return change / 2
    weight_of_end = -1 / math.expm1(-width)
    mean = weight_of_end - 1 / width  # of r in [0, 1] under a density like exp(h r)
    square = weight_of_end - 2 * mean / width  # and of r^2
    past = ratio**2 * (mean - square) * past_change
    return (past + (mean + ratio * square) * change) / (1 + ratio)


def _slope(velocity: Velocity, x: Tensor, time: float) -> Tensor:
    return velocity(x, batch_time(time, x)).to(x.dtype)


def _check_name(solver: str) -> None:
    if solver not in ODE_SOLVERS:
        raise ValueError(f"the ODE solvers are {', '.join(ODE_SOLVERS)}, got {solver!r}")

"""Search for the times and coefficients of a solver with few steps, against exact solutions.

Letters: B batch, ``...`` further axes, M candidate steps, N solver steps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from r3dpa.flow.solvers import Velocity, heun, midpoint
from r3dpa.flow.times import batch_time, ode_times, step_pairs
from r3dpa.flow.tuned import TunedSolver, multistep

__all__ = [
    "Pairs",
    "SolverError",
    "best_shift",
    "converged_pairs",
    "optimal_times",
    "search_solver",
    "solver_error",
]


@dataclass(frozen=True, eq=False)
class Pairs:
    """Noise and where the exact flow carries it.

    Args:
        noise: ``(B, ...)`` states at t = 1.
        solution: ``(B, ...)`` states at t = 0.
        uncertainty: RMSE of the solutions against those with half as many steps; an upper bound
            on their own error once that shrinks with the steps.

    Raises:
        ValueError: If the shapes differ or there is no sample.
    """

    noise: Tensor
    solution: Tensor
    uncertainty: float = 0.0

    def __post_init__(self) -> None:
        """Check the shapes."""
        if self.noise.shape != self.solution.shape or self.noise.numel() == 0:
            raise ValueError(
                "noise and solutions must have one shape and a sample, got "
                f"{tuple(self.noise.shape)} and {tuple(self.solution.shape)}"
            )

    def batches(self, size: int) -> Iterator[Pairs]:
        """The pairs in parts of at most ``size``."""
        for noise, solution in zip(self.noise.split(size), self.solution.split(size), strict=True):
            yield Pairs(noise, solution, self.uncertainty)


class SolverError(NamedTuple):
    """Distance of a solver from the exact solutions of the same noise.

    Attributes:
        rmse: Root of the mean square over all samples and numbers. Few samples that end at
            another mode of the data can make most of it.
        mean: Mean over the samples of their RMSE, by which solvers are ranked: it counts such
            samples, but a hundred samples suffice to tell two solvers apart.
        median: Median over the samples of their RMSE.
    """

    rmse: float
    mean: float
    median: float


def converged_pairs(
    velocity: Velocity, noise: Tensor, num_steps: int = 200, batch_size: int = 64
) -> Pairs:
    """Solve by Heun's method with many steps, and once more with half of them as a certificate.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
        noise: ``(B, ...)`` states at t = 1.
        num_steps: Steps of the reference, even.
        batch_size: Samples to solve at once.

    Returns:
        Solutions, with their RMSE against the half as ``uncertainty``.

    Raises:
        ValueError: If ``num_steps`` is odd or below 2.
    """
    if num_steps < 2 or num_steps % 2:
        raise ValueError(f"a reference needs an even number of steps, got {num_steps}")
    fine, coarse = (
        torch.cat([heun(velocity, part, ode_times(steps)) for part in noise.split(batch_size)])
        for steps in (num_steps, num_steps // 2)
    )
    return Pairs(noise, fine, (fine - coarse).double().square().mean().sqrt().item())


def solver_error(
    velocity: Velocity, solver: TunedSolver, pairs: Pairs, batch_size: int = 64
) -> SolverError:
    """Error of a solver on given pairs.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
        solver: Solver to judge.
        pairs: Noise and exact solutions.
        batch_size: Samples to solve at once.

    Returns:
        RMSE, mean and median.
    """
    return _summary(_all_squares(velocity, solver, pairs, batch_size))


def best_shift(
    velocity: Velocity,
    pairs: Pairs,
    num_steps: int,
    shifts: Sequence[float] = (0.5, 1.0, 1.5, 2.0, 3.0),
    batch_size: int = 64,
) -> TunedSolver:
    """AB2 on the shifted grid with the least mean error.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
        pairs: Noise and exact solutions.
        num_steps: Steps of the solver.
        shifts: Shifts to try, see :func:`r3dpa.flow.times.ode_times`.
        batch_size: Samples to solve at once.

    Returns:
        The best of them.
    """
    solvers = [TunedSolver.from_adams(ode_times(num_steps, shift=s), 2) for s in shifts]
    return min(solvers, key=lambda one: solver_error(velocity, one, pairs, batch_size).mean)


def optimal_times(
    velocity: Velocity,
    noise: Tensor,
    num_steps: int,
    *,
    num_candidates: int = 64,
    substeps: int = 4,
) -> Tensor:
    """Times of AB2 with the least sum of squared local errors, by dynamic programming.

    Trajectories are stored at M + 1 equidistant candidates, with their velocities. A step from
    candidate j to k, where the step before began at i, costs the mean squared difference between
    the AB2 step from the stored state at j and the stored state at k. The choice of N - 1 inner
    candidates with the least sum is found exactly, in ``O(M^3 N)`` operations on numbers; the
    samples enter through their inner products only.

    The errors of AB2 are used, since times that suit Euler are worse for AB2; and local errors as
    they are: weighed with the growth of a small perturbation until t = 0 the times were worse,
    because errors that move a path to another mode of the data are not small.

    Source: dynamic programming over steps as in Watson et al. 2021 and OptimalSteps (Pei et al.
    2025), with AB2 errors instead of Euler errors.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
        noise: ``(B, ...)`` states at t = 1; some dozens suffice. Two states per candidate and
            sample are held in memory.
        num_steps: N, at most ``num_candidates``.
        num_candidates: M.
        substeps: Midpoint steps between candidates.

    Returns:
        ``(N + 1,)`` float64 decreasing from 1 to 0.

    Raises:
        ValueError: If there is no step or more steps than candidates.
    """
    if not 1 <= num_steps <= num_candidates:
        raise ValueError(
            f"num_steps must lie between 1 and the {num_candidates} candidates, got {num_steps}"
        )
    times = ode_times(num_candidates)
    return times[_cheapest_path(*_local_errors(velocity, noise, times, substeps), num_steps)]


def search_solver(
    velocity: Velocity,
    train: Pairs,
    held_out: Pairs,
    start: TunedSolver,
    *,
    num_velocities: int = 2,
    iterations: int = 200,
    learning_rate: float = 0.03,
    batch_size: int = 64,
    check_every: int = 10,
) -> TunedSolver:
    """Tune times and coefficients by gradient descent through the solver.

    The N steps are a softmax; each step uses the last ``num_velocities`` velocities, with weights
    that are those of AB2 on the current times plus a free part, so that 2 N - 1 numbers are tuned
    for two velocities. Adam with a cosine schedule lowers the mean over samples of the log of
    their mean squared distance from the exact solution: a path that ends at another mode of the
    data has a distance that no solver of this NFE removes and whose gradient is chaotic, and would
    outweigh all others in a mean of squares.

    The result is the best iterate on the held-out pairs by that mean of logs, among those whose
    mean error (:class:`SolverError`) there is below that of the start; the start itself if there
    is none. Deterministic: batches are
    taken in turn. Activations are recomputed in the backward pass, one evaluation at a time.

    Source: Differentiable Solver Search (Wang et al. 2025).

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``, differentiable in both.
        train: Pairs to tune on.
        held_out: Pairs to choose the iterate on, of other noise.
        start: Solver to start from, such as :func:`best_shift`; its steps are kept in number.
        num_velocities: Velocities per step; the number of steps for the full triangle.
        iterations: Gradient steps, at least 1.
        learning_rate: Highest learning rate of Adam.
        batch_size: Samples per gradient step.
        check_every: Gradient steps between two looks at the held-out pairs.

    Returns:
        A solver without card.

    Raises:
        ValueError: If the start uses more velocities, or the counts are below 1.
    """
    if min(num_velocities, iterations, batch_size, check_every) < 1:
        raise ValueError(
            "num_velocities, iterations, batch_size and check_every must be at least 1, got "
            f"{num_velocities}, {iterations}, {batch_size}, {check_every}"
        )
    space = _SearchSpace.around(start, num_velocities)
    squares = _all_squares(velocity, start, held_out, batch_size)
    best, lowest, allowed = start, _log_error(squares).item(), _summary(squares).mean
    optimizer = torch.optim.Adam([space.log_steps, space.change], lr=learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations)
    batches = list(train.batches(batch_size))

    def recomputed(x: Tensor, time: Tensor) -> Tensor:
        return checkpoint(velocity, x, time, use_reentrant=False)

    for iteration in range(1, iterations + 1):
        part = batches[iteration % len(batches)]
        with torch.inference_mode(False), torch.enable_grad():
            times, coefficients = space.solver()
            end = multistep(recomputed, part.noise, times, coefficients, space.used)
            loss = _log_error(_squares(end, part.solution))
            parameters = (space.log_steps, space.change)
            # Not loss.backward(), which would also fill the gradients of the network.
            space.log_steps.grad, space.change.grad = torch.autograd.grad(loss, parameters)
        optimizer.step()
        schedule.step()
        if iteration % check_every == 0 or iteration == iterations:
            times, coefficients = (values.detach() for values in space.solver())
            if not (times.diff() < 0).all() or not coefficients.isfinite().all():
                continue  # a learning rate so high that steps vanish
            candidate = TunedSolver(times, coefficients)
            squares = _all_squares(velocity, candidate, held_out, batch_size)
            if _log_error(squares).item() < lowest and _summary(squares).mean < allowed:
                best, lowest = candidate, _log_error(squares).item()
    return best


class _SearchSpace(NamedTuple):
    """What is tuned: ``(N,)`` logs of the steps, ``(N, N)`` change of the AB2 weights; its band."""

    log_steps: Tensor
    change: Tensor
    used: Tensor

    @classmethod
    def around(cls, start: TunedSolver, num_velocities: int) -> _SearchSpace:
        ones = torch.ones(start.num_steps, start.num_steps, dtype=torch.bool)
        used = ones.tril() & ones.triu(1 - num_velocities)
        if (start.coefficients[~used] != 0).any():
            raise ValueError(
                f"the solver to start from uses more than the last {num_velocities} velocities"
            )
        space = cls((-start.times.diff()).log(), torch.zeros_like(start.coefficients), used)
        past = (start.coefficients - space.solver()[1]).tril(-1)
        return cls(space.log_steps.requires_grad_(), past.requires_grad_(), used)

    def solver(self) -> tuple[Tensor, Tensor]:
        """Times ``(N + 1,)`` and coefficients ``(N, N)``, differentiable."""
        steps = self.log_steps.softmax(dim=0)
        ends = torch.ones(1, dtype=steps.dtype), torch.zeros(1, dtype=steps.dtype)
        times = torch.cat([ends[0], 1 - steps.cumsum(dim=0)[:-1], ends[1]])
        past = torch.where(self.used, self.change, 0.0).tril(-1)
        if self.used.tril(-1).any():
            past = past + torch.diag(-steps[1:] / (2 * steps[:-1]), -1)
        return times, past + torch.diag(1 - past.sum(dim=1))


def _all_squares(velocity: Velocity, solver: TunedSolver, pairs: Pairs, batch_size: int) -> Tensor:
    parts = pairs.batches(batch_size)
    return torch.cat([_squares(solver.solve(velocity, one.noise), one.solution) for one in parts])


def _summary(squares: Tensor) -> SolverError:
    distances = squares.sqrt()
    rmse = squares.mean().sqrt().item()
    return SolverError(rmse, distances.mean().item(), distances.median().item())


def _squares(end: Tensor, solution: Tensor) -> Tensor:
    """Mean squared difference of each sample ``(B,)`` float64."""
    return (end.double() - solution.double()).square().flatten(1).mean(dim=1)


def _log_error(squares: Tensor) -> Tensor:
    """Mean log, finite also where a solver is exact."""
    return (squares + torch.finfo(squares.dtype).tiny).log().mean()


@torch.no_grad()
def _local_errors(
    velocity: Velocity, noise: Tensor, times: Tensor, substeps: int
) -> tuple[Tensor, Tensor]:
    """Mean squared error of single steps between candidates, started on the trajectory.

    Returns:
        ``(M + 1,)`` of the Euler step from candidate 0 to k, and ``(M, M, M + 1)`` of the AB2
        step from j to k after one from i to j; infinite where not i < j < k.
    """
    state, states, slopes = noise, [noise], []
    for now, then in step_pairs(times):
        slopes.append(velocity(state, batch_time(now, state)).to(state.dtype))
        between = torch.linspace(now, then, substeps + 1, dtype=torch.float64)
        state = midpoint(velocity, state, between)
        states.append(state)
    vectors = torch.stack([*states, *slopes]).flatten(1).double()
    products = (vectors @ vectors.T / noise.numel()).cpu()
    num = len(slopes)
    positions, cross, velocities = (
        products[: num + 1, : num + 1],
        products[: num + 1, num + 1 :],
        products[num + 1 :, num + 1 :],
    )
    first = torch.full((num + 1,), torch.inf, dtype=torch.float64)
    later = torch.full((num, num, num + 1), torch.inf, dtype=torch.float64)
    for j in range(num):
        k = torch.arange(j + 1, num + 1)
        step = times[k] - times[j]
        i = torch.arange(j)[:, None]
        moved = positions[j, j] + positions[k, k] - 2 * positions[j, k]
        if j == 0:
            along = cross[0, 0] - cross[k, 0]
            first[1:] = moved + step.square() * velocities[0, 0] + 2 * step * along
            continue
        old = -step.square() / (2 * (times[j] - times[i]))
        new = step - old
        square = new.square() * velocities[j, j] + old.square() * velocities[i, i]
        square = square + 2 * new * old * velocities[i, j]
        along = new * (cross[j, j] - cross[k, j]) + old * (cross[j, i] - cross[k, i])
        later[:j, j, j + 1 :] = moved + square + 2 * along
    return first.clamp(min=0), later.clamp(min=0)  # rounding of exact steps


def _cheapest_path(first: Tensor, later: Tensor, num_steps: int) -> list[int]:
    """Candidates ``0 = p_0 < ... < p_N = M`` of least cost.

    The cost is ``first[p_1]`` plus the sum of ``later[p_{n-1}, p_n, p_{n+1}]``. The state of the
    recursion is the last step (from, to).
    """
    last = len(first) - 1
    total = torch.full_like(later[:, 0], torch.inf)
    total[0] = first
    origins = []
    for _ in range(num_steps - 1):
        total, origin = (total[:, :last, None] + later).min(dim=0)
        origins.append(origin)
    path = [last, int(total[:, last].argmin())]
    for origin in reversed(origins):
        path.append(int(origin[path[-1], path[-2]]))
    return path[::-1]

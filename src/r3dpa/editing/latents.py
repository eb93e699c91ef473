"""Editing of given latents: inversion to noise, inpainting that preserves the surroundings.

The latents outside the mask are restored after every step of a solver::

    trajectory = invert(sit.velocity, latents, ode_times(50), "midpoint")
    start = noise_inside_mask(trajectory, edit_mask, noise)
    solve = ode_solver("midpoint", after_step=restore_outside_mask(trajectory, edit_mask))
    edited = solve(guidance, start, trajectory.times)

Letters: B batch, C latent channels, h x w latent size, T times, ``...`` axes of the latents.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from r3dpa.flow.interpolant import LINEAR, Interpolant
from r3dpa.flow.solvers import AfterStep, Velocity, ode_solver
from r3dpa.flow.times import batch_time, step_pairs


class Trajectory(NamedTuple):
    """Latents ``(T, B, ...)`` at decreasing times ``(T,)``: noise first, the given latents last."""

    times: Tensor
    states: Tensor


def invert(
    velocity: Velocity,
    latents: Tensor,
    times: Tensor,
    solver: str = "midpoint",
    *,
    interpolant: Interpolant = LINEAR,
) -> Trajectory:
    """Carry data along the probability flow towards noise, on a sampling grid in reverse.

    Sampling from the first state by the same solver on the same grid gives the data back up to the
    solver's error, which Euler steps make first order and midpoint steps second order small.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``, without guidance.
        latents: ``(B, ...)`` normalised latents at the last of the times.
        times: ``(T,)`` decreasing times of the sampling to come, see
            :func:`r3dpa.flow.times.ode_times`; a first time below 1 goes part of the way.
        solver: A key of :data:`r3dpa.flow.solvers.ODE_SOLVERS`.
        interpolant: Path of the velocity.
    """
    if step_pairs(times)[0][0] < times[-1]:
        raise ValueError(
            "inversion takes the times of the sampling to come, from noise to data; got "
            f"{times.tolist()}"
        )
    states = [latents]

    def record(x: Tensor, time: float, index: int) -> Tensor:
        states.append(x)
        return x

    ode_solver(solver, interpolant, record)(velocity, latents, times.flip(0))
    return Trajectory(times, torch.stack(states[::-1]))


def noise_inside_mask(
    trajectory: Trajectory, edit_mask: Tensor, noise: Tensor, interpolant: Interpolant = LINEAR
) -> Tensor:
    """Return the start of an edit: fresh noise inside the mask, inverted latents elsewhere.

    Where the trajectory starts at a time t below 1, the edit starts from the noisy latents of that
    time, ``alpha(t) data + sigma(t) noise``.

    Args:
        trajectory: From data to the time that the edit starts from.
        edit_mask: Bool, True where latents are generated anew; broadcasts to ``(B, ...)``, such as
            ``(B, 1, h, w)``.
        noise: ``(B, ...)`` standard Gaussian draw.
        interpolant: Path of the velocity.
    """
    inverted, data = trajectory.states[0], trajectory.states[-1]
    _check_mask(edit_mask, data)
    if noise.shape != data.shape:
        raise ValueError(f"noise must have shape {tuple(data.shape)}, got {tuple(noise.shape)}")
    start = batch_time(float(trajectory.times[0]), data)
    fresh = interpolant.interpolate(data, noise.to(data), start).to(data.dtype)
    return torch.where(edit_mask, fresh, inverted)


def restore_outside_mask(trajectory: Trajectory, edit_mask: Tensor) -> AfterStep:
    """Return a solver hook that restores the given latents outside the mask after every step.

    Outside the mask, the state equals the trajectory at every time of the grid, and the given
    latents bit for bit at the last time. Stages between two times (midpoint, Heun) see a state that
    is one step further outside the mask. Multistep solvers remember the velocities of restored
    states, and their corrections of an earlier step are overwritten as well.

    Args:
        trajectory: Trajectory of the latents to restore, on the time grid of the solver.
        edit_mask: Bool, True where latents are generated anew; broadcasts to ``(B, ...)``.

    Raises:
        ValueError: If the mask does not fit, or, in a step, the solver runs on another time grid.
    """
    _check_mask(edit_mask, trajectory.states[0])
    times = trajectory.times.tolist()

    def restore(x: Tensor, time: float, index: int) -> Tensor:
        if index >= len(times) or times[index] != time:
            raise ValueError(
                f"step {index} of the solver ends at t = {time}, but the latents were inverted on "
                f"{times}; use one time grid for both"
            )
        return torch.where(edit_mask, x, trajectory.states[index].to(x.dtype))

    return restore


def slerp(first: Tensor, second: Tensor, share: float) -> Tensor:
    """Interpolate two noises on the arc between them, which preserves their length.

    Per sample, with the angle a between the noises::

        (sin((1 - s) a) first + sin(s a) second) / sin(a)

    Parallel and opposite noises are interpolated linearly.

    Source: Shoemake 1985; for noises of diffusion models DDIM (Song et al. 2021), app. D.5.

    Args:
        first: ``(B, ...)``, returned at share 0.
        second: ``(B, ...)``, returned at share 1.
        share: Position s on the arc, in [0, 1].
    """
    if first.shape != second.shape or not 0 <= share <= 1:
        raise ValueError(
            "slerp needs two noises of one shape and a share in [0, 1], got "
            f"{tuple(first.shape)}, {tuple(second.shape)} and {share}"
        )
    flat_first, flat_second = first.flatten(1).double(), second.flatten(1).double()
    angle = torch.cosine_similarity(flat_first, flat_second, dim=1).clamp(-1, 1).acos()
    linear = angle.sin() < 1e-6  # the formula would divide 0 by 0
    divisor = torch.where(linear, 1.0, angle.sin())
    first_weight = torch.where(linear, 1 - share, ((1 - share) * angle).sin() / divisor)
    second_weight = torch.where(linear, share, (share * angle).sin() / divisor)
    mean = first_weight[:, None] * flat_first + second_weight[:, None] * flat_second
    return mean.reshape(first.shape).to(first.dtype)


def _check_mask(edit_mask: Tensor, latents: Tensor) -> None:
    shape = tuple(latents.shape)
    fits = edit_mask.dim() == len(shape) and all(
        size in (1, full) for size, full in zip(edit_mask.shape, shape, strict=True)
    )
    if edit_mask.dtype != torch.bool or not fits:
        raise ValueError(
            f"edit_mask must be bool and fit latents of shape {shape}, such as "
            f"{(shape[0], 1, *shape[2:])}; got {edit_mask.dtype} of shape {tuple(edit_mask.shape)}"
        )

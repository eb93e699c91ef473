"""``r3dpa tune-solver``: a solver of few steps fitted to one checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from r3dpa.checkpoints import read_checkpoint
from r3dpa.checkpoints.networks import format_table
from r3dpa.cli.scenes import generator_from, sit_sha256
from r3dpa.flow import ode_times
from r3dpa.flow.tuned import TunedSolver
from r3dpa.flow.tuning import (
    Pairs,
    SolverError,
    converged_pairs,
    optimal_times,
    search_solver,
    solver_error,
)
from r3dpa.generation import SamplerConfig
from r3dpa.io import source_commit, usable_device

__all__ = ["tune"]

_SHIFTS = (0.5, 1.0, 1.5, 2.0, 3.0)


def tune(
    ckpt: Path,
    out: Path,
    steps: int = 10,
    num: int = 64,
    val: int = 64,
    reference_steps: int = 200,
    iterations: int = 200,
    velocities: int = 2,
    batch_size: int = 16,
    seed: int = 0,
    weights: Literal["ema", "last"] = "ema",
    device: str = "auto",
) -> str:
    """Tunes a solver for one checkpoint and writes it; see ``r3dpa tune-solver --help``.

    The solvers are ranked by their mean error on held-out noise; the same number of further noises,
    used for no choice, gives the errors named "test".

    Returns:
        A table: solver, NFE, RMSE and mean error per sample on training, held-out and test
        noise.

    Raises:
        ValueError: If the checkpoint cannot be sampled from or a number is out of its range.
    """
    counts = {"steps": steps, "num": num, "val": val, "batch_size": batch_size}
    counts |= {"iterations": iterations, "velocities": velocities}
    # The search starts from AB2, which combines two velocities.
    least = {"velocities": 2 if steps > 1 else 1}
    for name, count in counts.items():
        if count < least.get(name, 1):
            raise ValueError(f"{name} must be at least {least.get(name, 1)}, got {count}")
    if reference_steps < 2 or reference_steps % 2:
        raise ValueError(f"reference_steps must be even and at least 2, got {reference_steps}")
    device = usable_device(device)
    checkpoint = read_checkpoint(ckpt)
    sit = generator_from(checkpoint, SamplerConfig(), weights, "fp32", device).sit

    def velocity(latents: Tensor, time: Tensor) -> Tensor:
        return sit.velocity(latents, time)

    random = torch.Generator().manual_seed(seed)
    shape = (num + 2 * val, sit.in_channels, *sit.input_size)
    noise = torch.randn(shape, generator=random).to(device)
    pairs = converged_pairs(velocity, noise, reference_steps, batch_size)
    sizes = [num, val, val]
    train, held_out, test = (
        Pairs(*part, pairs.uncertainty)
        for part in zip(noise.split(sizes), pairs.solution.split(sizes), strict=True)
    )

    solvers = {"euler": TunedSolver.from_adams(ode_times(steps), 1)}
    for shift in _SHIFTS:
        times = ode_times(steps, shift=shift)
        solvers[f"ab2, shift {shift:g}"] = TunedSolver.from_adams(times, 2)
    few = train.noise[:batch_size]
    times = optimal_times(velocity, few, steps, num_candidates=max(64, 4 * steps))
    solvers["ab2, learned times"] = TunedSolver.from_adams(times, 2)

    def errors(solver: TunedSolver) -> dict[str, SolverError]:
        sets = {"train": train, "held_out": held_out, "test": test}
        return {name: solver_error(velocity, solver, one, batch_size) for name, one in sets.items()}

    found = {name: errors(solver) for name, solver in solvers.items()}
    start = min(list(solvers)[1:], key=lambda name: found[name]["train"].mean)
    solvers["searched"] = search_solver(
        velocity,
        train,
        held_out,
        solvers[start],
        num_velocities=velocities,
        iterations=iterations,
        batch_size=batch_size,
    )
    found["searched"] = errors(solvers["searched"])
    # Equal errors: the one that was fitted, which is listed last.
    best = min(reversed(solvers), key=lambda name: found[name]["held_out"].mean)
    figures = {
        name: {one: error._asdict() for one, error in sets.items()} for name, sets in found.items()
    }
    card = {
        "solver": best,
        "sit_sha256": sit_sha256(checkpoint, weights),
        "stage": checkpoint.stage,
        "step": checkpoint.step,
        "weights": weights,
        "interpolant": checkpoint.interpolant,
        "trajectories": {"train": num, "held_out": val, "test": val, "seed": seed},
        "reference": {
            "solver": "heun",
            "steps": reference_steps,
            "rmse_to_half": pairs.uncertainty,
        },
        "search": {"start": start, "velocities": velocities, "iterations": iterations},
        "errors": figures,
        "commit": source_commit(),
    }
    TunedSolver(solvers[best].times, solvers[best].coefficients, card).save(out)
    rows = [
        (name, str(steps), *(f"{one.rmse:.5f} / {one.mean:.5f}" for one in sets.values()))
        for name, sets in found.items()
    ]
    header = ("solver", "NFE", "RMSE / mean: train", "held-out", "test")
    lowest = min(sets["test"].rmse for sets in found.values())
    certified = "converged" if pairs.uncertainty < lowest / 10 else "NOT CONVERGED: more steps"
    return "\n".join(
        [
            format_table(header, rows),
            f"reference: Heun, {reference_steps} steps; RMSE to half the steps "
            f"{pairs.uncertainty:.2g} ({certified})",
            f"saved: {best} in {out}",
        ]
    )

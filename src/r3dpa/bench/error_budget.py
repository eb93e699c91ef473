"""Where the error of a sampler comes from: solver, precision, model, and the floor of real data.

Letters: N samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from r3dpa.bench.problems import Problem, Setting, Solved

__all__ = ["Errors", "Reference", "budget", "certified_reference"]

_MARGIN = 10  # the reference must be this many times better than what it judges


@dataclass(frozen=True)
class Reference:
    """The converged solution, and how far it can be trusted.

    Args:
        solved: By Heun's method.
        steps: Of it.
        self_error: RMSE of its latents from those of half the steps.
    """

    solved: Solved
    steps: int
    self_error: float

    def certifies(self, error: float) -> bool:
        """Whether an error is at least ten times the reference's own."""
        return self.self_error < error / _MARGIN


@dataclass(frozen=True)
class Errors:
    """Of one setting against the converged solution of the same noise.

    Args:
        nfe: As counted.
        squared: ``(N,)`` mean squared error of the latents of each sample; None for an SDE.
        discretisation: RMSE of the same solver in fp32, not compiled; None for an SDE.
        precision: RMSE between the two; 0 where they are one.
        range_rmse_m: Of pixels with a return in both; None without a decoder, or for an SDE.
        mask_iou: Pixels with a return in both over those with one in either; None likewise.
    """

    nfe: int
    squared: NDArray[np.float64] | None
    discretisation: float | None
    precision: float
    range_rmse_m: float | None
    mask_iou: float | None

    @property
    def rmse(self) -> float | None:
        """Of all latents."""
        return None if self.squared is None else float(np.sqrt(self.squared.mean()))


def certified_reference(problem: Problem, steps: int, num: int) -> Reference:
    """The converged solution, and its distance from that of half the steps.

    Args:
        problem: What is solved.
        steps: Of Heun's method, at least 2.
        num: Samples.
    """
    solved, half = problem.converged(steps, num), problem.converged(steps // 2, num)
    return Reference(solved, steps, float(np.sqrt(_squared(solved.latents, half.latents).mean())))


def budget(
    problem: Problem,
    settings: Sequence[Setting],
    reference: Reference,
    look: Callable[[Setting, Solved], None],
) -> list[Errors]:
    """Errors of each setting.

    Args:
        problem: What is solved.
        settings: All ways.
        reference: Of as many samples as each setting solves.
        look: Is shown every result, which is not kept.
    """
    num = len(reference.solved.latents)
    plain: dict[tuple[object, ...], Solved] = {}
    found = []
    for setting in settings:
        # Rows that differ only in speed share their plain companion.
        key = (setting.sampler, setting.autoguided)
        if setting.plain == setting:
            solved = companion = plain[key] = problem.solve(setting, num)
        else:
            solved = problem.solve(setting, num)
            if key not in plain:
                plain[key] = problem.solve(setting.plain, num)
            companion = plain[key]
        look(setting, solved)
        precision = _rmse(solved.latents, companion.latents)
        if not setting.deterministic or setting.autoguided:
            # Another random path, or another model: no solution that it should converge to.
            found.append(Errors(solved.nfe, None, None, precision, None, None))
            continue
        ranges = _range_errors(solved.range_m, reference.solved.range_m)
        squared = _squared(solved.latents, reference.solved.latents)
        discretisation = _rmse(companion.latents, reference.solved.latents)
        found.append(Errors(solved.nfe, squared, discretisation, precision, *ranges))
    return found


def _squared(a: Tensor, b: Tensor) -> NDArray[np.float64]:
    return (a.double() - b.double()).flatten(1).square().mean(dim=1).numpy()


def _rmse(a: Tensor, b: Tensor) -> float:
    return float(np.sqrt(_squared(a, b).mean()))


def _range_errors(a: Tensor | None, b: Tensor | None) -> tuple[float | None, float | None]:
    """RMSE in metres over pixels valid in both, and intersection over union of the valid ones."""
    if a is None or b is None:
        return None, None
    both, either = (a > 0) & (b > 0), (a > 0) | (b > 0)
    if not both.any():
        return None, 0.0
    rmse = (a - b)[both].double().square().mean().sqrt().item()
    return rmse, (both.sum() / torch.clamp(either.sum(), min=1)).item()

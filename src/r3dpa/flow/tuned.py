"""A solver as numbers: its times, and how each step weighs the velocities met so far."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self

import torch
from torch import Tensor

from r3dpa.flow.solvers import OdeSolver, Velocity, ab2, ab3, euler
from r3dpa.io import atomic_path

__all__ = ["TunedSolver", "multistep"]

_FORMAT = "r3dpa tuned solver, version 1"
_ADAMS: dict[int, OdeSolver] = {1: euler, 2: ab2, 3: ab3}
_ROW_SUM_TOLERANCE = 1e-9  # rounding of a sum of a hundred weights stays far below


@dataclass(frozen=True, eq=False)
class TunedSolver:
    """Explicit linear multistep solver from noise to data with one evaluation per step.

    Step n goes from ``t_n`` to ``t_{n+1}`` along a mean of the velocities met so far::

        x_{n+1} = x_n + (t_{n+1} - t_n) sum_{j <= n} c_nj v_j        v_j = v(x_j, t_j)

    Every row of c sums to 1, so that a constant velocity is followed exactly. Euler and
    Adams-Bashforth on any grid are special cases (:meth:`from_adams`).

    Source: Differentiable Solver Search (Wang et al. 2025), eq. 9.

    Args:
        times: ``(N + 1,)`` float64, decreasing from 1 to 0.
        coefficients: ``(N, N)`` float64 c, lower triangular.
        card: Where the numbers come from and what errors they make: plain JSON values.

    Raises:
        ValueError: If times or coefficients are not as said above.

    Example:
        >>> solver = TunedSolver.from_adams(torch.tensor([1.0, 0.5, 0.0]), order=2)
        >>> solver.coefficients
        tensor([[ 1.0000,  0.0000],
                [-0.5000,  1.5000]], dtype=torch.float64)
        >>> solver.solve(lambda x, time: torch.ones_like(x), torch.zeros(1, 2))
        tensor([[-1., -1.]])
    """

    times: Tensor
    coefficients: Tensor
    card: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the numbers; they are kept in float64 on the CPU."""
        for name in ("times", "coefficients"):
            values = torch.as_tensor(getattr(self, name)).detach().to("cpu", torch.float64)
            object.__setattr__(self, name, values.clone())
            if not values.isfinite().all():
                raise ValueError(f"{name} of a tuned solver must be finite, got {values.tolist()}")
        times, coefficients = self.times, self.coefficients
        if times.dim() != 1 or len(times) < 2 or times[0] != 1 or times[-1] != 0:
            raise ValueError(f"times must go from 1 to 0, got {times.tolist()}")
        if not (times.diff() < 0).all():
            raise ValueError(f"times must decrease, got {times.tolist()}")
        if coefficients.shape != (self.num_steps, self.num_steps):
            raise ValueError(
                f"coefficients must be {(self.num_steps, self.num_steps)} for {len(times)} times, "
                f"got shape {tuple(coefficients.shape)}"
            )
        if coefficients.triu(1).any():
            raise ValueError(
                "coefficients must be lower triangular: a step knows no later velocity"
            )
        wrong = ((coefficients.sum(dim=1) - 1).abs() > _ROW_SUM_TOLERANCE).nonzero().flatten()
        if len(wrong):
            row = int(wrong[0])
            total = coefficients[row].sum().item()
            raise ValueError(f"every row of coefficients must sum to 1, row {row} sums to {total}")

    @classmethod
    def from_adams(cls, times: Tensor, order: Literal[1, 2, 3]) -> Self:
        """Euler (order 1), :func:`r3dpa.flow.ab2` or :func:`r3dpa.flow.ab3` on a grid.

        The solver itself is asked: with the n-th unit vector as n-th velocity, what a step adds
        are its weights.

        Args:
            times: ``(N + 1,)`` decreasing from 1 to 0.
            order: Order of the method.

        Returns:
            A solver without card.

        Raises:
            ValueError: If the times or the order are not as said.
        """
        if order not in _ADAMS:
            raise ValueError(f"order must be 1, 2 or 3, got {order}")
        times = times.detach().to("cpu", torch.float64)
        num_steps = len(times) - 1
        ends = [torch.zeros(1, num_steps, dtype=torch.float64)]
        for last in range(1, num_steps + 1):
            velocities = iter(torch.eye(num_steps, dtype=torch.float64))
            answer = lambda x, time, velocities=velocities: next(velocities)[None]  # noqa: E731
            ends.append(_ADAMS[order](answer, ends[0], times[: last + 1]))
        return cls(times, torch.cat(ends).diff(dim=0) / times.diff()[:, None])

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what :meth:`save` wrote.

        Args:
            path: JSON file.

        Returns:
            The solver, bit by bit.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it is damaged, naming the file and the field.
        """
        path = Path(path)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{path} is not JSON ({error}); tune the solver anew") from error
        if not isinstance(content, dict) or content.get("format") != _FORMAT:
            given = content.get("format") if isinstance(content, dict) else type(content).__name__
            raise ValueError(f"{path}: field 'format' must be {_FORMAT!r}, got {given!r}")
        times = _numbers(path, "times", content.get("times"))
        rows = content.get("coefficients")
        if not isinstance(rows, list):
            raise ValueError(f"{path}: field 'coefficients' must be a list, got {rows!r:.40}")
        triangle = torch.zeros(len(rows), len(rows), dtype=torch.float64)
        for index, row in enumerate(rows):
            values = _numbers(path, f"coefficients[{index}]", row)
            if len(values) != index + 1:
                raise ValueError(
                    f"{path}: field 'coefficients[{index}]' must hold {index + 1} numbers, got "
                    f"{len(values)}"
                )
            triangle[index, : index + 1] = torch.tensor(values, dtype=torch.float64)
        card = content.get("card")
        if not isinstance(card, dict):
            raise ValueError(f"{path}: field 'card' must be an object, got {card!r:.40}")
        try:
            return cls(torch.tensor(times, dtype=torch.float64), triangle, card)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def save(self, path: str | Path) -> None:
        """Write the solver as JSON; numbers come back bit by bit.

        Args:
            path: File to write.

        Raises:
            TypeError: If the card holds what JSON cannot.
            ValueError: If the card holds a number that is not finite.
        """
        content = {
            "format": _FORMAT,
            "times": self.times.tolist(),
            "coefficients": [row[: n + 1] for n, row in enumerate(self.coefficients.tolist())],
            "card": dict(self.card),
        }
        text = json.dumps(content, indent=1, allow_nan=False)
        with atomic_path(path) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")

    @property
    def num_steps(self) -> int:
        """Number of steps, which is the NFE."""
        return len(self.times) - 1

    @torch.no_grad()
    def solve(self, velocity: Velocity, x: Tensor) -> Tensor:
        """Carry noise to data.

        Args:
            velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
            x: ``(B, ...)`` state at t = 1.

        Returns:
            ``(B, ...)`` state at t = 0, dtype of ``x``.
        """
        return multistep(velocity, x, self.times, self.coefficients, self.coefficients != 0)


def multistep(
    velocity: Velocity, x: Tensor, times: Tensor, coefficients: Tensor, used: Tensor
) -> Tensor:
    """The recursion of :class:`TunedSolver`, differentiable in times, coefficients and ``x``.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)``.
        x: ``(B, ...)`` state at the first time.
        times: ``(N + 1,)`` float64 on the CPU.
        coefficients: ``(N, N)`` float64 on the CPU.
        used: ``(N, N)`` bool, the coefficients that count; velocities that no later step uses are
            let go.

    Returns:
        ``(B, ...)`` state at the last time, dtype of ``x``.
    """
    ones = x.new_ones(len(x), dtype=torch.promote_types(x.dtype, torch.float32))
    weights = times.diff()[:, None] * coefficients
    past: dict[int, Tensor] = {}
    for n, time in enumerate(times[:-1]):
        past[n] = velocity(x, time * ones).to(x.dtype)
        for j in used[n].nonzero().flatten().tolist():
            x = x + weights[n, j] * past[j]
        later = used[n + 1 :].any(dim=0)
        past = {j: slope for j, slope in past.items() if later[j]}
    return x


def _numbers(path: Path, name: str, given: object) -> list[float]:
    if isinstance(given, list) and all(
        isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        for value in given
    ):
        return [float(value) for value in given]
    raise ValueError(f"{path}: field {name!r} must be a list of finite numbers, got {given!r:.60}")

"""Whether the residual of an alignment, one minus the mean cosine, has stopped falling."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class ResidualAverages:
    """A fast and a slow average of the residual, which a checkpoint keeps.

    An average reaches over about ``1 / (1 - decay)`` steps. The alignment is released when the fast
    one is less than a given share below the slow one, but not before as many steps as the slow one
    reaches over. Both start at 0; divided by ``1 - decay ** steps`` they are means.

    Source: RARE (2026), with decays 0.999 and 0.99995 and a share of 0.02 for 400 000 steps.
    """

    steps: int = 0
    fast: float = 0.0
    slow: float = 0.0
    released: bool = False

    def update(self, residual: float, decays: tuple[float, float], within: float) -> float:
        """Add the residual of a step; return by which share the fast average is below the slow."""
        fast_decay, slow_decay = decays
        self.steps += 1
        self.fast += (1 - fast_decay) * (residual - self.fast)
        self.slow += (1 - slow_decay) * (residual - self.slow)
        fast = self.fast / (1 - fast_decay**self.steps)
        slow = self.slow / (1 - slow_decay**self.steps)
        fall = 1 - fast / slow if slow > 0 else 0.0
        if self.steps * (1 - slow_decay) >= 1 and fall < within:
            self.released = True
        return fall

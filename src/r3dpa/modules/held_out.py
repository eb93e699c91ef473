"""Means over held-out samples."""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat


class HeldOutMeans(Metric):
    """Means over held-out samples, each counted once, whatever the batches and processes.

    Loaders of several processes repeat samples to give all of them the same number of batches.
    """

    full_state_update = False
    index: list[Tensor]
    values: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        self.names: tuple[str, ...] = ()
        self.add_state("index", [], dist_reduce_fx="cat")
        self.add_state("values", [], dist_reduce_fx="cat")

    def update(self, index: Tensor, **sums: Tensor | tuple[Tensor, Tensor]) -> None:
        """Add samples by their index ``(B,)``: a value ``(B,)`` each, or its sum and weight."""
        pairs = [s if isinstance(s, tuple) else (s, torch.ones_like(s)) for s in sums.values()]
        self.names = tuple(sums)
        self.index.append(index)
        self.values.append(torch.stack([torch.stack(pair, dim=1).float() for pair in pairs], dim=1))

    def compute(self) -> dict[str, float]:
        """Means by name; 0 where all weights are 0."""
        index, order = dim_zero_cat(self.index).cpu().sort(stable=True)
        once = order[index.diff(prepend=index[:1] - 1) != 0]
        total, weight = dim_zero_cat(self.values).cpu()[once].double().sum(dim=0).unbind(dim=1)
        return dict(zip(self.names, (total / weight.clamp(min=1)).tolist(), strict=True))

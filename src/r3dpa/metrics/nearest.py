"""Distance of scenes to their nearest training scans: what a generator has memorised."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

_CELLS = (16, 64)


class Nearest(NamedTuple):
    """Distances ``(N,)`` to the nearest references, and their numbers ``(N,)``."""

    distance: Tensor
    number: Tensor


def nearest_images(range_m: Tensor, references: Iterable[Tensor]) -> Nearest:
    """Find the nearest of many range images, by the means of log2(1 + range) over 16 x 64 cells.

    The distance is the root mean square difference of the cells: 0 for a copy, 1 for a scene twice
    as far away throughout. Compare it with the distance of held-out scans to the same references.

    Args:
        range_m: ``(N, H, W)`` metres, not above 0 without a return, which counts as range 0.
        references: Batches ``(B, H, W)`` of the images to search.
    """
    cells = _cells(range_m)
    best = Nearest(torch.full((len(cells),), torch.inf), torch.zeros(len(cells), dtype=torch.long))
    first = 0
    for batch in references:
        others = _cells(batch)
        # Products of matrices find the nearest; their rounding must not hide a copy.
        index = torch.cdist(cells.double(), others.double()).argmin(dim=1)
        distance = (cells - others[index]).norm(dim=1)
        nearer = distance < best.distance
        best = Nearest(
            torch.where(nearer, distance, best.distance),
            torch.where(nearer, index + first, best.number),
        )
        first += len(batch)
    if not first:
        raise ValueError("nearest_images got no reference; give at least one")
    return best._replace(distance=best.distance / cells.shape[1] ** 0.5)


def _cells(range_m: Tensor) -> Tensor:
    levels = torch.log2(1 + range_m.float().clamp(min=0))
    return F.adaptive_avg_pool2d(levels[:, None], _CELLS).flatten(1)

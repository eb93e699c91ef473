"""Metrics over two sets of scans that need the samples themselves, or cells seen from above."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from r3dpa.metrics.functional import checked_features, polynomial_mmd
from r3dpa.metrics.functional_bev import BEVGrid, histogram_distance, minimum_matching
from r3dpa.metrics.functional_manifold import precision_recall


class _FeatureSets(Metric):
    """Keeps all features of both sets in the precision they are given in."""

    is_differentiable = False
    full_state_update = False

    real_features: list[Tensor]
    generated_features: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        self.add_state("real_features", default=[], dist_reduce_fx="cat")
        self.add_state("generated_features", default=[], dist_reduce_fx="cat")

    def update(self, features: Tensor, real: bool) -> None:
        """Add ``(N, F)`` features of real or of generated scans."""
        checked_features(features, f"{'real' if real else 'generated'} features")
        (self.real_features if real else self.generated_features).append(features.detach())

    def _features(self) -> tuple[Tensor, Tensor]:
        real = _joined(self.real_features, "real features")
        return real, _joined(self.generated_features, "generated features")


def _joined(parts: list[Tensor] | Tensor, name: str) -> Tensor:
    if len(parts) == 0:
        raise ValueError(f"no {name} given yet; call update(..., real={name.startswith('real')})")
    return dim_zero_cat(parts)


class PolynomialMMD(_FeatureSets):
    """Kernel distance (KID) of features: unbiased at any number of samples.

    Args:
        num_subsets: Random subsets that are averaged.
        subset_size: Samples of each set in one subset.
        seed: Of the subsets.
    """

    higher_is_better = False

    def __init__(self, num_subsets: int = 100, subset_size: int = 1000, seed: int = 0) -> None:
        super().__init__()
        self.num_subsets, self.subset_size, self.seed = num_subsets, subset_size, seed

    def compute(self) -> dict[str, float]:
        """``kid_mean`` and ``kid_std`` over the subsets."""
        generator = torch.Generator().manual_seed(self.seed)
        mean, std = polynomial_mmd(*self._features(), generator, self.num_subsets, self.subset_size)
        return {"kid_mean": mean, "kid_std": std}


class PrecisionRecall(_FeatureSets):
    """Precision, recall, density and coverage of features (PRDC).

    Args:
        num_neighbors: k of the balls around the samples.
    """

    higher_is_better = True

    def __init__(self, num_neighbors: int = 5) -> None:
        super().__init__()
        self.num_neighbors = num_neighbors

    def compute(self) -> dict[str, float]:
        """``precision``, ``recall``, ``density`` and ``coverage``."""
        return dict(vars(precision_recall(*self._features(), self.num_neighbors)))


class _CloudSets(Metric):
    """Cells that clouds occupy, and how many of their points are outside the grid."""

    is_differentiable = False
    higher_is_better = False
    full_state_update = False

    def __init__(self, grid: BEVGrid | None = None) -> None:
        super().__init__()
        self.grid = BEVGrid() if grid is None else grid
        for name in ("real", "generated"):
            points = torch.zeros(2, dtype=torch.int64)  # all, outside
            self.add_state(f"{name}_points", default=points, dist_reduce_fx="sum")

    def _cells(self, clouds: Sequence[Tensor], name: str) -> list[Tensor]:
        """Cells of each cloud; all are checked before the points of the first one count."""
        cells = [self.grid.cells(cloud, f"{name} cloud {i}") for i, cloud in enumerate(clouds)]
        points = getattr(self, f"{name}_points")
        for cloud in clouds:
            outside = len(cloud) - int(self.grid.inside(cloud).sum())
            points += points.new_tensor([len(cloud), outside])
        return cells

    def _outside_shares(self) -> dict[str, float]:
        shares = {}
        for name in ("real", "generated"):
            total, outside = getattr(self, f"{name}_points").tolist()
            shares[f"{name}_outside_share"] = outside / total
        return shares


class BEVHistogramDistance(_CloudSets):
    """JSD and its relatives of how many clouds occupy each cell seen from above.

    Points outside the grid do not count, by the definition of the published number;
    ``*_outside_share`` tells how many these were.

    Args:
        grid: Cells; the default is that of the published numbers.
    """

    real_counts: Tensor
    generated_counts: Tensor

    def __init__(self, grid: BEVGrid | None = None) -> None:
        super().__init__(grid)
        rows, columns = self.grid.shape
        for name in ("real", "generated"):
            counts = torch.zeros(rows * columns, dtype=torch.int32)
            self.add_state(f"{name}_counts", default=counts, dist_reduce_fx="sum")

    def update(self, clouds: Sequence[Tensor], real: bool) -> None:
        """Add clouds ``(P, 3 or more)``; NaN, or no point on the grid, is a ``ValueError``."""
        name = "real" if real else "generated"
        counts = getattr(self, f"{name}_counts")
        for occupied in self._cells(clouds, name):
            counts[occupied.to(counts.device)] += 1

    def compute(self) -> dict[str, float]:
        """Fields of :class:`HistogramDistance` and the ``*_outside_share`` of the points."""
        if not (self.real_counts.any() and self.generated_counts.any()):
            raise ValueError("the histogram needs at least one real and one generated cloud")
        distances = histogram_distance(self.real_counts, self.generated_counts)
        return vars(distances) | self._outside_shares()


class MinimumMatchingDistance(_CloudSets):
    """Published "MMD" of clouds: squared, without unit, on occupied cells seen from above.

    Points outside the grid do not count, as for :class:`BEVHistogramDistance`.

    Args:
        grid: Square grid of cells; the default is that of the published number.
    """

    def __init__(self, grid: BEVGrid | None = None) -> None:
        super().__init__(grid)
        for name in ("real", "generated"):
            self.add_state(f"{name}_cells", default=[], dist_reduce_fx="cat")
            self.add_state(f"{name}_sizes", default=[], dist_reduce_fx="cat")

    def update(self, clouds: Sequence[Tensor], real: bool) -> None:
        """Add clouds ``(P, 3 or more)``; NaN, or no point on the grid, is a ``ValueError``."""
        name = "real" if real else "generated"
        cells = self._cells(clouds, name)
        if not cells:
            return
        getattr(self, f"{name}_cells").append(torch.cat(cells).int())
        sizes = torch.tensor([len(part) for part in cells], device=cells[0].device)
        getattr(self, f"{name}_sizes").append(sizes)

    def compute(self) -> dict[str, float]:
        """The published number, in square metres too, and the ``*_outside_share`` of points."""
        real, generated = (
            _joined(getattr(self, f"{name}_cells"), f"{name} clouds")
            .long()
            .split(_joined(getattr(self, f"{name}_sizes"), f"{name} clouds").tolist())
            for name in ("real", "generated")
        )
        value = minimum_matching(real, generated, self.grid).mmd_squared_normalised
        width_m = self.grid.shape[0] * self.grid.cell_m
        published = {"mmd_squared_normalised": value, "mmd_m2": value * width_m**2}
        return published | self._outside_shares()

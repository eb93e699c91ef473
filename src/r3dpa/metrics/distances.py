"""Distances of two sets of scenes that need no network, as torchmetrics metrics.

Letters: B scenes, H x W range image, G groups that intervals leave out, n scenes that are kept.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from lidarsim.divergences import wasserstein_1
from r3dpa.geometry import points_of
from r3dpa.metrics.functional_bev import (
    BEVGrid,
    Matching,
    chamfer_squared,
    gaussian_kernel,
    histogram_distance,
    minimum_matching,
    point_histogram,
)
from r3dpa.metrics.resampling import Resampling
from r3dpa.metrics.results import MetricResult
from r3dpa.metrics.scene import Protocol

#: Width of the bins of ranges, metres.
RANGE_BIN_M = 0.1
SIDES = ("real", "generated")
#: Note of a mean over real scans, whose interval tells nothing of other generated scenes.
OVER_REAL_SCANS = "interval over draws of the real scans, generated scenes fixed"

#: Powers of ten that the published table prints its columns in.
_SCALES = {"FLD": -1, "JSD": -2, "MMD": -5}
_CHAMFER_PAIRS = 200


class SceneMetric(Metric):
    """Distance between generated scenes and real scans; the base of all metrics of scenes.

    States come in pairs, ``real_<name>`` and ``generated_<name>``. Those that grow with the scenes
    hold at most ``limits[side]`` of them: the ones whose names have the lowest hashes, a choice
    that is as good as a random one but does not depend on order, batches or interruptions.
    """

    full_state_update = False
    has_file = False  # whether the real side comes from the official statistics file
    real_count: Tensor
    generated_count: Tensor

    def __init__(self, max_real: int | None = None, max_generated: int | None = None) -> None:
        super().__init__()
        self.limits = {"real": max_real, "generated": max_generated}
        self._empty: dict[str, Tensor] = {}  # rows of the states that are lists of tensors
        self._add_states("count", torch.zeros((), dtype=torch.int64))

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """As torchmetrics does it, but an update that fails leaves the state as it was."""
        before = self.__dict__ | self._copy_state_dict()
        try:
            return super().forward(*args, **kwargs)
        except Exception:
            self.__dict__.update(before)
            raise

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """The distances as rows of a table, with intervals; of this process alone."""
        raise NotImplementedError

    def compute(self) -> dict[str, float]:
        """Values of :meth:`results` by name, of the scenes of all processes."""
        if not self.count("generated") or not self.has_reference:
            raise ValueError("update with real and with generated scenes: one side has none yet")
        values = {}
        for row in self.results(Resampling(num_resamples=0)):
            if row.value is None:
                raise ValueError(f"{row.name}: {row.note}")
            values[row.name] = row.value
        return values

    @property
    def has_reference(self) -> bool:
        """Whether the real side is known."""
        return self.has_file or self.count("real") > 0

    def count(self, side: str) -> int:
        """Scenes seen."""
        return int(getattr(self, f"{side}_count"))

    def load_state(self, name: str, value: Tensor) -> None:
        """Sets one of :meth:`real_states`; a ``ValueError`` if its shape is another."""
        grows = name in self._empty
        expected = (self._empty[name] if grows else getattr(self, name)).shape[grows:]
        if value.shape[grows:] != expected:
            raise ValueError(f"{name} of shape {tuple(value.shape)} ends not in {tuple(expected)}")
        setattr(self, name, [value] if grows else value)

    def adopt_real(self, *others: SceneMetric) -> None:
        """Takes over the real scans of other metrics of this kind, one after the other."""
        self.limits["real"] = None  # each of the others kept as many as it should
        states = [other.real_states() for other in others]
        for name in states[0]:
            parts: Any = [state[name] for state in states]
            if name not in self._empty:
                reduction = cast(Callable[[Tensor], Tensor], self._reductions[name])
                parts = reduction(torch.stack(parts))
            setattr(self, name, parts)

    def real_states(self) -> dict[str, Tensor]:
        """States of the real scans by name, without those beyond the limit."""
        if self._empty:
            self._prune("real")
        names = [name for name in self._defaults if name.startswith("real_")]
        return {n: self._joined(n) if n in self._empty else getattr(self, n) for n in names}

    def kept(self, side: str) -> tuple[Tensor, Tensor]:
        """Places ``(n,)`` among all scenes, and values ``(n, ...)``, of those that are kept."""
        self._prune(side)
        return self._joined(f"{side}_order")[:, 1], self._joined(f"{side}_values")

    def lowest(self, side: str, limit: int) -> Tensor:
        """Indices of up to ``limit`` kept scenes: those whose names have the lowest hashes."""
        return self._joined(f"{side}_order")[:, 0].argsort(stable=True)[:limit].sort().values

    def _add_states(self, name: str, default: Tensor, reduction: Any = "sum") -> None:
        for side in SIDES:
            self.add_state(f"{side}_{name}", default.clone(), dist_reduce_fx=reduction)

    def _add_kept(self, empty: Tensor) -> None:
        """Adds the states of scenes that are kept: their values, ranks and places."""
        for name, default in (("values", empty), ("order", torch.zeros(0, 2, dtype=torch.int64))):
            for side in SIDES:
                self.add_state(f"{side}_{name}", [], dist_reduce_fx="cat")
                self._empty[f"{side}_{name}"] = default

    def _joined(self, name: str) -> Tensor:
        parts = getattr(self, name)
        return dim_zero_cat(parts) if len(parts) else self._empty[name].to(self.device)

    def _sync_dist(self, *args: Any, **kwargs: Any) -> None:
        for name in self._empty:  # a process without scenes must take part with the right shape
            setattr(self, name, [self._joined(name)])
        super()._sync_dist(*args, **kwargs)

    def _keep(self, side: str, values: Tensor, names: Sequence[str] | None) -> None:
        """Adds ``(B, ...)`` values to the count and to the kept ones."""
        ranks = [0] * len(values) if names is None else [_rank(scene) for scene in names]
        count = getattr(self, f"{side}_count")
        places = count + torch.arange(len(values), device=self.device)
        order = torch.stack([torch.tensor(ranks).to(self.device), places], dim=1)
        getattr(self, f"{side}_order").append(order)
        getattr(self, f"{side}_values").append(values)
        count += len(values)
        limit = self.limits[side]
        if limit is not None and sum(map(len, getattr(self, f"{side}_order"))) > 2 * limit + 64:
            self._prune(side)

    def _prune(self, side: str) -> None:
        limit, order = self.limits[side], self._joined(f"{side}_order")
        if limit is None or len(order) <= limit:
            return
        values, kept = self._joined(f"{side}_values"), self.lowest(side, limit)
        setattr(self, f"{side}_order", [order.index_select(0, kept)])
        setattr(self, f"{side}_values", [values.index_select(0, kept)])

    def _row(
        self,
        name: str,
        value: float | None,
        counts: tuple[int, int | None] | None = None,
        **fields: Any,
    ) -> MetricResult:
        """A number of ``counts`` generated and real scenes, by default of all."""
        generated, real = counts or (self.count("generated"), self.count("real") or None)
        scale = _SCALES.get(name.removesuffix(" inf"), 0)
        return MetricResult(
            name, value, scale=scale, num_samples=generated, num_references=real, **fields
        )


class _Histograms(SceneMetric):
    """Sums of histograms of scenes; the generated ones in groups, which intervals leave out."""

    real_bins: Tensor
    generated_bins: Tensor

    def __init__(self, num_bins: int, num_groups: int, dtype: torch.dtype) -> None:
        super().__init__()
        for name, shape in (("real_bins", (num_bins,)), ("generated_bins", (num_groups, num_bins))):
            self.add_state(name, torch.zeros(shape, dtype=dtype), dist_reduce_fx="sum")
            # One number in place of up to 256 MB of zeros that torchmetrics would keep for reset.
            self._defaults[name] = torch.zeros((), dtype=dtype).expand(shape)

    def _groups(self, real: bool, num: int) -> tuple[Tensor, Tensor]:
        """Histograms ``(groups, bins)`` of a side, and the group ``(num,)`` of each new scene."""
        bins = self.real_bins[None] if real else self.generated_bins
        count = self.real_count if real else self.generated_count
        groups = (count + torch.arange(num, device=self.device)) % len(bins)
        count += num
        return bins, groups

    def _resampled_row(
        self,
        name: str,
        distance: Callable[[Tensor], float],
        resampling: Resampling,
        groups: Tensor,
        **fields: Any,
    ) -> MetricResult:
        """Row of the distance of the sum of the groups ``(G, bins)``."""

        def resampled(drawn: Tensor) -> float:
            return distance(torch.bincount(drawn, minlength=len(groups)).to(groups) @ groups)

        ends = resampling.interval(resampled, min(self.count("generated"), len(groups)))
        return self._row(name, distance(groups.sum(dim=0)), interval=ends, **fields)


class BEVHistogramDistance(_Histograms):
    """JSD and TV of how many clouds occupy each cell of ``grid`` seen from above.

    Intervals leave out each of ``num_groups`` groups of generated scenes in turn.
    """

    def __init__(self, grid: BEVGrid, num_groups: int = 1) -> None:
        super().__init__(grid.side**2, num_groups, torch.int32)
        self.grid = grid

    def update(self, clouds: Sequence[Tensor], real: bool) -> None:
        """Add clouds ``(P, 3 or more)``; NaN, or no point on the grid, is a ``ValueError``."""
        side = SIDES[not real]
        cells = [self.grid.cells(cloud, f"{side} cloud {i}") for i, cloud in enumerate(clouds)]
        bins, groups = self._groups(real, len(cells))
        for group, occupied in zip(groups, cells, strict=True):
            bins[group, occupied.to(bins.device)] += 1

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """JSD and TV."""
        occupied = (self.real_bins > 0) | (self.generated_bins > 0).any(dim=0)
        real, groups = self.real_bins[occupied].double(), self.generated_bins[:, occupied].float()

        def distance(name: str, field: str, note: str = "") -> MetricResult:
            def of(counted: Tensor) -> float:
                return getattr(histogram_distance(real, counted), field)

            return self._resampled_row(name, of, resampling, groups, note=note)

        half = "half of what the official code calls TV"
        return [distance("JSD", "jsd_distance"), distance("TV", "total_variation", half)]


class RangeHistogramDistance(_Histograms):
    """Earth mover's distance (W1) of the ranges of all returns, metres, in bins of 0.1 m.

    Intervals leave out each of ``num_groups`` groups of generated scenes in turn.
    """

    def __init__(self, range_max_m: float, num_groups: int = 1) -> None:
        super().__init__(math.ceil(range_max_m / RANGE_BIN_M), num_groups, torch.int64)

    def update(self, range_m: Tensor, real: bool) -> None:
        """Add range images ``(B, H, W)`` in metres, not above 0 without a return."""
        bins, groups = self._groups(real, len(range_m))
        width = bins.shape[1]
        index = (range_m.flatten(1) / RANGE_BIN_M).long().clamp(0, width - 1)
        index = index + width * groups[:, None].to(index.device)
        returns = (range_m > 0).flatten()
        bins.view(-1).index_add_(0, index.flatten().to(bins.device), returns.to(bins))

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """W1."""
        real, groups = self.real_bins.double().cpu().numpy(), self.generated_bins.double()

        def distance(counted: Tensor) -> float:
            return wasserstein_1(real, counted.double().cpu().numpy(), RANGE_BIN_M)

        return [self._resampled_row("W1 range", distance, resampling, groups, unit="m")]


class MinimumMatchingDistance(SceneMetric):
    """Published "MMD" on occupied cells seen from above, and 3D Chamfer distance of its matches.

    Points beyond the grid do not count in MMD, by its definition. The 3D distance, in square
    metres, is the mean over up to 200 real scans, each with the nearest generated scene by cells.
    All are kept without ``max_real`` and ``max_generated``.

    Attributes:
        reference_cells: Occupied cells ``(n,)`` of real scans without images, as in the official
            statistics file; the 3D distance is then left out.
    """

    def __init__(
        self, protocol: Protocol, max_real: int | None = None, max_generated: int | None = None
    ) -> None:
        super().__init__(max_real, max_generated)
        self.protocol = protocol
        self.reference_cells: list[Tensor] = []
        self._add_kept(torch.zeros(0, protocol.sensor.beams, protocol.sensor.columns))

    def update(self, range_m: Tensor, real: bool, names: Sequence[str] | None = None) -> None:
        """Add range images ``(B, H, W)``; of the named ones those with the lowest hashes stay."""
        self._keep(SIDES[not real], range_m.detach(), names)

    def clouds(self, images: Tensor) -> list[Tensor]:
        """Points ``(P, 3)`` of each range image."""
        projection, corner = self.protocol.projection, self.protocol.unprojection == "corner"
        return [points_of(image, projection, corner) for image in images]

    def matching(self) -> Matching:
        """Nearest generated scene of each real one."""
        grid = self.protocol.grid
        real, made = (
            [grid.cells(cloud) for cloud in self.clouds(self.kept(side)[1])] for side in SIDES
        )
        return minimum_matching(self.reference_cells or real, made, grid)

    def results(
        self, resampling: Resampling, matching: Matching | None = None
    ) -> list[MetricResult]:
        """MMD and CD of :meth:`matching`; intervals are over the real scans."""
        matching = matching or self.matching()
        distances = {"MMD": (matching.squared_normalised, "")}
        if not self.reference_cells:
            distances["CD 3D"] = self._chamfer(matching), "m2"
        kept, rows = len(self.kept("generated")[0]), []
        for name, (values, unit) in distances.items():
            mean, ends = values.mean().item(), resampling.of_mean(values)
            counts = (kept, len(values))
            row = self._row(name, mean, counts, interval=ends, unit=unit, note=OVER_REAL_SCANS)
            rows.append(row)
        return rows

    def _chamfer(self, matching: Matching) -> Tensor:
        nearest = matching.nearest[:_CHAMFER_PAIRS]
        real, made = (self.kept(side)[1] for side in SIDES)
        pairs = zip(
            self.clouds(real[: len(nearest)]),
            self.clouds(made[nearest.to(made.device)]),
            strict=True,
        )
        return torch.tensor([chamfer_squared(*pair) for pair in pairs], dtype=torch.float64)


class BaselineDistances(MinimumMatchingDistance):
    """JSD and MMD as R2DM, R2Flow and LiDM define them, of the range images that are kept.

    ==============  ======================================================================
    ``JSD points``  R2DM, R2Flow: of numbers of points, see :func:`point_histogram`
    ``MMD kernel``  R2DM, R2Flow: of the same histograms, see :func:`kernel_mmd`
    ``MMD 0.5 m``   LiDM: as ``MMD``, on cells of 0.5 m
    ==============  ======================================================================

    LiDM's JSD is that of :class:`BEVHistogramDistance`. Intervals of the first two are over the
    generated scenes, that of the third is over the real scans.
    """

    def results(
        self, resampling: Resampling, matching: Matching | None = None
    ) -> list[MetricResult]:
        """The three distances."""
        real, made = (self.clouds(self.kept(side)[1]) for side in SIDES)
        counts = (len(made), len(real))
        real_points, points = (
            torch.stack([point_histogram(cloud).flatten() for cloud in clouds]).double()
            for clouds in (real, made)
        )
        sums = real_points.sum(dim=0)
        real_shares, shares = (
            counted / counted.sum(dim=1, keepdim=True).clamp(min=1)
            for counted in (real_points, points)
        )
        own = gaussian_kernel(real_shares, real_shares).mean()
        across = gaussian_kernel(real_shares, shares).mean(dim=0)
        within = gaussian_kernel(shares, shares)

        def jsd(drawn: Tensor) -> float:
            return histogram_distance(sums, points[drawn].sum(dim=0)).jsd_distance

        def mmd(drawn: Tensor) -> float:
            between = across[drawn].mean()
            return (own + within[drawn][:, drawn].mean() - 2 * between).item()

        rows = []
        for name, distance in (("JSD points", jsd), ("MMD kernel", mmd)):
            ends = resampling.interval(distance, len(made))
            value = distance(torch.arange(len(made)))
            rows.append(self._row(name, value, counts, interval=ends))
        coarse = BEVGrid(cell_m=0.5)
        real_cells, cells = ([coarse.cells(cloud) for cloud in clouds] for clouds in (real, made))
        matched = minimum_matching(real_cells, cells, coarse).squared_normalised
        ends = resampling.of_mean(matched)
        mean, note = matched.mean().item(), OVER_REAL_SCANS
        return [*rows, self._row("MMD 0.5 m", mean, counts, interval=ends, note=note)]


def _rank(name: str) -> int:
    """Hash of a name as a signed number of 64 bits."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") - 2**63

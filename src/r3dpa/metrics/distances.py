"""Distances of two sets of scenes that need no network, as torchmetrics metrics.

Letters: B scenes, H x W range image, G groups that intervals leave out, R real scans, n scenes in
the states.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from typing import Any

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
from r3dpa.metrics.results import PUBLISHED_SCALES, MetricResult
from r3dpa.metrics.scene import Protocol

#: Width of the bins of ranges, metres.
RANGE_BIN_M = 0.1
SIDES = ("real", "generated")
#: Note of a mean over real scans, whose interval says nothing about other generated scenes.
OVER_REAL_SCANS = "interval over draws of the real scans, generated scenes fixed"

_CHAMFER_PAIRS = 200  # real scans that the 3D Chamfer distance is averaged over
_PRUNING_SLACK = 64  # scenes beyond twice the limit before a state is cut down to the limit


class SceneMetric(Metric):
    """Distance between generated scenes and real scans; base class of all metrics of scenes.

    Call ``update`` with batches of either side, then ``compute``; a batch alone has no distance, so
    that ``forward`` raises.

    States come in pairs, ``real_<name>`` and ``generated_<name>``. States that grow with the scenes
    hold at most ``limits[side]`` of them: those whose names have the lowest hashes. This subset is
    as good as a random one, but does not depend on order, batches or interruptions.
    """

    full_state_update = False
    #: Whether the real side comes from the official statistics file.
    has_official_reference = False
    real_count: Tensor
    generated_count: Tensor

    def __init__(self, max_real: int | None = None, max_generated: int | None = None) -> None:
        super().__init__()
        self.limits = {"real": max_real, "generated": max_generated}
        self._no_rows: dict[str, Tensor] = {}  # shape of the rows of the states that are lists
        for side in SIDES:
            self.add_state(f"{side}_count", torch.zeros((), dtype=torch.int64), "sum")

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """Return the distances as rows of a table, with intervals; of this process alone."""
        raise NotImplementedError

    def compute(self) -> dict[str, float]:
        """Return the values of :meth:`results` by name, over the scenes of all processes."""
        if not self.count("generated") or not self.has_reference:
            raise ValueError("update with real and with generated scenes: one side has none yet")
        values = {}
        for row in self.results(Resampling(num_resamples=0)):
            if row.value is None:
                raise ValueError(f"{row.name}: {row.note}")
            values[row.name] = row.value
        return values

    def reset(self) -> None:
        """Forget all scenes.

        Lists start with a part without rows: a process that sees no scene then sends the others
        the right shape and type.
        """
        super().reset()
        for name, no_rows in self._no_rows.items():
            setattr(self, name, [no_rows.to(self.device)])

    @property
    def has_reference(self) -> bool:
        """Whether the real side is known."""
        return self.has_official_reference or self.count("real") > 0

    def count(self, side: str) -> int:
        """Number of scenes seen."""
        return int(getattr(self, f"{side}_count"))

    def real_states(self) -> dict[str, Tensor]:
        """Return the states of the real scans by name, without the scans beyond the limit."""
        if self._no_rows:
            self._prune("real")
        states = {}
        for name, value in self.metric_state.items():
            if name.startswith("real_"):
                states[name] = dim_zero_cat(value) if isinstance(value, list) else value
        return states

    def load_real_state(self, name: str, value: Tensor) -> None:
        """Set one of :meth:`real_states`.

        Raises:
            ValueError: If the shape differs from the state's shape.
        """
        if name in self._no_rows:
            expected = (len(value), *self._no_rows[name].shape[1:])
        else:
            expected = tuple(getattr(self, name).shape)
        if tuple(value.shape) != expected:
            raise ValueError(f"{name} of shape {tuple(value.shape)}, expected {expected}")
        setattr(self, name, [value] if name in self._no_rows else value)

    def adopt_real(self, *others: SceneMetric) -> None:
        """Take over the real scans of other metrics of this kind, one after the other."""
        self.limits["real"] = None  # each of the others keeps as many as it should
        states = [other.real_states() for other in others]
        for name in states[0]:
            parts = [state[name] for state in states]
            if name in self._no_rows:
                setattr(self, name, parts)
            else:
                reduction: Any = self._reductions[name]
                setattr(self, name, reduction(torch.stack(parts)))

    def subset(self, side: str) -> tuple[Tensor, Tensor]:
        """Return places ``(n,)`` among all scenes, and values ``(n, ...)``, of those in the states.

        Places ascend.
        """
        self._prune(side)
        order = dim_zero_cat(getattr(self, f"{side}_order"))
        return order[:, 1], dim_zero_cat(getattr(self, f"{side}_values"))

    def lowest(self, side: str, limit: int) -> Tensor:
        """Return ascending indices of up to ``limit`` scenes whose names have the lowest hashes."""
        return self._hashes(side).argsort(stable=True)[:limit].sort().values

    def _hashes(self, side: str) -> Tensor:
        return dim_zero_cat(getattr(self, f"{side}_order"))[:, 0]

    def _add_subset_states(self, no_rows: Tensor) -> None:
        """Add the states of single scenes: their values, and their hashes and places."""
        for side in SIDES:
            self._no_rows[f"{side}_values"] = no_rows
            self._no_rows[f"{side}_order"] = torch.zeros(0, 2, dtype=torch.int64)
        for name in self._no_rows:
            self.add_state(name, [], dist_reduce_fx="cat")
        self.reset()

    def _append(self, side: str, values: Tensor, names: Sequence[str] | None) -> None:
        """Add ``(B, ...)`` values to the count and to the states of single scenes."""
        check_names(names, len(values))
        hashes = [0] * len(values) if names is None else [_hash_of(name) for name in names]
        count = getattr(self, f"{side}_count")
        places = count + torch.arange(len(values), device=self.device)
        order = torch.stack([torch.tensor(hashes).to(self.device), places], dim=1)
        getattr(self, f"{side}_order").append(order)
        getattr(self, f"{side}_values").append(values)
        count += len(values)
        limit = self.limits[side]
        if limit is not None:
            num_rows = sum(len(part) for part in getattr(self, f"{side}_order"))
            if num_rows > 2 * limit + _PRUNING_SLACK:
                self._prune(side)

    def _prune(self, side: str) -> None:
        limit, order = self.limits[side], dim_zero_cat(getattr(self, f"{side}_order"))
        if limit is None or len(order) <= limit:
            return
        values, chosen = dim_zero_cat(getattr(self, f"{side}_values")), self.lowest(side, limit)
        setattr(self, f"{side}_order", [order.index_select(0, chosen)])
        setattr(self, f"{side}_values", [values.index_select(0, chosen)])

    def _row(
        self,
        name: str,
        value: float | None,
        counts: tuple[int, int | None] | None = None,
        **fields: Any,
    ) -> MetricResult:
        """Row of a number over ``counts`` generated and real scenes, by default all."""
        generated, real = counts or (self.count("generated"), self.count("real") or None)
        scale = PUBLISHED_SCALES.get(name.removesuffix(" inf"), 0)
        return MetricResult(
            name, value, scale=scale, num_samples=generated, num_references=real, **fields
        )


def check_names(names: Sequence[str] | None, num_scenes: int) -> None:
    """Refuse names that are not one per scene with a ValueError."""
    if names is not None and len(names) != num_scenes:
        raise ValueError(f"{num_scenes} scenes need as many names, got {len(names)}")


class _Histograms(SceneMetric):
    """Sums of histograms of scenes; the generated ones in groups, which intervals leave out."""

    real_bins: Tensor
    generated_bins: Tensor

    def __init__(self, num_bins: int, num_groups: int, dtype: torch.dtype) -> None:
        super().__init__()
        self.num_bins, self.num_groups = num_bins, num_groups
        for side in SIDES:
            # One bin: torchmetrics keeps a copy of each empty state, here of up to 256 MB.
            self.add_state(f"{side}_bins", torch.zeros(1, dtype=dtype), "sum")
        self.reset()

    def reset(self) -> None:
        """Forget all scenes."""
        super().reset()
        self.real_bins = self.real_bins.new_zeros(self.num_bins)
        self.generated_bins = self.generated_bins.new_zeros(self.num_groups, self.num_bins)

    def _groups(self, real: bool, num: int) -> tuple[Tensor, Tensor]:
        """Count ``num`` scenes; histograms ``(groups, bins)``, and the group of each ``(num,)``."""
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

    Example:
        >>> from r3dpa.metrics.scene import DEFAULT
        >>> metric = BEVHistogramDistance(DEFAULT.grid)
        >>> cloud = torch.tensor([[10.0, 0.0, 0.0]])
        >>> metric.update([cloud], real=True)
        >>> metric.update([-cloud], real=False)
        >>> round(metric.compute()["JSD"], 3)  # nothing in common: the square root of ln 2
        0.833
    """

    def __init__(self, grid: BEVGrid, num_groups: int = 1) -> None:
        super().__init__(grid.side**2, num_groups, torch.int32)
        self.grid = grid

    def update(self, clouds: Sequence[Tensor], real: bool) -> None:
        """Add clouds ``(P, 3 or more)``.

        Raises:
            ValueError: If a cloud holds NaN or has no point on the grid; no cloud is added then.
        """
        side = "real" if real else "generated"
        cells = [self.grid.cells(cloud, f"{side} cloud {i}") for i, cloud in enumerate(clouds)]
        bins, groups = self._groups(real, len(cells))
        for group, occupied in zip(groups, cells, strict=True):
            bins[group, occupied.to(bins.device)] += 1

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """Return JSD and TV."""
        occupied = (self.real_bins > 0) | (self.generated_bins > 0).any(dim=0)
        real, groups = self.real_bins[occupied].double(), self.generated_bins[:, occupied].float()

        def jsd(counts: Tensor) -> float:
            return histogram_distance(real, counts).jsd_distance

        def total_variation(counts: Tensor) -> float:
            return histogram_distance(real, counts).total_variation

        note = "half of what the official code calls TV"
        return [
            self._resampled_row("JSD", jsd, resampling, groups),
            self._resampled_row("TV", total_variation, resampling, groups, note=note),
        ]


class RangeHistogramDistance(_Histograms):
    """Earth mover's distance (W1) of the ranges of all returns, metres, in bins of 0.1 m.

    Intervals leave out each of ``num_groups`` groups of generated scenes in turn.
    """

    num_broken: Tensor

    def __init__(self, range_max_m: float, num_groups: int = 1) -> None:
        super().__init__(math.ceil(range_max_m / RANGE_BIN_M), num_groups, torch.int64)
        self.add_state("num_broken", torch.zeros((), dtype=torch.int64), "sum")

    def update(self, range_m: Tensor, real: bool) -> None:
        """Add range images ``(B, H, W)`` in metres, not above 0 without a return.

        NaN and infinity are refused with the results: here it would wait for the GPU.
        """
        self.num_broken += (~(range_m < math.inf)).sum().to(self.num_broken.device)
        bins, groups = self._groups(real, len(range_m))
        width = bins.shape[1]
        index = (range_m.flatten(1) / RANGE_BIN_M).long().clamp(0, width - 1)
        index = index + width * groups[:, None].to(index.device)
        returns = (range_m > 0).flatten()
        bins.view(-1).index_add_(0, index.flatten().to(bins.device), returns.to(bins))

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """Return W1.

        Raises:
            ValueError: If a range is NaN or infinite.
        """
        _refuse_broken(int(self.num_broken))
        real, groups = self.real_bins.double().cpu().numpy(), self.generated_bins.double()

        def distance(counts: Tensor) -> float:
            return wasserstein_1(real, counts.double().cpu().numpy(), RANGE_BIN_M)

        return [self._resampled_row("W1 range", distance, resampling, groups, unit="m")]


class _ImageMetric(SceneMetric):
    """Range images of up to ``max_real`` and ``max_generated`` scenes, all by default."""

    def __init__(
        self, protocol: Protocol, max_real: int | None = None, max_generated: int | None = None
    ) -> None:
        super().__init__(max_real, max_generated)
        self.protocol = protocol
        self._add_subset_states(torch.zeros(0, protocol.sensor.beams, protocol.sensor.columns))

    def update(self, range_m: Tensor, real: bool, names: Sequence[str] | None = None) -> None:
        """Add range images ``(B, H, W)``; those whose names have the lowest hashes stay."""
        self._append("real" if real else "generated", range_m.detach(), names)

    def points_of_images(self, images: Tensor) -> list[Tensor]:
        """Return the points ``(P, 3)`` of each range image."""
        projection, corner = self.protocol.projection, self.protocol.unprojection == "corner"
        return [points_of(image, projection, corner) for image in images]

    def clouds(self, side: str) -> list[Tensor]:
        """Return the points ``(P, 3)`` of each scene in the states.

        Raises:
            ValueError: If a range is NaN or infinite.
        """
        images = self.subset(side)[1]
        _refuse_broken(int((~(images < math.inf)).sum()))
        return self.points_of_images(images)


class MinimumMatchingDistance(_ImageMetric):
    """Published "MMD" on occupied cells seen from above, and 3D Chamfer distance of its matches.

    Points beyond the grid do not count in MMD, by its definition. The 3D distance, in square
    metres, is the mean over up to 200 real scans, each with the nearest generated scene by cells:
    the scans whose names have the lowest hashes, so that all drives take part.

    Attributes:
        reference_cells: Occupied cells ``(n,)`` of real scans without images, as in the official
            statistics file; the 3D distance is then left out.
    """

    reference_cells: Sequence[Tensor] = ()

    def matching(self) -> Matching:
        """Find the nearest generated scene of each real one."""
        grid = self.protocol.grid
        generated = [grid.cells(cloud) for cloud in self.clouds("generated")]
        real = self.reference_cells or [grid.cells(cloud) for cloud in self.clouds("real")]
        return minimum_matching(real, generated, grid)

    def results(
        self, resampling: Resampling, matching: Matching | None = None
    ) -> list[MetricResult]:
        """Return MMD and CD of :meth:`matching`; intervals are over the real scans."""
        matching = matching or self.matching()
        num_generated = len(self.subset("generated")[0])

        def row(name: str, values: Tensor, unit: str = "") -> MetricResult:
            return self._row(
                name,
                values.mean().item(),
                (num_generated, len(values)),
                interval=resampling.of_mean(values),
                unit=unit,
                note=OVER_REAL_SCANS,
            )

        rows = [row("MMD", matching.squared_normalised)]
        if not self.reference_cells:
            rows.append(row("CD 3D", self._chamfer(matching), "m2"))
        return rows

    def _chamfer(self, matching: Matching) -> Tensor:
        """Chamfer distance ``(R,)`` of some real scans to their nearest generated scenes."""
        real, generated = self.subset("real")[1], self.subset("generated")[1]
        chosen = self.lowest("real", _CHAMFER_PAIRS)
        nearest = matching.nearest.to(chosen.device)[chosen]
        pairs = zip(
            self.points_of_images(real[chosen]),
            self.points_of_images(generated[nearest]),
            strict=True,
        )
        return torch.tensor([chamfer_squared(*pair) for pair in pairs], dtype=torch.float64)


class BaselineDistances(_ImageMetric):
    """JSD and MMD as R2DM, R2Flow and LiDM define them, of the range images in the states.

    ==============  ======================================================================
    ``JSD points``  R2DM, R2Flow: of numbers of points, see :func:`point_histogram`
    ``MMD kernel``  R2DM, R2Flow: of the same histograms, see :func:`kernel_mmd`
    ``MMD 0.5 m``   LiDM: as ``MMD``, on cells of 0.5 m
    ==============  ======================================================================

    LiDM's JSD is computed by :class:`BEVHistogramDistance`. Intervals of the first two are over the
    generated scenes, the interval of the third is over the real scans.
    """

    def results(self, resampling: Resampling) -> list[MetricResult]:
        """Return the three distances."""
        real, generated = self.clouds("real"), self.clouds("generated")
        counts = (len(generated), len(real))
        real_points, points = _point_histograms(real), _point_histograms(generated)
        real_sums = real_points.sum(dim=0)
        real_shares, shares = _shares(real_points), _shares(points)
        within_real = gaussian_kernel(real_shares, real_shares).mean()
        within = gaussian_kernel(shares, shares)
        across = gaussian_kernel(real_shares, shares).mean(dim=0)

        def jsd(drawn: Tensor) -> float:
            return histogram_distance(real_sums, points[drawn].sum(dim=0)).jsd_distance

        def mmd(drawn: Tensor) -> float:
            between = across[drawn].mean()
            return (within_real + within[drawn][:, drawn].mean() - 2 * between).item()

        rows = []
        for name, distance in (("JSD points", jsd), ("MMD kernel", mmd)):
            ends = resampling.interval(distance, len(generated))
            value = distance(torch.arange(len(generated)))
            rows.append(self._row(name, value, counts, interval=ends))
        grid = BEVGrid(cell_m=0.5)
        real_cells = [grid.cells(cloud) for cloud in real]
        cells = [grid.cells(cloud) for cloud in generated]
        nearest = minimum_matching(real_cells, cells, grid).squared_normalised
        ends = resampling.of_mean(nearest)
        mean, note = nearest.mean().item(), OVER_REAL_SCANS
        return [*rows, self._row("MMD 0.5 m", mean, counts, interval=ends, note=note)]


def _refuse_broken(num_broken: int) -> None:
    if num_broken:
        raise ValueError(
            f"the range images hold {num_broken} NaN or infinite values; repair the generator, or "
            "leave the scenes out and report it"
        )


def _point_histograms(clouds: Sequence[Tensor]) -> Tensor:
    """Points in each cell ``(N, cells)`` float64 of each cloud."""
    return torch.stack([point_histogram(cloud).flatten() for cloud in clouds]).double()


def _shares(histograms: Tensor) -> Tensor:
    return histograms / histograms.sum(dim=1, keepdim=True).clamp(min=1)


def _hash_of(name: str) -> int:
    """Hash of a name as a signed number of 64 bits."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") - 2**63

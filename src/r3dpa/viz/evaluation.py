"""Figures of an evaluation: where samples and real scans differ, and which scans match.

Letters: H beams, W columns, K bins, X cells along a side of a bird's-eye view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, SymLogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from r3dpa.geometry import LidarSensor
from r3dpa.viz.figures import strip_sheet
from r3dpa.viz.pictures import BACKGROUND, Array, as_numpy, bright_part, range_image_picture, save

Match = tuple[str, Array, Array]
"""Title, generated range image ``(H, W)`` in metres, range image of the nearest real scan."""

SAMPLES, REFERENCES = "tab:orange", "tab:blue"
MAX_CELLS = 250  # drawn along a side; finer histograms are summed over squares of cells
SHARE_MAP = bright_part("viridis", 0.1)
DECADES = 4  # of the logarithmic scales


def bev_histograms(samples: Array, references: Array, half_m: float = 50.0) -> Figure:
    """Draw samples and real scans seen from above, and the difference of their shares.

    Both share one logarithmic scale of four decades; the scale of the difference is linear near 0.

    Args:
        samples: ``(X, X)`` counts, not all 0; index 0 is at the lower limit of x and of y.
        references: ``(X, X)`` counts of real scans.
        half_m: Limit of x (forward) and of y (left) to both sides, in metres.
    """
    side = len(samples)
    step = math.ceil(side / MAX_CELLS)
    cell_m = step * 2 * half_m / side
    counts = [_sum_cells(as_numpy(cells, ("X", "X")), step) for cells in (samples, references)]
    drawn, real = (cells / cells.sum() for cells in counts)
    # The last cells may reach beyond the limits, where the axes end.
    end_m = len(drawn) * cell_m - half_m
    difference = drawn - real
    top = max(drawn.max(), real.max())
    share_scale = LogNorm(top / 10**DECADES, top, clip=True)
    largest = max(float(np.abs(difference).max()), top / 10**DECADES)
    linear_up_to = 10.0 ** np.ceil(np.log10(largest / 100))
    difference_scale = SymLogNorm(linear_up_to, vmin=-largest, vmax=largest)

    figure = Figure(figsize=(16.0, 5.4), layout="constrained")
    panels = figure.subplots(1, 3)
    empty = (drawn == 0) & (real == 0)
    for axes, values, hidden, colours, scale, title in (
        (panels[0], drawn, drawn == 0, SHARE_MAP, share_scale, "samples"),
        (panels[1], real, real == 0, SHARE_MAP, share_scale, "references"),
        (panels[2], difference, empty, "RdBu_r", difference_scale, "samples - references"),
    ):
        axes.set_facecolor(tuple(channel / 255 for channel in BACKGROUND))
        axes.imshow(
            np.ma.array(values, mask=hidden)[:, ::-1],
            cmap=colours,
            norm=scale,
            extent=(end_m, -half_m, -half_m, end_m),  # +y is to the left
            origin="lower",
            interpolation="nearest",
        )
        axes.set(xlim=(half_m, -half_m), ylim=(-half_m, half_m), xlabel="y, left (m)")
        axes.set_title(title, fontsize=11)
    panels[0].set_ylabel("x, forward (m)")
    label = f"share of all counts in a cell of {cell_m:.3g} x {cell_m:.3g} m"
    figure.colorbar(ScalarMappable(share_scale, SHARE_MAP), ax=panels[:2], label=label, shrink=0.8)
    difference_map = ScalarMappable(difference_scale, "RdBu_r")
    figure.colorbar(difference_map, ax=panels[2], label="difference of the shares", shrink=0.8)
    return figure


def range_histogram(edges_m: Array, samples: Array, references: Array, halves: Array) -> Figure:
    """Draw the returns per metre of range, and the ratio of samples to real scans.

    The band is the floor: the range of parts of the real scans.

    Args:
        edges_m: ``(K + 1,)`` ascending borders of the bins in metres.
        samples: ``(K,)`` counts, not all 0.
        references: ``(K,)`` counts of real scans.
        halves: ``(S, K)`` counts of parts of the real scans.
    """
    edges = as_numpy(edges_m, ("K + 1",))
    counts = [
        as_numpy(samples, ("K",)),
        as_numpy(references, ("K",)),
        *as_numpy(halves, ("S", "K")),
    ]
    drawn, real, *floor = (values / values.sum() / np.diff(edges) for values in counts)

    figure = Figure(figsize=(9.0, 6.2), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for axes, base in ((upper, np.ones_like(real)), (lower, real)):
        with np.errstate(divide="ignore", invalid="ignore"):  # bins without any real return
            lines = [np.where(base > 0, values / base, np.nan) for values in (real, drawn)]
            ends = [np.where(base > 0, values / base, np.nan) for values in floor]
        limits = [limit(ends, axis=0) for limit in (np.min, np.max)]
        axes.fill_between(
            edges,
            *(np.append(values, values[-1]) for values in limits),  # the last step has an end
            step="post",
            color=REFERENCES,
            alpha=0.3,
            linewidth=0,
            label="floor: parts of the references",
        )
        for values, colour, label in zip(
            lines, (REFERENCES, SAMPLES), ("references", "samples"), strict=True
        ):
            axes.stairs(values, edges, color=colour, linewidth=1.3, label=label, baseline=None)
        axes.set_yscale("log")
        axes.grid(alpha=0.3)
    upper.set_ylabel("share of the returns per metre")
    upper.legend(frameon=False)
    both = (drawn > 0) & (real > 0)
    largest_factor = np.exp(np.abs(np.log(drawn[both] / real[both])).max(initial=0.0))
    top = 10.0 ** np.clip(np.ceil(np.log10(largest_factor)), 0.5, 2)
    lower.set(ylim=(1 / top, top), xlim=edges[[0, -1]])
    lower.set(ylabel="ratio to the references", xlabel="range (m)")
    return figure


def matches_figure(best: Sequence[Match], worst: Sequence[Match], sensor: LidarSensor) -> Figure:
    """Draw the best and the worst matches, at least one: samples above the nearest real scans."""
    pictures = []
    for kind, matches in (("best", best), ("worst", worst)):
        for title, sample_m, reference_m in matches:
            pictures.append((f"{kind}: {title}: sample", range_image_picture(sample_m, sensor)))
            pictures.append(("nearest real scan", range_image_picture(reference_m, sensor)))
    return strip_sheet(pictures, sensor)[0]


def save_figures(
    folder: Path,
    *,
    cells: tuple[Array, Array],
    half_m: float,
    edges_m: Array,
    ranges: tuple[Array, Array],
    halves: Array,
    best: Sequence[Match],
    worst: Sequence[Match],
    sensor: LidarSensor,
) -> None:
    """Write ``birds_eye.png`` of ``cells``, ``ranges.png`` and ``matches.png`` to ``folder``."""
    save(bev_histograms(*cells, half_m), folder / "birds_eye.png")
    save(range_histogram(edges_m, *ranges, halves), folder / "ranges.png")
    save(matches_figure(best, worst, sensor), folder / "matches.png")


def _sum_cells(values: NDArray[np.float64], step: int) -> NDArray[np.float64]:
    """Sums over squares of cells; the last squares may be cut off by the border."""
    first = range(0, len(values), step)
    return np.add.reduceat(np.add.reduceat(values, first, axis=0), first, axis=1)

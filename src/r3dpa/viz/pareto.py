"""Accuracy against time: the Pareto picture, and errors against network evaluations."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

#: Safe for colour-blind readers (Okabe and Ito, then Tol), in the order of the solvers.
COLOURS = (
    *("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#7f7f7f", "#332288"),
    *("#882255", "#117733", "#999933", "#000000"),
)
_MARKERS = "osD^vPX<>hpd"
_LIMIT = "#aa3311"
_WRAP = 150  # characters of a sentence under the picture


class ParetoPoint(NamedTuple):
    """One way to sample: its label, the solver that gives its colour, and its numbers.

    ``seconds`` per scene and ``value`` (better when lower, in ``interval``) are above 0; open
    markers run in fp32.
    """

    label: str
    solver: str
    nfe: int
    seconds: float
    value: float
    interval: tuple[float, float]
    filled: bool = False


def pareto_figure(
    title: str,
    value_name: str,
    points: Sequence[ParetoPoint],
    front: Sequence[ParetoPoint],
    levels: Mapping[str, float],
    limits: Mapping[int, float],
    sentences: Sequence[str],
) -> Figure:
    """Error against seconds per scene, both logarithmic, with the front as a line.

    Args:
        title: Above the picture.
        value_name: Label of the vertical axis, with unit.
        points: All ways to sample.
        front: Points of the Pareto front, from the fastest on.
        levels: Horizontal lines by name, such as the error of bf16; at most three.
        limits: Seconds that NFE evaluations take at the peak of the device, by NFE.
        sentences: Under the picture: one for each step along the front.

    Raises:
        ValueError: If there is no point, or a time or value is not above 0.
    """
    styles = _styles(points)
    lines = [
        line
        for sentence in sentences
        for line in textwrap.wrap(sentence, _WRAP, subsequent_indent="    ")
    ]
    below = 0.19 * (len(lines) + 1)
    figure = Figure(figsize=(12.0, 6.8 + below), dpi=110, layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(6.8, below))[:, 0]
    axes = upper.subplots()
    for point in points:
        colour, marker = styles[point.solver]
        low, high = point.interval
        axes.errorbar(
            point.seconds,
            point.value,
            yerr=[[max(point.value - low, 0)], [max(high - point.value, 0)]],
            color=colour,
            marker=marker,
            markerfacecolor=colour if point.filled else "white",
            elinewidth=0.8,
            linestyle="none",
            zorder=3,
        )
    axes.plot([p.seconds for p in front], [p.value for p in front], color="#222222", lw=1.4)
    for point in front:
        place = (point.seconds, point.value)
        axes.annotate(point.label, place, (7, 7), textcoords="offset points", fontsize=8, zorder=4)
    entries = [
        Line2D([], [], color=colour, marker=marker, linestyle="none", label=solver)
        for solver, (colour, marker) in styles.items()
    ]
    entries.append(Line2D([], [], color="#222222", label="Pareto front (95 %)"))
    for style, (name, value) in zip(("--", "-.", ":"), levels.items(), strict=False):
        line = axes.axhline(value, color="#555555", linewidth=1.0, linestyle=style, zorder=1)
        line.set_label(f"{name}: {value:.3g}")
        entries.append(line)
    for number, (nfe, seconds) in enumerate(sorted(limits.items())):
        axes.axvline(seconds, ymax=0.035, color=_LIMIT, linewidth=1.4)
        axes.text(
            seconds,
            0.042 + 0.03 * (number % 2),  # neighbours in two rows
            f"{nfe}",
            transform=axes.get_xaxis_transform(),
            ha="center",
            fontsize=7.5,
            color=_LIMIT,
        )
    if limits:
        text = "least time of so many NFE"
        entries.append(Line2D([], [], color=_LIMIT, marker="|", linestyle="none", label=text))
    entries.append(Line2D([], [], linestyle="none", label="open: fp32; filled: bf16"))
    axes.legend(handles=entries, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    values = [*(p.value for p in points), *levels.values()]
    axes.set(xscale="log", yscale="log", xlabel="seconds per scene", ylabel=value_name)
    axes.set_ylim(min(values) / (max(values) / min(values)) ** 0.13 / 1.1, None)
    axes.grid(alpha=0.25, which="major")
    upper.suptitle(title, fontsize=12, x=0.02, ha="left")
    text = "\n".join(["Error and time along the front", *lines])
    lower.text(0.02, 0.98, text, ha="left", va="top", fontsize=8.5, parse_math=False)
    return figure


def discretisation_figure(
    panels: Mapping[str, Sequence[ParetoPoint]], references: Mapping[str, float]
) -> Figure:
    """Error of the solvers against network evaluations, with slopes of order 1 and 2.

    Args:
        panels: Points by title of the panel; their ``value`` is the error.
        references: Error of the converged reference by title; errors below ten times of it cannot
            be resolved.
    """
    figure = Figure(figsize=(6.6 * len(panels) + 0.4, 5.6), dpi=110, layout="constrained")
    for axes, (title, points) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        for solver, (colour, marker) in _styles(points).items():
            own = sorted((p for p in points if p.solver == solver), key=lambda p: p.nfe)
            counts, errors = [p.nfe for p in own], [p.value for p in own]
            axes.plot(counts, errors, color=colour, marker=marker, ms=5, lw=1.2, label=solver)
        _draw_orders(axes, points, 10 * references.get(title, 0.0))
        axes.set_title(title, fontsize=11)
        axes.legend(fontsize=7.5, frameon=False)
    return figure


def _draw_orders(axes: Axes, points: Sequence[ParetoPoint], unsure: float) -> None:
    """Guides, the range that the reference cannot resolve, and the scales."""
    counts = np.array(sorted({point.nfe for point in points}), dtype=float)
    lowest, highest = (f(point.value for point in points) for f in (min, max))
    for order, style in ((1, ":"), (2, "--")):
        guide = 1.3 * highest * (counts / counts[0]) ** -order
        axes.plot(counts, guide, color="#888888", linestyle=style, label=f"order {order}")
    if unsure > 0:
        label = "not converged: reference unsure"
        axes.axhspan(1e-300, unsure, color="#cc3311", alpha=0.12, linewidth=0, label=label)
    axes.set(xscale="log", yscale="log")
    axes.set_ylim(min(lowest, max(unsure, lowest / 3)) / 1.6, 2.2 * highest)
    axes.set_xlabel("network evaluations per sample (NFE)")
    axes.set_ylabel("RMSE of the latents from the converged solution")
    axes.xaxis.set_major_locator(LogLocator(2))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.grid(alpha=0.25, which="major")


def _styles(points: Sequence[ParetoPoint]) -> dict[str, tuple[str, str]]:
    """Colour and marker of each solver, in order of appearance."""
    if not points:
        raise ValueError("no point to draw; give at least one way with a time and a value")
    for point in points:
        if not (point.seconds > 0 and point.value > 0):
            raise ValueError(
                f"{point.label}: {point.seconds} s and {point.value}; a logarithmic picture needs "
                "numbers above 0"
            )
    solvers = dict.fromkeys(point.solver for point in points)
    return {
        solver: (COLOURS[place % len(COLOURS)], _MARKERS[place % len(_MARKERS)])
        for place, solver in enumerate(solvers)
    }

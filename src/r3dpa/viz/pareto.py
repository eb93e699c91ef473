"""Accuracy against time: the Pareto picture, as a figure and as a page, and errors against NFE."""

from __future__ import annotations

import html
import json
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

__all__ = ["ParetoPlot", "ParetoPoint", "discretisation_figure", "pareto_figure", "pareto_page"]

#: Safe for colour-blind readers (Okabe and Ito, then Tol), in the order of the solvers.
COLOURS = (
    *("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#7f7f7f", "#332288"),
    *("#882255", "#117733", "#999933", "#000000"),
)
_MARKERS = "osD^vPX<>hpd"
_NOT_YET = "1-4 steps, distilled: not trained yet"
_LINE_STYLES: tuple[Any, ...] = ("--", "-.", ":", (0, (5, 1, 1, 1)), (0, (1, 3)))
_WRAP = 150  # characters of a sentence under the picture


@dataclass(frozen=True)
class ParetoPoint:
    """One row of the benchmark in the picture.

    Args:
        label: Shown when pointed at.
        solver: Gives colour and marker.
        nfe: Network evaluations.
        seconds: Per scene, above 0.
        value: What is better when lower, above 0.
        low: Lower end of its interval; the value where unknown.
        high: Upper end.
        filled: Open where the networks run in fp32.
        details: What else a reader may ask, by name.
    """

    label: str
    solver: str
    nfe: int
    seconds: float
    value: float
    low: float
    high: float
    filled: bool = False
    details: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ParetoPlot:
    """Everything that one picture shows.

    Args:
        title: Above it.
        value_name: Label of the vertical axis, with unit.
        points: Rows.
        front: Indices of the points that the line joins, from the fastest on.
        levels: Horizontal lines by name, such as floor, converged model and published value.
        limits: Seconds that NFE evaluations take at the peak of the device, by NFE.
        peak_flop_s: Of the device; tells the second axis.
        sentences: Under the picture: what each further second buys.
        line: What the line is.
    """

    title: str
    value_name: str
    points: tuple[ParetoPoint, ...]
    front: tuple[int, ...]
    levels: Mapping[str, float]
    limits: Mapping[int, float]
    peak_flop_s: float
    sentences: tuple[str, ...]
    line: str = "Pareto front (95 %)"


def solver_colours(points: Sequence[ParetoPoint]) -> dict[str, str]:
    """Colour ``#rrggbb`` of each solver, in the order in which they come."""
    solvers = list(dict.fromkeys(point.solver for point in points))
    return {solver: COLOURS[place % len(COLOURS)] for place, solver in enumerate(solvers)}


def pareto_figure(plot: ParetoPlot) -> Figure:
    """Error or distance against seconds per scene, both logarithmic, with the front as a line.

    Args:
        plot: What is shown.

    Returns:
        Figure, 12 inches wide; its height follows from the sentences.

    Raises:
        ValueError: If there is no point, or a time or value is not above 0.
    """
    _check(plot.points)
    lines = [
        line
        for sentence in plot.sentences
        for line in textwrap.wrap(sentence, _WRAP, subsequent_indent="    ")
    ]
    below = 0.19 * (len(lines) + 1)
    figure = Figure(figsize=(12.0, 6.8 + below), dpi=110, layout="constrained")
    parts = figure.subfigures(2, 1, squeeze=False, height_ratios=(6.8, below))
    upper, lower = parts[0, 0], parts[1, 0]
    axes = upper.subplots()
    colours = solver_colours(plot.points)
    for place, (solver, colour) in enumerate(colours.items()):
        own = [point for point in plot.points if point.solver == solver]
        for point in own:
            axes.errorbar(
                point.seconds,
                point.value,
                yerr=[[max(point.value - point.low, 0)], [max(point.high - point.value, 0)]],
                color=colour,
                marker=_MARKERS[place % len(_MARKERS)],
                markersize=6,
                markerfacecolor=colour if point.filled else "white",
                elinewidth=0.8,
                linestyle="none",
                zorder=3,
            )
    chain = [plot.points[index] for index in plot.front]
    axes.plot(
        [p.seconds for p in chain],
        [p.value for p in chain],
        color="#222222",
        linewidth=1.4,
        zorder=2,
    )
    _name_front(axes, chain)
    for style, value in zip(_LINE_STYLES, plot.levels.values(), strict=False):
        axes.axhline(value, color="#555555", linewidth=1.0, linestyle=style, zorder=1)
    axes.set(xscale="log", yscale="log")
    _limits(axes, plot)
    axes.set_xlabel("seconds per scene")
    axes.set_ylabel(plot.value_name)
    upper.suptitle(plot.title, fontsize=12, x=0.02, ha="left")
    axes.grid(alpha=0.25, which="major")
    second = axes.secondary_xaxis(
        "top",
        functions=(lambda s: s * plot.peak_flop_s / 1e12, lambda t: t * 1e12 / plot.peak_flop_s),
    )
    second.set_xlabel(f"TFLOP that the device could do meanwhile ({plot.peak_flop_s:.3g} FLOP/s)")
    for axis in (axes.xaxis, axes.yaxis, second.xaxis):
        axis.set_minor_formatter(NullFormatter())
    _legend(axes, colours, plot)
    lower.text(
        0.02,
        0.98,
        "\n".join(["What each further second buys", *lines]),
        ha="left",
        va="top",
        fontsize=8.5,
        parse_math=False,
    )
    return figure


def _check(points: Sequence[ParetoPoint]) -> None:
    if not points:
        raise ValueError("no point to draw; give at least one row with a time and a value")
    for point in points:
        if not (point.seconds > 0 and point.value > 0):
            raise ValueError(
                f"{point.label}: {point.seconds} s and {point.value}; a logarithmic picture needs "
                "numbers above 0"
            )


def _name_front(axes: Axes, chain: Sequence[ParetoPoint]) -> None:
    for point in chain:
        axes.annotate(
            point.label,
            (point.seconds, point.value),
            xytext=(7, 7),
            textcoords="offset points",
            fontsize=8,
            zorder=4,
        )


def _limits(axes: Axes, plot: ParetoPlot) -> None:
    """Short vertical ticks at the least time of each NFE, and room for them below all points."""
    seconds = [point.seconds for point in plot.points] + list(plot.limits.values())
    values = [p.value for p in plot.points] + [v for v in plot.levels.values() if v > 0]
    low, high = min(values), max(values)
    axes.set_ylim(low / (high / low) ** 0.13 / 1.1, high * (high / low) ** 0.05 * 1.1)
    axes.set_xlim(min(seconds) / 1.3, max(seconds) * 1.6)
    width = np.log(max(seconds) * 2.1 / min(seconds))
    last = -np.inf
    raised = False
    for nfe, limit in sorted(plot.limits.items()):
        axes.axvline(limit, ymax=0.035, color="#aa3311", linewidth=1.4)
        # Labels nearer than their width take turns in two rows.
        raised = not raised if np.log(limit) - last < 0.03 * width else False
        last = np.log(limit)
        axes.text(
            limit,
            0.072 if raised else 0.042,
            f"{nfe}",
            transform=axes.get_xaxis_transform(),
            ha="center",
            fontsize=7.5,
            color="#aa3311",
        )


def _legend(axes: Axes, colours: Mapping[str, str], plot: ParetoPlot) -> None:
    entries = [
        Line2D([], [], color=colour, marker=_MARKERS[place % len(_MARKERS)], linestyle="none",
               markerfacecolor="white" if not _any_filled(plot, solver) else colour, label=solver)
        for place, (solver, colour) in enumerate(colours.items())
    ]  # fmt: skip
    entries.append(Line2D([], [], color="#222222", label=plot.line))
    for style, (name, value) in zip(_LINE_STYLES, plot.levels.items(), strict=False):
        entries.append(Line2D([], [], color="#555555", linestyle=style, label=_level(name, value)))
    if plot.limits:
        entries.append(
            Line2D([], [], color="#aa3311", marker="|", markersize=9, linestyle="none",
                   label="least time of so many NFE")
        )  # fmt: skip
    entries.append(
        Line2D([], [], color="#bbbbbb", marker="*", markersize=10, markerfacecolor="white",
               linestyle="none", label=_NOT_YET)
    )  # fmt: skip
    entries.append(
        Line2D([], [], color="black", marker="o", markerfacecolor="white", linestyle="none",
               label="open: fp32; filled: bf16")
    )  # fmt: skip
    axes.legend(
        handles=entries, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=8.5
    )


def _level(name: str, value: float) -> str:
    return f"{name}: {value:.3g}"


def _any_filled(plot: ParetoPlot, solver: str) -> bool:
    return any(point.filled for point in plot.points if point.solver == solver)


def discretisation_figure(
    panels: Mapping[str, Sequence[ParetoPoint]], references: Mapping[str, float]
) -> Figure:
    """Error of the solvers against network evaluations, with slopes of order 1 and 2.

    Args:
        panels: Points by title of the panel; their ``value`` is the error.
        references: Error of the converged reference by title: what lies below ten times of it
            cannot be told.

    Returns:
        Figure with a panel each side by side.

    Raises:
        ValueError: As :func:`pareto_figure`.
    """
    figure = Figure(figsize=(6.6 * len(panels) + 0.4, 5.6), dpi=110, layout="constrained")
    for axes, (title, points) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        _check(points)
        for place, (solver, colour) in enumerate(solver_colours(points).items()):
            own = sorted((p for p in points if p.solver == solver), key=lambda p: p.nfe)
            axes.plot(
                [p.nfe for p in own],
                [p.value for p in own],
                color=colour,
                marker=_MARKERS[place % len(_MARKERS)],
                markersize=5,
                linewidth=1.2,
                label=solver,
            )
        counts = np.array(sorted({point.nfe for point in points}), dtype=float)
        highest = max(point.value for point in points)
        for order, style in ((1, ":"), (2, "--")):
            guide = 1.3 * highest * (counts / counts[0]) ** -order
            axes.plot(counts, guide, color="#888888", linestyle=style, label=f"order {order}")
        lowest = min(point.value for point in points)
        if (unsure := 10 * references.get(title, 0.0)) > 0:
            axes.axhspan(
                1e-300, unsure, color="#cc3311", alpha=0.12, linewidth=0,
                label="not converged: reference unsure",
            )  # fmt: skip
        axes.set(xscale="log", yscale="log")
        axes.set_ylim(min(lowest, max(unsure, lowest / 3)) / 1.6, 2.2 * highest)
        axes.set_xlabel("network evaluations per sample (NFE)")
        axes.set_ylabel("RMSE of the latents from the converged solution")
        axes.set_title(title, fontsize=11)
        axes.xaxis.set_major_locator(LogLocator(base=2, numticks=12))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize=8, loc="lower left")
    return figure


def pareto_page(plots: Sequence[ParetoPlot]) -> str:
    """The same pictures as one HTML page that loads nothing: pointing tells all about a row.

    Args:
        plots: Pictures to choose from, at least one.

    Raises:
        ValueError: As :func:`pareto_figure`, or if there is no picture.
    """
    if not plots:
        raise ValueError("a page needs at least one picture")
    content = []
    for plot in plots:
        _check(plot.points)
        content.append(asdict(plot) | {"colours": solver_colours(plot.points)})
    data: dict[str, Any] = {"plots": content, "not_yet": _NOT_YET}
    # JSON may hold "<" within strings only, where its escape means the same: no name ends a script.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    parts = {"title": html.escape(plots[0].title), "data": text}
    template = (files("r3dpa.viz") / "pareto.html").read_text("utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)

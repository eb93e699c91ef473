"""Figures of numbers: logged quantities of a run, accuracy against time, beams of a sensor."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from lidarsim.sensors.estimation import SensorEstimate

Series = tuple[Sequence[float], Sequence[float]]

#: Safe for colour-blind readers (Okabe and Ito, then Tol), in the order of the solvers.
COLOURS = (
    "#0072b2",
    "#e69f00",
    "#009e73",
    "#cc79a7",
    "#56b4e9",
    "#d55e00",
    "#7f7f7f",
    "#332288",
    "#882255",
    "#117733",
    "#999933",
    "#000000",
)
_MARKERS = "osD^vPX<>hpd"


def loss_curves(curves: Mapping[str, Series]) -> Figure:
    """One panel per logged quantity: every value, faint, and a centred running mean.

    The title of a panel gives the first and the last value. The axis is logarithmic where all
    values are positive and differ. Quantities with a single value are no curve and left out.

    Args:
        curves: Steps and values by name, at least one of two values, as from :func:`read_metrics`.
    """
    series = {name: pair for name, pair in curves.items() if len(pair[1]) > 1}
    columns = min(4, len(series))
    rows = math.ceil(len(series) / columns)
    figure = Figure(figsize=(3.6 * columns + 0.2, 2.6 * rows + 0.2), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (name, (steps, values)) in zip(panels, series.items(), strict=False):
        _draw_curve(axes, name, np.asarray(steps, float), np.asarray(values, float))
    for axes in panels[len(series) :]:
        axes.set_visible(False)
    return figure


def read_metrics(path: str | Path) -> dict[str, Series]:
    """Quantities of a ``metrics.csv`` of Lightning's ``CSVLogger``: name -> (steps, values).

    Blank cells are left out, and so is a last line without an end (of a run that was stopped while
    writing). ``step`` and ``epoch`` are no quantities.

    Raises:
        ValueError: If there is no column ``step``.
    """
    with Path(path).open(newline="", encoding="utf-8") as file:
        table = csv.DictReader([line for line in file if line.endswith("\n")], restval="")
    names = [name for name in table.fieldnames or () if name not in ("step", "epoch")]
    if "step" not in (table.fieldnames or ()):
        raise ValueError(
            f"{path} has no column 'step' but {names}; give metrics.csv of a CSVLogger"
        )
    series: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in names}
    for row in table:
        for name in names:
            if row[name].strip():
                series[name][0].append(float(row["step"]))
                series[name][1].append(float(row[name]))
    return {name: pair for name, pair in series.items() if pair[0]}


def read_curves(run: Path) -> dict[str, Series]:
    """Quantities of a training by step, from the ``version_*/metrics.csv`` of each start.

    The values of earlier starts end where a later one begins, which did not go on from them. Files
    of ``r3dpa validate`` and ``test``, which have no training losses, are left out.
    """
    curves: dict[str, dict[float, float]] = {}
    paths = run.glob("version_*/metrics.csv")
    for path in sorted(paths, key=lambda path: path.stat().st_mtime):
        series = read_metrics(path)
        if series and all(name.startswith(("val/", "test/")) for name in series):
            continue
        first = min((min(steps) for steps, _ in series.values()), default=math.inf)
        for name, curve in curves.items():
            curves[name] = {step: value for step, value in curve.items() if step < first}
        for name, (steps, values) in series.items():
            curves.setdefault(name, {}).update(zip(steps, values, strict=True))
    ordered = {name: sorted(curve.items()) for name, curve in curves.items() if curve}
    return {name: ([s for s, _ in c], [v for _, v in c]) for name, c in ordered.items()}


def _draw_curve(
    axes: Axes, name: str, steps: NDArray[np.float64], values: NDArray[np.float64]
) -> None:
    axes.plot(steps, values, color="tab:blue", alpha=0.3, linewidth=0.8)
    axes.plot(
        steps,
        _running_mean(values, width=max(1, len(values) // 20)),
        color="tab:blue",
        linewidth=1.5,
        marker="o" if len(values) <= 20 else None,
        markersize=3,
    )
    axes.set_title(f"{name}\n{values[0]:.4g} → {values[-1]:.4g}", fontsize=10)
    axes.tick_params(labelsize=8)
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.set_xlabel("step", fontsize=8)
    axes.grid(alpha=0.3)
    finite = values[np.isfinite(values)]
    if len(finite) and 0 < finite.min() < finite.max():
        axes.set_yscale("log")
        spread = finite.max() / finite.min()
        if spread < 100:  # powers of ten alone would leave the axis with one label or none
            axes.yaxis.set_major_locator(
                MaxNLocator(4) if spread < 5 else LogLocator(subs=(1.0, 2.0, 5.0))
            )
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}"))
        axes.yaxis.set_minor_locator(NullLocator())


def _running_mean(values: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Mean of up to ``width`` finite values around each; NaN where a value is NaN."""
    finite = np.isfinite(values)
    window = np.ones(width)
    total = np.convolve(np.where(finite, values, 0.0), window, mode="same")
    count = np.convolve(finite.astype(np.float64), window, mode="same")
    return np.where(finite, total / np.maximum(count, 1.0), np.nan)


class ParetoPoint(NamedTuple):
    """One way to sample: seconds per scene and error, both above 0; open markers run in fp32."""

    label: str
    solver: str  #: gives the colour
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
) -> Figure:
    """Error against seconds per scene, both logarithmic, with the front as a line.

    Args:
        title: Above the picture.
        value_name: Label of the vertical axis, with unit.
        points: All ways to sample, at least one.
        front: Points of the Pareto front, from the fastest on.
        levels: Horizontal lines by name, such as the error of bf16; at most three.
    """
    looks = cycle(zip(COLOURS, _MARKERS, strict=True))
    styles = dict(zip(dict.fromkeys(point.solver for point in points), looks, strict=False))
    figure = Figure(figsize=(12.0, 6.8), dpi=110, layout="constrained")
    axes = figure.subplots()
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
    entries.append(Line2D([], [], color="#222222", label="Pareto front"))
    for style, (name, value) in zip(("--", "-.", ":"), levels.items(), strict=False):
        line = axes.axhline(value, color="#555555", linewidth=1.0, linestyle=style, zorder=1)
        line.set_label(f"{name}: {value:.3g}")
        entries.append(line)
    entries.append(Line2D([], [], linestyle="none", label="open: fp32; filled: bf16"))
    axes.legend(handles=entries, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    values = [*(p.value for p in points), *levels.values()]
    axes.set(xscale="log", yscale="log", xlabel="seconds per scene", ylabel=value_name)
    axes.set_ylim(min(values) / (max(values) / min(values)) ** 0.13 / 1.1, None)
    axes.grid(alpha=0.25, which="major")
    figure.suptitle(title, fontsize=12, x=0.02, ha="left")
    return figure


def beam_residuals(estimate: SensorEstimate) -> Figure:
    """Draw the residuals of each beam, its optical centre and its azimuth offset."""
    lasers = estimate.sensor.lasers
    inclination_deg = np.degrees(lasers.inclination_rad)
    low, lower, middle, upper, high = estimate.residual_deg.T
    figure = Figure(figsize=(10, 6), layout="constrained")
    residuals, heights, offsets = figure.subplots(1, 3, sharey=True, width_ratios=(2, 1, 1))
    residuals.hlines(inclination_deg, low, high, color=COLOURS[4], linewidth=1, label="5 to 95 %")
    residuals.hlines(
        inclination_deg, lower, upper, color=COLOURS[0], linewidth=3, label="25 to 75 %"
    )
    residuals.plot(middle, inclination_deg, "|", color=COLOURS[11], label="median")
    residuals.set(xlabel="residual, degrees", ylabel="inclination of the beam, degrees")
    residuals.legend(loc="best", fontsize="small")
    heights.plot(lasers.height_m, inclination_deg, ".", color=COLOURS[5])
    heights.set(xlabel="optical centre, m")
    offsets.plot(np.degrees(lasers.azimuth_offset_rad), inclination_deg, ".", color=COLOURS[2])
    offsets.set(xlabel="azimuth offset, degrees")
    figure.suptitle(
        f"{len(inclination_deg)} beams by {estimate.beams_by}, {estimate.sensor.shots} columns, "
        f"{estimate.num_scans} scans"
    )
    return figure

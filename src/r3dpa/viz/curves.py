"""Logged quantities of a training run as curves."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

Series = tuple[Sequence[float], Sequence[float]]


def loss_curves(curves: str | Path | Mapping[str, Series]) -> Figure:
    """One panel per logged quantity: every value, faint, and a centred running mean.

    The title of a panel gives the first and the last value. The axis is logarithmic where all
    values are positive and differ. Quantities with a single value are no curve and left out.

    Args:
        curves: ``metrics.csv`` of Lightning's ``CSVLogger``, or name -> (steps, values).

    Raises:
        ValueError: If there is nothing to draw or the file is not such a table.
    """
    series = curves if isinstance(curves, Mapping) else read_metrics(curves)
    series = {name: pair for name, pair in series.items() if len(pair[1]) > 1}
    if not series:
        raise ValueError("no quantity with two values or more; train with a CSVLogger for longer")
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
        ValueError: If there is no column ``step``, or a cell is not a number.
    """
    with Path(path).open(newline="", encoding="utf-8") as file:
        lines = [line for line in file if line.endswith("\n")]
    rows = csv.DictReader(lines, restval="")
    if "step" not in (rows.fieldnames or ()):
        raise ValueError(
            f"{path} has no column 'step' but {rows.fieldnames}; give metrics.csv of a CSVLogger"
        )
    series: dict[str, tuple[list[float], list[float]]] = {}
    for row in rows:
        for name in rows.fieldnames or ():
            if name in ("step", "epoch") or not row[name].strip():
                continue
            try:
                step, value = float(row["step"]), float(row[name])
            except ValueError as error:
                raise ValueError(
                    f"{path}, line {rows.line_num}, column {name!r}: {error}"
                ) from None
            steps, values = series.setdefault(name, ([], []))
            steps.append(step)
            values.append(value)
    return {name: series[name] for name in rows.fieldnames or () if name in series}


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

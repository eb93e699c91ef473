"""Curves of a run, and accuracy against time: lines, labels and scales are where they belong."""

import os

import numpy as np
import pytest

from r3dpa import viz

RAGGED = (
    "epoch,step,train/kl,train/flow,val/error,unused\n"
    "0,0,4.0,,,\n"
    "0,0,,-1.5\n"
    "0,50,2.0,nan,,\n"
    "1,100,,,0.25,\n"
    "1,150,1.0"
)


def test_read_metrics_skips_blanks_missing_cells_and_the_unfinished_line(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text(RAGGED)
    series = viz.read_metrics(path)
    assert list(series) == ["train/kl", "train/flow", "val/error"]
    assert series["train/kl"] == ([0, 50], [4, 2])
    assert series["val/error"] == ([100], [0.25])
    assert series["train/flow"][0] == [0, 50]
    assert series["train/flow"][1] == pytest.approx([-1.5, float("nan")], nan_ok=True)
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="no column 'step'"):
        viz.read_metrics(path)


def test_files_without_a_training_are_no_curves(tmp_path):
    for number, column in enumerate(("train/flow", "val/error", "test/FWID")):
        (tmp_path / f"version_{number}").mkdir()
        (tmp_path / f"version_{number}/metrics.csv").write_text(f"step,{column}\n0,1.0\n")
    assert list(viz.curves.read_curves(tmp_path)) == ["train/flow"]


def test_values_of_an_abandoned_start_end_where_the_next_one_begins(tmp_path):
    """The first start reached step 30, the second went on from a checkpoint of step 10."""
    starts = ("10,1.0,\n20,9.0,\n25,,8.0\n30,9.0,\n", "15,0.5,\n20,0.25,\n")
    for number, rows in enumerate(starts):
        path = tmp_path / f"version_{number}/metrics.csv"
        path.parent.mkdir()
        path.write_text(f"step,train/flow,val/error\n{rows}")
        os.utime(path, (number, number))
    assert viz.curves.read_curves(tmp_path) == {"train/flow": ([10, 15, 20], [1, 0.5, 0.25])}


def test_loss_curves_draws_a_panel_per_quantity_and_logs_where_positive(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text(RAGGED)
    figure = viz.loss_curves(viz.read_metrics(path))
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title().split("\n")[0] for axes in panels] == ["train/kl", "train/flow"]
    assert panels[0].get_title().endswith("4 → 2")
    assert [axes.get_yscale() for axes in panels] == ["log", "linear"]
    figure.draw_without_rendering()  # with NaN; a single value is no curve


def test_loss_curves_mean_is_centred_and_keeps_gaps():
    values = np.arange(100.0)  # a centred mean does not move a straight line
    values[40] = np.nan
    figure = viz.loss_curves({"loss": (np.arange(100), values)})
    raw, mean = (line.get_ydata() for line in figure.axes[0].lines)
    assert raw == pytest.approx(values, nan_ok=True)
    assert np.isnan(mean[40])
    assert mean[10:30] == pytest.approx(values[10:30])
    assert mean[60:90] == pytest.approx(values[60:90])


def test_pareto_picture_has_its_front_and_labels():
    points = [
        viz.ParetoPoint("euler 4", "euler", 0.1, 0.5, (0.4, 0.6)),
        viz.ParetoPoint("euler 8", "euler", 0.2, 0.25, (0.2, 0.3)),
        viz.ParetoPoint("ab2 8", "ab2", 0.21, 0.05, (0.04, 0.06), filled=True),
    ]
    found = viz.pareto_figure("title", "RMSE", points, points[::2], {"bf16": 0.01})
    axes = found.axes[0]
    lines = [line.get_xydata().tolist() for line in axes.lines]
    assert [[0.1, 0.5], [0.21, 0.05]] in lines  # the front
    assert {text.get_text() for text in axes.texts} == {"euler 4", "ab2 8"}
    legend = {text.get_text() for text in axes.get_legend().get_texts()}
    assert {"euler", "ab2", "bf16: 0.01"} <= legend
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert axes.get_ylim()[0] < 0.01
    faces = [line.get_markerfacecolor() for line in axes.lines if line.get_marker() in "os"]
    assert faces.count("white") == 2  # in fp32

"""Accuracy against time: points, front, limits and slopes are where they belong."""

from __future__ import annotations

import pytest

from r3dpa import viz

FAST = viz.ParetoPoint("euler 4", "euler", 4, 0.1, 0.5, (0.4, 0.6))
POINTS = [
    FAST,
    viz.ParetoPoint("euler 8", "euler", 8, 0.2, 0.25, (0.2, 0.3)),
    viz.ParetoPoint("ab2 8", "ab2", 8, 0.21, 0.05, (0.04, 0.06), filled=True),
]


def figure(**changes):
    given = {
        "title": "title",
        "value_name": "RMSE",
        "points": POINTS,
        "front": [POINTS[0], POINTS[2]],
        "levels": {"bf16": 0.01},
        "limits": {4: 0.05, 8: 0.09},
        "sentences": ["From $0.1 to 0.21 s"],
    }
    return viz.pareto_figure(**given | changes)


def test_line_labels_and_limits_of_the_picture():
    found = figure()
    axes = found.subfigs[0].axes[0]
    lines = [line.get_xydata().tolist() for line in axes.lines]
    assert [[0.1, 0.5], [0.21, 0.05]] in lines  # the front
    assert {"euler 4", "ab2 8", "4", "8"} <= {text.get_text() for text in axes.texts}
    assert {"euler", "ab2", "bf16: 0.01"} <= {
        text.get_text() for text in axes.get_legend().get_texts()
    }
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert axes.get_ylim()[0] < 0.01
    faces = [line.get_markerfacecolor() for line in axes.lines if line.get_marker() in "os"]
    assert faces.count("white") == 2  # in fp32
    assert "From $0.1 to 0.21 s" in found.subfigs[1].texts[0].get_text()


def test_errors_and_slopes_against_evaluations():
    found = viz.discretisation_figure({"toy": POINTS}, {"toy": 0.001})
    (axes,) = found.axes
    lines = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
    assert lines["euler"] == [[4, 0.5], [8, 0.25]]
    assert lines["order 1"][1][1] == pytest.approx(lines["order 1"][0][1] / 2)
    assert lines["order 2"][1][1] == pytest.approx(lines["order 2"][0][1] / 4)
    (unsure,) = axes.patches
    assert unsure.get_height() == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("points", "message"),
    [([], "no point"), ([FAST._replace(value=0.0)], "euler 4: 0.1 s and 0.0.*above 0")],
)
def test_what_cannot_be_drawn_is_refused(points, message):
    with pytest.raises(ValueError, match=message):
        figure(points=points)

"""Pictures of accuracy against time: what is drawn where, and the page without a network."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from r3dpa.viz.pareto import (
    ParetoPlot,
    ParetoPoint,
    discretisation_figure,
    pareto_figure,
    pareto_page,
    solver_colours,
)

EVIL = "</script><script>alert(1)</script>"


def point(solver, nfe, **changes):
    """Seconds grow with NFE, errors fall with its square."""
    value = 4 / nfe**2
    known = {"seconds": nfe / 10, "value": value, "low": 0.9 * value, "high": 1.1 * value}
    return ParetoPoint(
        **({"label": f"{solver} {nfe}", "solver": solver, "nfe": nfe} | known | changes)
    )


POINTS = tuple(point(s, n) for s in ("euler", "ab2") for n in (2, 4, 8, 16, 32, 64, 128, 256))
PLOT = ParetoPlot(
    "title",
    "error",
    POINTS,
    tuple(range(8, 16)),
    {"floor": 0.001, "published": 0.002},
    {nfe: nfe / 50 for nfe in (2, 4, 8, 16, 32, 64, 128, 256)},
    1e12,
    tuple(f"From {n} s to {2 * n} s: less, for {n} s more." for n in range(1, 8)),
)


def drawn(figure):
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return canvas


def texts(axes):
    return {text.get_text(): text for text in axes.texts}


def test_the_front_and_the_levels_are_where_they_belong():
    axes = pareto_figure(PLOT).axes[0]
    lines = [line.get_xydata() for line in axes.lines]
    front = np.array([[p.seconds, p.value] for p in POINTS[8:]])
    assert any(line.shape == front.shape and np.allclose(line, front) for line in lines)
    flat = {line[0][1] for line in lines if len(line) == 2 and line[0][1] == line[1][1]}
    assert {0.001, 0.002} <= flat
    assert {str(nfe) for nfe in PLOT.limits} <= texts(axes).keys()
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")


def test_open_markers_are_fp32():
    points = (point("ab2", 2), point("ab2", 4, filled=True))
    axes = pareto_figure(replace(PLOT, points=points, front=(0, 1))).axes[0]
    faces = [line.get_markerfacecolor() for line in axes.lines if line.get_marker() == "o"]
    assert faces == ["white", solver_colours(points)["ab2"]]


def test_the_legend_keeps_the_place_of_distilled_models():
    labels = [t.get_text() for t in pareto_figure(PLOT).axes[0].get_legend().get_texts()]
    assert "1-4 steps, distilled: not trained yet" in labels
    assert "floor: 0.001" in labels


def test_the_second_axis_is_work_at_the_peak():
    """1 TFLOP/s: as many TFLOP as seconds."""
    figure = pareto_figure(PLOT)
    drawn(figure)
    (second,) = figure.axes[0].child_axes
    np.testing.assert_allclose(second.get_xlim(), figure.axes[0].get_xlim(), rtol=1e-6)


def test_texts_do_not_lie_on_each_other():
    figure = pareto_figure(PLOT)
    renderer = drawn(figure).get_renderer()
    boxes = [t.get_window_extent(renderer) for a in figure.axes for t in a.texts if t.get_text()]
    boxes += [t.get_window_extent(renderer) for f in figure.subfigs for t in f.texts]
    boxes.append(figure.axes[0].get_legend().get_window_extent(renderer))
    for index, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[index + 1 :])
    whole = figure.bbox
    assert all(box.x0 >= 0 and box.x1 <= whole.x1 and box.y0 >= 0 for box in boxes)


def test_sentences_stand_under_the_picture():
    (written,) = pareto_figure(PLOT).subfigs[1].texts
    assert all(sentence in written.get_text() for sentence in PLOT.sentences)


def test_slopes_are_those_of_order_one_and_two():
    axes = discretisation_figure({"toy": POINTS}, {"toy": 1e-6}).axes[0]
    lines = {line.get_label(): line.get_xydata() for line in axes.lines}
    for order in (1, 2):
        nfe, error = np.log(lines[f"order {order}"].T)
        assert np.polyfit(nfe, error, 1)[0] == pytest.approx(-order)
    np.testing.assert_allclose(lines["ab2"], [[p.nfe, p.value] for p in POINTS[8:]])


@pytest.mark.parametrize(
    ("points", "message"),
    [((), "no point"), ((point("ab2", 2, value=0.0),), "ab2 2: 0.2 s and 0.0")],
)
def test_what_a_logarithm_cannot_show_is_refused(points, message):
    for draw in (pareto_figure, lambda plot: pareto_page([plot])):
        with pytest.raises(ValueError, match=message):
            draw(replace(PLOT, points=points, front=()))
    with pytest.raises(ValueError, match=message):
        discretisation_figure({"toy": points}, {})


def test_the_page_loads_nothing_and_holds_all_rows():
    page = pareto_page([replace(PLOT, title=EVIL), PLOT])
    assert not re.search(r"(src|href)\s*=|@import|url\(", page)
    assert page.count("<script") == 2
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1])
    assert [plot["title"] for plot in data["plots"]] == [EVIL, "title"]
    assert len(data["plots"][0]["points"]) == 16
    assert data["plots"][0]["sentences"] == list(PLOT.sentences)
    with pytest.raises(ValueError, match="at least one"):
        pareto_page([])


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
def test_the_script_of_the_page_is_valid(tmp_path):
    page = pareto_page([PLOT])
    script = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)[0]
    (tmp_path / "page.js").write_text(script)
    subprocess.run(["node", "--check", tmp_path / "page.js"], check=True, timeout=60)

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg

from r3dpa.geometry import LidarSensor
from r3dpa.viz import range_image_picture
from r3dpa.viz.evaluation import MAX_CELLS, bev_histograms, matches_figure, range_histogram

SENSOR = LidarSensor(beams=8, columns=32)


def panels(figure):
    """Axes with an image and no colour bar, by title."""
    return {a.get_title(): a for a in figure.axes if a.images and a.get_title()}


def value_at(axes, x_m, y_m):
    """Number drawn at a place of the scene; masked where nothing is drawn."""
    (image,) = axes.images
    left, right, bottom, top = image.get_extent()
    values = image.get_array()
    column = int((y_m - left) / (right - left) * values.shape[1])
    row = int((x_m - bottom) / (top - bottom) * values.shape[0])
    return values[row, column]


def test_bev_panels_hold_shares_and_their_difference():
    samples, references = np.zeros((4, 4)), np.zeros((4, 4))
    samples[3, 0] = 6  # far ahead, far right
    samples[0, 3] = 2  # far behind, far left
    references[3, 0] = 1
    references[1, 2] = 3
    shown = panels(bev_histograms(samples, torch.from_numpy(references), 2.0))
    places = [(1.5, -1.5), (-1.5, 1.5), (-0.5, 0.5)]
    assert [value_at(shown["samples"], *p) for p in places[:2]] == [0.75, 0.25]
    assert [value_at(shown["references"], *p) for p in places[::2]] == [0.25, 0.75]
    assert [value_at(shown["samples - references"], *p) for p in places] == [0.5, 0.25, -0.75]
    assert value_at(shown["samples"], -0.5, 0.5) is np.ma.masked
    assert shown["samples - references"].images[0].get_array().count() == 3
    common, other, difference = (axes.images[0].norm for axes in shown.values())
    assert common.vmax == other.vmax == difference.vmax == -difference.vmin == 0.75


def test_equal_bev_panels_are_drawn_forward_up_and_left_to_the_left():
    counts = np.zeros((4, 4))
    counts[3, 3] = 1  # ahead and left
    axes = panels(bev_histograms(counts, counts))["samples"]
    assert axes.get_xlim() == (50.0, -50.0)
    assert axes.get_ylim() == (-50.0, 50.0)
    figure = axes.get_figure()
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())[..., :3]
    corners = axes.transAxes.transform([(0.1, 0.9), (0.9, 0.9), (0.1, 0.1)]).astype(int)
    found = [picture[len(picture) - y, x].sum() > 100 for x, y in corners]
    assert found == [True, False, False]


def test_fine_bev_histograms_are_summed_without_loss():
    size = 2 * MAX_CELLS + 1  # blocks of 3, the last one cut off
    counts = np.random.default_rng(0).integers(1, 9, (size, size))
    axes = panels(bev_histograms(counts, counts, size / 2))["samples"]
    drawn = axes.images[0].get_array()
    assert max(drawn.shape) <= MAX_CELLS
    assert drawn.sum() == pytest.approx(1.0)
    assert value_at(axes, 4.5 - size / 2, 7.5 - size / 2) == pytest.approx(
        counts[3:6, 6:9].sum() / counts.sum()
    )
    assert axes.get_xlim() == (size / 2, -size / 2)


def test_range_densities_and_their_ratio_and_floor():
    halves = np.array([[1, 4, 0], [1, 4, 0]])
    figure = range_histogram(np.array([0, 1, 3, 4]), np.array([1, 2, 1]), halves.sum(0), halves)
    upper, lower = figure.axes
    drawn, ratio = ({p.get_label(): p.get_data() for p in a.patches} for a in (upper, lower))
    # shares 1/4 1/2 1/4 and 1/5 4/5 0 over bins of 1, 2, 1 m
    np.testing.assert_allclose(drawn["samples"].values, [0.25, 0.25, 0.25])
    np.testing.assert_allclose(drawn["references"].values, [0.2, 0.4, 0.0])
    np.testing.assert_allclose(drawn["samples"].edges, [0, 1, 3, 4])
    np.testing.assert_allclose(ratio["samples"].values, [1.25, 0.625, np.nan])


def test_floor_band_lies_between_the_halves():
    halves = np.array([[3, 1], [1, 3]])
    figure = range_histogram(np.arange(3.0), np.array([1, 1]), halves.sum(0), halves)
    for axes, low, high in zip(figure.axes, (0.25, 0.5), (0.75, 1.5), strict=True):
        (band,) = axes.collections
        corners = band.get_paths()[0].vertices
        assert set(np.round(corners[:, 1], 9)) == {low, high}
        assert (corners[:, 0].min(), corners[:, 0].max()) == (0.0, 2.0)


def test_matches_show_each_sample_above_its_nearest_scan():
    images = [torch.full((8, 32), range_m) for range_m in (5.0, 6.0, 20.0, 40.0)]
    figure = matches_figure([("a $x", *images[:2])], [("b", *images[2:])], SENSOR)
    strips = [axes for axes in figure.axes if axes.images]
    titles, real = [axes.get_title(loc="left") for axes in strips], "nearest real scan"
    assert titles == ["best: a $x: sample", real, "worst: b: sample", real]
    for axes, image in zip(strips, images, strict=True):
        np.testing.assert_array_equal(
            axes.images[0].get_array(), range_image_picture(image, SENSOR)
        )
